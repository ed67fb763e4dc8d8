"""Connected bright regions of a binary picture, as arrays."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array

# A filled ellipse covers pi/4 = 0.785 of its box; squares of a few pixels cover all of it, a ring or a crescent half.
_LEAST_FILL = 0.55
_MOST_ELONGATED = 2.5


@dataclass(frozen=True, eq=False)
class Blobs:
    """Regions of one image.

    Attributes:
        centers_px: (M, 2) centres of mass.
        areas_px2: (M,) numbers of pixels.
    """

    centers_px: Array
    areas_px2: Array

    @property
    def radii_px(self) -> Array:
        """(M,) radii of the circles of the same area. [px]"""
        radii: Array = np.sqrt(self.areas_px2 / np.pi)
        return radii

    def __len__(self) -> int:
        return len(self.areas_px2)


def disc_like_blobs(mask: NDArray[np.uint8], least_area_px2: float, most: int) -> Blobs:
    """Regions that may be images of discs: compact, filled, clear of the picture's edge.

    Args:
        mask: (H, W), nonzero inside.
        least_area_px2: smaller ones are noise.
        most: number of the largest regions to keep; the time of the matching grows with its square.

    Returns:
        Blobs in descending order of area.
    """
    _, _, stats, centers = cv2.connectedComponentsWithStats(mask, connectivity=8)
    left, top, width, height, area = (stats[1:, column] for column in range(5))
    rows, columns = mask.shape
    inside = (left > 0) & (top > 0) & (left + width < columns) & (top + height < rows)
    compact = (width <= _MOST_ELONGATED * height) & (height <= _MOST_ELONGATED * width)
    filled = area >= _LEAST_FILL * width * height
    keep = np.flatnonzero(inside & compact & filled & (area >= least_area_px2))
    keep = keep[np.argsort(-area[keep], kind="stable")][:most]
    return Blobs(centers[1:][keep].astype(np.float64), area[keep].astype(np.float64))
