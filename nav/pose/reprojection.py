"""Whitened reprojection residuals of many poses at once, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.se3 import Array
from nav.pose.features import Features

# Of the axes x, y, z the one after each, and the one before.
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


@dataclass(frozen=True, eq=False)
class State:
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
    def nominal(features: Features, rotations: Array, translations_m: Array) -> State:
        """Poses of a drogue and rig exactly as built."""
        return State(rotations, translations_m, np.zeros((len(rotations), features.departures)))


@dataclass(frozen=True, eq=False)
class Loss:
    """How residuals count.

    Attributes:
        huber_sigmas: where the loss of a feature's residual turns from square to linear, in standard deviations.
        tilt_prior_rad: standard deviation of the axis' x and y components about the camera's axis.
    """

    huber_sigmas: float = np.inf
    tilt_prior_rad: float = np.inf


SQUARES = Loss()


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


def linearise(features: Features, state: State, loss: Loss = SQUARES) -> Linearised:
    """Residuals of every frame's features in its pose.

    The shift of a disc's ellipse centre is in the residuals and not in the derivatives, where it hardly matters.

    Args:
        features: S frames.
        state: S poses.
        loss: how residuals count.
    """
    count, size = len(state.rotations), 2 * features.measured.shape[2] * features.measured.shape[3]
    with_tilt, free = np.isfinite(loss.tilt_prior_rad), features.departures
    jacobian = np.zeros((count, 6 + free, size + 2 * with_tilt + free))
    residuals = np.empty((count, jacobian.shape[2]))
    # A trial step may put a feature at a camera's own depth; its infinite cost turns the step down.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        in_front = _fill_features(features, state, jacobian[:, :, :size], residuals[:, :size])
        if np.isfinite(loss.huber_sigmas):
            costs = _weigh(jacobian[:, :, :size], residuals[:, :size], loss.huber_sigmas, features)
        else:
            costs = _half_squares(residuals[:, :size])
        if with_tilt:
            axes = state.rotations[:, :, 2] / loss.tilt_prior_rad
            residuals[:, size : size + 2] = axes[:, :2]
            jacobian[:, 4, size], jacobian[:, 5, size] = axes[:, 2], -axes[:, 1]
            jacobian[:, 3, size + 1], jacobian[:, 5, size + 1] = -axes[:, 2], axes[:, 0]
        if free:
            residuals[:, -free:] = state.departures
            jacobian[:, 6:, -free:] = np.eye(free)
        if with_tilt or free:
            costs += _half_squares(residuals[:, size:])
    return Linearised(jacobian, residuals, np.where(in_front & np.isfinite(costs), costs, np.inf))


def predicted_px(features: Features, state: State) -> Array:
    """(S, E, F, 2) ellipse centres that the poses would show. [px]"""
    _, _, slopes, _ = _images(features, state)
    camera = features.camera
    return slopes.transpose(0, 2, 3, 1) * (camera.fx_px, camera.fy_px) + (camera.cx_px, camera.cy_px)


def _fill_features(features: Features, state: State, jacobian: Array, residuals: Array) -> Array:
    """Write the features' part of both arrays; (S,) whether all features lie in front of the cameras."""
    # Few frames have few numbers, and time goes by the number of array operations: both rows of the whitening matrix,
    # and the three axes, are worked on at once.
    weights, offsets = features.whitening
    shape = weights.shape[3:]
    rows = jacobian.reshape(*jacobian.shape[:2], 2, *shape)
    both = residuals.reshape(len(residuals), 2, *shape)
    arms, depth, slopes, z = _images(features, state)
    whitened = weights[:, 0] * slopes[:, :1] + weights[:, 1] * slopes[:, 1:]
    np.add(whitened, offsets, out=both)

    by_place = rows[:, :3]
    np.divide(weights, z[:, None, None, None], out=by_place[:, :2])
    np.divide(whitened, -z[:, None, None], out=by_place[:, 2])
    # The derivative by the turn is the cross product of the arm and that by the place.
    arms = arms[:, :, None, None]
    np.multiply(arms[:, _NEXT], by_place[:, _LAST], out=rows[:, 3:6])
    rows[:, 3:6] -= arms[:, _LAST] * by_place[:, _NEXT]
    if len(features.shifts_m):
        turned = np.swapaxes(features.shifts_m @ np.swapaxes(state.rotations, 1, 2)[:, None], 2, 3)
        shifted = rows[:, 6 : 6 + len(features.shifts_m)]
        shifted[:] = (turned[:, :, :, None, None] * by_place[:, None]).sum(axis=2)
    if features.disparity_sigma_px > 0:
        a, b = features.measured[2:4, :, 1]
        rows[:, -1, 0, 1] = features.disparity_sigma_px * a
        rows[:, -1, 1, 1] = features.disparity_sigma_px * b
        both[:, :, 1] += rows[:, -1, :, 1] * state.departures[:, -1:, None]
    if features.coupling is not None and len(features.eye_x_m) > 1:
        _couple(both, features.coupling)
        _couple(rows, features.coupling[:, :, None])
    in_front: Array = (depth > 0).all(axis=1)
    return in_front


