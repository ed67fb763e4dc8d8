"""What a pixel takes of the light beside it, at both edges of annuli; see `nav.centroids.pixel_response`."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.centroids.annulus_places import ANNULUS_BACKGROUND, ANNULUS_HOLE, ANNULUS_INNER, ANNULUS_OUTER
from nav.centroids.edge_pictures import add_box_pictures
from nav.centroids.patches import PixelSet
from nav.centroids.pixel_response import BOX_PICTURES
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum, Model, NormalEquations


def response_pictures(pixels: PixelSet, parameters: Array, shares: tuple[Array32, Array32], light: Array32) -> Array32:
    """(N, 3, K) what edges of pixel boxes show beyond Gaussian ones, at both edges of an annulus. [DN]

    Args:
        pixels: of the annuli.
        parameters: (N, P) where the edges are, see `nav.centroids.annulus_model`.
        shares: (N, K) of the pixels that lie on the annulus, and in the hole.
        light: (N, K) of the annulus above the background.
    """
    hole = (parameters[:, ANNULUS_HOLE] - parameters[:, ANNULUS_BACKGROUND]).astype(np.float32)[:, None]
    pictures = np.zeros((len(parameters), BOX_PICTURES, pixels.x_px.shape[1]), np.float32)
    between, in_hole = shares
    for place, inside, step in ((ANNULUS_OUTER, between + in_hole, light), (ANNULUS_INNER, in_hole, hole - light)):
        ellipses = parameters[:, place].astype(np.float32)
        add_box_pictures(ellipses, pixels.x_px, pixels.y_px, pixels.present, inside, step, pictures)
    return pictures


def starting_with_pictures(fit: Minimum, pictures: Array32) -> Minimum:
    """Where a fit of the model without pictures (N, S, K) ended, as a start of that with them: there are none yet."""
    jacobian = np.concatenate([fit.jacobian, pictures], axis=1)
    normal = NormalEquations(jacobian, fit.residuals, fit.normal.weights)
    parameters = np.pad(fit.parameters, ((0, 0), (0, pictures.shape[1])))
    return Minimum(parameters, fit.residuals, jacobian, normal)


def with_pictures(model: Model, pictures: Array32) -> Model:
    """The model with given pictures (N, S, K) added, in amounts that are its last parameters."""
    count = pictures.shape[1]

    def extended(parameters: Array) -> tuple[Array32, Array32]:
        values, jacobian = model(parameters[:, :-count])
        amounts = parameters[:, None, -count:].astype(np.float32)
        return values + np.matmul(amounts, pictures)[:, 0], np.concatenate([jacobian, pictures], axis=1)

    return extended
