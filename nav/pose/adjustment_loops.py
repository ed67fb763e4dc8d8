"""Compiled loops: reprojection residuals of poses, their derivatives, and their least-squares adjustment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.numerics.cholesky import factorise, invert, solve
from nav.numerics.compiled import compiled, is_finite

_ITERATIONS = 20
# Keeps the normal equations of a frontal, far drogue solvable; far below the information of any marker.
_DAMPING_FRACTION = 1e-9
_LARGEST_TURN_RAD = 0.35
# The sine of a smaller angle equals the angle in float64.
_SMALLEST_ANGLE_RAD = 1e-9
_LARGEST_MOVE_FRACTION = 0.3
_LARGEST_DEPARTURE_SIGMAS = 10.0
# A step that would lower the cost by less moves no parameter by more than 5e-5 deviations; it is taken as the last one.
_CONVERGED = 1e-9
# Smaller pivots of a scaled information may be rounding; a whole ring's are above 1e-5 up to 200 m, 20 degrees aside.
_LEAST_PIVOT = 1e-13
# A start whose steps had to be shortened to this share is at its minimum within rounding.
_LEAST_REACH = 1e-4


class SharedInputs(NamedTuple):
    """Inputs that all frames share: cameras, drogue, priors and loss; see `Features` and `Loss`."""

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


class _Position(NamedTuple):
    """Position of a feature in the left camera frame. [m]

    Attributes:
        arm_x, arm_y, arm_z: from the drogue's origin to the feature.
        depth: of the feature.
        center_x, center_y, center_z: the point whose image is the centre of the feature's ellipse.
    """

    arm_x: float
    arm_y: float
    arm_z: float
    depth: float
    center_x: float
    center_y: float
    center_z: float


class _Measured(NamedTuple):
    """A measured feature in one eye: its pixel, and the entries of its whitening matrix `[[a, 0], [b, c]]`."""

    u_px: float
    v_px: float
    a: float
    b: float
    c: float


class _Coupling(NamedTuple):
    """Matrix, by rows, by which the first eye's whitened residuals add to the second's; see `Features`."""

    u_by_u: float
    u_by_v: float
    v_by_u: float
    v_by_v: float


@compiled
def _feature_position(
    shared: SharedInputs, feature: int, rotation: Array, translation_m: Array, departures: Array
) -> _Position:
    """Position of a feature of the drogue in a pose.

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
    return _Position(arm_x, arm_y, arm_z, depth, center_x, center_y, center_z)


@compiled
def predict_centers(shared: SharedInputs, rotations: Array, translations_m: Array, pixels_px: Array) -> None:
    """Fill (S, E, F, 2) ellipse centres that poses of the nominal drogue would show."""
    nominal = np.zeros(len(shared.shifts_m))
    for s in range(len(rotations)):
        for f in range(len(shared.points_m)):
            position = _feature_position(shared, f, rotations[s], translations_m[s], nominal)
            x, y, z = position.center_x, position.center_y, position.center_z
            for e in range(len(shared.eye_x_m)):
                pixels_px[s, e, f, 0] = shared.fx_px * (x - shared.eye_x_m[e]) / z + shared.cx_px
                pixels_px[s, e, f, 1] = shared.fy_px * y / z + shared.cy_px


@compiled
def _fill_feature(
    shared: SharedInputs,
    measured: _Measured,
    eye: int,
    position: _Position,
    rotation: Array,
    shifts_m: Array,
    columns: tuple[int, int],
    jacobian: Array,
    residuals: Array,
) -> None:
    """Fill both residuals of one feature in one eye, and their derivatives by the pose and the shared departures."""
    u, v, a, b, c = measured.u_px, measured.v_px, measured.a, measured.b, measured.c
    arm_x, arm_y, arm_z = position.arm_x, position.arm_y, position.arm_z
    center_x, center_y, z = position.center_x, position.center_y, position.center_z
    to_x, to_y = shared.fx_px * (center_x - shared.eye_x_m[eye]) / z, shared.fy_px * center_y / z
    off_u, off_v = to_x + shared.cx_px - u, to_y + shared.cy_px - v
    for row in range(2):
        by_u, by_v = (a, 0.0) if row == 0 else (b, c)
        column = columns[row]
        residuals[column] = by_u * off_u + by_v * off_v
        by_x, by_y = by_u * shared.fx_px / z, by_v * shared.fy_px / z
        by_z = -(by_u * to_x + by_v * to_y) / z
        jacobian[0, column], jacobian[1, column], jacobian[2, column] = by_x, by_y, by_z
        # The derivative by the rotation vector is the cross product of the arm and the derivative by the translation.
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
def _add_coupling(coupling: _Coupling, first: tuple[int, int], second: tuple[int, int], rows: Array) -> None:
    """Add the first eye's whitened columns, times the coupling, to the second's columns."""
    for k in range(len(rows)):
        row = rows[k]
        one, other = row[first[0]], row[first[1]]
        row[second[0]] += coupling.u_by_u * one + coupling.u_by_v * other
        row[second[1]] += coupling.v_by_u * one + coupling.v_by_v * other


