"""The lens: blur of radiance after the pixel's box."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# Beyond four sigma the Gaussian holds less than 1e-4 of the light.
_KERNEL_REACH_SIGMA = 4.0


def blur(radiance: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """Gaussian point spread of lens and pixel crosstalk.

    Args:
        radiance: (H, W, C), box-sampled.
        sigma_px: standard deviation. [px]
    """
    if sigma_px == 0:
        return radiance
    reach = int(np.ceil(_KERNEL_REACH_SIGMA * sigma_px))
    kernel = cv2.getGaussianKernel(2 * reach + 1, sigma_px, cv2.CV_32F)
    blurred: NDArray[np.float32] = cv2.sepFilter2D(
        radiance, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REPLICATE
    )
    return blurred
