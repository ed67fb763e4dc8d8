"""The drogue as the probe truly sees it, and what estimates of that err."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from droguekit.benchmark.sequences.sequence_motion import TrueMotion
from droguekit.benchmark.sequences.sequence_truth import Moment, TrueSequence
from geometry.se3 import Array, RigidTransform
from geometry.stereo import StereoRig
from nav.docking import capture_radius_m

# No flight goes straight for longer; where the drogue hardly comes nearer, nothing is predicted.
_LONGEST_WAY_S = 60.0


@dataclass(frozen=True)
class Arrival:
    """How the tip comes to the plane of the rim.

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
        capture_radius_m: within which the drogue takes the tip in. [m]
        closure_m_s: how fast its forward part shrinks; None where the motion is not known. [m/s]
        predicted: if both go on as they truly move at this instant; None unless they close.
        in_the_end: what the sequence brings; None where the tip never comes to the rim, or only after a gap.
    """

    mouth_from_tip_m: Array
    capture_radius_m: float
    closure_m_s: float | None
    predicted: Arrival | None
    in_the_end: Arrival | None


def true_dockings(sequences: Sequence[TrueSequence], motions: Mapping[int, TrueMotion]) -> dict[int, TrueDocking]:
    """By frame, for all pairs of sequences that show a drogue."""
    found: dict[int, TrueDocking] = {}
    for sequence in sequences:
        for run in sequence.runs():
            arrivals = arrivals_in_the_end(run)
            for moment, arrival in zip(run, arrivals, strict=True):
                found[moment.frame_index] = _true_docking(moment, motions.get(moment.frame_index), arrival)
    return found


def tip_in_left_m(rig: StereoRig) -> Array:
    """(3,) tip of the probe in the left camera. [m]"""
    return rig.body_from_left.inverse().apply(rig.probe_tip_body_m)


def predicted_arrival(left_from_drogue: RigidTransform, velocity_m_s: Array, tip_m: Array) -> Arrival | None:
    """Where the tip comes to the plane of the rim if the drogue keeps its velocity and attitude.

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


def arrivals_in_the_end(run: Sequence[Moment]) -> list[Arrival | None]:
    """For each pair of a run how the tip next comes through the plane of the rim, from the mouth's side."""
    poses = [moment.left_from_drogue for moment in run if moment.left_from_drogue is not None]
    tip_m = tip_in_left_m(run[0].rig)
    tips = np.array([pose.inverse().apply(tip_m) for pose in poses])
    times = np.array([moment.time_s for moment in run])
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


def _true_docking(moment: Moment, motion: TrueMotion | None, in_the_end: Arrival | None) -> TrueDocking:
    rig, pose, drogue = moment.rig, moment.left_from_drogue, moment.drogue
    if pose is None or drogue is None:
        raise ValueError(f"frame {moment.frame_index}: shows no drogue")
    radius_m = capture_radius_m(drogue)
    mouth = rig.body_from_left.apply(pose.translation_m) - rig.probe_tip_body_m
    if motion is None:
        return TrueDocking(mouth, radius_m, None, None, in_the_end)
    closure = -float(rig.body_from_left.rotate(motion.velocity_m_s)[0])
    predicted = predicted_arrival(pose, motion.velocity_m_s, tip_in_left_m(rig))
    return TrueDocking(mouth, radius_m, closure, predicted, in_the_end)
