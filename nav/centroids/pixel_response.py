"""What a pixel takes of the light beside it: how the edges of a frame depart from the blur of a Gaussian.

A pixel takes the light of a square, and a share of what falls on its eight neighbours: across an edge that is no
Gaussian, and along an image axis another shape than across the corners. A Gaussian in its place moves centres by a
thousandth of a pixel or two, differently by where in its pixel the edge lies, as much as the noise of bright days.
"""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.centroids.disc_places import ELLIPSE_PARAMETER_COUNT
from nav.centroids.edge_pictures import add_box_pictures
from nav.centroids.patches import PixelSet
from nav.centroids.shared_parameters import least_of_all, reduced_equations
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum
from nav.numerics.matrix_loops import add_rows

# The pixel's own box, those beside it, and those across its corners.
BOX_PICTURES = 3


def without_pixel_response(fit: Minimum, pixels: PixelSet, inside: Array32, contrast: Array) -> tuple[Minimum, Array32]:
    """A fit of Gaussian edges, corrected for the frame's own shape of edges.

    The edge is a mixture of the Gaussian, of the pixel's own box, and of the boxes beside it and across its corners.
    Their shares are one for all outlines of the frame. Within the nine boxes the outline is taken as a straight line:
    what a box takes is then the second difference, by both its sides, of the half square of the distance inwards. All
    are alike on opposite sides of an outline, so that fitting them takes nothing from what is known of a centre.

    Args:
        fit: of N outlines, its first parameters those of the ellipse.
        pixels: of the outlines.
        inside: (N, K) share of the light from within.
        contrast: (N,) step of light at the edge. [DN]

    Returns:
        The fit after one linear step with the shares free, and (N, K) what the data have beyond Gaussian edges.
    """
    weights = pixels.present
    shapes = np.zeros((len(weights), BOX_PICTURES, weights.shape[1]), np.float32)
    steps = np.repeat(contrast.astype(np.float32)[:, None], weights.shape[1], axis=1)
    ellipses = fit.parameters[:, :ELLIPSE_PARAMETER_COUNT].astype(np.float32)
    add_box_pictures(ellipses, pixels.x_px, pixels.y_px, weights, inside, steps, shapes)
    normal, gradient = reduced_equations(fit, shapes, weights)
    shares = least_of_all(normal.sum(axis=0), gradient.sum(axis=0))
    beyond = np.zeros_like(weights)
    add_rows(shapes, np.tile(shares.astype(np.float32), (len(weights), 1)), beyond)
    return fit.given(fit.residuals - beyond, weights), beyond
