"""Monte-Carlo noise of the renderer, measured on pixels that were rendered twice."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from render.camera.sensor import MONO_WEIGHTS
from scenes.sky.photometry import REC709_LUMINANCE

# One pixel in so many is rendered twice: a sixteenth more work, and some dozens of pairs on the smallest drogue.
DUPLICATE_EVERY = 16


@dataclass(frozen=True)
class MonteCarloNoise:
    """Noise of the renderer on pixels of the drogue.

    Attributes:
        fraction: root mean square error of luminance over root mean square luminance.
        over_sensor: root mean square error of the sensor's electrons over the standard deviation of shot and read
            noise, both behind the lens.
    """

    fraction: float
    over_sensor: float


NO_NOISE = MonteCarloNoise(fraction=0.0, over_sensor=0.0)
"""Noise of an image without a drogue, and of an engine without sampling."""


@dataclass(frozen=True, eq=False)
class SensorNoise:
    """How the sensor of a frame responds to light and to its errors.

    Attributes:
        weights: (3, C) weights of the three bands in each of the sensor's channels.
        per_cd_m2: electrons per luminance. [e- m2/cd]
        read_noise_e: standard deviation of the read noise. [e-]
        left_by_lens: share of independent errors of neighbouring pixels that is left behind the lens.
    """

    weights: NDArray[np.float64]
    per_cd_m2: float
    read_noise_e: float
    left_by_lens: float

    @classmethod
    def of(cls, frame: FrameSpec) -> SensorNoise:
        """The noise of a frame's sensor at its exposure."""
        sensor = frame.sensor
        left_by_lens = 1.0
        if sensor.psf_sigma_px > 0:
            reach = int(np.ceil(4 * sensor.psf_sigma_px))
            # The root of the kernel's energy, once for the rows and once for the columns.
            left_by_lens = float(np.sum(cv2.getGaussianKernel(2 * reach + 1, sensor.psf_sigma_px) ** 2))
        weights = MONO_WEIGHTS.T.astype(np.float64) if sensor.color == "mono" else np.eye(3)
        return cls(
            weights=weights,
            per_cd_m2=sensor.electrons_per_cd_m2(frame.exposure),
            read_noise_e=sensor.read_noise_e,
            left_by_lens=left_by_lens,
        )

    def variance(self, mean: NDArray[np.float64]) -> float:
        """Variance of shot and read noise for (P, 3) light on average. [cd2/m4]"""
        electrons = float(np.mean(np.maximum(mean @ self.weights, 0.0))) * self.per_cd_m2
        return (electrons + self.read_noise_e**2) / self.per_cd_m2**2


def measure_noise(
    frame: FrameSpec, first: NDArray[np.float32], second: NDArray[np.float32], shared: NDArray[np.float32]
) -> MonteCarloNoise:
    """Noise of one estimate of pixels, from two independent ones.

    The lens averages over neighbours, which leaves a known share of independent errors, and all of an error that
    neighbours have in common.

    Args:
        frame: gives sensor and exposure.
        first, second: (P, 3) estimates of the same pixels, independent apart from the shared error. [cd/m2]
        shared: (P, 3) known error that both estimates and the neighbouring pixels have in common. [cd/m2]
    """
    if not len(first):
        return NO_NOISE
    # float64: squares of 1e-5 of daylight matter in the sums.
    error, mean = (first - second).astype(np.float64) / np.sqrt(2), (first + second).astype(np.float64) / 2
    luminance = [values @ REC709_LUMINANCE for values in (error, shared, mean)]
    fraction = np.sqrt(np.sum(luminance[0] ** 2 + luminance[1] ** 2) / max(np.sum(luminance[2] ** 2), 1e-30))
    sensor = SensorNoise.of(frame)
    behind_lens = np.mean((sensor.left_by_lens * error @ sensor.weights) ** 2 + (shared @ sensor.weights) ** 2)
    return MonteCarloNoise(fraction=float(fraction), over_sensor=float(np.sqrt(behind_lens / sensor.variance(mean))))
