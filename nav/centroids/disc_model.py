"""The picture of a disc: a blurred edge between two planes of light."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.centroids.disc_places import DISC_BACKGROUND, DISC_FIXED_COUNT, DISC_LEVEL, DISC_WIDTH, ELLIPSE_PARAMETER_COUNT
from nav.centroids.edge_pictures import draw_discs
from nav.centroids.edge_profile import START_WIDTH_PX, edge_widths, ellipse_parameters
from nav.centroids.patches import PixelSet, edge_distances
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum, Model

# An initial outline may be this far off; pixels this far from it show one side only. [px]
_CLEAR_PX = 1.0


def disc_model(pixels: PixelSet, slope_outside: bool, slope_inside: bool, further: Array32 | None = None) -> Model:
    """`I = (b + g.x) (1 - S) + (A + h.x) S + k.F`.

    Args:
        pixels: where.
        slope_outside: whether the background's plane g is fitted.
        slope_inside: whether the disc's plane h is fitted.
        further: (N, E, K) shares F of other backgrounds, whose lights k above b are fitted, the last parameters.
    """
    x, y = pixels.x_px, pixels.y_px
    if further is None:
        further = np.zeros((len(x), 0, x.shape[1]), np.float32)
    count = DISC_FIXED_COUNT + 2 * slope_outside + 2 * slope_inside + further.shape[1]

    def model(parameters: Array) -> tuple[Array32, Array32]:
        picture, jacobian = np.empty_like(x), np.empty((len(x), count, x.shape[1]), np.float32)
        given, widths = parameters.astype(np.float32), edge_widths(parameters[:, DISC_WIDTH])
        draw_discs(given, widths, (slope_outside, slope_inside), x, y, further, picture, jacobian)
        return picture, jacobian

    return model


def disc_start(pixels: PixelSet, shapes_px: Array, further_count: int) -> Array:
    """(N, P) parameters of the initial outlines with the mean levels on either side of them, all further ones zero."""
    parameters = np.zeros((len(shapes_px), DISC_FIXED_COUNT + further_count))
    parameters[:, :ELLIPSE_PARAMETER_COUNT] = ellipse_parameters(np.zeros((len(shapes_px), 2)), shapes_px)
    parameters[:, DISC_WIDTH] = START_WIDTH_PX
    distance = edge_distances(shapes_px, pixels.x_px, pixels.y_px)
    for column, side in ((DISC_BACKGROUND, distance < -_CLEAR_PX), (DISC_LEVEL, distance > _CLEAR_PX)):
        weight = pixels.present * side
        parameters[:, column] = (weight * pixels.values).sum(axis=1) / np.maximum(weight.sum(axis=1), 1)
    return parameters


def contrasts(fit: Minimum) -> Array:
    """(N,) light of fitted discs above that beside them. [DN]"""
    contrast: Array = fit.parameters[:, DISC_LEVEL] - fit.parameters[:, DISC_BACKGROUND]
    return contrast
