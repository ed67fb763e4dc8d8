"""The picture of an annulus: two blurred edges, between them light that changes with the azimuth."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.centroids.annulus_places import (
    ANNULUS_AMPLITUDE,
    ANNULUS_BACKGROUND,
    ANNULUS_CENTERS,
    ANNULUS_HOLE,
    ANNULUS_INNER,
    ANNULUS_OUTER,
    ANNULUS_WIDTH,
)
from nav.centroids.edge_pictures import draw_annuli
from nav.centroids.edge_profile import START_WIDTH_PX, edge_widths, ellipse_parameters
from nav.centroids.ellipses import Ellipses
from nav.centroids.patches import PixelSet, edge_distances
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum, Model
from nav.numerics.matrix_loops import tie_rows

SLOPE_TURNS = 5


def annulus_model(pixels: PixelSet, turns: Array32, beyond: Array32) -> Model:
    """`I = b (1 - So) + A(azimuth) (So - Si) + b' Si + k(azimuth) F`.

    Args:
        pixels: where.
        turns: (N, T, K) functions of the azimuth whose sum is A.
        beyond: (N, K) share F of what lies beyond the annulus's surroundings and is lighter by k than they are.
    """
    x, y = pixels.x_px, pixels.y_px
    count = ANNULUS_AMPLITUDE + turns.shape[1]

    def model(parameters: Array) -> tuple[Array32, Array32]:
        picture, jacobian = np.empty_like(x), np.empty((len(x), count, x.shape[1]), np.float32)
        given, widths = parameters.astype(np.float32), edge_widths(parameters[:, ANNULUS_WIDTH])
        draw_annuli(given, widths, x, y, turns, beyond, picture, jacobian)
        return picture, jacobian

    return model


def shares_of(fit: Minimum, ties: Array) -> tuple[Array32, Array32]:
    """(N, K) how much of each pixel lies on the annulus, and how much in the hole.

    They are the derivatives by the annulus's mean light and by the hole's, whose parameters are free ones.
    """
    tied = ties.shape[2] - (ties.shape[1] - ANNULUS_WIDTH)
    between, in_hole = (fit.jacobian[:, tied + place - ANNULUS_WIDTH] for place in (ANNULUS_AMPLITUDE, ANNULUS_HOLE))
    return np.ascontiguousarray(between), np.ascontiguousarray(in_hole)


def light_above(parameters: Array, turns: Array32) -> Array32:
    """(N, K) the annulus's light above the background. [DN]"""
    rest = parameters[:, ANNULUS_BACKGROUND:].astype(np.float32)
    light: Array32 = np.matmul(rest[:, None, ANNULUS_AMPLITUDE - ANNULUS_BACKGROUND :], turns)[:, 0]
    return light - rest[:, 0, None]


def azimuth_basis(pixels: PixelSet, order: int) -> Array32:
    """(N, 2 order + 1, K): one, then cosines and sines of multiples of the azimuth."""
    angle = np.arctan2(pixels.y_px, pixels.x_px)
    rows = [np.ones_like(angle)]
    for multiple in range(1, order + 1):
        rows += [np.cos(multiple * angle), np.sin(multiple * angle)]
    return np.stack(rows, axis=1)


def radial_slopes(pixels: PixelSet, turns: Array32, outer: Ellipses, inner: Ellipses) -> Array32:
    """(N, 5, K): the first two orders of the azimuth, growing outwards from nothing in the annulus's middle.

    Without them a slope of light across the annulus, steeper at the outer edge than at the inner one, moves both.
    """
    middle = ((outer.radii_px + inner.radii_px) / 2).astype(np.float32)[:, None]
    outwards = np.hypot(pixels.x_px, pixels.y_px) / middle - 1
    slopes: Array32 = outwards[:, None] * turns[:, :SLOPE_TURNS]
    return slopes


def annulus_start(pixels: PixelSet, outer: Ellipses, inner: Ellipses, turn_count: int) -> Array:
    """(N, P) parameters of the predicted edges with the mean levels outside, on and within the annulus."""
    parameters = np.zeros((len(outer), ANNULUS_AMPLITUDE + turn_count))
    shift = inner.centers_px - outer.centers_px
    parameters[:, ANNULUS_OUTER] = ellipse_parameters(np.zeros((len(outer), 2)), outer.shapes_px)
    parameters[:, ANNULUS_INNER] = ellipse_parameters(shift, inner.shapes_px)
    parameters[:, ANNULUS_WIDTH] = START_WIDTH_PX
    to_outer = edge_distances(outer.shapes_px, pixels.x_px, pixels.y_px)
    x, y = (pixels.x_px - shift[:, :1], pixels.y_px - shift[:, 1:])
    to_inner = edge_distances(inner.shapes_px, x.astype(np.float32), y.astype(np.float32))
    sides = (
        (ANNULUS_BACKGROUND, to_outer < -1),
        (ANNULUS_HOLE, to_inner > 1),
        (ANNULUS_AMPLITUDE, (to_outer > 0) & (to_inner < 0)),
    )
    for column, side in sides:
        weight = pixels.present * side
        parameters[:, column] = (weight * pixels.values).sum(axis=1) / np.maximum(weight.sum(axis=1), 1)
    return parameters


def tied_to_pose(start: Array, thin: bool) -> Array:
    """(N, P, Q) how the model's parameters follow the free ones.

    A common shift of both edges is free, and the size of each, or of thin annuli of both; their shapes are not.
    """
    count = start.shape[1]
    moved = np.zeros((len(start), count, 3 if thin else 4))
    moved[:, ANNULUS_CENTERS, [0, 1, 0, 1]] = 1
    for place, edge in enumerate((ANNULUS_OUTER, ANNULUS_INNER)):
        moved[:, edge.start + 2 : edge.stop, 2 if thin else 2 + place] = start[:, edge.start + 2 : edge.stop]
    rest = np.broadcast_to(np.eye(count)[:, ANNULUS_WIDTH:], (len(start), count, count - ANNULUS_WIDTH))
    return np.concatenate([moved, rest], axis=2)


def in_free_parameters(model: Model, start: Array, ties: Array) -> Model:
    """The model in its free parameters, counted from the start."""
    # Both ellipses follow the first few; all others are free themselves.
    tied = ties.shape[2] - (ties.shape[1] - ANNULUS_WIDTH)
    across = np.ascontiguousarray(ties[:, :ANNULUS_WIDTH, :tied].transpose(0, 2, 1), np.float32)

    def in_free(free: Array) -> tuple[Array32, Array32]:
        values, jacobian = model(start + np.einsum("npq,nq->np", ties, free))
        by_free = np.empty((len(jacobian), ties.shape[2], jacobian.shape[2]), np.float32)
        tie_rows(jacobian, across, by_free)
        return values, by_free

    return in_free


def all_parameters(start: Array, ties: Array, fit: Minimum) -> Array:
    """(N, P) the model's parameters where a fit in the free ones, and what else follows them, ended."""
    parameters: Array = start + np.einsum("npq,nq->np", ties, fit.parameters[:, : ties.shape[2]])
    return parameters
