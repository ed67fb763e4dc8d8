"""The parameters of a blurred elliptic edge, and the step across it; `nav.centroids.edge_pictures` draws them."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.centroids.edge_pictures import blurred_steps
from nav.centroids.ellipses import shape_inverses
from nav.numerics.compiled import Array32

# Blur of the pixel's box (1/12 px^2) and of a lens and sensor with a Gaussian of 0.5 px: where the fit starts. [px]
START_WIDTH_PX = float(np.sqrt(0.25 + 1 / 12))
# Below this an edge lies within one pixel and its width says nothing. [px]
_SMALLEST_WIDTH_PX = 0.2


def edge_widths(width_px: Array) -> Array32:
    """(N,) widths as an edge is drawn with them: within one pixel it says nothing. [px]"""
    return np.maximum(width_px, _SMALLEST_WIDTH_PX).astype(np.float32)


def blurred_step(z: Array32) -> tuple[Array32, Array32]:
    """`(1 + erf(z)) / 2` to 2.5e-7, single precision's rounding included, and `exp(-z^2)`, which it is made of.

    The latter is zero where it is smaller than 2.4e-16.

    Both sides of the step are alike.

    Source: M. Abramowitz and I. Stegun, Handbook of Mathematical Functions, 7.1.26.
    """
    step, bell = np.empty_like(z), np.empty_like(z)
    blurred_steps(z.ravel(), np.float32(1), step.ravel(), bell.ravel())
    return step, bell


def ellipse_parameters(offsets_px: Array, shapes_px: Array) -> Array:
    """(N, 5) parameters of ellipses with centres (N, 2) and shapes (N, 2, 2)."""
    inverse = shape_inverses(shapes_px)
    return np.column_stack([offsets_px, inverse[:, 0, 0], inverse[:, 1, 1], inverse[:, 0, 1]])


def parameter_shapes(ellipse: Array) -> Array:
    """(N, 2, 2) shapes of ellipses with parameters (N, 5)."""
    return shape_inverses(np.stack([ellipse[:, [2, 4]], ellipse[:, [4, 3]]], axis=1))
