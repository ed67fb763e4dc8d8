"""What a receiver means to do behind the drogue, and the guidance that does it with a lag."""

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
from scenes.environment import draw

# Camera axes (right, down, forward) of a receiver that flies east, in world axes (east, north, up).
_WORLD_FROM_LEVEL_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# Our choice: a step is followed with an overshoot of 1.5 %.
_DAMPING = 0.8


def sample_attitude(rng: np.random.Generator, pose: PoseRanges) -> Array:
    """(3, 3) rotation `world_from_left` of a receiver that flies east, pitched and banked."""
    pitch, bank = np.radians([draw(rng, pose.camera_pitch_deg), draw(rng, pose.camera_bank_deg)])
    about_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    about_z = np.array([[np.cos(bank), -np.sin(bank), 0], [np.sin(bank), np.cos(bank), 0], [0, 0, 1]])
    rotation: Array = _WORLD_FROM_LEVEL_CAMERA @ about_x @ about_z
    return rotation


def run_m(time_s: Array, length_m: float, speed_m_s: float) -> Array:
    """(...) way made (...) s after the start of a run over a length, from rest to rest. [m]"""
    peak_m_s = min(speed_m_s, (length_m * CLOSURE_ACCELERATION_M_S2) ** 0.5)
    rise_s = peak_m_s / CLOSURE_ACCELERATION_M_S2
    total_s = run_time_s(length_m, speed_m_s)
    time = np.clip(time_s, 0.0, total_s)
    half = CLOSURE_ACCELERATION_M_S2 / 2
    steady = half * rise_s**2 + peak_m_s * (time - rise_s)
    way: Array = np.where(time < rise_s, half * time**2, steady)
    way = np.where(total_s - time < rise_s, length_m - half * (total_s - time) ** 2, way)
    return way


def wanted_places(receiver: Receiver, manoeuvre: Manoeuvre, offset_m: Sequence[float], time_s: Array) -> Array:
    """Where the drogue is meant to be seen.

    Args:
        receiver: distances and speeds.
        manoeuvre: of this sequence.
        offset_m: right and down, at the beginning. [m]
        time_s: (T,) from the beginning of the sequence. [s]

    Returns:
        (T, 3) right and down of the rig's axis, and forward of the left eye. [m]
    """
    near_m = receiver.nearest_m(manoeuvre)
    length_m = receiver.start_m - near_m
    share = np.ones_like(time_s)
    depth = np.full_like(time_s, receiver.start_m)
    if manoeuvre != "station":
        depth -= run_m(time_s - receiver.hold_s, length_m, receiver.closure_m_s)
    if manoeuvre == "docking":
        share = (depth - near_m) / length_m
    if manoeuvre == "missed-approach":
        turn_s = receiver.hold_s + run_time_s(length_m, receiver.closure_m_s)
        depth += run_m(time_s - turn_s, length_m, receiver.closure_m_s)
    return np.stack([share * offset_m[0], share * offset_m[1], depth], axis=-1)


class Guidance:
    """A receiver that is steered to a place relative to what it knows of the drogue, sample by sample.

    It knows its own place and velocity against the tanker at once, and the drogue's place with a delay. Between samples
    its acceleration is constant.
    """

    def __init__(self, follower: Follower, period_s: float, start_m: Array) -> None:
        """Begin at rest.

        Args:
            follower: bandwidth, delay and limit.
            period_s: of the samples. [s]
            start_m: (3, S) place. [m]
        """
        self._rate = 2 * np.pi * follower.bandwidth_hz
        self._limit_m_s2 = follower.acceleration_limit_m_s2
        self._delay = follower.delay_s / period_s
        self._period_s = period_s
        self._seen: list[Array] = []
        self.place_m = start_m.copy()
        self.velocity_m_s = np.zeros_like(start_m)
        self.acceleration_m_s2 = np.zeros_like(start_m)

    def place_after(self, offset_s: float) -> Array:
        """(3, S) place a part of a period after the last sample. [m]"""
        place: Array = self.place_m + offset_s * self.velocity_m_s + offset_s**2 / 2 * self.acceleration_m_s2
        return place

    def steer(self, drogue_m: Array, from_drogue_m: Array, from_drogue_m_s: Array) -> None:
        """Decide the acceleration until the next sample.

        Args:
            drogue_m: (3, S) where the drogue is now; it is acted on when it is old enough. [m]
            from_drogue_m: (3, S) where the receiver should be from the drogue. [m]
            from_drogue_m_s: (3, S) how fast this changes. [m/s]
        """
        self._seen.append(drogue_m.copy())
        known, moving = self._known()
        # Carried on over the delay: what is left of it is of second order.
        now = known + self._delay * self._period_s * moving
        error = now + from_drogue_m - self.place_m
        error_rate = moving + from_drogue_m_s - self.velocity_m_s
        away = np.maximum(np.linalg.norm(error, axis=0), 1e-12)
        # From far away no faster than what half the limit can bring to rest on the way, so that it does not swing past.
        speed = np.minimum(self._rate / (2 * _DAMPING) * away, np.sqrt(self._limit_m_s2 * away))
        wanted = 2 * _DAMPING * self._rate * (speed * error / away + error_rate)
        size = np.linalg.norm(wanted, axis=0)
        self.acceleration_m_s2 = wanted * np.minimum(1.0, self._limit_m_s2 / np.maximum(size, 1e-12))

    def move(self) -> None:
        """Go on to the next sample."""
        self.place_m = self.place_after(self._period_s)
        self.velocity_m_s = self.velocity_m_s + self._period_s * self.acceleration_m_s2

    def _known(self) -> tuple[Array, Array]:
        """(3, S) place and velocity of the drogue a delay ago."""
        at = len(self._seen) - 1 - self._delay
        if at < 1:
            return self._seen[0], np.zeros_like(self._seen[0])
        # The rate is that of the step before, as the one after is younger than the delay.
        older, newer = self._seen[int(at) - 1 : int(at) + 1]
        return newer + (at - int(at)) * (newer - older), (newer - older) / self._period_s
