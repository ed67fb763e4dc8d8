"""Whitened reprojection residuals of many poses at once, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.se3 import Array
from nav.pose.features import Features


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
            costs = (residuals[:, :size] ** 2).sum(axis=1) / 2
        if with_tilt:
            axes = state.rotations[:, :, 2] / loss.tilt_prior_rad
            residuals[:, size : size + 2] = axes[:, :2]
            jacobian[:, 4, size], jacobian[:, 5, size] = axes[:, 2], -axes[:, 1]
            jacobian[:, 3, size + 1], jacobian[:, 5, size + 1] = -axes[:, 2], axes[:, 0]
        if free:
            residuals[:, -free:] = state.departures
            jacobian[:, 6:, -free:] = np.eye(free)
        costs += (residuals[:, size:] ** 2).sum(axis=1) / 2
    return Linearised(jacobian, residuals, np.where(in_front & np.isfinite(costs), costs, np.inf))


def predicted_px(features: Features, state: State) -> Array:
    """(S, E, F, 2) ellipse centres that the poses would show. [px]"""
    _, _, x_z, y_z, _ = _images(features, state)
    u = features.camera.fx_px * x_z + features.camera.cx_px
    v = features.camera.fy_px * y_z + features.camera.cy_px
    return np.stack([u, np.broadcast_to(v, u.shape)], axis=-1)


def _fill_features(features: Features, state: State, jacobian: Array, residuals: Array) -> Array:
    """Write the features' part of both arrays; (S,) whether all features lie in front of the cameras."""
    u, v, a, b, c = features.measured
    camera = features.camera
    rows = jacobian.reshape(*jacobian.shape[:2], 2, *u.shape[1:])
    arms, depth, x_z, y_z, z = _images(features, state)
    ax, ay, az = (arms[:, None, :, axis] for axis in range(3))
    off_u = camera.fx_px * x_z + camera.cx_px - u
    if features.disparity_sigma_px > 0:
        off_u[:, 1] += features.disparity_sigma_px * state.departures[:, -1:]
    off_v = camera.fy_px * y_z + camera.cy_px - v
    both = residuals.reshape(len(residuals), 2, *u.shape[1:])
    both[:, 0] = a * off_u
    both[:, 1] = b * off_u + c * off_v

    by_x, by_y = camera.fx_px / z, camera.fy_px / z
    ux, vx, vy = a * by_x, b * by_x, c * by_y
    uz, vz = -ux * x_z, -vx * x_z - vy * y_z
    rows[:, 0, 0], rows[:, 2, 0] = ux, uz
    rows[:, 0, 1], rows[:, 1, 1], rows[:, 2, 1] = vx, vy, vz
    rows[:, 3, 0], rows[:, 4, 0], rows[:, 5, 0] = ay * uz, az * ux - ax * uz, -ay * ux
    rows[:, 3, 1], rows[:, 4, 1], rows[:, 5, 1] = ay * vz - az * vy, az * vx - ax * vz, ax * vy - ay * vx
    if len(features.shifts_m):
        turned = features.shifts_m @ np.swapaxes(state.rotations, 1, 2)[:, None]
        sx, sy, sz = (turned[:, :, None, :, axis] for axis in range(3))
        shifted = rows[:, 6 : 6 + len(features.shifts_m)]
        shifted[:, :, 0] = sx * ux[:, None] + sz * uz[:, None]
        shifted[:, :, 1] = sx * vx[:, None] + sy * vy[:, None] + sz * vz[:, None]
    if features.disparity_sigma_px > 0:
        rows[:, -1, 0, 1] = features.disparity_sigma_px * a[:, 1]
        rows[:, -1, 1, 1] = features.disparity_sigma_px * b[:, 1]
    if features.coupling is not None and len(features.eye_x_m) > 1:
        _couple(both, features.coupling)
        _couple(rows, features.coupling[:, :, None])
    in_front: Array = (depth > 0).all(axis=(1, 2))
    return in_front


def _images(features: Features, state: State) -> tuple[Array, Array, Array, Array, Array]:
    """Where the features are and where their ellipse centres appear.

    Returns:
        arms (S, F, 3) from the drogue's origin [m], depths (S, 1, F) [m], slopes x/z (S, E, F) and y/z (S, 1, F) of the
        ellipse centres, and the depths (S, 1, F) that belong to them [m]. Rectified eyes share depth and y.
    """
    points = features.points_m
    if len(features.shifts_m):
        shared = state.departures[:, : len(features.shifts_m)] @ features.shifts_m.reshape(len(features.shifts_m), -1)
        points = points + shared.reshape(-1, *points.shape)
    arms = points @ np.swapaxes(state.rotations, 1, 2)
    tx, ty, tz = (state.translations_m[:, axis, None, None] for axis in range(3))
    nx, ny, nz = (state.rotations[:, axis, 2, None, None] for axis in range(3))
    depth = arms[:, None, :, 2] + tz
    # The ellipse centre is the image of `t - (r^2 / t_z) (e_z - n_z n)` (geometry.circles).
    shift = features.radii_m**2 / depth
    z = depth - shift * (1 - nz * nz)
    x_z = (arms[:, None, :, 0] + tx - features.eye_x_m[:, None] + shift * (nz * nx)) / z
    y_z = (arms[:, None, :, 1] + ty + shift * (nz * ny)) / z
    return arms, depth, x_z, y_z, z


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
