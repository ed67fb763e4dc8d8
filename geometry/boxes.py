"""Boxes as (x, y of the low corner, width, height): what two of them share. [px]"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from geometry.se3 import Array


def intersection_area(first: ArrayLike, second: ArrayLike) -> Array:
    """Area that boxes share.

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
    """Shared area over the area of both.

    Args:
        first, second: (..., 4), broadcast against each other.

    Returns:
        (...) from 0 to 1; 0 where a box has no area or is not a number.
    """
    one, other = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    shared = intersection_area(one, other)
    union = one[..., 2] * one[..., 3] + other[..., 2] * other[..., 3] - shared
    ratio = np.divide(shared, union, out=np.zeros_like(union), where=union > 0)
    # Rounding takes equal boxes beyond 1.
    fractions: Array = np.minimum(np.nan_to_num(ratio, nan=0.0), 1.0)
    return fractions
