"""Noise from pairs of pictures, and the search for the samples that reach a noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from studies.render_cost.noise_search import NoiseEstimate, noise_of, reach_noise, relative_noise, samples_for


def test_noise_of_two_pictures_is_that_of_one() -> None:
    rng = np.random.default_rng(1)
    one, other = 50.0 + 2.0 * rng.standard_normal((2, 200, 200))
    # 40,000 pixels: the standard error of a standard deviation is 1/sqrt(80,000) of it, 0.35 %; four of them.
    assert relative_noise(one, other, np.ones((200, 200), dtype=bool)) == pytest.approx(0.04, rel=0.015)


def test_only_pixels_of_the_masks_count() -> None:
    one, other = np.full((4, 4), 3.0), np.full((4, 4), 5.0)
    one[0], other[0] = 4.0, 4.0
    first_row = np.zeros((4, 4), dtype=bool)
    first_row[0] = True
    found = noise_of(7, (one, other), (np.ones((4, 4), dtype=bool), first_row))
    # Twelve of sixteen pixels differ by 2: sqrt(12 / 16 * 4 / 2) over a mean of 4.
    assert found.noise == pytest.approx(np.sqrt(1.5) / 4)
    assert (found.noise_inside, found.mean_cd_m2, found.samples) == (0.0, 4.0, 7)


def renderer(power: float, tried: list[int]) -> Callable[..., Any]:  # type: ignore[no-untyped-def]
    """Noise that falls with a power of the samples, 0.4 at one."""

    def measure(samples: int) -> NoiseEstimate:
        tried.append(samples)
        return NoiseEstimate(samples, 0.4 * samples**-power, 0.2 * samples**-power, 1.0)

    return measure


def test_the_square_root_law_needs_a_pilot_and_one_check() -> None:
    tried: list[int] = []
    found = reach_noise(renderer(0.5, tried), 0.05, pilot=4, most_samples=1000)
    assert tried == [4, 64] and found.samples == 64 and not found.is_carried_on


def test_beyond_the_most_samples_the_law_is_taken_at_its_word() -> None:
    tried: list[int] = []
    found = reach_noise(renderer(0.5, tried), 0.01, pilot=4, most_samples=100)
    assert max(tried) == 100 and found.samples == 1600 and found.is_carried_on
    assert found.noise == pytest.approx(0.01) and found.noise_inside == pytest.approx(0.005)


def test_a_noise_below_the_one_asked_for_with_one_sample_stands() -> None:
    tried: list[int] = []
    found = reach_noise(renderer(0.5, tried), 0.8, pilot=4, most_samples=100)
    assert tried == [4, 1] and found.samples == 1 and not found.is_carried_on


def test_samples_are_never_fewer_than_one() -> None:
    assert samples_for(NoiseEstimate(4, 0.01, 0.01, 1.0), 1.0) == 1
