"""Whitened reprojection residuals of poses, and their derivatives, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geometry.se3 import Array
from nav.numerics.compiled import compiled


class Shared(NamedTuple):
    """What all frames of some features have in common, and how residuals count; see `Features` and `Loss`."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    eye_x_m: Array
    points_m: Array
    radii_m: Array
    shifts_m: Array
    disparity_sigma_px: float
    huber_sigmas: float
    tilt_prior_rad: float


@compiled
def _place(
    shared: Shared, feature: int, rotation: Array, translation_m: Array, departures: Array
) -> tuple[float, float, float, float, float, float, float]:
    """A feature's arm from the drogue's origin, its depth, and the point whose image is its ellipse's centre. [m]

    The ellipse centre is the image of `t - (r^2 / t_z) (e_z - n_z n)` (geometry.circles).
    """
    x, y, z = shared.points_m[feature, 0], shared.points_m[feature, 1], shared.points_m[feature, 2]
    for g in range(len(shared.shifts_m)):
        shift = shared.shifts_m[g, feature]
        x += departures[g] * shift[0]
        y += departures[g] * shift[1]
        z += departures[g] * shift[2]
    arm_x = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
    arm_y = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
    arm_z = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
    depth = arm_z + translation_m[2]
    scale = shared.radii_m[feature] ** 2 / depth
    center_x = arm_x + translation_m[0] + scale * rotation[0, 2] * rotation[2, 2]
    center_y = arm_y + translation_m[1] + scale * rotation[1, 2] * rotation[2, 2]
    center_z = depth + scale * (rotation[2, 2] * rotation[2, 2] - 1)
    return arm_x, arm_y, arm_z, depth, center_x, center_y, center_z


@compiled
def predict_centers(shared: Shared, rotations: Array, translations_m: Array, pixels_px: Array) -> None:
    """Fill (S, E, F, 2) ellipse centres that poses of the nominal drogue would show."""
    nominal = np.zeros(len(shared.shifts_m))
    for s in range(len(rotations)):
        for f in range(len(shared.points_m)):
            place = _place(shared, f, rotations[s], translations_m[s], nominal)
            for e in range(len(shared.eye_x_m)):
                pixels_px[s, e, f, 0] = shared.fx_px * (place[4] - shared.eye_x_m[e]) / place[6] + shared.cx_px
                pixels_px[s, e, f, 1] = shared.fy_px * place[5] / place[6] + shared.cy_px


@compiled
def _fill_feature(
    shared: Shared,
    measured: tuple[float, float, float, float, float],
    eye: int,
    place: tuple[float, float, float, float, float, float, float],
    rotation: Array,
    shifts_m: Array,
    columns: tuple[int, int],
    jacobian: Array,
    residuals: Array,
) -> None:
    """Both residuals of one feature in one eye, and their derivatives by the pose and the shared shifts."""
    u, v, a, b, c = measured
    arm_x, arm_y, arm_z, _, center_x, center_y, z = place
    to_x, to_y = shared.fx_px * (center_x - shared.eye_x_m[eye]) / z, shared.fy_px * center_y / z
    off_u, off_v = to_x + shared.cx_px - u, to_y + shared.cy_px - v
    for row in range(2):
        by_u, by_v = (a, 0.0) if row == 0 else (b, c)
        column = columns[row]
        residuals[column] = by_u * off_u + by_v * off_v
        by_x, by_y = by_u * shared.fx_px / z, by_v * shared.fy_px / z
        by_z = -(by_u * to_x + by_v * to_y) / z
        jacobian[0, column], jacobian[1, column], jacobian[2, column] = by_x, by_y, by_z
        # The derivative by the turn is the cross product of the arm and that by the place.
        jacobian[3, column] = arm_y * by_z - arm_z * by_y
        jacobian[4, column] = arm_z * by_x - arm_x * by_z
        jacobian[5, column] = arm_x * by_y - arm_y * by_x
        for g in range(len(shifts_m)):
            x, y, along = shifts_m[g, 0], shifts_m[g, 1], shifts_m[g, 2]
            jacobian[6 + g, column] = (
                by_x * (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * along)
                + by_y * (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * along)
                + by_z * (rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * along)
            )


@compiled
def _couple(
    coupling: tuple[float, float, float, float], first: tuple[int, int], second: tuple[int, int], rows: Array
) -> None:
    """Add the first eye's whitened columns, times the coupling by rows, to the second's."""
    for k in range(len(rows)):
        row = rows[k]
        one, other = row[first[0]], row[first[1]]
        row[second[0]] += coupling[0] * one + coupling[1] * other
        row[second[1]] += coupling[2] * one + coupling[3] * other


