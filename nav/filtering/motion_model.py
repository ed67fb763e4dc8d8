"""Motion of the drogue against the left camera: state, error covariance, and prediction in time.

The model is constant velocity under white acceleration, seen from a vibrating camera. Three white accelerations act:
that between hose and receiver, alike along all axes; that of the drogue's attitude; and that of the camera's attitude,
which moves the image of the drogue in proportion to its distance. Vibration lies above half the pair rate, so it cannot
be followed: each pair sees another sample of it. It is part of the state because it is part of the pose that the camera
sees. While the receiver turns, velocity turns with the image: the camera's rate is then far above the drogue's, and
what stands still outside moves on a circle about the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from geometry.se3 import Array, RigidTransform, exp_rotation, left_jacobian, log_rotation, skew

_MOST_HYPOTHESES = 16
_MAY_BE_ZERO = (
    "long_term_excess",
    "vibration_m",
    "vibration_rad",
    "noise_scale_variance_per_s",
    "turns_per_s",
    "max_coast_s",
    "max_delay_s",
)


@dataclass(frozen=True)
class FilterSettings:
    """Noise densities, vibration and limits of the filter; docs/explanation/filtering.md has the sources.

    Attributes:
        acceleration_m2_s3: density of the drogue's acceleration against the receiver, along each axis. [m^2/s^3]
        swing_rad2_s3: density of the angular acceleration of the drogue's attitude. [rad^2/s^3]
        camera_rad2_s3: density of the camera's angular acceleration; its effect grows with distance. [rad^2/s^3]
        long_term_excess: ratio of the densities over a long time to those over an instant, less one. Correlated
            accelerations add up over time, white ones (0) do not.
        correlation_s: correlation time of the accelerations. [s]
        vibration_m, vibration_rad: standard deviations of the camera's vibration along and about each axis.
        vibration_s: correlation time of the vibration. [s]
        noise_scale_variance_per_s: growth of the variance of the logarithm of `ProcessNoiseScale`, by which rough or
            calm air scales the three densities; 0 keeps the densities as they are. [1/s]
        turn_rad2_s3: density of the camera's angular acceleration while the receiver begins or ends a turn. [rad^2/s^3]
        turns_per_s: how often a turn begins; 0 for never. [1/s]
        turn_s: how long a turn lasts. [s]
        start_speed_m_s, start_rate_rad_s, start_turn_rad_s: standard deviations along and about each axis at the first
            measurement: of the drogue's speed and rate, and of the camera's rate, whose effect grows with distance.
        gate_probability: share of good measurements that pass the chi-square gate.
        restart_fixes: the filter restarts after this many consecutive rejected measurements that agree with each other.
        max_coast_s: how long after its last measurement the filter still predicts. [s]
        max_delay_s: how much older than the newest measurement another one may be. [s]
        most_hypotheses: how many hypotheses are kept.
        least_weight: hypotheses with a smaller weight are dropped.
    """

    acceleration_m2_s3: float = 0.1
    swing_rad2_s3: float = 0.01
    camera_rad2_s3: float = 0.0003
    long_term_excess: float = 3.0
    correlation_s: float = 0.2
    vibration_m: float = 0.0002
    vibration_rad: float = 0.00018
    vibration_s: float = 0.005
    noise_scale_variance_per_s: float = 0.05
    turn_rad2_s3: float = 0.5
    turns_per_s: float = 0.001
    turn_s: float = 0.5
    start_speed_m_s: float = 3.0
    start_rate_rad_s: float = 0.5
    start_turn_rad_s: float = 1.0
    gate_probability: float = 0.999999
    restart_fixes: int = 5
    max_coast_s: float = 0.5
    max_delay_s: float = 1.0
    most_hypotheses: int = 4
    least_weight: float = 1e-3

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            # Without process noise the gain goes to zero, and the filter ignores new measurements.
            may_be_zero = field.name in _MAY_BE_ZERO
            if not np.isfinite(value) or value < 0 or (value == 0 and not may_be_zero):
                raise ValueError(f"{field.name}: must be positive and finite, got {value}")
        if not self.gate_probability < 1:
            raise ValueError(f"gate_probability: must be below 1, got {self.gate_probability}")
        if not self.least_weight < 1 / self.most_hypotheses:
            raise ValueError(f"least_weight: must be below 1 / most_hypotheses, got {self.least_weight}")
        if self.most_hypotheses > _MOST_HYPOTHESES:
            raise ValueError(f"most_hypotheses: must be at most {_MOST_HYPOTHESES}, got {self.most_hypotheses}")


# Slices of the error vector: the drogue's position and attitude without the camera's vibration, their rates, and the
# vibration.
POSITION, ATTITUDE, VELOCITY, RATE, VIBRATION_SHIFT, VIBRATION_TURN = (
    slice(3 * part, 3 * part + 3) for part in range(6)
)
VIBRATION = slice(12, 18)
SIZE = 18
_AXES, _IDENTITY = np.eye(3), np.eye(SIZE)
# Size of the reported error: position and attitude as the camera sees them, velocity, rate.
REPORTED_SIZE = 12


@dataclass(frozen=True, eq=False)
class MotionState:
    """Motion of the drogue against the left camera.

    The camera sees the pose `t + shift`, `exp([turn]x) R`, with the shift and turn of vibration. Errors are defined by
    `t + dt`, `exp([w]x) R`, and sums for the other parts.

    Attributes:
        translation_m: (3,) t. [m]
        rotation: (3, 3) R.
        velocity_m_s, rate_rad_s: (3,) each, `t' = v`, `R' = [rate]x R`. [m/s, rad/s]
        vibration_shift_m, vibration_turn_rad: (3,) each, the part of the pose that comes from vibration. [m, rad]
        covariance: (18, 18) of the error, in the order of the attributes above.
    """

    translation_m: Array
    rotation: Array
    velocity_m_s: Array
    rate_rad_s: Array
    vibration_shift_m: Array
    vibration_turn_rad: Array
    covariance: Array

    @cached_property
    def pose(self) -> RigidTransform:
        """`left_from_drogue` as the camera sees it, vibration included."""
        return RigidTransform(self._vibration_rotation @ self.rotation, self.translation_m + self.vibration_shift_m)

    def with_error(self, error: Array, covariance: Array) -> MotionState:
        """The state after injecting an (18,) error.

        Args:
            error: from this state to the new one.
            covariance: (18, 18) of the error about `error` in this state's tangent; transformed to the new
                state's tangent.
        """
        reset = _IDENTITY.copy()
        reset[ATTITUDE, ATTITUDE] = left_jacobian(error[ATTITUDE])
        return MotionState(
            translation_m=self.translation_m + error[POSITION],
            rotation=orthonormal(exp_rotation(error[ATTITUDE]) @ self.rotation),
            velocity_m_s=self.velocity_m_s + error[VELOCITY],
            rate_rad_s=self.rate_rad_s + error[RATE],
            vibration_shift_m=self.vibration_shift_m + error[VIBRATION_SHIFT],
            vibration_turn_rad=self.vibration_turn_rad + error[VIBRATION_TURN],
            covariance=symmetric(reset @ covariance @ reset.T),
        )

    def error_to(self, other: MotionState) -> Array:
        """(18,) error from this state to another one."""
        return np.concatenate(
            [
                other.translation_m - self.translation_m,
                log_rotation(other.rotation @ self.rotation.T),
                other.velocity_m_s - self.velocity_m_s,
                other.rate_rad_s - self.rate_rad_s,
                other.vibration_shift_m - self.vibration_shift_m,
                other.vibration_turn_rad - self.vibration_turn_rad,
            ]
        )

    @cached_property
    def pose_jacobian(self) -> Array:
        """(6, 18) derivative of the error of the pose that the camera sees, by the error of the state."""
        jacobian = np.zeros((6, SIZE))
        jacobian[:3, POSITION] = jacobian[:3, VIBRATION_SHIFT] = _AXES
        jacobian[3:, ATTITUDE] = self._vibration_rotation
        jacobian[3:, VIBRATION_TURN] = left_jacobian(self.vibration_turn_rad)
        return jacobian

    @cached_property
    def reported_covariance(self) -> Array:
        """(12, 12) covariance of the pose that the camera sees, velocity and rate."""
        jacobian = np.zeros((REPORTED_SIZE, SIZE))
        jacobian[:6] = self.pose_jacobian
        jacobian[6:9, VELOCITY] = jacobian[9:, RATE] = _AXES
        return symmetric(jacobian @ self.covariance @ jacobian.T)

    @cached_property
    def _vibration_rotation(self) -> Array:
        """(3, 3) rotation that comes from vibration."""
        return exp_rotation(self.vibration_turn_rad)


def symmetric(matrix: Array) -> Array:
    """The symmetric part of a matrix, which removes the asymmetry of rounding."""
    part: Array = (matrix + matrix.T) / 2
    return part


def orthonormal(rotation: Array) -> Array:
    """The rotation nearest to a product of rotations, which rounding has made slightly non-orthonormal.

    One step of Newton's iteration for the polar factor. It converges quadratically, so one step removes rounding.
    """
    nearest: Array = rotation @ (1.5 * _AXES - 0.5 * (rotation.T @ rotation))
    return nearest


# Far below what any centroid resolves; keeps covariances invertible without vibration. [m, rad]
_SMALLEST_VIBRATION = 1e-9


@dataclass(frozen=True, eq=False)
class PredictionStep:
    """Prediction over one step in time.

    Attributes:
        state: after the step.
        transition: (18, 18) from the error before to the error after.
        noise: (18, 18) covariance of the process noise.
        air_noise: (18, 18) the part of it that comes from the air, and grows with its roughness.
    """

    state: MotionState
    transition: Array
    noise: Array
    air_noise: Array


def propagate(
    state: MotionState, duration_s: float, settings: FilterSettings, factor: float = 1.0, turn_rad2_s3: float = 0.0
) -> PredictionStep:
    """Propagate a state and its covariance in time.

    In a turn of the receiver, `v' = rate x v` instead of zero.

    Args:
        state: before.
        duration_s: not negative. [s]
        settings: densities and vibration.
        factor: scales the densities of the settings.
        turn_rad2_s3: additional density of the camera's angular acceleration in a turn of the receiver; 0 for no
            turn. [rad^2/s^3]
    """
    rotation_vector_rad = state.rate_rad_s * duration_s
    turn = exp_rotation(rotation_vector_rad)
    kept_vibration = float(np.exp(-duration_s / settings.vibration_s))
    transition = _IDENTITY.copy()
    transition[POSITION, VELOCITY] = duration_s * _AXES
    transition[ATTITUDE, ATTITUDE] = turn
    transition[ATTITUDE, RATE] = duration_s * left_jacobian(rotation_vector_rad)
    transition[VIBRATION, VIBRATION] = kept_vibration * _IDENTITY[VIBRATION, VIBRATION]
    velocity, turn_shift_m = state.velocity_m_s, np.zeros(3)
    if turn_rad2_s3 > 0:
        turn_coupling = skew(state.rate_rad_s) * duration_s**2 / 2
        velocity, turn_shift_m = turn @ velocity, turn_coupling @ velocity
        transition[POSITION, VELOCITY] += turn_coupling
        transition[POSITION, RATE] = -skew(state.velocity_m_s) * duration_s**2 / 2
        transition[VELOCITY, VELOCITY] = turn
        transition[VELOCITY, RATE] = -skew(velocity) @ transition[ATTITUDE, RATE]
    air_noise = factor * _air_noise(state.translation_m, duration_s, settings)
    noise = air_noise.copy()
    if turn_rad2_s3 > 0:
        turn_density = apparent_pose_covariance(state.translation_m, 0.0, 0.0, turn_rad2_s3)
        noise += _white_acceleration_noise(turn_density, duration_s)
    noise[VIBRATION, VIBRATION] = (1 - kept_vibration**2) * vibration_covariance(state.translation_m, settings)
    propagated = MotionState(
        translation_m=state.translation_m + duration_s * state.velocity_m_s + turn_shift_m,
        velocity_m_s=velocity,
        rotation=orthonormal(turn @ state.rotation),
        rate_rad_s=state.rate_rad_s,
        vibration_shift_m=kept_vibration * state.vibration_shift_m,
        vibration_turn_rad=kept_vibration * state.vibration_turn_rad,
        covariance=symmetric(transition @ state.covariance @ transition.T + noise),
    )
    return PredictionStep(state=propagated, transition=transition, noise=noise, air_noise=air_noise)


def vibration_covariance(translation_m: Array, settings: FilterSettings) -> Array:
    """(6, 6) covariance of the apparent shift and turn of a drogue at (3,), seen by a vibrating camera. [m, rad]

    A camera that turns by a small `a` sees the drogue shifted by `-a x t` and turned by `-a`.
    """
    position_variance, attitude_variance = (
        max(sd, _SMALLEST_VIBRATION) ** 2 for sd in (settings.vibration_m, settings.vibration_rad)
    )
    return apparent_pose_covariance(translation_m, position_variance, 0.0, attitude_variance)


def _air_noise(translation_m: Array, duration_s: float, settings: FilterSettings) -> Array:
    """(18, 18) process noise of the accelerations of the settings, for a drogue at (3,)."""
    density = apparent_pose_covariance(
        translation_m, settings.acceleration_m2_s3, settings.swing_rad2_s3, settings.camera_rad2_s3
    )
    return _white_acceleration_noise(density, duration_s)


def _white_acceleration_noise(density: Array, duration_s: float) -> Array:
    """(18, 18) process noise of white acceleration with a (6, 6) density over a time.

    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001,
    eq. 6.2.2-4, doi:10.1002/0471221279.
    """
    noise = np.zeros((SIZE, SIZE))
    noise[:6, :6] = density * duration_s**3 / 3
    noise[:6, 6:12] = noise[6:12, :6] = density * duration_s**2 / 2
    noise[6:12, 6:12] = density * duration_s
    return noise


def apparent_pose_covariance(
    translation_m: Array, position_variance: float, attitude_variance: float, camera_variance: float
) -> Array:
    """(6, 6) covariance of the drogue's position and attitude as a turning camera sees them.

    The same holds for their rates, and for their accelerations.

    Args:
        translation_m: (3,) position of the drogue. [m]
        position_variance: along each axis.
        attitude_variance: about each axis.
        camera_variance: of the camera's attitude, about each axis.
    """
    # p I + c L L^T, -c L and (a + c) I with the lever L = [t]x: by floats, because numpy takes several times as long.
    x, y, z = translation_m.tolist()
    p, c, both = position_variance, camera_variance, attitude_variance + camera_variance
    return np.array(
        [
            [p + c * (y * y + z * z), -c * x * y, -c * x * z, 0.0, c * z, -c * y],
            [-c * x * y, p + c * (x * x + z * z), -c * y * z, -c * z, 0.0, c * x],
            [-c * x * z, -c * y * z, p + c * (x * x + y * y), c * y, -c * x, 0.0],
            [0.0, -c * z, c * y, both, 0.0, 0.0],
            [c * z, 0.0, -c * x, 0.0, both, 0.0],
            [-c * y, c * x, 0.0, 0.0, 0.0, both],
        ]
    )
