"""Irregular motion as a sum of drawn sines: known at any time, with its rate, without a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from geometry.se3 import Array

_SINES = 8


@dataclass(frozen=True)
class Oscillation:
    """A sum of sines along several axes.

    Attributes:
        amplitudes: (A,) of each sine, the same for all of an axis.
        rates_rad_s: (A, N) angular frequencies. [rad/s]
        phases_rad: (A, N). [rad]
    """

    amplitudes: Array
    rates_rad_s: Array
    phases_rad: Array

    def at(self, time_s: ArrayLike) -> Array:
        """(..., A) values at (...) times."""
        time = np.asarray(time_s, dtype=np.float64)[..., None, None]
        value: Array = self.amplitudes * np.sin(self.rates_rad_s * time + self.phases_rad).sum(axis=-1)
        return value


def sample_oscillation(rng: np.random.Generator, sd: ArrayLike, low_hz: float, high_hz: float) -> Oscillation:
    """Draw one.

    Args:
        rng: draws frequencies, one in each of equal parts of the band, and phases.
        sd: (A,) standard deviation of each axis.
        low_hz, high_hz: the band. [Hz]
    """
    deviations = np.asarray(sd, dtype=np.float64)
    shape = (len(deviations), _SINES)
    steps = (np.arange(_SINES) + rng.random(shape)) / _SINES
    rates = 2 * np.pi * (low_hz + (high_hz - low_hz) * steps)
    phases = rng.uniform(0.0, 2 * np.pi, shape)
    return Oscillation(deviations * np.sqrt(2.0 / _SINES), rates, phases)
