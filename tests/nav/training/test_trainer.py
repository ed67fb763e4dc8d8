from __future__ import annotations

import numpy as np
import pytest

from nav.training.trainer import learning_rate
from nav.training.training_settings import TrainingSettings


def test_the_learning_rate_rises_then_falls_by_a_cosine() -> None:
    settings = TrainingSettings(
        image_passes=8800, batch_images=8, warmup_fraction=1 / 11, learning_rate=0.5, floor_fraction=0.02
    )
    rates = np.array([learning_rate(settings, step) for step in range(settings.steps + 1)])
    assert (np.diff(rates[:101]) > 0).all() and (np.diff(rates[100:]) < 0).all()
    assert rates[100] == pytest.approx(0.5) and rates[-1] == pytest.approx(0.01)
    assert rates[600] == pytest.approx(0.5 * 1.02 / 2)  # the middle of the cosine: half way between top and floor


@pytest.mark.parametrize("fraction", [0.0, 0.05, 0.5])
def test_equal_shares_of_a_short_and_a_long_training_have_equal_rates(fraction: float) -> None:
    short, long = (TrainingSettings(image_passes=passes, warmup_fraction=fraction) for passes in (1600, 160_000))
    shares = np.arange(0, short.steps, 5)
    slow = np.array([learning_rate(long, 100 * step) for step in shares])
    fast = np.array([learning_rate(short, step) for step in shares])
    # They differ by less than one step of the short training, of its ramp or of its cosine.
    assert np.abs(slow - fast).max() <= short.learning_rate / (fraction * short.steps or short.steps)
    assert fast.mean() == pytest.approx(slow.mean(), rel=0.02)
