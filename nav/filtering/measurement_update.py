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
    apparent_pose_covariance,
    orthonormal,
    symmetric,
    vibration_covariance,
)
from nav.pose.pose_method import NoFixReason

# Positions and standard deviations beyond these are implausible, and the squares of much larger ones overflow.
_LARGEST_DISTANCE_M = 1e5
_LARGEST_SD = 1e5
_SMALLEST_SD = 1e-9
# Of the correlation matrix; below it a covariance is singular within float64.
_LEAST_EIGENVALUE = 1e-12
# Our methods have two; more, from a file, would only cost time.
_MOST_MODES = 8
# Each mode keeps at least this share of the mixture's variance in every direction.
_SMALLEST_MODE_SHARE = 1e-6


@dataclass(frozen=True, eq=False)
class PoseMeasurement:
    """Poses that explain one pair of images.

    Attributes:
        poses: one for each mode, at least one.
        covariance: (6, 6) of each of them, in the tangent of `datasets_manifest.types.estimates`.
        weights: of the modes; they sum to 1.
    """

    poses: tuple[RigidTransform, ...]
    covariance: Array
    weights: tuple[float, ...]


def measurement_from_estimate(
    estimate: PoseEstimate, symmetry_order: int, least_weight: float
) -> PoseMeasurement | NoFixReason:
    """Convert an estimate to a measurement for the filter, or say why it cannot be used.

    An estimate that is the mean of its modes has the covariance of their mixture. The spread between the modes is
    subtracted from it to get the covariance of each mode.

    Args:
        estimate: of any method.
        symmetry_order: of the drogue's markers; of equivalent rolls, modes get the one nearest to the estimate's.
        least_weight: modes with a smaller weight are left out.
    """
    covariance, pose = estimate.covariance, estimate.left_from_drogue
    if covariance is None:
        return NoFixReason("the estimate has no covariance")
    if estimate.tangent != TANGENT:
        return NoFixReason(f"the covariance is in another tangent: {estimate.tangent}")
    if np.abs(pose.translation_m).max() > _LARGEST_DISTANCE_M:
        return NoFixReason(f"the drogue is farther than {_LARGEST_DISTANCE_M:g} m")
    fault = _covariance_fault(covariance)
    if fault:
        return NoFixReason(f"the covariance {fault}")
    modes = sorted((mode for mode in estimate.modes if mode.weight > least_weight), key=lambda mode: -mode.weight)
    modes = modes[:_MOST_MODES]
    if len(modes) < 2:
        return PoseMeasurement((pose,), symmetric(covariance), (1.0,))
    total = sum(mode.weight for mode in modes)
    weights = np.array([mode.weight / total for mode in modes])
    poses = tuple(nearest_roll(mode.left_from_drogue, pose.rotation, symmetry_order) for mode in modes)
    offsets = np.stack([pose_difference(pose, mode) for mode in poses])
    if np.abs(offsets[:, :3]).max() > _LARGEST_DISTANCE_M:
        return NoFixReason(f"a mode is farther than {_LARGEST_DISTANCE_M:g} m")
    # A method that reports its best mode, not the mean, reports the covariance of that mode.
    is_mixture_mean = np.linalg.norm(weights @ offsets) < np.linalg.norm(offsets[0])
    mode_covariance = (
        _subtract_mode_spread(covariance, (offsets.T * weights) @ offsets) if is_mixture_mean else symmetric(covariance)
    )
    return PoseMeasurement(poses, mode_covariance, tuple(weights.tolist()))


def pose_difference(start: RigidTransform, end: RigidTransform) -> Array:
    """(6,) tangent vector from one pose to another. [m, rad]"""
    return np.concatenate([end.translation_m - start.translation_m, log_rotation(end.rotation @ start.rotation.T)])


def nearest_roll(pose: RigidTransform, rotation: Array, symmetry_order: int) -> RigidTransform:
    """The pose, rolled by the multiple of the markers' symmetry angle that brings it nearest to a rotation."""
    return rolled(pose, steps_to_roll(pose.rotation, rotation, symmetry_order), symmetry_order)


def steps_to_roll(rotation: Array, wanted: Array, symmetry_order: int) -> int:
    """Number of the markers' symmetry angles about the drogue's axis that bring a rotation nearest to another."""
    turn = wanted.T @ rotation
    # The trace of `turn @ R_z(angle)` is largest where the angle undoes the roll.
    roll_rad = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    return round(float(-roll_rad * symmetry_order / (2 * np.pi)))


def rolled(pose: RigidTransform, steps: int, symmetry_order: int) -> RigidTransform:
    """The pose after a number of the markers' symmetry angles about the drogue's axis."""
    if steps % symmetry_order == 0:
        return pose
    about_axis = exp_rotation(np.array([0.0, 0.0, 2 * np.pi * steps / symmetry_order]))
    return RigidTransform(pose.rotation @ about_axis, pose.translation_m)


