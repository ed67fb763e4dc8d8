"""Weighted Gauss-Newton adjustment of many poses at once, each to its own frame's features."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array, skew
from nav.pose.features import Features
from nav.pose.reprojection import SQUARES, Linearised, Loss, State, linearise

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
# Poses that are done leave the batch when they are more than this share of it; copying costs less than computing then.
_DONE_FRACTION = 0.3


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Poses that each start led to.

    Attributes:
        rotations: (S, 3, 3) `left_from_drogue`.
        translations_m: (S, 3).
        departures: (S, G) from the nominal drogue and rig, see `State`.
        costs: (S,) half the sum of squared whitened residuals, with priors.
        information: (S, K, K) in the tangent of `datasets_manifest.estimates`, and the departures.
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
    count = len(rotations)
    state = State.nominal(features, rotations.copy(), translations_m.copy())
    size = 6 + features.departures
    result = Adjusted(
        rotations.copy(),
        translations_m.copy(),
        np.zeros_like(state.departures),
        np.empty(count),
        np.empty((count, size, size)),
    )
    now = linearise(features, state, loss)
    active, reach = np.arange(count), np.ones(count)
    done = np.zeros(count, dtype=bool)
    for _ in range(_ITERATIONS):
        steps, gain = _steps(now, state)
        trial = _moved(state, reach[:, None] * steps)
        ahead = linearise(features, trial, loss)
        better = ahead.costs <= now.costs
        state, now = _chosen(better, trial, state), _kept(better, ahead, now)
        reach = np.where(better, np.minimum(1.0, 2 * reach), 0.25 * reach)
        done |= (gain < _CONVERGED) | (reach < _LEAST_REACH)
        if done.all():
            break
        if done.sum() > _DONE_FRACTION * len(done):
            _store(result, active[done], state, now, done)
            left = ~done
            active, reach, done = active[left], reach[left], done[left]
            features = features.take(np.flatnonzero(left))
            state = State(state.rotations[left], state.translations_m[left], state.departures[left])
            now = Linearised(now.jacobian[left], now.residuals[left], now.costs[left])
    _store(result, active, state, now, np.ones(len(active), dtype=bool))
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


def _steps(now: Linearised, state: State) -> tuple[Array, Array]:
    """(S, K) Gauss-Newton steps of limited length, (S,) by how much the linearised cost would sink."""
    normal = now.information
    diagonal = np.einsum("skk->sk", normal)
    # Where nothing was measured, any positive number keeps the equations solvable; the step is zero there.
    diagonal += _DAMPING_FRACTION * diagonal + (diagonal == 0)
    gradient = (now.jacobian @ now.residuals[..., None])[..., 0]
    sound = np.isfinite(now.costs)
    if not sound.all():
        normal = np.where(sound[:, None, None], normal, np.eye(normal.shape[1]))
        gradient = np.where(sound[:, None], gradient, 0.0)
    steps = -np.linalg.solve(normal, gradient[..., None])[..., 0]
    gain = -(steps * gradient).sum(axis=1) / 2
    move_turn = steps[:, :6].reshape(-1, 2, 3)
    limits = np.full((len(steps), 2), _LARGEST_TURN_RAD)
    limits[:, 0] = _LARGEST_MOVE_FRACTION * np.abs(state.translations_m[:, 2])
    move_turn /= np.maximum(1.0, np.sqrt((move_turn**2).sum(axis=2)) / limits)[:, :, None]
    if state.departures.shape[1]:
        np.clip(steps[:, 6:], -_LARGEST_DEPARTURE_SIGMAS, _LARGEST_DEPARTURE_SIGMAS, out=steps[:, 6:])
    return steps, gain


def _moved(state: State, steps: Array) -> State:
    rotations = _turns(steps[:, 3:6]) @ state.rotations
    return State(rotations, state.translations_m + steps[:, :3], state.departures + steps[:, 6:])


def _turns(vectors_rad: Array) -> Array:
    """(S, 3, 3) rotations of (S, 3) rotation vectors.

    Rodrigues' formula `I + sin(a) / a [v]x + 2 sin^2(a / 2) / a^2 [v]x^2`: a library's general rotations take ten times
    as long for two of them.
    """
    cross = skew(vectors_rad)
    angles = np.sqrt((vectors_rad**2).sum(axis=1))[:, None, None]
    angles = np.maximum(angles, _SMALLEST_ANGLE_RAD)
    half = np.sin(angles / 2) / angles
    turns: Array = np.eye(3) + np.sin(angles) / angles * cross + 2 * half * half * (cross @ cross)
    return turns


def _chosen(better: NDArray[np.bool_], trial: State, state: State) -> State:
    if better.all():
        return trial
    return State(
        np.where(better[:, None, None], trial.rotations, state.rotations),
        np.where(better[:, None], trial.translations_m, state.translations_m),
        np.where(better[:, None], trial.departures, state.departures),
    )


def _kept(better: NDArray[np.bool_], ahead: Linearised, now: Linearised) -> Linearised:
    if better.all():
        return ahead
    return Linearised(
        np.where(better[:, None, None], ahead.jacobian, now.jacobian),
        np.where(better[:, None], ahead.residuals, now.residuals),
        np.where(better, ahead.costs, now.costs),
    )


def _store(result: Adjusted, where: NDArray[np.int64], state: State, now: Linearised, which: NDArray[np.bool_]) -> None:
    result.rotations[where], result.translations_m[where] = state.rotations[which], state.translations_m[which]
    result.departures[where], result.costs[where] = state.departures[which], now.costs[which]
    result.information[where] = now.information[which]
