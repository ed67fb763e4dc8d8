"""Readings of a laser rangefinder."""

from __future__ import annotations

import numpy as np

from datasets_manifest.recipe.rigs import Rangefinder
from scenes.sampler import sample_frame, sample_rangefinder_m
from tests.support.recipe_builder import RecipeTable, build_recipe, stations

BASE: RecipeTable = {"name": "bench", "frames": {"count": 4}, "distance": stations(2.0, 3.0)}


def errors_m(rangefinder: Rangefinder, seed: int, count: int) -> np.ndarray:
    return np.array([sample_rangefinder_m(rangefinder, seed, index, 5.0) - 5.0 for index in range(count)])


def test_without_errors_it_reads_the_distance() -> None:
    perfect = Rangefinder(offset_m=0, noise_m=0, resolution_m=0)
    assert sample_rangefinder_m(perfect, 1, 0, 3.1234567) == 3.1234567


def test_noise_has_the_stated_spread_and_the_offset_stays() -> None:
    errors = errors_m(Rangefinder(offset_m=0.003, noise_m=0.001, resolution_m=0), 7, 4000)
    # A standard deviation from 4000 draws is known to 1.1 %, a mean to 0.016 mm.
    assert abs(errors.std() / 0.001 - 1) < 0.05
    np.testing.assert_allclose(errors[:2000].mean(), errors[2000:].mean(), atol=0.1e-3)
    assert abs(errors.mean()) < 0.003 + 0.1e-3


def test_offsets_of_datasets_spread_evenly_over_their_range() -> None:
    still = Rangefinder(offset_m=0.003, noise_m=0, resolution_m=0)
    offsets = np.array([errors_m(still, seed, 1)[0] for seed in range(1000)])
    assert np.abs(offsets).max() <= 0.003
    # A uniform spread has a standard deviation of 0.003 / sqrt(3); from 1000 draws it is known to 1.4 %.
    assert abs(offsets.std() / (0.003 / np.sqrt(3)) - 1) < 0.07


def test_readings_are_whole_steps_of_the_last_digit() -> None:
    readings = [sample_rangefinder_m(Rangefinder(resolution_m=0.001), 1, index, 4.0) for index in range(50)]
    assert readings == [round(reading, 3) for reading in readings]
    assert len(set(readings)) > 3


def test_a_rangefinder_changes_nothing_else_of_a_frame() -> None:
    plain, read = (sample_frame(recipe, 1) for recipe in (build_recipe(BASE), build_recipe(BASE, rangefinder={})))
    assert "rangefinder_reading_m" not in plain.model_dump(mode="json")
    table = read.model_dump(mode="json")
    reading_m = table.pop("rangefinder_reading_m")
    assert table == plain.model_dump(mode="json")
    # The offset, and six standard deviations of noise and rounding.
    assert abs(reading_m - 3.0) < 0.003 + 6 * 0.0011


def test_a_recipe_without_one_does_not_know_of_it() -> None:
    assert "rangefinder" not in build_recipe(BASE).model_dump(mode="json")


def test_a_frame_without_a_drogue_has_no_reading() -> None:
    recipe = build_recipe(BASE, frames={"empty_fraction": 1.0}, rangefinder={})
    assert sample_frame(recipe, 0).rangefinder_reading_m is None
