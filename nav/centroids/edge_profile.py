"""The blurred edge of an ellipse and how it changes with the ellipse: what disc and annulus are drawn with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from geometry.se3 import Array
from nav.centroids.marker_signal import Array32

# Blur of the pixel's box (1/12 px^2) and of a lens and sensor with a Gaussian of 0.5 px: where the fit starts. [px]
START_WIDTH_PX = float(np.sqrt(0.25 + 1 / 12))
# Below this an edge lies within one pixel and its width says nothing. [px]
_SMALLEST_WIDTH_PX = 0.2
# Keeps the middle of the ellipse, where the distance has no gradient, finite.
_TINY = np.float32(1e-12)

# Centre x, y; elements xx, yy, xy of the inverse shape.
ELLIPSE_PARAMETERS = 5


@dataclass(frozen=True, eq=False)
class Edge:
    """An edge at the pixels of N patches.

    Attributes:
        inside: (N, K) share S of the light that comes from within.
        density: (N, K) dS/dD. [1/px]
        distance_px: (N, K) distance D inwards from the edge.
        slopes: (N, 5, K) dD by the ellipse's parameters.
    """

    inside: Array32
    density: Array32
    distance_px: Array32
    slopes: Array32

    def take(self, patches: slice) -> Edge:
        """The edge at some of the patches."""
        return Edge(self.inside[patches], self.density[patches], self.distance_px[patches], self.slopes[patches])


def edge_profile(ellipse: Array, width_px: Array, x_px: Array32, y_px: Array32) -> Edge:
    """`S = (1 + erf(D / (sqrt2 s))) / 2` with `D = (1 - q) / |grad q|`, `q = |L (x - c)|`.

    Args:
        ellipse: (N, 5) centre, then elements xx, yy, xy of the symmetric L.
        width_px: (N,) s.
        x_px, y_px: (N, K).
    """
    cx, cy, a, c, b = (ellipse[:, i, None].astype(np.float32) for i in range(ELLIPSE_PARAMETERS))
    s = np.maximum(width_px, _SMALLEST_WIDTH_PX)[:, None].astype(np.float32)
    dx, dy = x_px - cx, y_px - cy
    w0, w1 = a * dx + b * dy, b * dx + c * dy
    q = np.sqrt(w0 * w0 + w1 * w1 + _TINY)
    m0, m1 = a * w0 + b * w1, b * w0 + c * w1
    # |grad q| = |m| / q with m = L L (x - c); its derivative needs p = L m.
    inverse = 1 / np.sqrt(m0 * m0 + m1 * m1 + _TINY * (a * a + c * c))
    p0, p1 = a * m0 + b * m1, b * m0 + c * m1
    distance = q * (1 - q) * inverse
    by_q = (1 - 2 * q) * inverse / q
    by_gradient = distance * inverse * inverse
    slopes = np.empty((len(ellipse), ELLIPSE_PARAMETERS, x_px.shape[1]), np.float32)
    slopes[:, 0] = by_gradient * (a * p0 + b * p1) - by_q * m0
    slopes[:, 1] = by_gradient * (b * p0 + c * p1) - by_q * m1
    slopes[:, 2] = by_q * w0 * dx - by_gradient * (m0 * w0 + p0 * dx)
    slopes[:, 3] = by_q * w1 * dy - by_gradient * (m1 * w1 + p1 * dy)
    slopes[:, 4] = by_q * (w0 * dy + w1 * dx) - by_gradient * (m0 * w1 + m1 * w0 + p0 * dy + p1 * dx)
    z = distance * (np.float32(np.sqrt(0.5)) / s)
    inside = np.float32(0.5) + np.float32(0.5) * erf(z)
    density = np.exp(-z * z) * (np.float32(1 / np.sqrt(2 * np.pi)) / s)
    return Edge(inside, density, distance, slopes)


def ellipse_parameters(offsets_px: Array, shapes_px: Array) -> Array:
    """(N, 5) parameters of ellipses with centres (N, 2) and shapes (N, 2, 2)."""
    inverse = np.linalg.inv(shapes_px)
    return np.column_stack([offsets_px, inverse[:, 0, 0], inverse[:, 1, 1], inverse[:, 0, 1]])


def parameter_shapes(ellipse: Array) -> Array:
    """(N, 2, 2) shapes of ellipses with parameters (N, 5)."""
    inverse = np.stack([ellipse[:, [2, 4]], ellipse[:, [4, 3]]], axis=1)
    shapes: Array = np.linalg.inv(inverse)
    return shapes
