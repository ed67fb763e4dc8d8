"""Bilinear sampling of images that gives the same values with every release of OpenCV."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def sample_bilinear(
    image: NDArray[Any], column: NDArray[np.float32], row: NDArray[np.float32], border: int = cv2.BORDER_CONSTANT
) -> NDArray[Any]:
    """Values of an image between its pixels.

    OpenCV 4 rounds positions to 1/32 of a pixel, OpenCV 5 does not. Maps of fixed point do it in both, bit for bit as
    version 4 does with maps of float32.

    Args:
        image: (H, W) or (H, W, C) of uint8 or float32, H and W up to 32767.
        column, row: (h, w) positions, h and w up to 32767. [px]
        border: OpenCV's border mode; by default it is zero outside.

    Returns:
        (h, w) or (h, w, C) of the image's type.

    Source: OpenCV, `convertMaps` and `remap`.
    """
    fixed = cv2.convertMaps(column, row, cv2.CV_16SC2)
    sampled: NDArray[Any] = cv2.remap(image, *fixed, cv2.INTER_LINEAR, borderMode=border)
    return sampled