@compiled
def _weigh(columns: tuple[int, int], threshold: float, jacobian: Array, residuals: Array) -> float:
    """Weigh a feature by the root of Huber's weight; its cost by Huber's loss."""
    one, other = columns
    square = residuals[one] ** 2 + residuals[other] ** 2
    norm = np.sqrt(square)
    if norm <= threshold:
        return float(square / 2)
    root = np.sqrt(threshold / norm)
    residuals[one] *= root
    residuals[other] *= root
    for k in range(len(jacobian)):
        jacobian[k, one] *= root
        jacobian[k, other] *= root
    return float(threshold * (norm - threshold / 2))


@compiled
def _add_priors(
    shared: Shared, rotation: Array, departures: Array, column: int, jacobian: Array, residuals: Array
) -> float:
    """Residuals of the tilt, where it has a prior, and of the departures; half the sum of their squares."""
    at = column
    if np.isfinite(shared.tilt_prior_rad):
        x, y, z = (
            rotation[0, 2] / shared.tilt_prior_rad,
            rotation[1, 2] / shared.tilt_prior_rad,
            rotation[2, 2] / shared.tilt_prior_rad,
        )
        residuals[at], residuals[at + 1] = x, y
        jacobian[4, at], jacobian[5, at] = z, -y
        jacobian[3, at + 1], jacobian[5, at + 1] = -z, x
        at += 2
    for g in range(len(departures)):
        residuals[at + g] = departures[g]
        jacobian[6 + g, at + g] = 1.0
    cost = 0.0
    for k in range(column, len(residuals)):
        cost += residuals[k] ** 2 / 2
    return cost


@compiled
def linearise_frame(
    shared: Shared,
    measured: Array,
    coupling: Array,
    rotation: Array,
    translation_m: Array,
    departures: Array,
    jacobian: Array,
    residuals: Array,
) -> float:
    """Fill residuals (M,) and derivatives (K, M) of one pose; its cost, infinite where it is not a number.

    Args:
        measured: (5, E, F) of the frame.
        coupling: (4, F) of the frame, or (4, 0).
    """
    eyes, count = len(shared.eye_x_m), len(shared.points_m)
    jacobian[:] = 0.0
    residuals[:] = 0.0
    in_front = True
    cost = 0.0
    for f in range(count):
        place = _place(shared, f, rotation, translation_m, departures)
        in_front &= place[3] > 0
        for e in range(eyes):
            own = (measured[0, e, f], measured[1, e, f], measured[2, e, f], measured[3, e, f], measured[4, e, f])
            if own[2] == 0:
                continue
            columns = (e * count + f, (eyes + e) * count + f)
            _fill_feature(shared, own, e, place, rotation, shared.shifts_m[:, f], columns, jacobian, residuals)
            if e == 1 and shared.disparity_sigma_px > 0:
                for column, by_u in ((columns[0], own[2]), (columns[1], own[3])):
                    jacobian[-1, column] = shared.disparity_sigma_px * by_u
                    residuals[column] += jacobian[-1, column] * departures[-1]
            if e == 1 and coupling.shape[1] > 0:
                by = (coupling[0, f], coupling[1, f], coupling[2, f], coupling[3, f])
                _couple(by, (f, eyes * count + f), columns, jacobian)
                _couple(by, (f, eyes * count + f), columns, residuals.reshape(1, -1))
        for e in range(eyes):
            cost += _weigh((e * count + f, (eyes + e) * count + f), shared.huber_sigmas, jacobian, residuals)
    cost += _add_priors(shared, rotation, departures, 2 * eyes * count, jacobian, residuals)
    return cost if in_front and np.isfinite(cost) else np.inf


@compiled
def linearise_frames(
    shared: Shared,
    measured: Array,
    coupling: Array,
    rotations: Array,
    translations_m: Array,
    departures: Array,
    jacobian: Array,
    residuals: Array,
    costs: Array,
) -> None:
    """Fill the arrays of `Linearised` for S poses.

    Args:
        measured: (5, S, E, F).
        coupling: (4, S, F), or (4, S, 0).
    """
    for s in range(len(rotations)):
        costs[s] = linearise_frame(
            shared,
            measured[:, s],
            coupling[:, s],
            rotations[s],
            translations_m[s],
            departures[s],
            jacobian[s],
            residuals[s],
        )
