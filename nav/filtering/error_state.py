"""The mean of the motion on its manifold, and the covariance of the error around it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from geometry.se3 import Array, RigidTransform, exp_rotation, left_jacobian, log_rotation

# Where what lies in an error: the drogue's place and turn without the camera's shaking, their rates, and the shaking.
PLACE, TURN, VELOCITY, RATE, SHIFT, SHAKE = (slice(3 * part, 3 * part + 3) for part in range(6))
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
