"""How much of an image's noise is the renderer's own, measured on pixels that were rendered twice."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.frame import FrameSpec
from render.sensor import MONO_WEIGHTS
from scenes.light import REC709_LUMINANCE

# Every so many pixels are rendered twice: a sixteenth more work, and some dozen pairs from the smallest drogue.
TWICE_EVERY = 16


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


NO_NOISE = MonteCarloNoise(0.0, 0.0)
"""Of an image without a drogue, and of an engine without sampling."""


def measure_noise(
    frame: FrameSpec, first: NDArray[np.float32], second: NDArray[np.float32], shared: NDArray[np.float32]
) -> MonteCarloNoise:
    """Noise of one estimate of pixels, from two independent ones.

    The lens averages over neighbours, whose errors are independent, and so leaves a known share of them; of an error
    that neighbours share it leaves all.

    Args:
        frame: with sensor and exposure.
        first, second: (P, 3) estimates of the same pixels, independent but for: [cd/m2]
        shared: (P, 3) what is known of the error that both have, and their neighbours with them. [cd/m2]
    """
    if not len(first):
        return NO_NOISE
    sensor = frame.sensor
    # float64: squares of 1e-5 of daylight matter in the sums.
    error, mean = (first - second).astype(np.float64) / np.sqrt(2), (first + second).astype(np.float64) / 2
    luminance = [values @ REC709_LUMINANCE for values in (error, shared, mean)]
    fraction = np.sqrt(np.sum(luminance[0] ** 2 + luminance[1] ** 2) / max(np.sum(luminance[2] ** 2), 1e-30))
    if sensor.color == "mono":
        error, shared, mean = (values @ MONO_WEIGHTS.T for values in (error, shared, mean))
    per_cd_m2 = sensor.electrons_per_cd_m2(frame.exposure)
    shot_and_read = np.mean(np.maximum(mean, 0.0)) * per_cd_m2 + sensor.read_noise_e**2
    left_by_lens = 1.0
    if sensor.psf_sigma_px > 0:
        reach = int(np.ceil(4 * sensor.psf_sigma_px))
        # Twice the square root of the kernel's energy along one axis: rows and columns.
        left_by_lens = float(np.sum(cv2.getGaussianKernel(2 * reach + 1, sensor.psf_sigma_px) ** 2))
    behind_lens = np.sqrt(np.mean((left_by_lens * error) ** 2 + shared**2))
    over_sensor = per_cd_m2 * behind_lens / np.sqrt(shot_and_read)
    return MonteCarloNoise(float(fraction), float(over_sensor))
