"""The receiver: its attitude, its desired path behind the drogue, and the guidance that follows it with a lag."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from datasets_manifest.recipe.drogue_ranges import PoseRanges
from datasets_manifest.recipe.sequence_ranges import (
    CLOSURE_ACCELERATION_M_S2,
    Follower,
    Manoeuvre,
    Receiver,
    run_time_s,
)
from geometry.se3 import Array
from scenes.environment_sampling import sample_uniform

# Camera axes (right, down, forward) of a receiver that flies east, in world axes (east, north, up).
_WORLD_FROM_LEVEL_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# Our choice: the response to a step overshoots by 1.5 %.
_DAMPING = 0.8


def sample_attitude(rng: np.random.Generator, pose: PoseRanges) -> Array:
    """(3, 3) rotation `world_from_left` of a receiver that flies east with a drawn pitch and bank."""
    pitch, bank = np.radians([sample_uniform(rng, pose.camera_pitch_deg), sample_uniform(rng, pose.camera_bank_deg)])
    about_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    about_z = np.array([[np.cos(bank), -np.sin(bank), 0], [np.sin(bank), np.cos(bank), 0], [0, 0, 1]])
    rotation: Array = _WORLD_FROM_LEVEL_CAMERA @ about_x @ about_z
    return rotation


def closure_distance_m(time_s: Array, length_m: float, speed_m_s: float) -> Array:
    """(...) distance covered (...) s after the start of a run over a length, from rest to rest. [m]"""
    peak_m_s = min(speed_m_s, (length_m * CLOSURE_ACCELERATION_M_S2) ** 0.5)
    rise_s = peak_m_s / CLOSURE_ACCELERATION_M_S2
    total_s = run_time_s(length_m, speed_m_s)
    time = np.clip(time_s, 0.0, total_s)
    half = CLOSURE_ACCELERATION_M_S2 / 2
    steady = half * rise_s**2 + peak_m_s * (time - rise_s)
    distance: Array = np.where(time < rise_s, half * time**2, steady)
    distance = np.where(total_s - time < rise_s, length_m - half * (total_s - time) ** 2, distance)
    return distance


def desired_offsets_m(receiver: Receiver, manoeuvre: Manoeuvre, offset_m: Sequence[float], time_s: Array) -> Array:
    """Desired position of the drogue relative to the receiver.

    Args:
        receiver: distances and speeds.
        manoeuvre: of this sequence.
        offset_m: right and down, at the start. [m]
        time_s: (T,) from the start of the sequence. [s]

    Returns:
        (T, 3) right and down of the rig's axis, and forward of the left eye. [m]
    """
    near_m = receiver.nearest_m(manoeuvre)
    length_m = receiver.start_m - near_m
    share = np.ones_like(time_s)
    depth = np.full_like(time_s, receiver.start_m)
    if manoeuvre != "station":
        depth -= closure_distance_m(time_s - receiver.hold_s, length_m, receiver.closure_m_s)
    if manoeuvre == "docking":
        share = (depth - near_m) / length_m
    if manoeuvre == "missed-approach":
        turn_s = receiver.hold_s + run_time_s(length_m, receiver.closure_m_s)
        depth += closure_distance_m(time_s - turn_s, length_m, receiver.closure_m_s)
    return np.stack([share * offset_m[0], share * offset_m[1], depth], axis=-1)


class Guidance:
    """Steers a receiver to a position relative to the drogue, sample by sample.

    It knows its own position and velocity relative to the tanker without delay, and the drogue's position with a delay.
    Between samples its acceleration is constant.
    """

    def __init__(self, follower: Follower, period_s: float, start_m: Array) -> None:
        """Start at rest.

        Args:
            follower: bandwidth, delay and limit.
            period_s: of the samples. [s]
            start_m: (3, S) position. [m]
        """
        self._rate = 2 * np.pi * follower.bandwidth_hz
        self._limit_m_s2 = follower.acceleration_limit_m_s2
        self._delay = follower.delay_s / period_s
        self._period_s = period_s
        self._drogue_history: list[Array] = []
        self.position_m = start_m.copy()
        self.velocity_m_s = np.zeros_like(start_m)
        self.acceleration_m_s2 = np.zeros_like(start_m)

    def position_after(self, offset_s: float) -> Array:
        """(3, S) position a fraction of a period after the last sample. [m]"""
        position: Array = self.position_m + offset_s * self.velocity_m_s + offset_s**2 / 2 * self.acceleration_m_s2
        return position

    def steer(self, drogue_m: Array, from_drogue_m: Array, from_drogue_m_s: Array) -> None:
        """Set the acceleration until the next sample.

        Args:
            drogue_m: (3, S) present position of the drogue; guidance uses it after the delay. [m]
            from_drogue_m: (3, S) desired position of the receiver relative to the drogue. [m]
            from_drogue_m_s: (3, S) its rate. [m/s]
        """
        self._drogue_history.append(drogue_m.copy())
        known, moving = self._known()
        # Extrapolated over the delay: the error is of second order.
        now = known + self._delay * self._period_s * moving
        error = now + from_drogue_m - self.position_m
        error_rate = moving + from_drogue_m_s - self.velocity_m_s
        away = np.maximum(np.linalg.norm(error, axis=0), 1e-12)
        # From far away no faster than half the acceleration limit can stop within the distance, to avoid overshoot.
        speed = np.minimum(self._rate / (2 * _DAMPING) * away, np.sqrt(self._limit_m_s2 * away))
        wanted = 2 * _DAMPING * self._rate * (speed * error / away + error_rate)
        size = np.linalg.norm(wanted, axis=0)
        self.acceleration_m_s2 = wanted * np.minimum(1.0, self._limit_m_s2 / np.maximum(size, 1e-12))

    def move(self) -> None:
        """Advance to the next sample."""
        self.position_m = self.position_after(self._period_s)
        self.velocity_m_s = self.velocity_m_s + self._period_s * self.acceleration_m_s2

    def _known(self) -> tuple[Array, Array]:
        """(3, S) position and velocity of the drogue one delay ago."""
        at = len(self._drogue_history) - 1 - self._delay
        if at < 1:
            return self._drogue_history[0], np.zeros_like(self._drogue_history[0])
        # The velocity is that of the previous step, as the next one is younger than the delay.
        older, newer = self._drogue_history[int(at) - 1 : int(at) + 1]
        return newer + (at - int(at)) * (newer - older), (newer - older) / self._period_s