def _covariance_fault(covariance: Array) -> str:
    """Why a (6, 6) matrix is no covariance of a pose; empty when it is one."""
    variances = np.diag(covariance)
    if not ((variances > _SMALLEST_SD**2) & (variances < _LARGEST_SD**2)).all():
        return f"has a variance outside {_SMALLEST_SD**2:g} to {_LARGEST_SD**2:g}"
    correlation = covariance / np.sqrt(np.outer(variances, variances))
    if np.abs(correlation - correlation.T).max() > 1e-6 or np.abs(correlation).max() > 1 + 1e-6:
        return "is not symmetric"
    if np.linalg.eigvalsh(symmetric(correlation)).min() < _LEAST_EIGENVALUE:
        return "is not positive definite"
    return ""


def _subtract_mode_spread(covariance: Array, spread: Array) -> Array:
    """A mixture's covariance minus the (6, 6) spread of its modes, kept positive definite."""
    scale = np.linalg.cholesky(symmetric(covariance))
    inverse = np.linalg.inv(scale)
    values, vectors = np.linalg.eigh(symmetric(np.eye(6) - inverse @ spread @ inverse.T))
    error_factor = scale @ vectors * np.sqrt(np.maximum(values, _SMALLEST_MODE_SHARE))
    return symmetric(error_factor @ error_factor.T)


_POSE = 6


@dataclass(frozen=True, eq=False)
class Innovation:
    """Difference between a measured pose and its prediction.

    Attributes:
        error: (6,) from the predicted to the measured pose, in the tangent of `datasets_manifest.types.estimates`.
        jacobian: (6, 18) derivative of the predicted pose by the error of the state.
        whitener: (6, 6) inverse of the lower Cholesky factor of the covariance of `error`.
        whitened: (6,) `whitener @ error`.
        nis: normalised innovation squared, chi-square with 6 degrees of freedom.
        log_likelihood: logarithm of the density of `error`.
    """

    error: Array
    jacobian: Array
    whitener: Array
    whitened: Array
    nis: float
    log_likelihood: float


def compute_innovation(state: MotionState, pose: RigidTransform, covariance: Array) -> Innovation:
    """Compare a measured pose with a predicted state.

    Args:
        state: at the time of the images.
        pose: measured, with the roll that is nearest to the state's.
        covariance: (6, 6) of it, positive definite.
    """
    jacobian = state.pose_jacobian
    error = pose_difference(state.pose, pose)
    factor = np.linalg.cholesky(symmetric(jacobian @ state.covariance @ jacobian.T + covariance))
    # For a matrix this small, one inverse is faster than three checked solves with the factor.
    whitener = np.linalg.inv(factor)
    whitened = whitener @ error
    nis = float(whitened @ whitened)
    log_likelihood = -nis / 2 - float(np.log(np.diag(factor)).sum()) - _POSE / 2 * np.log(2 * np.pi)
    return Innovation(
        error=error,
        jacobian=jacobian,
        whitener=whitener,
        whitened=whitened,
        nis=nis,
        log_likelihood=log_likelihood,
    )


@dataclass(frozen=True, eq=False)
class Correction:
    """A state corrected by a measurement.

    Attributes:
        state: after the correction.
        error_factor: (18, 18) `I - K H`, the factor by which the error before enters the error after.
    """

    state: MotionState
    error_factor: Array


def correct_state(state: MotionState, innovation: Innovation, covariance: Array) -> Correction:
    """Kalman update of a state by a measured pose with a (6, 6) covariance.

    The covariance is updated in Joseph's form, which keeps it positive definite.
    """
    cross = state.covariance @ innovation.jacobian.T
    gain = cross @ innovation.whitener.T @ innovation.whitener
    error_factor = np.eye(SIZE) - gain @ innovation.jacobian
    posterior = error_factor @ state.covariance @ error_factor.T + gain @ covariance @ gain.T
    return Correction(state.with_error(gain @ innovation.error, posterior), error_factor)


def initial_state(pose: RigidTransform, covariance: Array, settings: FilterSettings) -> MotionState:
    """State after the first measured pose: pose and vibration are correlated, and the motion is unknown."""
    vibration = vibration_covariance(pose.translation_m, settings)
    initial = np.zeros((SIZE, SIZE))
    initial[:_POSE, :_POSE] = covariance + vibration
    initial[:_POSE, VIBRATION] = initial[VIBRATION, :_POSE] = -vibration
    initial[VIBRATION, VIBRATION] = vibration
    drogue_variances = (settings.start_speed_m_s**2, settings.start_rate_rad_s**2)
    camera_variance = settings.start_turn_rad_s**2
    initial[6:12, 6:12] = apparent_pose_covariance(pose.translation_m, *drogue_variances, camera_variance)
    zero = np.zeros(3)
    return MotionState(
        translation_m=pose.translation_m,
        rotation=orthonormal(pose.rotation),
        velocity_m_s=zero,
        rate_rad_s=zero,
        vibration_shift_m=zero,
        vibration_turn_rad=zero,
        covariance=symmetric(initial),
    )
