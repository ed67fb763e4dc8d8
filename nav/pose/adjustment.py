"""Weighted Gauss-Newton adjustment of a pose to the markers of both eyes, for several starts at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from geometry.se3 import Array, skew
from nav.pose.interface import Observation
from nav.pose.prediction import eye_points, predict_px

_ITERATIONS = 20
# Keeps the normal equations of a frontal, far drogue solvable; far below any information a marker brings.
_DAMPING_FRACTION = 1e-9
_LARGEST_TURN_RAD = 0.35
_LARGEST_MOVE_FRACTION = 0.3
# A step below this changes no digit that a benchmark prints. [m and rad]
_CONVERGED = 1e-9


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Poses that each start led to.

    Attributes:
        rotations: (S, 3, 3) `left_from_drogue`.
        translations_m: (S, 3).
        costs: (S,) half the sum of squared whitened residuals.
        information: (S, 6, 6) `J^T W J` in the tangent of `datasets_manifest.estimates`.
    """

    rotations: Array
    translations_m: Array
    costs: Array
    information: Array


def adjust(observation: Observation, rotations: Array, translations_m: Array) -> Adjusted:
    """Minimise the whitened reprojection error over all measurements of both eyes.

    A step that raises the cost is shortened, so a start never ends worse than it began.

    Args:
        observation: at least three markers, not on a line.
        rotations: (S, 3, 3) starts.
        translations_m: (S, 3).
    """
    whitening = whitening_matrices(observation)
    rotations, translations_m = rotations.copy(), translations_m.copy()
    residuals = _residuals(observation, whitening, rotations, translations_m)
    costs = _costs(residuals)
    reach = np.ones(len(costs))
    for _ in range(_ITERATIONS):
        jacobian = _jacobian(observation, whitening, rotations, translations_m)
        steps = reach[:, None] * _steps(jacobian, residuals, translations_m)
        new_rotations = Rotation.from_rotvec(steps[:, 3:]).as_matrix() @ rotations
        new_translations = translations_m + steps[:, :3]
        new_residuals = _residuals(observation, whitening, new_rotations, new_translations)
        new_costs = _costs(new_residuals)
        better = new_costs <= costs
        rotations[better], translations_m[better] = new_rotations[better], new_translations[better]
        residuals[better], costs[better] = new_residuals[better], new_costs[better]
        reach = np.where(better, np.minimum(1.0, 2 * reach), 0.25 * reach)
        if np.abs(steps).max() < _CONVERGED:
            break
    jacobian = _jacobian(observation, whitening, rotations, translations_m)
    return Adjusted(rotations, translations_m, costs, np.swapaxes(jacobian, 1, 2) @ jacobian)


def whitening_matrices(observation: Observation) -> Array:
    """(2, N, 2, 2) matrices that turn residuals into units of standard deviations; zero where nothing was measured."""
    whitening = np.zeros_like(observation.cov_px2)
    seen = observation.seen
    whitening[seen] = np.linalg.inv(np.linalg.cholesky(observation.cov_px2[seen]))
    return whitening


def _residuals(observation: Observation, whitening: Array, rotations: Array, translations_m: Array) -> Array:
    """(S, 4N) whitened differences of prediction and measurement."""
    measured = np.nan_to_num(observation.pixels_px)
    # A trial step may put a marker at a camera's own depth; its infinite cost turns the step down.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        difference = predict_px(observation.rig, observation.layout, rotations, translations_m) - measured
        whitened = np.einsum("enij,senj->seni", whitening, difference)
    flat: Array = whitened.reshape(len(rotations), -1)
    return flat


def _costs(residuals: Array) -> Array:
    """(S,) half the sum of squares, infinite where it is not a number."""
    with np.errstate(invalid="ignore", over="ignore"):
        costs = (residuals**2).sum(axis=1) / 2
    return np.where(np.isfinite(costs), costs, np.inf)


def _jacobian(observation: Observation, whitening: Array, rotations: Array, translations_m: Array) -> Array:
    """(S, 4N, 6) derivatives of the residuals; the shift of a disc's centre is left out, it hardly changes."""
    camera = observation.rig.camera
    points = eye_points(observation.rig, observation.layout.centers_m, rotations, translations_m)
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    zero = np.zeros_like(x)
    by_point = np.stack(
        [
            np.stack([camera.fx_px / z, zero, -camera.fx_px * x / z**2], axis=-1),
            np.stack([zero, camera.fy_px / z, -camera.fy_px * y / z**2], axis=-1),
        ],
        axis=-2,
    )
    levers = np.einsum("sij,nj->sni", rotations, observation.layout.centers_m)
    by_turn = -np.einsum("senij,snjk->senik", by_point, skew(levers))
    full = np.einsum("enij,senjk->senik", whitening, np.concatenate([by_point, by_turn], axis=-1))
    flat: Array = full.reshape(len(rotations), -1, 6)
    return flat


def _steps(jacobian: Array, residuals: Array, translations_m: Array) -> Array:
    """(S, 6) Gauss-Newton steps of limited length."""
    normal = np.swapaxes(jacobian, 1, 2) @ jacobian
    trace = np.trace(normal, axis1=1, axis2=2)
    damped = normal + _DAMPING_FRACTION * trace[:, None, None] * np.eye(6)
    gradient = np.einsum("smk,sm->sk", jacobian, residuals)
    steps = -np.linalg.solve(damped, gradient[..., None])[..., 0]
    move = np.linalg.norm(steps[:, :3], axis=1) / (_LARGEST_MOVE_FRACTION * np.abs(translations_m[:, 2]))
    turn = np.linalg.norm(steps[:, 3:], axis=1) / _LARGEST_TURN_RAD
    steps[:, :3] /= np.maximum(1.0, move)[:, None]
    steps[:, 3:] /= np.maximum(1.0, turn)[:, None]
    result: Array = steps
    return result
