"""The truth of sequences: when each pair was taken, where the drogue was, whether it was visible, and how it moved.

Records hold the twists of camera and drogue at the instant of a pair. The camera's vibration of some tens of hertz is
part of that: at the drogue's distance it amounts to tenths of a metre a second, and pairs at 25 Hz cannot resolve it. A
filter can only know the motion from pair to pair, and docking needs no more. The true motion here is the derivative of
a cubic spline through the true positions of neighbouring pairs, and a spline through their rates of turn: both follow
changes within some tenths of a second, and vibration averages out.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import BSpline, make_lsq_spline
from scipy.spatial.transform import Rotation

from datasets_manifest.types.estimates import Motion
from datasets_manifest.types.records import PairRecord, PixelBox
from drogue_models.parameters import DrogueParameters
from droguekit.scoring.poses.drogue_truth import LEAST_SEEN_FRACTION, seen_fraction
from droguekit.scoring.poses.pose_errors import Parts
from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES, Eye, StereoRig

Visibility = Literal["seen", "partly", "hidden", "dazzled"]
"""`seen`: enough of the drogue to be found; `hidden`: nothing of the drogue, or of none of its markers; `dazzled`: the
sun in the lens may outshine it, so that neither a pose nor its absence is wrong."""
# A pair that comes later than this many periods follows a gap.
_GAP_PERIODS = 1.5
# Of 2, 3, 4, 5, 6 and 8 pairs at 25 Hz, 4 and 2 err least against the simulated motion of docking runs without its
# vibration: attitude follows gusts faster than the place does.
KNOT_S = 0.16
"""From knot to knot of the spline through places. [s]"""
RATE_KNOT_S = 0.08
"""The same through rates. [s]"""
# Four pairs in 0.2 s, which is 20 Hz; over fewer, vibration does not average out. The rest is room for rounding.
_LONGEST_PERIOD_S = 0.0501
_DEGREE = 3
MOTION_PARTS: Parts = {"velocity": slice(0, 3), "rate": slice(3, 6), "motion": slice(0, 6)}
"""Of errors and covariances of a motion."""


@dataclass(frozen=True)
class EyeTruth:
    """The drogue in one image.

    Attributes:
        box_px: around its visible pixels, in pixel-centre coordinates; None where there are none. [px]
        seen_fraction: see `visibility.seen_fraction`.
        is_dazzled: the sun is beside the drogue.
    """

    box_px: PixelBox | None
    seen_fraction: float
    is_dazzled: bool

    @property
    def visibility(self) -> Visibility:
        """Whether the drogue should be found in this image."""
        if self.seen_fraction == 0:
            return "hidden"
        if self.is_dazzled:
            return "dazzled"
        return "seen" if self.seen_fraction >= LEAST_SEEN_FRACTION else "partly"


@dataclass(frozen=True, eq=False)
class TrueState:
    """The true state at one pair of a sequence.

    Attributes:
        frame_index, sequence_id, time_s: of the pair, at the middle of its exposure.
        rig: the cameras and the probe.
        drogue: None without one.
        left_from_drogue: None without a drogue.
        instant_velocity_m_s: of the drogue's origin in the left camera at that instant, vibration included; None
            without a drogue. [m/s]
        eyes: the drogue in each image.
    """

    frame_index: int
    sequence_id: int
    time_s: float
    rig: StereoRig
    drogue: DrogueParameters | None
    left_from_drogue: RigidTransform | None
    instant_velocity_m_s: Array | None
    eyes: Mapping[Eye, EyeTruth]

    @property
    def visibility(self) -> Visibility:
        """Of the pair: that of both images, or `partly` where they differ."""
        visibilities = {eye.visibility for eye in self.eyes.values()}
        return visibilities.pop() if len(visibilities) == 1 else "partly"


@dataclass(frozen=True, eq=False)
class TrueSequence:
    """Two or more pairs that follow each other.

    Attributes:
        sequence_id: its number.
        period_s: median time from one pair to the next, the lesser one of two. [s]
        states: by ascending time.
    """

    sequence_id: int
    period_s: float
    states: tuple[TrueState, ...]

    def runs(self) -> Iterator[tuple[TrueState, ...]]:
        """The pairs with a drogue that follow each other without a gap."""
        run: list[TrueState] = []
        for state in self.states:
            gap = run and state.time_s - run[-1].time_s > _GAP_PERIODS * self.period_s
            if run and (gap or state.left_from_drogue is None):
                yield tuple(run)
                run = []
            if state.left_from_drogue is not None:
                run.append(state)
        if run:
            yield tuple(run)


@dataclass(frozen=True, eq=False)
class TrueMotion:
    """Motion of the drogue relative to the left camera at one pair.

    Attributes:
        velocity_m_s: (3,) of its origin, in the left camera. [m/s]
        rate_rad_s: (3,) `R' = [w]x R`, in the left camera. [rad/s]
        vibration_m_s: (3,) velocity of the instant minus `velocity_m_s`; None where it is not known. [m/s]
    """

    velocity_m_s: Array
    rate_rad_s: Array
    vibration_m_s: Array | None


def true_state(record: PairRecord) -> TrueState | None:
    """A record as the true state of a pair in its sequence; None where it belongs to none."""
    if record.sequence_id is None:
        return None
    frame, pose, velocity = record.frame, record.left_from_drogue, None
    if pose is not None:
        camera, drogue = frame.left_twist_per_s, frame.drogue_twist_per_s
        # Derivative of `FrameSpec.left_from_drogue_at` at mid-exposure.
        velocity = pose.rotate(drogue[:3]) - camera[:3] - np.cross(camera[3:], pose.translation_m)
    views = dict(zip(EYES, (record.views.left, record.views.right), strict=True))
    return TrueState(
        frame_index=record.frame_index,
        sequence_id=record.sequence_id,
        time_s=record.time_s,
        rig=frame.rig,
        drogue=frame.drogue,
        left_from_drogue=pose,
        instant_velocity_m_s=velocity,
        eyes={
            eye: EyeTruth(view.box_visible_xywh_px, seen_fraction(record, eye), frame.loss == "glare")
            for eye, view in views.items()
        },
    )


def true_sequences(states: Iterable[TrueState | None]) -> tuple[TrueSequence, ...]:
    """The sequences of a dataset by their numbers; single pairs are left out.

    Raises:
        ValueError: two pairs of a sequence have one time.
    """
    by_id: dict[int, list[TrueState]] = {}
    for one in states:
        if one is not None:
            by_id.setdefault(one.sequence_id, []).append(one)
    return tuple(_sequence(number, by_id[number]) for number in sorted(by_id) if len(by_id[number]) > 1)


def true_motions(sequences: Sequence[TrueSequence]) -> dict[int, TrueMotion]:
    """Motion by frame; none within `KNOT_S` of the ends of a run of pairs, nor of pairs at less than 20 Hz."""
    motions: dict[int, TrueMotion] = {}
    for sequence in sequences:
        if sequence.period_s <= _LONGEST_PERIOD_S:
            for run in sequence.runs():
                motions |= _run_motions(run, sequence.period_s)
    return motions


def motion_errors(motion: Motion, truth: TrueMotion) -> Array:
    """(6,) estimate minus truth: velocity [m/s], then rate [rad/s]."""
    return np.concatenate([motion.velocity_m_s - truth.velocity_m_s, motion.rate_rad_s - truth.rate_rad_s])


def smoothing_spline(times_s: Array, values: Array, period_s: float, knot_s: float = KNOT_S) -> BSpline:
    """Least-squares cubic spline with as many values from each knot to the next.

    Args:
        times_s: (n,) ascending, without a gap; at least four. [s]
        values: (n, ...) at these.
        period_s: from one to the next, about. [s]
        knot_s: about how far knots are apart, a whole number of periods. [s]
    """
    span, step = times_s[-1] - times_s[0], pairs_per_knot(period_s, knot_s)
    # A cubic of that many pieces has three numbers more, and no more than there are values.
    most = min((len(times_s) - 1) // step, len(times_s) - _DEGREE)
    pieces = max(1, min(int(span / (step * period_s) + 0.5), most))
    # Knots at even times would leave a piece without values, and the spline open, where times are uneven.
    places = np.arange(len(times_s))
    inner = np.interp(np.linspace(0, places[-1], pieces + 1), places, times_s)
    knots = np.concatenate([[times_s[0]] * _DEGREE, inner, [times_s[-1]] * _DEGREE])
    return make_lsq_spline(times_s, values, knots, k=_DEGREE)


def pairs_per_knot(period_s: float, knot_s: float = KNOT_S) -> int:
    """Number of pairs from knot to knot, at least one."""
    return max(1, round(knot_s / period_s))


def _sequence(number: int, states: list[TrueState]) -> TrueSequence:
    ordered = sorted(states, key=lambda one: one.time_s)
    steps = np.diff([one.time_s for one in ordered])
    if not (steps > 0).all():
        at = ordered[int(np.argmin(steps))].frame_index
        raise ValueError(f"frame {at}: time_s: must differ from that of the next pair of sequence {number}")
    # A mean of two steps is the length of neither, where one of them is a gap.
    return TrueSequence(number, float(np.percentile(steps, 50, method="lower")), tuple(ordered))


def _run_motions(run: Sequence[TrueState], period_s: float) -> dict[int, TrueMotion]:
    # Near the ends a spline's derivative is not known as well.
    margin = pairs_per_knot(period_s)
    if len(run) <= 2 * margin:
        return {}
    times = np.array([state.time_s for state in run])
    poses = [state.left_from_drogue for state in run if state.left_from_drogue is not None]
    places = np.array([pose.translation_m for pose in poses])
    velocity = smoothing_spline(times, places, period_s).derivative()(times)
    # Rates from pair to pair belong to the middle between them; turns of any size are well defined there.
    attitudes = Rotation.from_matrix(np.array([pose.rotation for pose in poses]))
    steps = (attitudes[1:] * attitudes[:-1].inv()).as_rotvec() / np.diff(times)[:, None]
    rate = smoothing_spline((times[1:] + times[:-1]) / 2, steps, period_s, RATE_KNOT_S)(times)
    return {
        run[k].frame_index: TrueMotion(velocity[k], rate[k], _vibration(run[k], velocity[k]))
        for k in range(margin, len(run) - margin)
    }


def _vibration(state: TrueState, velocity_m_s: Array) -> Array | None:
    return None if state.instant_velocity_m_s is None else state.instant_velocity_m_s - velocity_m_s
