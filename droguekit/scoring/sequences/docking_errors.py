"""Docking quantities, mouth position, closure, predicted miss and capture, against the true ones."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from datasets_manifest.types.estimates import Docking, Estimate, PoseEstimate
from droguekit.scoring.confidence_intervals import mean_interval, root_mean_square
from droguekit.scoring.results.sequence_result import (
    BodyAxes,
    Calibration,
    Captures,
    DockingBin,
    DockingErrors,
    DockingRow,
    MissRow,
)
from droguekit.scoring.sequences.filter_errors import SequenceData
from droguekit.scoring.sequences.sequence_truth import TrueMotion, TrueSequence, TrueState
from geometry.se3 import Array, RigidTransform
from geometry.stereo import StereoRig
from nav.docking import capture_radius_m

# Longest straight flight that is predicted: where the drogue hardly comes nearer, a prediction means nothing.
_LONGEST_WAY_S = 60.0
_AXES = ("forward", "right", "down")


@dataclass(frozen=True)
class Arrival:
    """Arrival of the probe's tip at the plane of the rim.

    Attributes:
        miss_m: distance from the drogue's axis there. [m]
        contact_s: time until then. [s]
    """

    miss_m: float
    contact_s: float


@dataclass(frozen=True, eq=False)
class TrueDocking:
    """The truth of `estimates.Docking` at one pair.

    Attributes:
        mouth_from_tip_m: (3,) centre of the rim from the tip, in the receiver's body axes. [m]
        capture_radius_m: largest miss at which the drogue captures the tip. [m]
        closure_m_s: how fast its forward part shrinks; None where the motion is not known. [m/s]
        predicted: if both keep their true motion of this instant; None unless they close.
        actual: later in the sequence; None where the tip never comes to the rim, or only after a gap.
    """

    mouth_from_tip_m: Array
    capture_radius_m: float
    closure_m_s: float | None
    predicted: Arrival | None
    actual: Arrival | None


class DockingPair(NamedTuple):
    """One pair with docking quantities, reported and true."""

    frame_index: int
    reported: Docking
    true: TrueDocking

    @property
    def capture_radius_m(self) -> float:
        """The radius that captures are judged by: the estimate's own if it reports one, else the drogue's. [m]"""
        reported_m = self.reported.capture_radius_m
        return self.true.capture_radius_m if reported_m is None else reported_m


def docking_errors(
    data: SequenceData, truth: Mapping[int, TrueDocking], estimates: Mapping[int, Estimate]
) -> DockingErrors | None:
    """The scores of a method; None where it reports no docking quantities.

    Args:
        data: the truth of the sequences.
        truth: of docking, by frame.
        estimates: of the method, by frame.
    """
    pairs = [
        DockingPair(index, estimate.docking, truth[index])
        for index, estimate in sorted(estimates.items())
        if isinstance(estimate, PoseEstimate) and estimate.docking is not None and index in truth
    ]
    if not pairs:
        return None
    bin_of, bins = data.groups.bin_of_frame, []
    for k, place in enumerate(data.groups.bins):
        inside = [pair for pair in pairs if bin_of[pair.frame_index] == k]
        if inside:
            row = _row(data, inside, sum(bin_of[index] == k for index in truth))
            bins.append(DockingBin(**dict(row), low_m=place.low_m, high_m=place.high_m))
    return DockingErrors(overall=_row(data, pairs, len(truth)), bins=tuple(bins))


def true_dockings(sequences: Sequence[TrueSequence], motions: Mapping[int, TrueMotion]) -> dict[int, TrueDocking]:
    """By frame, for all pairs of sequences that show a drogue."""
    found: dict[int, TrueDocking] = {}
    for sequence in sequences:
        for run in sequence.runs():
            arrivals = actual_arrivals(run)
            for state, arrival in zip(run, arrivals, strict=True):
                found[state.frame_index] = _true_docking(state, motions.get(state.frame_index), arrival)
    return found


def tip_in_left_m(rig: StereoRig) -> Array:
    """(3,) tip of the probe in the left camera. [m]"""
    return rig.body_from_left.inverse().apply(rig.probe_tip_body_m)


def predicted_arrival(left_from_drogue: RigidTransform, velocity_m_s: Array, tip_m: Array) -> Arrival | None:
    """Arrival of the tip at the plane of the rim if the drogue keeps its velocity and attitude.

    Args:
        left_from_drogue: pose now.
        velocity_m_s: (3,) of the drogue's origin in the left camera. [m/s]
        tip_m: (3,) tip of the probe in the left camera. [m]

    Returns:
        None where the tip is behind the plane already, or does not come to it within a minute.
    """
    axis = left_from_drogue.rotation[:, 2]
    tip_from_mouth = tip_m - left_from_drogue.translation_m
    ahead_m, closing_m_s = float(-axis @ tip_from_mouth), float(-axis @ velocity_m_s)
    if ahead_m < 0 or closing_m_s <= 0 or ahead_m > _LONGEST_WAY_S * closing_m_s:
        return None
    contact_s = ahead_m / closing_m_s
    return Arrival(float(np.linalg.norm(tip_from_mouth - contact_s * velocity_m_s)), contact_s)


def actual_arrivals(run: Sequence[TrueState]) -> list[Arrival | None]:
    """For each pair of a run the next arrival of the tip at the plane of the rim, from the mouth's side."""
    poses = [state.left_from_drogue for state in run if state.left_from_drogue is not None]
    tip_m = tip_in_left_m(run[0].rig)
    tips = np.array([pose.inverse().apply(tip_m) for pose in poses])
    times = np.array([state.time_s for state in run])
    arrivals: list[Arrival | None] = [None] * len(run)
    miss_m, at_s = None, 0.0
    for k in range(len(run) - 1, -1, -1):
        if k + 1 < len(run) and tips[k, 2] < 0 <= tips[k + 1, 2]:
            share = tips[k, 2] / (tips[k, 2] - tips[k + 1, 2])
            crossing = tips[k] + share * (tips[k + 1] - tips[k])
            miss_m, at_s = (
                float(np.hypot(crossing[0], crossing[1])),
                float(times[k] + share * (times[k + 1] - times[k])),
            )
        if miss_m is not None and tips[k, 2] < 0:
            arrivals[k] = Arrival(miss_m, at_s - float(times[k]))
    return arrivals


