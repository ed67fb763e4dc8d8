"""Where a drogue points while its hose and the wind turn."""

from __future__ import annotations

import numpy as np

from scenes.flight.towed_hose import mouth_directions


def test_the_drogue_points_with_a_lag_of_its_own() -> None:
    period_s = 0.02
    link = np.tile([1.0, 0.0, 0.0], (100, 1))
    wind = 50.0 * link
    wind[1:] = 50.0 * np.array([np.cos(0.1), np.sin(0.1), 0.0])
    lagged = mouth_directions(wind, link, period_s)
    wanted = 0.7 * np.array([np.cos(0.1), np.sin(0.1)]) + 0.3 * np.array([1.0, 0.0])
    wanted /= np.linalg.norm(wanted)
    # First order with 0.15 s, by its differential equation: the step is a ramp over the first period.
    time_s = period_s * np.arange(1, 100)
    ramp = 1 - 0.15 / period_s * (np.exp(period_s / 0.15) - 1) * np.exp(-time_s / 0.15)
    # The relative weight of wind against still air, 1 - 1/sqrt(1 + 1/50^2), changes the direction by 1e-5.
    np.testing.assert_allclose(lagged[1:, 1], wanted[1] * ramp, atol=1e-5)
