"""Motion of hose, drogue and receiver in one sequence, at any time, with the receiver's attitude, path and guidance.

A sequence is simulated from its beginning, on time grids that do not depend on the times asked for; cubic splines
through the samples are, by definition, the true motion. `FrameKinematics` is what one stereo pair takes of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from datasets_manifest.recipe.drogue_ranges import PoseRanges
from datasets_manifest.recipe.sequence_ranges import (
    CLOSURE_ACCELERATION_M_S2,
    Follower,
    HoseParameters,
    Manoeuvre,
    Receiver,
    run_time_s,
)
from datasets_manifest.types.appearance import Obstacle
from datasets_manifest.types.frame import DropoutKind
from geometry.se3 import Array, RigidTransform
from scenes.environment_sampling import sample_uniform
from scenes.flight.airflow import GUST_PERIOD_S
from scenes.flight.hose_step import air_at_nodes
from scenes.flight.towed_hose import LINKS, TIME_STEP_S, HoseModel, HoseState, mouth_directions


@dataclass(frozen=True, eq=False)
class FrameKinematics:
    """Poses and motion of one pair; fields as in `FrameSpec`.

    Attributes:
        sequence_id: its sequence, or None for a single pair.
        time_s: mid-exposure. [s]
        left_from_drogue, left_from_tanker: poses, or None without a drogue.
        world_from_left: pose.
        camera_offset_m: east and north, as in `Environment`. [m]
        left_twist_per_s, drogue_twist_per_s: (6,) body twists. [m/s, rad/s]
        hose_nodes_left_m: (K, 3) from the coupling to the pod, or None without a drogue. [m]
        loss: as in `FrameSpec`.
        obstacle: a bar in front of the cameras, or None.
        sun_deg: elevation and azimuth of the sun if they differ from the scene's, or None. [deg]
    """

    sequence_id: int | None
    time_s: float
    left_from_drogue: RigidTransform | None
    world_from_left: RigidTransform
    left_from_tanker: RigidTransform | None
    left_twist_per_s: Array
    drogue_twist_per_s: Array
    hose_nodes_left_m: Array | None
    camera_offset_m: tuple[float, float] = (0.0, 0.0)
    loss: DropoutKind | None = None
    obstacle: Obstacle | None = None
    sun_deg: tuple[float, float] | None = None


# Camera axes (right, down, forward) of a receiver that flies east, in world axes (east, north, up).
_WORLD_FROM_LEVEL_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# Our choice: the response to a step overshoots by 1.5 %.
_DAMPING = 0.8
# Time in which hose and receiver forget their initial state: the slowest swing dies out within a few periods.
SETTLING_S = 20.0


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

    def position_after(self, offset_s: float | Array) -> Array:
        """(3, S) position a fraction of a period after the last sample, or (N, 3, S) for (N, 1, 1) of them. [m]"""
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


@dataclass(frozen=True, eq=False)
class SimulationInputs:
    """External inputs that move hose and receiver; all arrays start at the beginning of the simulation.

    Attributes:
        gusts_m_s: (T, 3, S) along the flight, sideways to the right, and up, `GUST_PERIOD_S` apart. [m/s]
        pod_m: function from (...) times [s] to (..., 3) positions of the pod about its mean [m].
        from_drogue_m: (T, 3, S) desired position of the receiver's left eye relative to the drogue's coupling. [m]
        nose_source_m: (3,) source of the bow wave relative to the left eye, in the tanker's axes. [m]
        body_radius_m: of the receiver's nose; 0 for no bow wave. [m]
        follower: the receiver's guidance.
    """

    gusts_m_s: Array
    pod_m: Callable[[Array], Array]
    from_drogue_m: Array
    nose_source_m: Array
    body_radius_m: float
    follower: Follower


@dataclass(frozen=True, eq=False)
class SimulatedMotion:
    """Samples of a simulation, `GUST_PERIOD_S` apart; axes are the tanker's.

    Attributes:
        nodes_m: (T, 3, S, N + 1) from the pod to the drogue. [m]
        past_drogue_m_s: (T, 3, S) velocity of the air past the drogue. [m/s]
        eye_m: (T, 3, S) position of the receiver's left eye. [m]
    """

    nodes_m: Array
    past_drogue_m_s: Array
    eye_m: Array


def simulate(
    hose: HoseParameters, inputs: SimulationInputs, release_m: Array | None = None, time_step_s: float = TIME_STEP_S
) -> SimulatedMotion:
    """Simulate sequences from the beginning.

    Args:
        hose: the hose and its flight condition.
        inputs: what moves hose and receiver.
        release_m: (3,) position at which the drogue is released, or None for the equilibrium in still air. [m]
        time_step_s: of the hose; `GUST_PERIOD_S` is a multiple of it. [s]

    Raises:
        ValueError: the time step does not divide `GUST_PERIOD_S`, or the hose is too light for it, or too short for
            `release_m`.
    """
    substeps = round(GUST_PERIOD_S / time_step_s)
    if substeps < 1 or abs(substeps * time_step_s - GUST_PERIOD_S) > 1e-12:
        raise ValueError(f"time_step_s: must be a whole part of {GUST_PERIOD_S} s, got {time_step_s}")
    samples, _, sequences = inputs.gusts_m_s.shape
    model = HoseModel(hose, sequences)
    model.check_step(time_step_s)
    still = model.equilibrium()
    state = model.equilibrium() if release_m is None else _released_hose(hose, release_m, sequences)
    times = time_step_s * np.arange(samples * substeps + 1)
    pod_m = np.repeat(inputs.pod_m(times)[..., None], sequences, axis=-1)
    state.nodes_m += pod_m[0][..., None]
    hanging_m = still.nodes_m[..., -1]
    begin_m = hanging_m if inputs.follower.bandwidth_hz == 0 else state.nodes_m[..., -1]
    guidance = Guidance(inputs.follower, GUST_PERIOD_S, begin_m + inputs.from_drogue_m[0])
    closing_m_s = np.gradient(inputs.from_drogue_m, GUST_PERIOD_S, axis=0)
    gusts = np.concatenate([inputs.gusts_m_s, inputs.gusts_m_s[-1:]])
    nodes, past, eyes, air = [], [], [], np.empty_like(state.nodes_m)
    bow = (hose.airspeed_m_s * inputs.body_radius_m**2 / 4, (inputs.body_radius_m / 2) ** 2)
    nose_m = inputs.nose_source_m[:, None]
    shares = (np.arange(substeps) / substeps)[:, None, None]
    for k in range(samples):
        if inputs.follower.bandwidth_hz == 0:
            guidance.position_m = hanging_m + inputs.from_drogue_m[k]
            guidance.velocity_m_s = closing_m_s[k]
        else:
            guidance.steer(state.nodes_m[..., -1], inputs.from_drogue_m[k], closing_m_s[k])
        # Of all steps at once: for arrays this small, calls cost more than sums.
        gust = gusts[k] + shares * (gusts[k + 1] - gusts[k])
        source = guidance.position_after(shares * GUST_PERIOD_S) + nose_m
        for step in range(substeps):
            air_at_nodes(state.nodes_m, gust[step], hose.airspeed_m_s, source[step], bow, air)
            if step == 0:
                nodes.append(state.nodes_m.copy())
                past.append(air[..., -1] - state.velocities_m_s[..., -1])
                eyes.append(guidance.position_m)
            model.step(state, air, pod_m[k * substeps + step + 1], time_step_s)
        guidance.move()
    return SimulatedMotion(nodes_m=np.stack(nodes), past_drogue_m_s=np.stack(past), eye_m=np.stack(eyes))


def _released_hose(hose: HoseParameters, release_m: Array, sequences: int) -> HoseState:
    """A hose at rest in an arc from the pod to a point, its links at their lengths."""
    chord_m = float(np.linalg.norm(release_m))
    ratio = chord_m / hose.length_m
    if ratio >= 1 or chord_m == 0:
        raise ValueError(
            f"release_m: a hose of {hose.length_m:g} m cannot hang between the pod and a point {chord_m:g} m away"
        )
    # Chord over length of N equal links on an arc, each turned by `turn` from the one before:
    # sin(N turn/2) / (N sin(turn/2)).
    turn = brentq(
        lambda angle: np.sin(LINKS * angle / 2) / (LINKS * np.sin(angle / 2)) - ratio, 1e-9, 2 * np.pi / LINKS
    )
    along = np.asarray(release_m) / chord_m
    down = np.array([0.0, 0.0, -1.0]) - along * -along[2]
    if np.linalg.norm(down) < 1e-9:
        down = np.array([1.0, 0.0, 0.0])
    down = down / np.linalg.norm(down)
    angles = turn * ((LINKS - 1) / 2 - np.arange(LINKS))
    links = hose.length_m / LINKS * (np.cos(angles) * along[:, None] + np.sin(angles) * down[:, None])
    nodes = np.zeros((3, sequences, LINKS + 1))
    nodes[:, :, 1:] = np.cumsum(links, axis=1)[:, None]
    tensions = np.zeros((sequences, LINKS))
    return HoseState(nodes_m=nodes, velocities_m_s=np.zeros_like(nodes), tensions_n=tensions)


class Trajectory:
    """One simulated sequence as functions of time; time 0 is the end of settling."""

    def __init__(self, motion: SimulatedMotion, settling_s: float) -> None:
        """Fit splines to the samples of the first sequence of a simulation."""
        times = GUST_PERIOD_S * np.arange(len(motion.nodes_m)) - settling_s
        nodes = motion.nodes_m[:, :, 0]
        mouth = mouth_directions(motion.past_drogue_m_s[..., 0], nodes[..., -1] - nodes[..., -2], GUST_PERIOD_S)
        self.end_s = float(times[-1])
        self._nodes = CubicSpline(times, nodes.transpose(0, 2, 1))
        self._mouth = CubicSpline(times, mouth)
        self._eye = CubicSpline(times, motion.eye_m[..., 0])

    def nodes_m(self, time_s: float) -> Array:
        """(N + 1, 3) hose from the pod to the drogue's coupling. [m]"""
        return np.asarray(self._nodes(time_s), dtype=np.float64)

    def mouth(self, time_s: float) -> Array:
        """(3,) direction from the coupling to the mouth, not of unit length."""
        return np.asarray(self._mouth(time_s), dtype=np.float64)

    def eye_m(self, time_s: float) -> Array:
        """(3,) position of the receiver's left eye, without vibration. [m]"""
        return np.asarray(self._eye(time_s), dtype=np.float64)
