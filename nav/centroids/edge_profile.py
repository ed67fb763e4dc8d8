"""The blurred edge of an ellipse and how it changes with the ellipse: what disc and annulus are drawn with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.se3 import Array
from nav.centroids.ellipses import shape_inverses
from nav.centroids.marker_signal import Array32

# Blur of the pixel's box (1/12 px^2) and of a lens and sensor with a Gaussian of 0.5 px: where the fit starts. [px]
START_WIDTH_PX = float(np.sqrt(0.25 + 1 / 12))
# Below this an edge lies within one pixel and its width says nothing. [px]
_SMALLEST_WIDTH_PX = 0.2
# Keeps the middle of the ellipse, where the distance has no gradient, finite.
_TINY = np.float32(1e-12)
# Of Abramowitz and Stegun's rational form of the error function, the coefficients halved.
_ERF_P = np.float32(0.3275911)
_ERF_HALVES = tuple(np.float32(a / 2) for a in (0.254829592, -0.284496736, 1.421413741, -1.453152027, 1.061405429))

# Of z^2. Beyond it S is 0 or 1 in single precision, and exp(-z^2) adds nothing to any sum. Left as it is, it and its
# products become denormal numbers a little further out, for each of which a processor takes a hundred times as long.
_FAR = np.float32(36)

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


def edge_profile(ellipse: Array, width_px: Array, x_px: Array32, y_px: Array32, slopes: Array32 | None = None) -> Edge:
    """`S = (1 + erf(D / (sqrt2 s))) / 2` with `D = (1 - q) / |grad q|`, `q = |L (x - c)|`.

    Args:
        ellipse: (N, 5) centre, then elements xx, yy, xy of the symmetric L.
        width_px: (N,) s.
        x_px, y_px: (N, K).
        slopes: (N, 5, K) to be filled with the slopes, None for a new array.
    """
    cx, cy, a, c, b = ellipse.astype(np.float32).T[:, :, None]
    s = np.maximum(width_px, _SMALLEST_WIDTH_PX)[:, None].astype(np.float32)
    dx, dy = x_px - cx, y_px - cy
    w0, w1 = a * dx + b * dy, b * dx + c * dy
    q = np.sqrt(w0 * w0 + w1 * w1 + _TINY)
    m0, m1 = a * w0 + b * w1, b * w0 + c * w1
    # |grad q| = |m| / q with m = L L (x - c); its derivative needs p = L m.
    inverse = 1 / np.sqrt(m0 * m0 + m1 * m1 + _TINY * (a * a + c * c))
    rest = 1 - q
    distance = q * rest * inverse
    by_q = (rest - q) * inverse / q
    by_gradient = distance * inverse * inverse
    h0, h1 = by_gradient * m0, by_gradient * m1
    g0 = by_q * w0 - (a * h0 + b * h1)
    g1 = by_q * w1 - (b * h0 + c * h1)
    if slopes is None:
        slopes = np.empty((len(ellipse), ELLIPSE_PARAMETERS, x_px.shape[1]), np.float32)
    np.subtract(-a * g0, b * g1, out=slopes[:, 0])
    np.subtract(-b * g0, c * g1, out=slopes[:, 1])
    np.subtract(g0 * dx, h0 * w0, out=slopes[:, 2])
    np.subtract(g1 * dy, h1 * w1, out=slopes[:, 3])
    np.subtract(g0 * dy + g1 * dx, h0 * w1 + h1 * w0, out=slopes[:, 4])
    inside, bell = blurred_step(distance * (np.float32(np.sqrt(0.5)) / s))
    bell *= np.float32(1 / np.sqrt(2 * np.pi)) / s
    return Edge(inside, bell, distance, slopes)


def blurred_step(z: Array32) -> tuple[Array32, Array32]:
    """`(1 + erf(z)) / 2` to 2.5e-7, single precision's rounding included, and `exp(-z^2)`, which it is made of.

    The latter is zero where it is smaller than 2.4e-16.

    Three to six times as fast as an error function that is exact to the last bit. Both sides of the step are alike.

    Source: M. Abramowitz and I. Stegun, Handbook of Mathematical Functions, 7.1.26.
    """
    bell: Array32 = z * z
    np.copyto(bell, np.inf, where=bell > _FAR)
    np.negative(bell, out=bell)
    np.exp(bell, out=bell)
    t = np.abs(z)
    t *= _ERF_P
    t += 1
    np.reciprocal(t, out=t)
    step: Array32 = _ERF_HALVES[-1] * t
    for coefficient in _ERF_HALVES[-2::-1]:
        step += coefficient
        step *= t
    step *= bell
    np.subtract(np.float32(0.5), step, out=step)
    np.copysign(step, z, out=step)
    step += np.float32(0.5)
    return step, bell


def ellipse_parameters(offsets_px: Array, shapes_px: Array) -> Array:
    """(N, 5) parameters of ellipses with centres (N, 2) and shapes (N, 2, 2)."""
    inverse = shape_inverses(shapes_px)
    return np.column_stack([offsets_px, inverse[:, 0, 0], inverse[:, 1, 1], inverse[:, 0, 1]])


def parameter_shapes(ellipse: Array) -> Array:
    """(N, 2, 2) shapes of ellipses with parameters (N, 5)."""
    return shape_inverses(np.stack([ellipse[:, [2, 4]], ellipse[:, [4, 3]]], axis=1))
