"""Weighted Gauss-Newton adjustment of many poses at once, each to the features of its own frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.pose.adjustment_loops import SharedInputs, adjust_frames, linearise_frames, predict_centers
from nav.pose.features import Features


@dataclass(frozen=True, eq=False)
class AdjustmentState:
    """Poses that are being adjusted, one for each frame of some features.

    Attributes:
        rotations: (S, 3, 3) `left_from_drogue`.
        translations_m: (S, 3).
        departures: (S, G) from the nominal drogue and rig, in standard deviations, see `Features`.
    """

    rotations: Array
    translations_m: Array
    departures: Array

    @staticmethod
    def nominal(features: Features, rotations: Array, translations_m: Array) -> AdjustmentState:
        """Poses of a drogue and rig exactly as built."""
        return AdjustmentState(rotations, translations_m, np.zeros((len(rotations), features.departures)))


@dataclass(frozen=True, eq=False)
class Loss:
    """How residuals count.

    Attributes:
        huber_sigmas: where the loss of a feature's residual turns from square to linear, in standard deviations.
        tilt_prior_rad: standard deviation of the axis' x and y components about the camera's axis.
    """

    huber_sigmas: float = np.inf
    tilt_prior_rad: float = np.inf


SQUARED_LOSS = Loss()


@dataclass(frozen=True, eq=False)
class Linearised:
    """Residuals and derivatives.

    Attributes:
        jacobian: (S, K, M) derivatives of M weighted residuals with respect to translation [m], rotation vector [rad]
            and the departures.
        residuals: (S, M), in standard deviations.
        costs: (S,) half the sum of squares, by Huber's loss where one is set; infinite where it is not a number.
    """

    jacobian: Array
    residuals: Array
    costs: Array

    @property
    def information(self) -> Array:
        """(S, K, K) `J W J^T`."""
        information: Array = self.jacobian @ np.swapaxes(self.jacobian, 1, 2)
        return information


def linearise(features: Features, state: AdjustmentState, loss: Loss = SQUARED_LOSS) -> Linearised:
    """Residuals of every frame's features in its pose.

    The shift of a disc's ellipse centre is in the residuals and not in the derivatives, where it hardly matters.

    Args:
        features: S frames.
        state: S poses.
        loss: how residuals count.
    """
    count, free = len(state.rotations), features.departures
    rows = 2 * features.measured.shape[2] * features.measured.shape[3] + 2 * np.isfinite(loss.tilt_prior_rad) + free
    result = Linearised(np.empty((count, 6 + free, rows)), np.empty((count, rows)), np.empty(count))
    places = (_contiguous(array) for array in (state.rotations, state.translations_m, state.departures))
    linearise_frames(shared_inputs(features, loss), *frame_inputs(features), *places, *vars(result).values())
    return result


def project_features(features: Features, rotations: Array, translations_m: Array) -> Array:
    """(S, E, F, 2) ellipse centres that poses of the nominal drogue would show. [px]"""
    pixels = np.empty((len(rotations), len(features.eye_x_m), len(features.points_m), 2))
    predict_centers(shared_inputs(features, SQUARED_LOSS), _contiguous(rotations), _contiguous(translations_m), pixels)
    return pixels


def shared_inputs(features: Features, loss: Loss) -> SharedInputs:
    """What the compiled loops take that all frames have in common."""
    camera = features.camera
    return SharedInputs(
        float(camera.fx_px),
        float(camera.fy_px),
        float(camera.cx_px),
        float(camera.cy_px),
        _contiguous(features.eye_x_m),
        _contiguous(features.points_m),
        _contiguous(features.radii_m),
        _contiguous(features.shifts_m),
        float(features.disparity_sigma_px),
        float(loss.huber_sigmas),
        float(loss.tilt_prior_rad),
    )


def frame_inputs(features: Features) -> tuple[Array, Array]:
    """What they take of each frame: measurements (5, B, E, F), and couplings (4, B, F) or none (4, B, 0)."""
    coupling = features.coupling
    if coupling is None:
        coupling = np.empty((4, features.frames, 0))
    return _contiguous(features.measured), _contiguous(coupling)


def _contiguous(array: Array) -> Array:
    """As loops are compiled for: they would be compiled anew for another layout, or for what is not to be written."""
    plain: Array = np.require(array, requirements=["C", "W"])
    return plain


@dataclass(frozen=True, eq=False)
class AdjustedPoses:
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


def adjust(features: Features, rotations: Array, translations_m: Array, loss: Loss = SQUARED_LOSS) -> AdjustedPoses:
    """Minimise the whitened reprojection error over all measurements.

    A step that raises the cost is shortened, so a start never ends worse than it began.

    Args:
        features: S frames, in each at least three markers that are not on a line.
        rotations: (S, 3, 3) starts.
        translations_m: (S, 3).
        loss: how residuals count.
    """
    count, size = len(rotations), 6 + features.departures
    result = AdjustedPoses(
        np.array(rotations, np.float64, order="C"),
        np.array(translations_m, np.float64, order="C"),
        np.zeros((count, features.departures)),
        np.empty(count),
        np.empty((count, size, size)),
    )
    places = (result.rotations, result.translations_m, result.departures)
    adjust_frames(shared_inputs(features, loss), *frame_inputs(features), *places, result.costs, result.information)
    return result


def information_at(features: Features, rotations: Array, translations_m: Array) -> Array:
    """(S, K, K) information that the features of S frames hold in given poses; see `Adjusted`."""
    return linearise(features, AdjustmentState.nominal(features, rotations, translations_m)).information


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
