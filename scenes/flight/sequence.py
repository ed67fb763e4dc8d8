"""Sequences of a recipe: which sequence a pair belongs to, when it is taken, and where everything is then."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.drogue_ranges import PoseRanges
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.recipe.sequence_ranges import SequenceRanges
from drogue_models.parameters import DrogueParameters
from geometry.pinhole import PinholeCamera
from geometry.se3 import FRD_FROM_OPTICAL, Array, RigidTransform, exp_twist, log_twist
from scenes.environment_sampling import sample_uniform
from scenes.flight.airflow import GUST_PERIOD_S, dryden, sample_gusts
from scenes.flight.dropouts import (
    DropoutEvent,
    OccludingBar,
    formation_displacement_m,
    occluding_bar,
    sample_dropout,
    sun_beside_drogue_deg,
)
from scenes.flight.suspension import WORLD_FROM_TANKER, hose_tail_m
from scenes.flight.towed_hose import HoseModel, drogue_rotation, still_mouth_direction
from scenes.flight.trajectory import (
    SETTLING_S,
    FrameKinematics,
    SimulationInputs,
    Trajectory,
    desired_offsets_m,
    sample_attitude,
    simulate,
)
from scenes.framing import outline_points_m

_SINES = 8
# Pause between the last pair of a sequence and the first of the next, so that no tracker takes them for neighbours.
_PAUSE_S = 10.0
# Frequency bands of the motion of tanker and receiver; our choice. [Hz]
_TANKER_HZ, _ATTITUDE_HZ, _VIBRATION_HZ = (0.05, 0.2), (0.05, 0.6), (8.0, 40.0)
# Step of central differences for rates: its error is (2 pi 40 Hz 1e-5 s)^2 / 6 = 1e-6 of the fastest vibration.
_HALF_DIFFERENCE_S = 1e-5
# Nearest that the rim may come to the left eye. [m]
_NEAREST_M = 0.1
# Largest angle of the drogue's axis from the camera's: the camera must see the mouth, not the back.
_MOST_AXIS_ANGLE_DEG = 60.0
# Samples beyond the last pair, for the ends of splines and finite differences.
_SPARE_SAMPLES = 3


def sequence_kinematics(
    recipe: Recipe, sequence: SequenceRanges, drogue: DrogueParameters, frame_index: int
) -> FrameKinematics:
    """Poses and motion of one frame; the same for a frame alone, in any order and in any process.

    Args:
        recipe: as it holds for the frame's scene.
        sequence: the recipe's section on sequences.
        drogue: of the scene.
        frame_index: of the frame.

    Raises:
        ValueError: the drogue comes too near to the camera or turns away from it, or the airspeed is too low for
            turbulence.
    """
    flight, place = _flight_of_frame(recipe, sequence, drogue, frame_index)
    return flight.kinematics(place, recipe.rig.camera)


def sequence_left_from_drogue(
    recipe: Recipe, sequence: SequenceRanges, drogue: DrogueParameters, frame_index: int
) -> RigidTransform:
    """The pose of `sequence_kinematics` alone, in a sixth of the time; arguments and errors are the same."""
    flight, place = _flight_of_frame(recipe, sequence, drogue, frame_index)
    return flight.left_from_drogue(place)


def _flight_of_frame(
    recipe: Recipe, sequence: SequenceRanges, drogue: DrogueParameters, frame_index: int
) -> tuple[Flight, int]:
    """The sequence of a frame, and the frame's place in it."""
    sequence_id, place = divmod(frame_index, sequence.frames_per_sequence)
    flight = _flight(recipe.stream_seed, sequence_id, sequence, drogue, recipe.pose, recipe.rig.baseline_m)
    return flight, place


# Frames of a recipe are mostly rendered in order, so that the last two simulated sequences are enough.
@lru_cache(maxsize=2)
def _flight(
    seed: int, sequence_id: int, sequence: SequenceRanges, drogue: DrogueParameters, pose: PoseRanges, baseline_m: float
) -> Flight:
    return Flight(seed, sequence_id, sequence, drogue, pose, baseline_m)