@compiled
def _apply_huber_weight(columns: tuple[int, int], threshold: float, jacobian: Array, residuals: Array) -> float:
    """Multiply a feature's residuals and derivatives by the root of its Huber weight; returns its Huber loss."""
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
    shared: SharedInputs, rotation: Array, departures: Array, column: int, jacobian: Array, residuals: Array
) -> float:
    """Fill the residuals of the priors on tilt (where it has one) and departures; returns half their sum of squares."""
    at = column
    if is_finite(shared.tilt_prior_rad):
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
    shared: SharedInputs,
    measured: Array,
    coupling: Array,
    rotation: Array,
    translation_m: Array,
    departures: Array,
    jacobian: Array,
    residuals: Array,
) -> float:
    """Fill residuals (M,) and derivatives (K, M) of one pose; returns its cost, infinite where it is nan.

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
        position = _feature_position(shared, f, rotation, translation_m, departures)
        in_front &= position.depth > 0
        for e in range(eyes):
            own = _Measured(
                measured[0, e, f], measured[1, e, f], measured[2, e, f], measured[3, e, f], measured[4, e, f]
            )
            if own.a == 0:
                continue
            columns = (e * count + f, (eyes + e) * count + f)
            _fill_feature(shared, own, e, position, rotation, shared.shifts_m[:, f], columns, jacobian, residuals)
            if e == 1 and shared.disparity_sigma_px > 0:
                for column, by_u in ((columns[0], own.a), (columns[1], own.b)):
                    jacobian[-1, column] = shared.disparity_sigma_px * by_u
                    residuals[column] += jacobian[-1, column] * departures[-1]
            if e == 1 and coupling.shape[1] > 0:
                by = _Coupling(coupling[0, f], coupling[1, f], coupling[2, f], coupling[3, f])
                _add_coupling(by, (f, eyes * count + f), columns, jacobian)
                _add_coupling(by, (f, eyes * count + f), columns, residuals.reshape(1, -1))
        for e in range(eyes):
            cost += _apply_huber_weight(
                (e * count + f, (eyes + e) * count + f), shared.huber_sigmas, jacobian, residuals
            )
    cost += _add_priors(shared, rotation, departures, 2 * eyes * count, jacobian, residuals)
    return cost if in_front and is_finite(cost) else np.inf


@compiled
def linearise_frames(
    shared: SharedInputs,
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


@compiled
def _fill_normal_matrix(jacobian: Array, normal: Array) -> None:
    """Fill `J J^T`."""
    for p in range(len(jacobian)):
        for q in range(p + 1):
            total = 0.0
            for k in range(jacobian.shape[1]):
                total += jacobian[p, k] * jacobian[q, k]
            normal[p, q] = normal[q, p] = total


@compiled
def _find_step(
    jacobian: Array, residuals: Array, normal: Array, scale: Array, gradient: Array, root: Array, step: Array
) -> float:
    """Fill a Gauss-Newton step; returns the decrease of the linearised cost. Scratch: scale, gradient, root."""
    for k in range(len(step)):
        # Where nothing was measured the step is zero for any scale.
        scale[k] = 1 / np.sqrt(normal[k, k]) if normal[k, k] > 0 else 1.0
        gradient[k] = 0.0
        for m in range(len(residuals)):
            gradient[k] -= jacobian[k, m] * residuals[m]
    factorise(normal, scale, _DAMPING_FRACTION, root)
    solve(root, scale, gradient, step)
    gain = 0.0
    for k in range(len(step)):
        gain += step[k] * gradient[k] / 2
    return gain


@compiled
def _limit_step(step: Array, depth_m: float) -> None:
    """Limit the length of a step, in place."""
    for start, limit in ((0, _LARGEST_MOVE_FRACTION * abs(depth_m)), (3, _LARGEST_TURN_RAD)):
        length = np.sqrt(step[start] ** 2 + step[start + 1] ** 2 + step[start + 2] ** 2)
        if length > limit:
            for k in range(start, start + 3):
                step[k] *= limit / length
    for k in range(6, len(step)):
        step[k] = min(max(step[k], -_LARGEST_DEPARTURE_SIGMAS), _LARGEST_DEPARTURE_SIGMAS)


@compiled
def _fill_turned(rotation: Array, x: float, y: float, z: float, turned: Array) -> None:
    """Fill a rotation times that of a vector v, `I + sin(a) / a [v]x + 2 sin^2(a / 2) / a^2 [v]x^2` (Rodrigues)."""
    angle = max(np.sqrt(x * x + y * y + z * z), _SMALLEST_ANGLE_RAD)
    first, half = np.sin(angle) / angle, np.sin(angle / 2) / angle
    second = 2 * half * half
    for k in range(3):
        r0, r1, r2 = rotation[0, k], rotation[1, k], rotation[2, k]
        c0, c1, c2 = y * r2 - z * r1, z * r0 - x * r2, x * r1 - y * r0
        turned[0, k] = r0 + first * c0 + second * (y * c2 - z * c1)
        turned[1, k] = r1 + first * c1 + second * (z * c0 - x * c2)
        turned[2, k] = r2 + first * c2 + second * (x * c1 - y * c0)


@compiled
def adjust_frames(
    shared: SharedInputs,
    measured: Array,
    coupling: Array,
    rotations: Array,
    translations_m: Array,
    departures: Array,
    costs: Array,
    information: Array,
) -> None:
    """Minimise the costs of S poses in place, and fill costs (S,) and information (S, K, K) at the minima.

    Gauss-Newton; a step that raises the cost is shortened. `measured` and `coupling` are as in `linearise_frames`.
    """
    count, free = departures.shape
    size = 6 + free
    prior_rows = 2 if is_finite(shared.tilt_prior_rad) else 0
    rows = 2 * measured.shape[2] * measured.shape[3] + prior_rows + free
    jacobian, residuals = np.empty((2, size, rows)), np.empty((2, rows))
    turned, moved, departed = np.empty((3, 3)), np.empty(3), np.empty(free)
    normal, root = np.empty((size, size)), np.empty((size, size))
    scale, gradient, step = np.empty(size), np.empty(size), np.empty(size)
    for s in range(count):
        own, coupled = measured[:, s], coupling[:, s]
        now, reach = 0, 1.0
        cost = linearise_frame(
            shared, own, coupled, rotations[s], translations_m[s], departures[s], jacobian[0], residuals[0]
        )
        for _ in range(_ITERATIONS):
            if not is_finite(cost):
                break
            _fill_normal_matrix(jacobian[now], normal)
            gain = _find_step(jacobian[now], residuals[now], normal, scale, gradient, root, step)
            _limit_step(step, translations_m[s, 2])
            _fill_turned(rotations[s], reach * step[3], reach * step[4], reach * step[5], turned)
            for k in range(3):
                moved[k] = translations_m[s, k] + reach * step[k]
            for k in range(free):
                departed[k] = departures[s, k] + reach * step[6 + k]
            ahead = linearise_frame(
                shared, own, coupled, turned, moved, departed, jacobian[1 - now], residuals[1 - now]
            )
            if ahead <= cost:
                # Assignments of whole arrays check shapes; compiling the text of that error takes a third of the time.
                for k in range(3):
                    translations_m[s, k] = moved[k]
                    for column in range(3):
                        rotations[s, k, column] = turned[k, column]
                for k in range(free):
                    departures[s, k] = departed[k]
                now, cost, reach = 1 - now, ahead, min(1.0, 2 * reach)
            else:
                reach *= 0.25
            if gain < _CONVERGED or reach < _LEAST_REACH:
                break
        costs[s] = cost
        _fill_normal_matrix(jacobian[now], information[s])


@compiled
def invert_information(information: Array, covariances: Array, determined: NDArray[np.bool_]) -> None:
    """Fill covariances (S, 6, 6) of poses and (S,) whether their information (S, K, K) determines them; else zero."""
    count, size, _ = information.shape
    scale, lower, root = np.empty(size), np.empty((size, size)), np.empty((size, size))
    for s in range(count):
        # Metres and radians differ in size: only scaled pivots can be compared with rounding.
        for k in range(size):
            scale[k] = 1 / np.sqrt(information[s, k, k])
        least = factorise(information[s], scale, 0.0, lower)
        determined[s] = is_finite(least) and least > _LEAST_PIVOT
        if determined[s]:
            invert(lower, scale, root, covariances[s])
        else:
            covariances[s] = 0.0
