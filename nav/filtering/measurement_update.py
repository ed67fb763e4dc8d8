"""Kalman update of one state by one measured pose: conversion of estimates, innovation, correction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets_manifest.types.estimates import TANGENT, PoseEstimate
from geometry.se3 import Array, RigidTransform, exp_rotation, log_rotation
from nav.filtering.motion_model import (
    SIZE,
    VIBRATION,
    FilterSettings,
    MotionState,
    orthonormal,
    seen_from_turning,
    symmetric,
    vibration_covariance,
)
from nav.pose.pose_method import NoFixReason

# Places and deviations beyond these are no drogue's, and squares of much larger ones overflow.
_FARTHEST_M = 1e5
_LARGEST_SD = 1e5
_SMALLEST_SD = 1e-9
# Of the correlation matrix; below, float64 cannot tell a covariance from a singular one.
_LEAST_EIGENVALUE = 1e-12
# Methods have two; more from a file would only cost time.
_MOST_MODES = 8
# A mode keeps at least this share of the mixture's variance in every direction.
_LEAST_OWN_SHARE = 1e-6


@dataclass(frozen=True, eq=False)
class Fix:
    """Poses that explain one pair of images.

    Attributes:
        poses: at least one.
        covariance: (6, 6) of each of them, in the tangent of `datasets_manifest.types.estimates`.
        weights: their shares, which sum to 1.
    """

    poses: tuple[RigidTransform, ...]
    covariance: Array
    weights: tuple[float, ...]


def fix_of(estimate: PoseEstimate, symmetry_order: int, least_weight: float) -> Fix | NoFixReason:
    """What can be filtered of an estimate, or why nothing can.

    An estimate between its modes has the covariance of their mixture; each mode's own is that without what the modes
    are apart.

    Args:
        estimate: of any method.
        symmetry_order: of the drogue's markers; of equivalent rolls, modes get the one nearest to the estimate's.
        least_weight: modes with a smaller share are left out.
    """
    covariance, pose = estimate.covariance, estimate.left_from_drogue
    if covariance is None:
        return NoFixReason("the estimate has no covariance")
    if estimate.tangent != TANGENT:
        return NoFixReason(f"the covariance is in another tangent: {estimate.tangent}")
    if np.abs(pose.translation_m).max() > _FARTHEST_M:
        return NoFixReason(f"the drogue is farther than {_FARTHEST_M:g} m")
    fault = _fault(covariance)
    if fault:
        return NoFixReason(f"the covariance {fault}")
    modes = sorted((mode for mode in estimate.modes if mode.weight > least_weight), key=lambda mode: -mode.weight)
    modes = modes[:_MOST_MODES]
    if len(modes) < 2:
        return Fix((pose,), symmetric(covariance), (1.0,))
    total = sum(mode.weight for mode in modes)
    weights = np.array([mode.weight / total for mode in modes])
    poses = tuple(nearest_roll(mode.left_from_drogue, pose.rotation, symmetry_order) for mode in modes)
    away = np.stack([pose_difference(pose, mode) for mode in poses])
    if np.abs(away[:, :3]).max() > _FARTHEST_M:
        return NoFixReason(f"a mode is farther than {_FARTHEST_M:g} m")
    # A method that reports its best mode instead reports that mode's covariance.
    is_mixture = np.linalg.norm(weights @ away) < np.linalg.norm(away[0])
    own = _without_spread(covariance, (away.T * weights) @ away) if is_mixture else symmetric(covariance)
    return Fix(poses, own, tuple(weights.tolist()))


def pose_difference(start: RigidTransform, end: RigidTransform) -> Array:
    """(6,) tangent vector that leads from one pose to another. [m, rad]"""
    return np.concatenate([end.translation_m - start.translation_m, log_rotation(end.rotation @ start.rotation.T)])


def nearest_roll(pose: RigidTransform, rotation: Array, symmetry_order: int) -> RigidTransform:
    """The pose turned about its axis by that multiple of the markers' turn which brings it nearest to a rotation."""
    turn = rotation.T @ pose.rotation
    # The trace of `turn @ R_z(angle)` is largest where the angle undoes the roll.
    roll_rad = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    steps = round(float(-roll_rad * symmetry_order / (2 * np.pi)))
    if steps % symmetry_order == 0:
        return pose
    about_axis = exp_rotation(np.array([0.0, 0.0, 2 * np.pi * steps / symmetry_order]))
    return RigidTransform(pose.rotation @ about_axis, pose.translation_m)


