"""What a pixel takes of the light beside it: how the edges of a frame depart from the blur of a Gaussian.

A pixel takes the light of a square, and a share of what falls on its eight neighbours: across an edge that is no
Gaussian, and along an image axis another shape than across the corners. A Gaussian in its place moves centres by a
thousandth of a pixel or two, differently by where in its pixel the edge lies, as much as the noise of bright days.
"""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.centroids.edge_profile import ELLIPSE_PARAMETERS
from nav.centroids.least_squares import Minimum
from nav.centroids.marker_signal import Array32
from nav.centroids.patches import PixelSet

# Shares of light from within between which an edge is seen.
_SEEN = (1e-3, 1 - 1e-3)
# Sides of the pixel and its neighbours, from its middle. [px]
_SIDES_PX = np.array([-1.5, -0.5, 0.5, 1.5], np.float32)
# Edges nearer to an image axis are taken as this far from it (sine of the angle): the closed form divides by it.
_LEAST_SINE = np.float32(0.05)
# Of a normal matrix with unit diagonal: shapes that light too dim cannot tell apart are shared out between them.
_RIDGE = 1e-3
_SHAPES = 3


def without_pixel_response(fit: Minimum, pixels: PixelSet, inside: Array32, contrast: Array) -> tuple[Minimum, Array32]:
    """A fit of Gaussian edges, corrected for the frame's own shape of edges.

    The edge is a mixture of the Gaussian, of the pixel's own box, and of the boxes beside it and across its corners.
    Their shares are one for all outlines of the frame. All are alike on opposite sides of an outline, so that fitting
    them takes nothing from what is known of a centre.

    Args:
        fit: of N outlines, its first parameters those of the ellipse.
        pixels: of the outlines.
        inside: (N, K) share of the light from within.
        contrast: (N,) step of light at the edge. [DN]

    Returns:
        The fit after one linear step with the shares free, and (N, K) what the data have beyond Gaussian edges.
    """
    weights = pixels.present
    edge = (inside > _SEEN[0]) & (inside < _SEEN[1]) & (weights > 0)
    counts = edge.sum(axis=1)
    ellipses = np.repeat(fit.parameters[:, :ELLIPSE_PARAMETERS].astype(np.float32), counts, axis=0)
    steps = box_edges(ellipses, pixels.x_px[edge], pixels.y_px[edge])
    steps -= inside[edge]
    steps *= np.repeat(contrast.astype(np.float32), counts)
    shapes = np.zeros((len(weights), _SHAPES, weights.shape[1]), np.float32)
    for shape, step in enumerate(steps):
        shapes[:, shape][edge] = step
    weighted = (shapes * weights[:, None]).transpose(0, 2, 1)
    coupled = np.matmul(fit.jacobian, weighted).astype(np.float64)
    taken = np.matmul(fit.covariance(), coupled)
    slopes = np.matmul(fit.jacobian, (weights * fit.residuals)[:, :, None])[..., 0].astype(np.float64)
    along = np.einsum("nks,nk->s", weighted, fit.residuals) - np.einsum("nps,np->s", taken, slopes)
    own = np.matmul(shapes, weighted) - np.matmul(coupled.transpose(0, 2, 1), taken)
    shares = _solved(own.sum(axis=0), along)
    beyond: Array32 = np.matmul(shares.astype(np.float32), shapes)
    return fit.given(fit.residuals - beyond, weights), beyond


def _solved(normal: Array, gradient: Array) -> Array:
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), np.finfo(np.float32).tiny))
    unit = normal * scale[:, None] * scale + _RIDGE * np.eye(len(scale))
    shares: Array = scale * np.linalg.solve(unit, gradient * scale)
    return shares


def box_edges(ellipse: Array32, x_px: Array32, y_px: Array32) -> Array32:
    """(3, E) light from within that a pixel's own box takes, those beside it, and those across its corners.

    The outline is a straight line across the nine boxes. What a box takes is the second difference, by both its sides,
    of the half square of the distance inwards.

    Args:
        ellipse: (E, 5) of each place.
        x_px, y_px: (E,).
    """
    cx, cy, a, c, b = ellipse.T
    dx, dy = x_px - cx, y_px - cy
    w0, w1 = a * dx + b * dy, b * dx + c * dy
    # No overflow to guard against here: hypot would, at five times the price.
    q, m0, m1 = np.sqrt(w0 * w0 + w1 * w1), a * w0 + b * w1, b * w0 + c * w1
    slope = np.sqrt(m0 * m0 + m1 * m1)
    across, down = (np.maximum(np.abs(m) / slope, _LEAST_SINE) for m in (m0, m1))
    inwards = (1 - q) * q / slope + _SIDES_PX[:, None, None] * across + _SIDES_PX[:, None] * down
    np.maximum(inwards, 0, out=inwards)
    squares = inwards * inwards
    between = squares[1:] - squares[:-1]
    taken = (between[:, 1:] - between[:, :-1]) / (2 * across * down)
    beside = (taken[0, 1] + taken[2, 1] + taken[1, 0] + taken[1, 2]) / 4
    corners = (taken[0, 0] + taken[2, 0] + taken[0, 2] + taken[2, 2]) / 4
    edges: Array32 = np.stack([taken[1, 1], beside, corners])
    return edges
