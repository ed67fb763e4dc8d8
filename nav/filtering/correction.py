"""One measured pose into one state: innovation, its chi-square, and the Kalman update."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.se3 import Array, RigidTransform
from nav.filtering.error_state import SIZE, MotionState, orthonormal, symmetric
from nav.filtering.filter_settings import FilterSettings
from nav.filtering.motion_model import seen_from_turning, vibration_covariance
from nav.filtering.pose_measurement import pose_difference

_POSE = 6
_VIBRATION = slice(12, 18)


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
    initial[:_POSE, _VIBRATION] = initial[_VIBRATION, :_POSE] = -shaking
    initial[_VIBRATION, _VIBRATION] = shaking
    drogue2, camera2 = (settings.start_speed_m_s**2, settings.start_rate_rad_s**2), settings.start_turn_rad_s**2
    initial[6:12, 6:12] = seen_from_turning(pose.translation_m, *drogue2, camera2)
    zero = np.zeros(3)
    return MotionState(pose.translation_m, orthonormal(pose.rotation), zero, zero, zero, zero, symmetric(initial))
