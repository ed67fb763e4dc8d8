"""The Kalman filter that predicts the next box."""

from __future__ import annotations

import numpy as np
import pytest

from nav.tracking.box_motion import BoxMotion
from nav.tracking.region import box_center, box_size

PERIOD_S = 0.04


def box_at(x: float, y: float, size: float) -> tuple[float, float, float, float]:
    return x - size / 2, y - size / 4, size, size / 2


def test_predictions_converge_for_constant_velocity() -> None:
    motion = BoxMotion(box_at(100, 200, 40), 0.0)
    for index in range(1, 60):
        motion.update(box_at(100 + 12 * index, 200 - 7 * index, 40 * 1.02**index), index * PERIOD_S)
    expected = motion.predict(60 * PERIOD_S).box
    # What is left of the first guess after 59 boxes is far below a thousandth of a pixel.
    np.testing.assert_allclose(expected, box_at(100 + 12 * 60, 200 - 7 * 60, 40 * 1.02**60), atol=1e-3)


def test_prediction_errors_match_their_standard_deviations() -> None:
    """A box that is pushed at random, as often and as hard as the filter believes, and measured with its noise."""
    rng = np.random.default_rng(3)
    acceleration, noise_px = 1.0e6, np.hypot(0.01 * 80, 0.3)
    steps = 20
    state, motion, ratios = np.array([0.0, 0.0]), BoxMotion(box_at(0, 0, 160), 0.0), []
    for index in range(1, 1500):
        for _ in range(steps):
            dt = PERIOD_S / steps
            state += np.array([state[1] * dt, np.sqrt(acceleration * dt) * rng.standard_normal()])
        measured = state[0] + noise_px * np.sqrt(2) * rng.standard_normal()
        expected = motion.predict(index * PERIOD_S)
        ratios.append((measured - box_center(expected.box)[0]) / expected.sd[0])
        motion.update(box_at(measured, 0, 160), index * PERIOD_S)
    # Noise is a hundredth of 160 * sqrt(1/2) px and 0.3 px; the variance of 1500 squares of unit variance scatters by
    # 4 %, and the pushes come in twenty steps instead of evenly.
    assert np.mean(np.square(ratios[50:])) == pytest.approx(1.0, abs=0.2)


def test_without_measurements_uncertainty_grows_and_the_shape_stays() -> None:
    motion = BoxMotion(box_at(100, 200, 40), 1.0)
    sds = np.array([motion.predict(1.0 + gap).sd for gap in (0.0, 0.04, 0.2, 1.0)])
    assert (np.diff(sds, axis=0) > 0).all()
    later = motion.predict(2.0).box
    assert later[2] / later[3] == pytest.approx(2.0)
    assert box_size(later) == pytest.approx(40 / np.sqrt(2))
    np.testing.assert_array_equal(motion.predict(0.0).box, motion.predict(1.0).box)
