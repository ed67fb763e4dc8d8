"""Weighted Gauss-Newton adjustment of many poses at once, each to its own frame's features."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.pose.adjustment_loops import adjust_frames
from nav.pose.features import Features
from nav.pose.reprojection import SQUARES, Loss, State, arrays_of, linearise, shared_of


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Poses that each start led to.

    Attributes:
        rotations: (S, 3, 3) `left_from_drogue`.
        translations_m: (S, 3).
        departures: (S, G) from the nominal drogue and rig, see `State`.
        costs: (S,) half the sum of squared whitened residuals, with priors.
        information: (S, K, K) in the tangent of `datasets_manifest.types.estimates`, and the departures.
    """

    rotations: Array
    translations_m: Array
    departures: Array
    costs: Array
    information: Array


def adjust(features: Features, rotations: Array, translations_m: Array, loss: Loss = SQUARES) -> Adjusted:
    """Minimise the whitened reprojection error over all measurements.

    A step that raises the cost is shortened, so a start never ends worse than it began.

    Args:
        features: S frames, in each at least three markers that are not on a line.
        rotations: (S, 3, 3) starts.
        translations_m: (S, 3).
        loss: how residuals count.
    """
    count, size = len(rotations), 6 + features.departures
    result = Adjusted(
        np.array(rotations, np.float64, order="C"),
        np.array(translations_m, np.float64, order="C"),
        np.zeros((count, features.departures)),
        np.empty(count),
        np.empty((count, size, size)),
    )
    places = (result.rotations, result.translations_m, result.departures)
    adjust_frames(shared_of(features, loss), *arrays_of(features), *places, result.costs, result.information)
    return result


def information_at(features: Features, rotations: Array, translations_m: Array) -> Array:
    """(S, K, K) information that the features of S frames hold in given poses; see `Adjusted`."""
    return linearise(features, State.nominal(features, rotations, translations_m)).information


def inverse_information(information: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Covariances of the pose.

    Args:
        information: (S, K, K), K = 6 or more; whatever follows the pose is marginalised.

    Returns:
        (S, 6, 6) covariances, (S,) whether the measurements determine the whole pose; the covariance of others is zero.
    """
    # Metres and radians differ in size: judge the eigenvalues of the scaled matrix.
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    sound = (np.isfinite(information).all(axis=(1, 2)) & (diagonal > 0).all(axis=1))[:, None]
    scale = np.sqrt(np.where(sound, diagonal, 1.0))
    outer = scale[:, :, None] * scale[:, None, :]
    values, vectors = np.linalg.eigh(np.where(sound[..., None], information / outer, np.eye(information.shape[1])))
    sound = sound[:, 0] & (values[:, 0] > np.finfo(np.float64).eps)
    inverse = (vectors / np.where(sound, values.T, np.inf).T[:, None, :]) @ np.swapaxes(vectors, 1, 2) / outer
    return inverse[:, :6, :6], sound
