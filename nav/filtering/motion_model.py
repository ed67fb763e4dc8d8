"""Motion of the drogue against the left camera: state, error covariance, and prediction in time.

The model is constant velocity under white acceleration, seen from a vibrating camera. Three white accelerations act:
that between hose and receiver, alike along all axes; that of the drogue's attitude; and that of the camera's attitude,
which moves the image of the drogue in proportion to its distance. Vibration lies above half the pair rate, so it cannot
be followed: each pair sees another sample of it. It is part of the state because it is part of the pose that the camera
sees. While the receiver turns, velocity turns with the image: the camera's rate is then far above the drogue's, and
what stands still outside moves on a circle about the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from geometry.se3 import Array, RigidTransform, exp_rotation, left_jacobian, log_rotation, skew

_MOST_HYPOTHESES = 16
_MAY_BE_ZERO = (
    "lasting",
    "vibration_m",
    "vibration_rad",
    "agitation_per_s",
    "turns_per_s",
    "max_coast_s",
    "max_delay_s",
)


@dataclass(frozen=True)
class FilterSettings:
    """Densities of white acceleration, vibration, and the filter's limits; sources: docs/explanation/filtering.md.

    Attributes:
        acceleration_m2_s3: density of the drogue's acceleration against the receiver, along each axis. [m^2/s^3]
        swing_rad2_s3: density of the angular acceleration of the drogue's attitude. [rad^2/s^3]
        camera_rad2_s3: density of the camera's angular acceleration, which moves what is far away most. [rad^2/s^3]
        lasting: how much larger the densities are over a long time than over an instant, less one: accelerations that
            last add up, which white ones do not; 0 for white ones.
        lasting_s: how long they last. [s]
        vibration_m, vibration_rad: standard deviations of the camera's fast shaking along and about each axis.
        vibration_s: after this time the shaking is another one. [s]
        agitation_per_s: how fast the factor changes that rougher or calmer air puts on the three densities, as
            variance of its logarithm; 0 for air as the densities say. [1/s]
        turn_rad2_s3: density of the camera's angular acceleration while the receiver turns aside or back. [rad^2/s^3]
        turns_per_s: how often it begins to; 0 where it never does. [1/s]
        turn_s: how long it does. [s]
        start_speed_m_s, start_rate_rad_s, start_turn_rad_s: standard deviations along and about each axis at the first
            fix: of the drogue's speed and rate, and of the camera's rate, which moves what is far away most.
        gate_probability: share of good fixes that the chi-square gate lets pass.
        restart_fixes: after so many rejected fixes in a row that fit each other, these are believed.
        max_coast_s: how long after its last fix the filter still answers. [s]
        max_delay_s: how much later than a newer fix one may still arrive. [s]
        most_hypotheses: how many explanations of ambiguous fixes are followed.
        least_weight: share below which an explanation is dropped.
    """

    acceleration_m2_s3: float = 0.1
    swing_rad2_s3: float = 0.01
    camera_rad2_s3: float = 0.0003
    lasting: float = 3.0
    lasting_s: float = 0.2
    vibration_m: float = 0.0002
    vibration_rad: float = 0.00018
    vibration_s: float = 0.005
    agitation_per_s: float = 0.05
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
            # A motion without surprises would be a filter that stops listening.
            may_be_zero = field.name in _MAY_BE_ZERO
            if not np.isfinite(value) or value < 0 or (value == 0 and not may_be_zero):
                raise ValueError(f"{field.name}: must be positive and finite, got {value}")
        if not self.gate_probability < 1:
            raise ValueError(f"gate_probability: must be below 1, got {self.gate_probability}")
        if not self.least_weight < 1 / self.most_hypotheses:
            raise ValueError(f"least_weight: must be below 1 / most_hypotheses, got {self.least_weight}")
        if self.most_hypotheses > _MOST_HYPOTHESES:
            raise ValueError(f"most_hypotheses: must be at most {_MOST_HYPOTHESES}, got {self.most_hypotheses}")


# Where what lies in an error: the drogue's place and turn without the camera's shaking, their rates, and the shaking.
PLACE, TURN, VELOCITY, RATE, SHIFT, SHAKE = (slice(3 * part, 3 * part + 3) for part in range(6))
VIBRATION = slice(12, 18)
SIZE = 18
_AXES = np.eye(3)
# Errors of what the filter tells: place and turn as the camera sees them, velocity, rate.
TOLD = 12


@dataclass(frozen=True, eq=False)
class MotionState:
    """Motion of the drogue against the left camera.

    The pose that the camera sees is `t + shift`, `exp([shake]x) R`; errors are `t + dt`, `exp([w]x) R` and sums.

    Attributes:
        translation_m: (3,) t. [m]
        rotation: (3, 3) R.
        velocity_m_s, rate_rad_s: (3,) each, `t' = v`, `R' = [rate]x R`. [m/s, rad/s]
        shift_m, shake_rad: (3,) each, the part of the pose that comes from vibration. [m, rad]
        covariance: (18, 18) of the error, in the order of the attributes above.
    """

    translation_m: Array
    rotation: Array
    velocity_m_s: Array
    rate_rad_s: Array
    shift_m: Array
    shake_rad: Array
    covariance: Array

    @cached_property
    def pose(self) -> RigidTransform:
        """`left_from_drogue` as the camera sees it, vibration included."""
        return RigidTransform(self._shaken @ self.rotation, self.translation_m + self.shift_m)

    def moved(self, error: Array, covariance: Array) -> MotionState:
        """The state that differs by an (18,) error.

        Args:
            error: from here to there.
            covariance: (18, 18) of the error about `error`, as seen from here; it goes along to the new tangent.
        """
        reset = np.eye(SIZE)
        reset[TURN, TURN] = left_jacobian(error[TURN])
        return MotionState(
            translation_m=self.translation_m + error[PLACE],
            rotation=orthonormal(exp_rotation(error[TURN]) @ self.rotation),
            velocity_m_s=self.velocity_m_s + error[VELOCITY],
            rate_rad_s=self.rate_rad_s + error[RATE],
            shift_m=self.shift_m + error[SHIFT],
            shake_rad=self.shake_rad + error[SHAKE],
            covariance=symmetric(reset @ covariance @ reset.T),
        )

    def error_of(self, other: MotionState) -> Array:
        """(18,) error that leads from here to another state."""
        return np.concatenate(
            [
                other.translation_m - self.translation_m,
                log_rotation(other.rotation @ self.rotation.T),
                other.velocity_m_s - self.velocity_m_s,
                other.rate_rad_s - self.rate_rad_s,
                other.shift_m - self.shift_m,
                other.shake_rad - self.shake_rad,
            ]
        )

    @cached_property
    def pose_jacobian(self) -> Array:
        """(6, 18) error of the pose that the camera sees, by the error of the state."""
        jacobian = np.zeros((6, SIZE))
        jacobian[:3, PLACE] = jacobian[:3, SHIFT] = _AXES
        jacobian[3:, TURN] = self._shaken
        jacobian[3:, SHAKE] = left_jacobian(self.shake_rad)
        return jacobian

    @cached_property
    def told_covariance(self) -> Array:
        """(12, 12) covariance of the pose that the camera sees, velocity and rate."""
        jacobian = np.zeros((TOLD, SIZE))
        jacobian[:6] = self.pose_jacobian
        jacobian[6:9, VELOCITY] = jacobian[9:, RATE] = _AXES
        return symmetric(jacobian @ self.covariance @ jacobian.T)

    @cached_property
    def _shaken(self) -> Array:
        """(3, 3) turn that comes from vibration."""
        return exp_rotation(self.shake_rad)


def symmetric(matrix: Array) -> Array:
    """The symmetric part, without what rounding leaves of the other."""
    part: Array = (matrix + matrix.T) / 2
    return part


def orthonormal(rotation: Array) -> Array:
    """The rotation nearest to a product of rotations, which rounding has bent.

    One step of Newton's iteration for the polar factor, which squares what is off: from rounding to nothing.
    """
    nearest: Array = rotation @ (1.5 * _AXES - 0.5 * (rotation.T @ rotation))
    return nearest


# Far below any centroid's worth, so that covariances have inverses where nothing shakes. [m, rad]
_LEAST_SHAKING = 1e-9


@dataclass(frozen=True, eq=False)
class Step:
    """One step in time.

    Attributes:
        state: after it.
        transition: (18, 18) of the error before to the error after.
        noise: (18, 18) covariance of what came in between.
        rough: (18, 18) the part of it that air makes, and that grows with its roughness.
    """

    state: MotionState
    transition: Array
    noise: Array
    rough: Array


def advance(
    state: MotionState, duration_s: float, settings: FilterSettings, factor: float = 1.0, turn_rad2_s3: float = 0.0
) -> Step:
    """Go on for a time.

    With a turn, `v' = rate x v` instead of zero.

    Args:
        state: before.
        duration_s: not negative. [s]
        settings: densities and vibration.
        factor: on the densities of the settings.
        turn_rad2_s3: density of the camera's angular acceleration beyond those, where the receiver turns.
            [rad^2/s^3]
    """
    turn_rad = state.rate_rad_s * duration_s
    turn = exp_rotation(turn_rad)
    persists = float(np.exp(-duration_s / settings.vibration_s))
    transition = np.eye(SIZE)
    transition[PLACE, VELOCITY] = duration_s * _AXES
    transition[TURN, TURN] = turn
    transition[TURN, RATE] = duration_s * left_jacobian(turn_rad)
    transition[VIBRATION, VIBRATION] = persists * np.eye(6)
    velocity, curve = state.velocity_m_s, np.zeros(3)
    if turn_rad2_s3 > 0:
        bend = skew(state.rate_rad_s) * duration_s**2 / 2
        velocity, curve = turn @ velocity, bend @ velocity
        transition[PLACE, VELOCITY] += bend
        transition[PLACE, RATE] = -skew(state.velocity_m_s) * duration_s**2 / 2
        transition[VELOCITY, VELOCITY] = turn
        transition[VELOCITY, RATE] = -skew(velocity) @ transition[TURN, RATE]
    rough = factor * _noise(
        seen_from_turning(
            state.translation_m, settings.acceleration_m2_s3, settings.swing_rad2_s3, settings.camera_rad2_s3
        ),
        duration_s,
    )
    noise = rough.copy()
    if turn_rad2_s3 > 0:
        noise += _noise(seen_from_turning(state.translation_m, 0.0, 0.0, turn_rad2_s3), duration_s)
    noise[VIBRATION, VIBRATION] = (1 - persists**2) * vibration_covariance(state.translation_m, settings)
    moved = replace(
        state,
        translation_m=state.translation_m + duration_s * state.velocity_m_s + curve,
        velocity_m_s=velocity,
        rotation=orthonormal(turn @ state.rotation),
        shift_m=persists * state.shift_m,
        shake_rad=persists * state.shake_rad,
        covariance=symmetric(transition @ state.covariance @ transition.T + noise),
    )
    return Step(moved, transition, noise, rough)


def vibration_covariance(translation_m: Array, settings: FilterSettings) -> Array:
    """(6, 6) covariance of shift and shake of a drogue at (3,) that a shaking camera sees. [m, rad]

    A camera that turns by a small a sees the drogue shifted by `-a x t` and turned by -a.
    """
    along2, about2 = (max(sd, _LEAST_SHAKING) ** 2 for sd in (settings.vibration_m, settings.vibration_rad))
    return seen_from_turning(translation_m, along2, 0.0, about2)


def _noise(density: Array, duration_s: float) -> Array:
    """(18, 18) covariance that white acceleration of a (6, 6) density leaves after a time.

    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001,
    eq. 6.2.2-4, doi:10.1002/0471221279.
    """
    noise = np.zeros((SIZE, SIZE))
    noise[:6, :6] = density * duration_s**3 / 3
    noise[:6, 6:12] = noise[6:12, :6] = density * duration_s**2 / 2
    noise[6:12, 6:12] = density * duration_s
    return noise


def seen_from_turning(translation_m: Array, along2: float, about2: float, camera2: float) -> Array:
    """(6, 6) covariance of place and turn from those along and about each axis of the drogue, and about the camera's.

    So it is of their rates, and of their accelerations.
    """
    lever = skew(translation_m)
    seen = np.zeros((6, 6))
    seen[:3, :3] = along2 * _AXES + camera2 * lever @ lever.T
    seen[:3, 3:] = -camera2 * lever
    seen[3:, :3] = seen[:3, 3:].T
    seen[3:, 3:] = (about2 + camera2) * _AXES
    return seen