def _fault(covariance: Array) -> str:
    """What keeps a (6, 6) matrix from being a covariance of a pose; empty when nothing does."""
    variances = np.diag(covariance)
    if not ((variances > _SMALLEST_SD**2) & (variances < _LARGEST_SD**2)).all():
        return f"has a variance outside {_SMALLEST_SD**2:g} to {_LARGEST_SD**2:g}"
    correlation = covariance / np.sqrt(np.outer(variances, variances))
    if np.abs(correlation - correlation.T).max() > 1e-6 or np.abs(correlation).max() > 1 + 1e-6:
        return "is not symmetric"
    if np.linalg.eigvalsh(symmetric(correlation)).min() < _LEAST_EIGENVALUE:
        return "is not positive definite"
    return ""


def _without_spread(covariance: Array, spread: Array) -> Array:
    """A mixture's covariance less the (6, 6) spread of its modes, positive definite whatever rounding does."""
    scale = np.linalg.cholesky(symmetric(covariance))
    inverse = np.linalg.inv(scale)
    values, vectors = np.linalg.eigh(symmetric(np.eye(6) - inverse @ spread @ inverse.T))
    kept = scale @ vectors * np.sqrt(np.maximum(values, _LEAST_OWN_SHARE))
    return symmetric(kept @ kept.T)


_POSE = 6


@dataclass(frozen=True, eq=False)
class Innovation:
    """What a measured pose says beyond the prediction.

    Attributes:
        error: (6,) from the predicted to the measured pose, in the tangent of `datasets_manifest.types.estimates`.
        jacobian: (6, 18) of the predicted pose by the error of the state.
        whitener: (6, 6) inverse of the lower Cholesky factor of its covariance.
        white: (6,) `whitener @ error`.
        nis: its square, chi-square with 6 degrees of freedom.
        log_likelihood: logarithm of its density.
    """

    error: Array
    jacobian: Array
    whitener: Array
    white: Array
    nis: float
    log_likelihood: float


def innovation_of(state: MotionState, pose: RigidTransform, covariance: Array) -> Innovation:
    """Compare a measured pose with a predicted state.

    Args:
        state: at the time of the images.
        pose: measured, with the roll that is nearest to the state's.
        covariance: (6, 6) of it, positive definite.
    """
    jacobian = state.pose_jacobian
    error = pose_difference(state.pose, pose)
    factor = np.linalg.cholesky(symmetric(jacobian @ state.covariance @ jacobian.T + covariance))
    # Of so small a matrix the inverse costs less than three checked calls that solve with the factor.
    whitener = np.linalg.inv(factor)
    white = whitener @ error
    nis = float(white @ white)
    log_likelihood = -nis / 2 - float(np.log(np.diag(factor)).sum()) - _POSE / 2 * np.log(2 * np.pi)
    return Innovation(error, jacobian, whitener, white, nis, log_likelihood)


@dataclass(frozen=True, eq=False)
class Correction:
    """What a fix makes of a state.

    Attributes:
        state: after it.
        kept: (18, 18) `I - K H`, what is left of the error before.
    """

    state: MotionState
    kept: Array


def correct(state: MotionState, innovation: Innovation, covariance: Array) -> Correction:
    """Take a measured pose of a (6, 6) covariance.

    The covariance is updated in Joseph's form, which keeps it positive definite.
    """
    cross = state.covariance @ innovation.jacobian.T
    gain = cross @ innovation.whitener.T @ innovation.whitener
    kept = np.eye(SIZE) - gain @ innovation.jacobian
    posterior = kept @ state.covariance @ kept.T + gain @ covariance @ gain.T
    return Correction(state.moved(gain @ innovation.error, posterior), kept)


def first_state(pose: RigidTransform, covariance: Array, settings: FilterSettings) -> MotionState:
    """What one measured pose tells: where the drogue is but for the shaking, and nothing of its motion."""
    shaking = vibration_covariance(pose.translation_m, settings)
    initial = np.zeros((SIZE, SIZE))
    initial[:_POSE, :_POSE] = covariance + shaking
    initial[:_POSE, VIBRATION] = initial[VIBRATION, :_POSE] = -shaking
    initial[VIBRATION, VIBRATION] = shaking
    drogue2, camera2 = (settings.start_speed_m_s**2, settings.start_rate_rad_s**2), settings.start_turn_rad_s**2
    initial[6:12, 6:12] = seen_from_turning(pose.translation_m, *drogue2, camera2)
    zero = np.zeros(3)
    return MotionState(pose.translation_m, orthonormal(pose.rotation), zero, zero, zero, zero, symmetric(initial))
