from __future__ import annotations

import numpy as np
import pytest

from nav.training.trainer import learning_rate
from nav.training.training_settings import TrainingSettings


def test_the_learning_rate_rises_then_falls_by_a_cosine() -> None:
    settings = TrainingSettings(
        image_passes=8800, batch_images=8, warmup_passes=800, learning_rate=0.5, floor_fraction=0.02
    )
    rates = np.array([learning_rate(settings, step) for step in range(settings.steps + 1)])
    assert (np.diff(rates[:101]) > 0).all() and (np.diff(rates[100:]) < 0).all()
    assert rates[100] == pytest.approx(0.5) and rates[-1] == pytest.approx(0.01)
    assert rates[600] == pytest.approx(0.5 * 1.02 / 2)  # the middle of the cosine: half way between top and floor
