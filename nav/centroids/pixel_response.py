"""How the pixels' response shapes edges, beyond the blur of a Gaussian.

A pixel integrates the light of a square, and gets a share of the light on its eight neighbours. The resulting edge is
not Gaussian, and its shape differs between the image axes and the diagonals. A Gaussian in its place shifts centres by
one or two thousandths of a pixel, depending on where in its pixel the edge lies: as much as the noise of bright days.

The shares are common to all outlines of a frame; they are fitted with each outline's own parameters eliminated.
"""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.centroids.blurred_edges import ELLIPSE_PARAMETER_COUNT, add_box_responses
from nav.centroids.outline_pixels import OutlinePixels
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum, add_rows, normal_equations, weighted_products

# Added to a normal matrix with unit diagonal: dim light does not separate the shared amounts.
_RIDGE = 1e-3


def reduced_equations(fit: Minimum, pictures: Array32, weights: Array32) -> tuple[Array, Array]:
    """Normal equations of amounts that all outlines share, with each outline's own parameters eliminated.

    Args:
        fit: of N outlines.
        pictures: (N, S, K) derivatives of the data by the shared amounts.
        weights: (N, K).

    Returns:
        (N, S, S) matrices and (N, S) gradients; their sums over N are the equations of the amounts.
    """
    count, shared = fit.parameters.shape[1], pictures.shape[1]
    pictures = np.ascontiguousarray(pictures)
    coupled, slopes = np.empty((len(weights), count, shared)), np.empty((len(weights), count, 1))
    weighted_products(fit.jacobian, pictures, weights, coupled)
    weighted_products(fit.jacobian, fit.residuals[:, None], weights, slopes)
    normal, gradient = np.empty((len(weights), shared, shared)), np.empty((len(weights), shared))
    normal_equations(pictures, fit.residuals, weights, normal, gradient)
    taken = np.matmul(fit.covariance(), coupled)
    gradient -= np.einsum("nps,np->ns", taken, slopes[..., 0])
    normal -= np.matmul(coupled.transpose(0, 2, 1), taken)
    return normal, gradient


def solve_shared(normal: Array, gradient: Array) -> Array:
    """(S,) amounts that solve the summed equations."""
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), np.finfo(np.float32).tiny))
    unit = normal * scale[:, None] * scale + _RIDGE * np.eye(len(scale))
    amounts: Array = scale * np.linalg.solve(unit, gradient * scale)
    return amounts


# The pixel's own box, the four beside it, and the four across its corners.
RESPONSE_BOXES = 3


def correct_pixel_response(
    fit: Minimum, pixels: OutlinePixels, inside: Array32, contrast: Array
) -> tuple[Minimum, Array32]:
    """Correct a fit of Gaussian edges for the frame's own edge shape.

    The edge is a mixture of the Gaussian, of the pixel's own box, and of the boxes beside it and across its corners,
    with the same shares for all outlines of the frame. Within the nine boxes the outline is taken as a straight line:
    the response of a box is then the second difference, along both its sides, of half the squared inward distance. All
    responses are equal on opposite sides of an outline, so fitting them does not weaken the estimate of its centre.

    Args:
        fit: of N outlines, its first parameters those of the ellipse.
        pixels: of the outlines.
        inside: (N, K) share of the light from within.
        contrast: (N,) step of light at the edge. [DN]

    Returns:
        The fit after one linear step with free shares, and (N, K) the difference of the edges from Gaussian ones.
    """
    weights = pixels.present
    shapes = np.zeros((len(weights), RESPONSE_BOXES, weights.shape[1]), np.float32)
    steps = np.repeat(contrast.astype(np.float32)[:, None], weights.shape[1], axis=1)
    ellipses = fit.parameters[:, :ELLIPSE_PARAMETER_COUNT].astype(np.float32)
    add_box_responses(ellipses, pixels.x_px, pixels.y_px, weights, inside, steps, shapes)
    normal, gradient = reduced_equations(fit, shapes, weights)
    shares = solve_shared(normal.sum(axis=0), gradient.sum(axis=0))
    beyond = np.zeros_like(weights)
    add_rows(shapes, np.tile(shares.astype(np.float32), (len(weights), 1)), beyond)
    return fit.after_linear_step(fit.residuals - beyond, weights), beyond