class Flight:
    """One sequence of a recipe, simulated."""

    def __init__(
        self,
        seed: int,
        sequence_id: int,
        sequence: SequenceRanges,
        drogue: DrogueParameters,
        pose: PoseRanges,
        baseline_m: float,
    ) -> None:
        """Simulate the sequence; every draw is keyed by the dataset's seed and the sequence.

        Args:
            seed: of the dataset.
            sequence_id: which sequence.
            sequence: ranges of its motion.
            drogue: at the end of the hose.
            pose: ranges of the receiver's mean attitude and the drogue's roll.
            baseline_m: of the rig. [m]
        """
        self._id, self._sequence, self._drogue = sequence_id, sequence, drogue
        receiver = sequence.receiver
        tail_m = hose_tail_m(drogue)
        self._drogue_from_tail_m = np.array([0.0, 0.0, tail_m])
        self._roll_rad = float(
            np.radians(sample_uniform(frame_generator(seed, sequence_id, "drogue roll"), pose.roll_deg))
        )
        world_from_left = sample_attitude(frame_generator(seed, sequence_id, "receiver"), pose)
        self._tanker_from_left = WORLD_FROM_TANKER.T @ world_from_left
        shaking = frame_generator(seed, sequence_id, "receiver shake")
        attitude_rad, vibration_rad = np.radians([receiver.attitude_sd_deg, receiver.vibration_deg])
        self._attitude = sample_oscillation(shaking, [attitude_rad] * 3, *_ATTITUDE_HZ)
        vibration = [receiver.vibration_m] * 3 + [vibration_rad] * 3
        self._vibration = sample_oscillation(shaking, vibration, *_VIBRATION_HZ)
        self._baseline_m = baseline_m
        self._dropout = sample_dropout(frame_generator(seed, sequence_id, "loss"), sequence.losses, sequence_id)
        inputs, settling_s = self._simulation_inputs(seed, baseline_m, tail_m)
        release_m = None if sequence.release_m is None else np.array(sequence.release_m)
        self._trajectory = Trajectory(simulate(sequence.hose, inputs, release_m), settling_s)

    def _simulation_inputs(self, seed: int, baseline_m: float, tail_m: float) -> tuple[SimulationInputs, float]:
        """What moves hose and receiver, and how long before the first pair the simulation begins. [s]"""
        sequence, receiver, sequence_id = self._sequence, self._sequence.receiver, self._id
        hose = sequence.hose
        settling_s = SETTLING_S if sequence.release_m is None else 0.0
        span_s = settling_s + (sequence.frames_per_sequence - 1) / sequence.frame_rate_hz
        samples = int(np.ceil(span_s / GUST_PERIOD_S)) + _SPARE_SAMPLES
        severity = sequence.turbulence[sequence_id % len(sequence.turbulence)]
        air = dryden(severity, hose.turbulence_altitude_m)
        gusts = sample_gusts(frame_generator(seed, sequence_id, "gusts"), air, hose.airspeed_m_s, (samples, 1))
        tanker = frame_generator(seed, sequence_id, "tanker motion")
        pod = sample_oscillation(tanker, [sequence.tanker_motion_m] * 3, *_TANKER_HZ)
        offsets = frame_generator(seed, sequence_id, "receiver offset")
        offset_m = sample_uniform(offsets, receiver.offset_right_m), sample_uniform(offsets, receiver.offset_down_m)
        manoeuvre = receiver.manoeuvres[sequence_id % len(receiver.manoeuvres)]
        times = GUST_PERIOD_S * np.arange(samples) - settling_s
        desired = desired_offsets_m(receiver, manoeuvre, offset_m, times) + np.array([baseline_m / 2, 0.0, 0.0])
        links = np.diff(HoseModel(hose).equilibrium().nodes_m[:, 0], axis=-1)
        mouth = still_mouth_direction(hose.airspeed_m_s, links[:, -1])
        from_drogue = tail_m * mouth - desired @ self._tanker_from_left.T
        nose_m = np.array(receiver.nose_body_m) - np.array([receiver.body_radius_m / 2, 0.0, 0.0])
        source = self._tanker_from_left @ (FRD_FROM_OPTICAL.inverse().rotate(nose_m))
        inputs = SimulationInputs(
            gusts_m_s=gusts,
            pod_m=pod.at,
            from_drogue_m=from_drogue[..., None],
            nose_source_m=source,
            body_radius_m=receiver.body_radius_m,
            follower=receiver.follower,
        )
        return inputs, settling_s

    def kinematics(self, place: int, camera: PinholeCamera) -> FrameKinematics:
        """Poses and motion of the pair at a place of the sequence.

        Raises:
            ValueError: the drogue comes too near to the camera or turns away from it.
        """
        time_s = place / self._sequence.frame_rate_hz
        tanker_from_left = self.tanker_from_left(time_s)
        left_from_axes = tanker_from_left.inverse()
        self._check_visible(time_s)
        nodes = self._trajectory.nodes_m(time_s)
        east_m, north_m = self._camera_offset_m(time_s, tanker_from_left.translation_m)
        pod = RigidTransform(np.eye(3), nodes[0])
        length_s = self._sequence.frames_per_sequence / self._sequence.frame_rate_hz
        return FrameKinematics(
            sequence_id=self._id,
            time_s=self._id * (length_s + _PAUSE_S) + time_s,
            left_from_drogue=left_from_axes @ self.tanker_from_drogue(time_s),
            world_from_left=RigidTransform(self._world_from_tanker(time_s) @ tanker_from_left.rotation, np.zeros(3)),
            left_from_tanker=left_from_axes @ pod,
            left_twist_per_s=_twist(self.tanker_from_left, time_s),
            drogue_twist_per_s=_twist(self.tanker_from_drogue, time_s),
            hose_nodes_left_m=left_from_axes.apply(nodes[::-1]),
            camera_offset_m=(east_m, north_m),
            loss=self._dropout.kind if self._dropout is not None and self._dropout.is_active(time_s) else None,
            obstacle=None if self._bar is None else self._bar.at(time_s, camera),
            sun_deg=self._sun_deg,
        )

    def left_from_drogue(self, place: int) -> RigidTransform:
        """The pose of `kinematics` alone; raises as it does."""
        time_s = place / self._sequence.frame_rate_hz
        steady = self._check_visible(time_s)
        # A bar or a sun that fits no frame of the sequence raises.
        _ = self._bar, self._sun_deg
        return steady if self._turning is None else self._left_from_drogue(time_s)

    def _world_from_tanker(self, time_s: float) -> Array:
        """(3, 3) attitude of the formation: it flies east, unless it turns into the sun."""
        if self._dropout is None or self._dropout.kind != "glare":
            return WORLD_FROM_TANKER
        rotation: Array = self._dropout.formation_rotation(time_s) @ WORLD_FROM_TANKER
        return rotation

    def _camera_offset_m(self, time_s: float, eye_m: Array) -> tuple[float, float]:
        """East and north of the camera from the pod's position at the start of the sequence. [m]"""
        speed_m_s = self._sequence.hose.airspeed_m_s
        if self._dropout is None or self._dropout.kind != "glare":
            east_m, north_m, _ = (WORLD_FROM_TANKER @ (np.array([-speed_m_s * time_s, 0.0, 0.0]) + eye_m)).tolist()
            return east_m, north_m
        place_m = (
            formation_displacement_m(self._dropout, speed_m_s, time_s) + (self._world_from_tanker(time_s) @ eye_m)[:2]
        )
        return float(place_m[0]), float(place_m[1])

    def _left_from_drogue(self, time_s: float) -> RigidTransform:
        pose: RigidTransform = self.tanker_from_left(time_s).inverse() @ self.tanker_from_drogue(time_s)
        return pose

    @property
    def _turning(self) -> DropoutEvent | None:
        """How the receiver turns aside in this sequence, or None."""
        return self._dropout if self._dropout is not None and self._dropout.kind == "out-of-view" else None

    @cached_property
    def _bar(self) -> OccludingBar | None:
        """The bar that occludes the drogue in this sequence, or None."""
        if self._dropout is None or self._dropout.kind != "occlusion":
            return None
        return occluding_bar(self._dropout, outline_points_m(self._drogue), self._baseline_m, self._left_from_drogue)

    @cached_property
    def _sun_deg(self) -> tuple[float, float] | None:
        """Elevation and azimuth of the sun if this sequence sets them, for glare; otherwise None. [deg]"""
        if self._dropout is None or self._dropout.kind != "glare":
            return None
        middle_s = self._dropout.middle_s
        rotation = self._world_from_tanker(middle_s) @ self.tanker_from_left(middle_s).rotation
        world_from_left = RigidTransform(rotation, np.zeros(3))
        middle_m = self._left_from_drogue(middle_s).translation_m
        return sun_beside_drogue_deg(self._dropout, world_from_left, middle_m, self._drogue.rim_radius_m)

    def tanker_from_left(self, time_s: float) -> RigidTransform:
        """Pose of the left eye in axes that move with the tanker."""
        steady = self._steady_tanker_from_left(time_s)
        if self._turning is None:
            return steady
        return RigidTransform(steady.rotation @ self._turning.receiver_rotation(time_s), steady.translation_m)

    def _steady_tanker_from_left(self, time_s: float) -> RigidTransform:
        """The same for a receiver that does not turn aside."""
        shake = self._vibration.at(time_s)
        turn = exp_twist(np.concatenate([np.zeros(3), self._attitude.at(time_s) + shake[3:]])).rotation
        rotation = self._tanker_from_left @ turn
        return RigidTransform(rotation, self._trajectory.eye_m(time_s) + rotation @ shake[:3])

    def tanker_from_drogue(self, time_s: float) -> RigidTransform:
        """Pose of the drogue in the same axes: its coupling at the end of the hose, its mouth into the wind."""
        rotation = drogue_rotation(self._trajectory.mouth(time_s), self._roll_rad)
        return RigidTransform(rotation, self._trajectory.nodes_m(time_s)[-1] - rotation @ self._drogue_from_tail_m)

    def _check_visible(self, time_s: float) -> RigidTransform:
        """`left_from_drogue` for a receiver that does not turn aside.

        Which side of the drogue it sees does not depend on where it looks.

        Raises:
            ValueError: the drogue comes too near to the camera or turns away from it.
        """
        left_from_drogue = self._steady_tanker_from_left(time_s).inverse() @ self.tanker_from_drogue(time_s)
        depth_m = float(left_from_drogue.translation_m[2])
        what = f"sequence {self._id}: leaves the visible volume at {time_s:.2f} s"
        if depth_m - self._drogue.rim_radius_m < _NEAREST_M:
            raise ValueError(
                f"{what}: the drogue's rim comes to {depth_m:.2f} m from the left eye; raise end_m or abort_m, or take "
                "a faster follower or calmer air"
            )
        axis_angle_deg = float(np.degrees(np.arccos(np.clip(left_from_drogue.rotation[2, 2], -1, 1))))
        if axis_angle_deg > _MOST_AXIS_ANGLE_DEG:
            raise ValueError(
                f"{what}: the drogue's axis is {axis_angle_deg:.0f} degrees from the camera's, more than "
                f"{_MOST_AXIS_ANGLE_DEG:g}; raise hose.airspeed_m_s, or tilt the camera by pose.camera_pitch_deg"
            )
        visible: RigidTransform = left_from_drogue
        return visible


