"""Weighted Gauss-Newton adjustment of many poses at once, each to the features of its own frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.pose.adjustment_loops import (
    SharedInputs,
    adjust_frames,
    invert_information,
    linearise_frames,
    predict_centers,
)
from nav.pose.features import Features


@dataclass(frozen=True, eq=False)
class AdjustmentState:
    """Unknowns of the adjustment: one pose, and the departures from nominal, for each frame of some features.

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
        """Poses of a drogue and rig exactly as built, without departures."""
        return AdjustmentState(rotations, translations_m, np.zeros((len(rotations), features.departures)))


@dataclass(frozen=True, eq=False)
class Loss:
    """Loss function and tilt prior.

    Attributes:
        huber_sigmas: threshold of Huber's loss on a feature's residual, in standard deviations; infinite for squares.
        tilt_prior_rad: standard deviation of the prior on the x and y components of the drogue's axis; infinite for
            none.
    """

    huber_sigmas: float = np.inf
    tilt_prior_rad: float = np.inf


SQUARED_LOSS = Loss()


@dataclass(frozen=True, eq=False)
class Linearised:
    """Whitened residuals and their derivatives.

    Attributes:
        jacobian: (S, K, M) derivatives of M weighted residuals with respect to translation [m], rotation vector [rad]
            and the departures.
        residuals: (S, M), in standard deviations.
        costs: (S,) half the sum of squares, or of Huber's losses; infinite where it is nan.
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
    """Residuals and derivatives of every frame's features in its pose.

    The residuals contain the shift of a disc's ellipse centre; the derivatives neglect it.

    Args:
        features: S frames.
        state: S poses.
        loss: loss function and tilt prior.
    """
    count, departure_count = len(state.rotations), features.departures
    rows = (
        2 * features.measured.shape[2] * features.measured.shape[3]
        + 2 * np.isfinite(loss.tilt_prior_rad)
        + departure_count
    )
    result = Linearised(
        jacobian=np.empty((count, 6 + departure_count, rows)), residuals=np.empty((count, rows)), costs=np.empty(count)
    )
    unknowns = (contiguous(state.rotations), contiguous(state.translations_m), contiguous(state.departures))
    outputs = (result.jacobian, result.residuals, result.costs)
    linearise_frames(shared_inputs(features, loss), *frame_inputs(features), *unknowns, *outputs)
    return result


def project_features(features: Features, rotations: Array, translations_m: Array) -> Array:
    """(S, E, F, 2) predicted ellipse centres of the nominal drogue in poses. [px]"""
    pixels = np.empty((len(rotations), len(features.eye_x_m), len(features.points_m), 2))
    predict_centers(shared_inputs(features, SQUARED_LOSS), contiguous(rotations), contiguous(translations_m), pixels)
    return pixels


def shared_inputs(features: Features, loss: Loss) -> SharedInputs:
    """Inputs of the compiled loops that all frames share."""
    camera = features.camera
    return SharedInputs(
        fx_px=float(camera.fx_px),
        fy_px=float(camera.fy_px),
        cx_px=float(camera.cx_px),
        cy_px=float(camera.cy_px),
        eye_x_m=contiguous(features.eye_x_m),
        points_m=contiguous(features.points_m),
        radii_m=contiguous(features.radii_m),
        shifts_m=contiguous(features.shifts_m),
        disparity_sigma_px=float(features.disparity_sigma_px),
        huber_sigmas=float(loss.huber_sigmas),
        tilt_prior_rad=float(loss.tilt_prior_rad),
    )


def frame_inputs(features: Features) -> tuple[Array, Array]:
    """Inputs of the loops for each frame: measurements (5, B, E, F), and couplings (4, B, F), or (4, B, 0) for none."""
    coupling = features.coupling
    if coupling is None:
        coupling = np.empty((4, features.frames, 0))
    return contiguous(features.measured), contiguous(coupling)


def contiguous(array: Array) -> Array:
    """The array as C-contiguous and writeable; the loops would be compiled anew for any other kind of array."""
    # `numpy.require` takes ten times as long to find that nothing is to be done.
    return array if array.flags.c_contiguous and array.flags.writeable else np.array(array, order="C")


@dataclass(frozen=True, eq=False)
class AdjustedPoses:
    """Results of an adjustment, one for each start.

    Attributes:
        rotations: (S, 3, 3) `left_from_drogue`.
        translations_m: (S, 3).
        departures: (S, G) from the nominal drogue and rig, see `AdjustmentState`.
        costs: (S,) half the sum of squared whitened residuals, priors included.
        information: (S, K, K) of the pose, in the tangent of `datasets_manifest.types.estimates`, and the departures.
    """

    rotations: Array
    translations_m: Array
    departures: Array
    costs: Array
    information: Array


def adjust(features: Features, rotations: Array, translations_m: Array, loss: Loss = SQUARED_LOSS) -> AdjustedPoses:
    """Minimise the whitened reprojection error over all measurements.

    A step that raises the cost is shortened, so the result never has a higher cost than the start.

    Args:
        features: S frames, each with at least three markers that are not collinear.
        rotations: (S, 3, 3) starts.
        translations_m: (S, 3).
        loss: loss function and tilt prior.
    """
    count, size = len(rotations), 6 + features.departures
    result = AdjustedPoses(
        rotations=np.array(rotations, np.float64, order="C"),
        translations_m=np.array(translations_m, np.float64, order="C"),
        departures=np.zeros((count, features.departures)),
        costs=np.empty(count),
        information=np.empty((count, size, size)),
    )
    unknowns = (result.rotations, result.translations_m, result.departures)
    adjust_frames(shared_inputs(features, loss), *frame_inputs(features), *unknowns, result.costs, result.information)
    return result


def information_at(features: Features, rotations: Array, translations_m: Array) -> Array:
    """(S, K, K) information of the features of S frames in given poses; see `AdjustedPoses`."""
    return linearise(features, AdjustmentState.nominal(features, rotations, translations_m)).information


def inverse_information(information: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Covariances of poses from their information.

    Args:
        information: (S, K, K), K >= 6; unknowns after the pose are marginalised.

    Returns:
        (S, 6, 6) covariances, and (S,) whether the measurements determine the whole pose; the covariance is zero where
        they do not.
    """
    covariances, determined = np.empty((len(information), 6, 6)), np.empty(len(information), np.bool_)
    invert_information(contiguous(information), covariances, determined)
    return covariances, determined