def _images(features: Features, state: State) -> tuple[Array, Array, Array, Array]:
    """Where the features are and where their ellipse centres appear.

    Returns:
        arms (S, 3, F) from the drogue's origin [m], depths (S, F) [m], slopes x/z and y/z (S, 2, E, F) of the ellipse
        centres, and the depths (S, F) that belong to them [m]. Rectified eyes share depth and y.
    """
    points = features.points_m.T
    if len(features.shifts_m):
        shared = state.departures[:, : len(features.shifts_m)] @ features.shifts_m.reshape(len(features.shifts_m), -1)
        points = points + np.swapaxes(shared.reshape(-1, *features.points_m.shape), 1, 2)
    arms = state.rotations @ points
    places = arms + state.translations_m[:, :, None]
    normals = state.rotations[:, :, 2]
    depth = places[:, 2]
    # The ellipse centre is the image of `t - (r^2 / t_z) (e_z - n_z n)` (geometry.circles).
    shift = normals * normals[:, 2:]
    shift[:, 2] -= 1
    virtual = places + shift[:, :, None] * (features.radii_m**2 / depth)[:, None]
    z = virtual[:, 2]
    slopes = np.empty((len(z), 2, len(features.eye_x_m), z.shape[1]))
    np.divide(virtual[:, None, 0] - features.eye_x_m[:, None], z[:, None], out=slopes[:, 0])
    slopes[:, 1] = (virtual[:, 1] / z)[:, None]
    return arms, depth, slopes, z


def _half_squares(residuals: Array) -> Array:
    """(S,) half the sum of squares of (S, M)."""
    sums: Array = np.einsum("sm,sm->s", residuals, residuals)
    return sums / 2


def _couple(rows: Array, coupling: Array) -> None:
    """Add the first eye's whitened rows (..., 2, E, F), times the coupling (4, ..., F), to the second's in place."""
    first, second = rows[..., 0, 0, :], rows[..., 1, 0, :]
    rows[..., 0, 1, :] += coupling[0] * first + coupling[1] * second
    rows[..., 1, 1, :] += coupling[2] * first + coupling[3] * second


def _weigh(jacobian: Array, residuals: Array, threshold: float, features: Features) -> Array:
    """Weigh both arrays in place by the roots of Huber's weights; (S,) costs by Huber's loss."""
    eyes, count = features.measured.shape[2:]
    pairs = residuals.reshape(len(residuals), 2, eyes, count)
    norms = np.sqrt((pairs**2).sum(axis=1))
    costs: Array = np.where(norms <= threshold, norms**2 / 2, threshold * (norms - threshold / 2)).sum(axis=(1, 2))
    roots = np.sqrt(threshold / np.maximum(norms, threshold))
    pairs *= roots[:, None]
    rows = jacobian.reshape(*jacobian.shape[:2], 2, eyes, count)
    rows *= roots[:, None, None]
    return costs
