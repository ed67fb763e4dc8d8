"""Least squares over the reprojection residuals of poses, compiled."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.numerics.compiled import compiled
from nav.numerics.damped_steps import solve_damped
from nav.pose.reprojection_loops import Shared, linearise_frame

_ITERATIONS = 20
# Keeps the normal equations of a frontal, far drogue solvable; far below any information a marker brings.
_DAMPING_FRACTION = 1e-9
_LARGEST_TURN_RAD = 0.35
# The sine of a smaller angle is the angle, in float64.
_SMALLEST_ANGLE_RAD = 1e-9
_LARGEST_MOVE_FRACTION = 0.3
_LARGEST_DEPARTURE_SIGMAS = 10.0
# The last step would lower the cost by less, so it moves no parameter by more than 5e-5 deviations, and is still taken.
_CONVERGED = 1e-9
# A start whose steps had to be shortened to this share is stuck at its minimum's rounding.
_LEAST_REACH = 1e-4


@compiled
def _normal(jacobian: Array, normal: Array) -> None:
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
    """Fill a Gauss-Newton step; by how much the linearised cost would sink. Scale, gradient and root are for work."""
    for k in range(len(step)):
        # Where nothing was measured any scale will do: the step is zero there.
        scale[k] = 1 / np.sqrt(normal[k, k]) if normal[k, k] > 0 else 1.0
        gradient[k] = 0.0
        for m in range(len(residuals)):
            gradient[k] -= jacobian[k, m] * residuals[m]
    solve_damped(normal, scale, gradient, _DAMPING_FRACTION, root, step)
    gain = 0.0
    for k in range(len(step)):
        gain += step[k] * gradient[k] / 2
    return gain


@compiled
def _limit(step: Array, depth_m: float) -> None:
    """Shorten a step in place."""
    for start, limit in ((0, _LARGEST_MOVE_FRACTION * abs(depth_m)), (3, _LARGEST_TURN_RAD)):
        length = np.sqrt(step[start] ** 2 + step[start + 1] ** 2 + step[start + 2] ** 2)
        if length > limit:
            for k in range(start, start + 3):
                step[k] *= limit / length
    for k in range(6, len(step)):
        step[k] = min(max(step[k], -_LARGEST_DEPARTURE_SIGMAS), _LARGEST_DEPARTURE_SIGMAS)


@compiled
def _turn(rotation: Array, x: float, y: float, z: float, turned: Array) -> None:
    """Fill a rotation, turned by a rotation vector: `I + sin(a) / a [v]x + 2 sin^2(a / 2) / a^2 [v]x^2` (Rodrigues)."""
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
    shared: Shared,
    measured: Array,
    coupling: Array,
    rotations: Array,
    translations_m: Array,
    departures: Array,
    costs: Array,
    information: Array,
) -> None:
    """Take S poses to minima of their costs, in place, and fill costs (S,) and information (S, K, K) there.

    Gauss-Newton; a step that raises the cost is shortened. `measured` and `coupling` are those of `linearise_frames`.
    """
    count, free = departures.shape
    size = 6 + free
    prior_rows = 2 if np.isfinite(shared.tilt_prior_rad) else 0
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
            if not np.isfinite(cost):
                break
            _normal(jacobian[now], normal)
            gain = _find_step(jacobian[now], residuals[now], normal, scale, gradient, root, step)
            _limit(step, translations_m[s, 2])
            _turn(rotations[s], reach * step[3], reach * step[4], reach * step[5], turned)
            for k in range(3):
                moved[k] = translations_m[s, k] + reach * step[k]
            for k in range(free):
                departed[k] = departures[s, k] + reach * step[6 + k]
            ahead = linearise_frame(
                shared, own, coupled, turned, moved, departed, jacobian[1 - now], residuals[1 - now]
            )
            if ahead <= cost:
                rotations[s], translations_m[s], departures[s] = turned, moved, departed
                now, cost, reach = 1 - now, ahead, min(1.0, 2 * reach)
            else:
                reach *= 0.25
            if gain < _CONVERGED or reach < _LEAST_REACH:
                break
        costs[s] = cost
        _normal(jacobian[now], information[s])