def _true_docking(state: TrueState, motion: TrueMotion | None, actual: Arrival | None) -> TrueDocking:
    rig, pose, drogue = state.rig, state.left_from_drogue, state.drogue
    if pose is None or drogue is None:
        raise ValueError(f"frame {state.frame_index}: shows no drogue")
    radius_m = capture_radius_m(drogue)
    mouth = rig.body_from_left.apply(pose.translation_m) - rig.probe_tip_body_m
    if motion is None:
        return TrueDocking(mouth, radius_m, None, None, actual)
    closure = -float(rig.body_from_left.rotate(motion.velocity_m_s)[0])
    predicted = predicted_arrival(pose, motion.velocity_m_s, tip_in_left_m(rig))
    return TrueDocking(mouth, radius_m, closure, predicted, actual)


def calibration(errors: Array, deviations: Array) -> Calibration | None:
    """How often errors stay within once and twice their standard deviation; None where none is above 0."""
    known = deviations > 0
    if not known.any():
        return None
    ratios = np.abs(errors[known]) / deviations[known]
    return Calibration(n=int(known.sum()), within_1=float(np.mean(ratios <= 1)), within_2=float(np.mean(ratios <= 2)))


def _row(data: SequenceData, pairs: Sequence[DockingPair], of: int) -> DockingRow:
    errors = np.array([pair.reported.mouth_from_tip_m - pair.true.mouth_from_tip_m for pair in pairs])
    deviations = np.array([pair.reported.mouth_sd_m for pair in pairs])
    squares = np.square(errors).sum(axis=1)
    ends = mean_interval(squares, [data.sequence_of(pair.frame_index) for pair in pairs], (0.0, math.inf))
    closures = np.array(
        [
            pair.reported.closure_m_s - pair.true.closure_m_s
            for pair in pairs
            if pair.reported.closure_m_s is not None and pair.true.closure_m_s is not None
        ]
    )
    contacts = [
        pair.reported.contact_s - pair.true.predicted.contact_s
        for pair in pairs
        if pair.reported.contact_s is not None and pair.true.predicted is not None
    ]
    predicted = [(pair, pair.true.predicted) for pair in pairs]
    final = [(pair, pair.true.actual) for pair in pairs]
    return DockingRow(
        n=len(pairs),
        of=of,
        mouth_rmse_m=_body_axes(np.sqrt(np.square(errors).mean(axis=0))),
        mouth_bias_m=_body_axes(errors.mean(axis=0)),
        mouth_rms_m=float(np.sqrt(squares.mean())),
        mouth_interval=None if ends is None else (float(np.sqrt(ends[0])), float(np.sqrt(ends[1]))),
        calibration={axis: calibration(errors[:, k], deviations[:, k]) for k, axis in enumerate(_AXES)},
        closure_n=len(closures),
        closure_rmse_m_s=root_mean_square(closures) if len(closures) else None,
        closure_bias_m_s=float(closures.mean()) if len(closures) else None,
        contact_median_absolute_s=float(np.median(np.abs(contacts))) if contacts else None,
        miss=_miss_row(predicted),
        miss_in_the_end=_miss_row(final),
        captures=_captures(predicted),
        captures_in_the_end=_captures(final),
    )


def _miss_row(pairs: Sequence[tuple[DockingPair, Arrival | None]]) -> MissRow | None:
    both = [
        (pair.reported.miss_m - true.miss_m, pair.reported.miss_sd_m or 0.0)
        for pair, true in pairs
        if pair.reported.miss_m is not None and true is not None
    ]
    if not both:
        return None
    errors, deviations = (np.array(column) for column in zip(*both, strict=True))
    return MissRow(
        n=len(errors),
        bias_m=float(errors.mean()),
        rmse_m=root_mean_square(errors),
        median_absolute_m=float(np.median(np.abs(errors))),
        p95_m=float(np.percentile(np.abs(errors), 95)),
        calibration=calibration(errors, deviations),
    )


def _captures(pairs: Sequence[tuple[DockingPair, Arrival | None]]) -> Captures | None:
    """Reported against true captures; None where no pair has both."""
    known = [(pair, true) for pair, true in pairs if pair.reported.captured is not None and true is not None]
    if not known:
        return None
    cases = [(pair.reported.captured, true.miss_m <= pair.capture_radius_m) for pair, true in known]
    radii = {pair.capture_radius_m for pair, _ in known}
    return Captures(
        radius_m=radii.pop() if len(radii) == 1 else None,
        true_yes=cases.count((True, True)),
        false_yes=cases.count((True, False)),
        false_no=cases.count((False, True)),
        true_no=cases.count((False, False)),
    )


def _body_axes(values: Array) -> BodyAxes:
    return BodyAxes(**dict(zip(_AXES, values.tolist(), strict=True)))