def _twist(pose_at: Callable[[float], RigidTransform], time_s: float) -> Array:
    """(6,) rate of a pose in its own frame: velocity [m/s], angular velocity [rad/s]."""
    step = pose_at(time_s - _HALF_DIFFERENCE_S).inverse() @ pose_at(time_s + _HALF_DIFFERENCE_S)
    rate: Array = log_twist(step) / (2 * _HALF_DIFFERENCE_S)
    return rate


@dataclass(frozen=True)
class Oscillation:
    """Irregular motion as a sum of sines along several axes: known at any time, with its rate, without a time grid.

    Attributes:
        amplitudes: (A,) of each sine, the same for all of an axis.
        rates_rad_s: (A, N) angular frequencies. [rad/s]
        phases_rad: (A, N). [rad]
    """

    amplitudes: Array
    rates_rad_s: Array
    phases_rad: Array

    def at(self, time_s: ArrayLike) -> Array:
        """(..., A) values at (...) times."""
        time = np.asarray(time_s, dtype=np.float64)[..., None, None]
        value: Array = self.amplitudes * np.sin(self.rates_rad_s * time + self.phases_rad).sum(axis=-1)
        return value


def sample_oscillation(rng: np.random.Generator, sd: ArrayLike, low_hz: float, high_hz: float) -> Oscillation:
    """Draw an oscillation.

    Args:
        rng: draws phases, and one frequency in each of equal parts of the band.
        sd: (A,) standard deviation of each axis.
        low_hz, high_hz: the band. [Hz]
    """
    deviations = np.asarray(sd, dtype=np.float64)
    shape = (len(deviations), _SINES)
    steps = (np.arange(_SINES) + rng.random(shape)) / _SINES
    rates = 2 * np.pi * (low_hz + (high_hz - low_hz) * steps)
    phases = rng.uniform(0.0, 2 * np.pi, shape)
    return Oscillation(amplitudes=deviations * np.sqrt(2.0 / _SINES), rates_rad_s=rates, phases_rad=phases)
