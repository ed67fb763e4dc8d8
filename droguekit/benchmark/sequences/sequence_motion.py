"""How the drogue truly moved, without the vibration that no pair can show, and what estimates of it err.

The record's twists say how camera and drogue move at the instant of a pair. The camera's vibration of some tens of
hertz is part of that: over the distance to the drogue it makes tenths of a metre a second, and pairs at 25 Hz cannot
tell it. What a filter can know, and what a docking needs, is the motion from pair to pair. The truth here is the
derivative of a cubic spline through the true places of neighbouring pairs, and a spline through their rates of turn:
they follow what changes within some tenths of a second, and vibration averages out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, make_lsq_spline
from scipy.spatial.transform import Rotation

from datasets_manifest.types.estimates import Motion
from droguekit.benchmark.poses.consistency import Parts
from droguekit.benchmark.sequences.sequence_truth import Moment, TrueSequence
from geometry.se3 import Array

# Of 2, 3, 4, 5, 6 and 8 pairs at 25 Hz, 4 and 2 err least against the simulated motion of docking runs without its
# vibration: attitude follows gusts faster than the place does.
KNOT_S = 0.16
"""From knot to knot of the spline through places. [s]"""
RATE_KNOT_S = 0.08
"""The same through rates. [s]"""
# Four pairs in 0.2 s, which is 20 Hz; over fewer, vibration does not average out. The rest is room for rounding.
_LONGEST_PERIOD_S = 0.0501
_DEGREE = 3


@dataclass(frozen=True, eq=False)
class TrueMotion:
    """How the drogue moves against the left camera at one pair.

    Attributes:
        velocity_m_s: (3,) of its origin, in the left camera. [m/s]
        rate_rad_s: (3,) `R' = [w]x R`, in the left camera. [rad/s]
        vibration_m_s: (3,) what the instant's velocity has besides; None where that is not known. [m/s]
    """

    velocity_m_s: Array
    rate_rad_s: Array
    vibration_m_s: Array | None


def pairs_per_knot(period_s: float, knot_s: float = KNOT_S) -> int:
    """How many pairs come in the time from knot to knot, at least one."""
    return max(1, round(knot_s / period_s))


def smoothing_spline(times_s: Array, values: Array, period_s: float, knot_s: float = KNOT_S) -> BSpline:
    """Least-squares cubic spline with evenly spaced knots.

    Args:
        times_s: (n,) ascending, without a gap; at least four.
        values: (n, ...) at these.
        period_s: from one to the next.
        knot_s: about how far knots are apart, a whole number of periods. [s]
    """
    span, step = times_s[-1] - times_s[0], pairs_per_knot(period_s, knot_s)
    # A cubic of that many pieces has three numbers more, and no more than there are values.
    most = min((len(times_s) - 1) // step, len(times_s) - _DEGREE)
    pieces = max(1, min(int(span / (step * period_s) + 0.5), most))
    inner = np.linspace(times_s[0], times_s[-1], pieces + 1)
    knots = np.concatenate([[times_s[0]] * _DEGREE, inner, [times_s[-1]] * _DEGREE])
    return make_lsq_spline(times_s, values, knots, k=_DEGREE)


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


MOTION_PARTS: Parts = {"velocity": slice(0, 3), "rate": slice(3, 6), "motion": slice(0, 6)}
"""Of errors and covariances of a motion."""


def _run_motions(run: Sequence[Moment], period_s: float) -> dict[int, TrueMotion]:
    # Near the ends a spline's derivative is not known as well.
    margin = pairs_per_knot(period_s)
    if len(run) <= 2 * margin:
        return {}
    times = np.array([moment.time_s for moment in run])
    poses = [moment.left_from_drogue for moment in run if moment.left_from_drogue is not None]
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


def _vibration(moment: Moment, velocity_m_s: Array) -> Array | None:
    return None if moment.instant_velocity_m_s is None else moment.instant_velocity_m_s - velocity_m_s
