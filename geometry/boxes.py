"""Intersection and intersection over union of boxes (x, y of the low corner, width, height). [px]"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from geometry.se3 import Array


def intersection_area(first: ArrayLike, second: ArrayLike) -> Array:
    """Area of the intersection of boxes.

    Args:
        first, second: (..., 4), broadcast against each other.

    Returns:
        (...) [px^2]
    """
    one, other = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    low = np.maximum(one[..., :2], other[..., :2])
    high = np.minimum(one[..., :2] + one[..., 2:], other[..., :2] + other[..., 2:])
    sides = np.maximum(high - low, 0.0)
    area: Array = sides[..., 0] * sides[..., 1]
    return area


def intersection_over_union(first: ArrayLike, second: ArrayLike) -> Array:
    """Intersection over union of boxes.

    Args:
        first, second: (..., 4), broadcast against each other.

    Returns:
        (...) from 0 to 1; 0 where a box has no area or is NaN.
    """
    one, other = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    shared = intersection_area(one, other)
    union = one[..., 2] * one[..., 3] + other[..., 2] * other[..., 3] - shared
    ratio = np.divide(shared, union, out=np.zeros_like(union), where=union > 0)
    # Rounding errors can exceed 1 for equal boxes.
    fractions: Array = np.minimum(np.nan_to_num(ratio, nan=0.0), 1.0)
    return fractions
