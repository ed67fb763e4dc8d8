"""The simplest loops, over one row of pixels, that the other compiled ones call.

Caches of those others do not see a change here (`nav.numerics.compiled`): delete `__pycache__` after one.
"""

from __future__ import annotations

import numpy as np

from nav.numerics.compiled import Array32, compiled


@compiled
def multiply_rows(left: Array32, right: Array32, factor: np.float32, product: Array32) -> None:
    """Fill `product` with the factor times left times right."""
    for k in range(len(left)):
        product[k] = factor * left[k] * right[k]


@compiled
def add_row(values: Array32, factor: np.float32, total: Array32) -> None:
    """Add the factor times the values to a total."""
    for k in range(len(values)):
        total[k] += factor * values[k]


@compiled
def dot(left: Array32, right: Array32) -> np.float32:
    """Sum of products."""
    total = np.float32(0)
    for k in range(len(left)):
        total += left[k] * right[k]
    return total
