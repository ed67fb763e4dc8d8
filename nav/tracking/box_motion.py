"""Prediction of the next box: a Kalman filter of constant velocity for centre and log-scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.se3 import Array
from nav.tracking.region import Box, box_center, box_from_center, box_size

# Standard deviation of the initial velocity, in x, y [px/s] and log-scale [1/s]: three of it are 60 px at 25 Hz.
_INITIAL_RATE_SD = np.array([500.0, 500.0, 0.3])
# Density of white acceleration [px^2/s^3, 1/s^3]: 8 px and half a percent from pair to pair at 25 Hz.
# Boxes of `docking-10m` in light turbulence leave constant velocity by 1.3 px (5 at most).
_ACCELERATION = np.array([1.0e6, 1.0e6, 0.4])
# Standard deviations of a measured box: a share of its size, and pixels.
_NOISE_FRACTION = np.array([0.01, 0.01, 0.01])
_NOISE_PX = 0.3


@dataclass(frozen=True, eq=False)
class PredictedBox:
    """A predicted box.

    Attributes:
        box: the prediction.
        sd: (3,) standard deviations of the innovation: x, y [px] and log-scale.
    """

    box: Box
    sd: Array


class BoxMotion:
    """Kalman filter of one box."""

    def __init__(self, box: Box, time_s: float) -> None:
        """Start at rest, with a large variance of the velocity."""
        self._time_s = time_s
        self._shape = box
        self._mean = np.stack([_box_vector(box), np.zeros(3)])
        self._covariance = np.zeros((3, 2, 2))
        self._covariance[:, 0, 0] = _noise_variance(box)
        self._covariance[:, 1, 1] = _INITIAL_RATE_SD**2

    def predict(self, time_s: float, predicted: Box | None = None, sd_px: float | None = None) -> PredictedBox:
        """Predict the box at a time; does not change the filter.

        Args:
            time_s: that time. [s]
            predicted: a better prediction of the box, which replaces the filter's own.
            sd_px: standard deviation of its centre, which replaces the filter's own. [px]
        """
        mean, covariance = self._at(time_s)
        scale = float(np.exp(mean[0, 2])) / box_size(self._shape)
        box = box_from_center(mean[0, :2], self._shape[2] * scale, self._shape[3] * scale)
        sd = np.sqrt(covariance[:, 0, 0] + _noise_variance(box))
        if sd_px is not None:
            sd[:2] = sd_px
        return PredictedBox(box if predicted is None else predicted, sd)

    def update(self, box: Box, time_s: float) -> None:
        """Update by a measured box; several boxes of one time are combined."""
        mean, covariance = self._at(time_s)
        gain = covariance[:, :, 0] / (covariance[:, 0, 0] + _noise_variance(box))[:, None]
        self._mean = mean + (gain * (_box_vector(box) - mean[0])[:, None]).T
        self._covariance = covariance - gain[:, :, None] * covariance[:, None, 0, :]
        self._shape, self._time_s = box, max(time_s, self._time_s)

    def _at(self, time_s: float) -> tuple[Array, Array]:
        """Mean (2, 3) and covariance (3, 2, 2) of value and rate at a time; past times get the current ones."""
        step = max(0.0, time_s - self._time_s)
        forward = np.array([[1.0, step], [0.0, 1.0]])
        noise = np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
        return forward @ self._mean, forward @ self._covariance @ forward.T + _ACCELERATION[:, None, None] * noise


def _box_vector(box: Box) -> Array:
    return np.append(box_center(box), np.log(box_size(box)))


def _noise_variance(box: Box) -> Array:
    """(3,) variances of x, y [px^2] and log-scale of a measured box."""
    size = box_size(box)
    variance: Array = (_NOISE_FRACTION * (size, size, 1)) ** 2 + np.array([_NOISE_PX, _NOISE_PX, _NOISE_PX / size]) ** 2
    return variance
