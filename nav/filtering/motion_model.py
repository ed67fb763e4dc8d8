"""Constant velocity under white acceleration, seen from a camera that shakes.

The accelerations are those of hose and receiver, alike along all axes, of the drogue's attitude, and of the camera's
attitude, which moves the picture of the drogue by its distance. The vibration lies above half the rate of the pairs:
it cannot be followed, and each pair sees another one. It is a state of its own all the same, because it belongs to the
pose that the camera sees. While the receiver turns, velocity goes round with the picture: the camera's rate is then far
above the drogue's, and what stands still outside runs on a circle about the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geometry.se3 import Array, exp_rotation, left_jacobian, skew
from nav.filtering.error_state import (
    PLACE,
    RATE,
    SIZE,
    TURN,
    VELOCITY,
    MotionState,
    orthonormal,
    symmetric,
)
from nav.filtering.filter_settings import FilterSettings

_VIBRATION = slice(12, 18)
_AXES = np.eye(3)
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
    transition[_VIBRATION, _VIBRATION] = persists * np.eye(6)
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
    noise[_VIBRATION, _VIBRATION] = (1 - persists**2) * vibration_covariance(state.translation_m, settings)
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
