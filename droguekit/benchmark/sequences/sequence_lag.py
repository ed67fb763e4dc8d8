"""How far estimates lag behind the truth: the shift in time that makes them agree best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from datasets_manifest.random_streams import named_generator
from datasets_manifest.types.estimates import PoseEstimate
from droguekit.benchmark.poses.pose_errors import COMPONENTS
from droguekit.benchmark.results.sequence_result import Lag
from droguekit.benchmark.sequences.sequence_motion import smoothing_spline
from droguekit.benchmark.sequences.sequence_truth import Moment, TrueSequence
from droguekit.benchmark.statistics import CONFIDENCE, RESAMPLES
from geometry.se3 import Array, RigidTransform, angles_from_axis

MOST_LAG_S = 0.5
"""Shifts up to this are looked at, forward and back. [s]"""
_SHIFTS: Array = np.linspace(-MOST_LAG_S, MOST_LAG_S, 201)
# Less is rounding, where the drogue does not move or moves evenly. [m^2, deg^2]
_LEAST_BEND = 1e-12
# Fewer estimates tell nothing; a second at 25 Hz.
_FEWEST = 25
_FEWEST_PER_RUN = 5


def lags(sequences: Sequence[TrueSequence], estimates: Mapping[int, PoseEstimate], key: str) -> dict[str, Lag] | None:
    """Lag of every component of the pose; None where no sequence is long enough.

    The squared error against the truth of `lag` seconds ago is summed over all sequences. A constant error of each
    sequence does not count, for on a steady approach nothing tells it from a lag. The truth is without vibration, see
    `sequence_motion`. Between the shifts that are tried, the least sum lies at the vertex of a parabola.

    Args:
        sequences: the truth.
        estimates: of a method, by frame.
        key: of the bootstrap's random stream.
    """
    tables, counts = [], []
    for sequence in sequences:
        runs = [_run_sums(run, sequence.period_s, estimates) for run in sequence.runs()]
        known = [run for run in runs if run is not None]
        if known:
            tables.append(np.sum([table for table, _ in known], axis=0))
            counts.append(sum(count for _, count in known))
    if sum(counts) < _FEWEST:
        return None
    sums = np.array(tables)
    rng = named_generator(key)
    times = rng.multinomial(len(sums), np.full(len(sums), 1 / len(sums)), RESAMPLES)
    return {name: _lag(sums[:, c], times) for c, name in enumerate(COMPONENTS)}


def _run_sums(
    run: Sequence[Moment], period_s: float, estimates: Mapping[int, PoseEstimate]
) -> tuple[Array, int] | None:
    """(5, 201) squared errors by component and shift, of how many estimates; None where the run is too short."""
    times = np.array([moment.time_s for moment in run])
    # The same estimates at every shift: those whose truth is known at all of them.
    inside = (times - MOST_LAG_S >= times[0]) & (times + MOST_LAG_S <= times[-1])
    chosen = [k for k, moment in enumerate(run) if inside[k] and moment.frame_index in estimates]
    if len(chosen) < _FEWEST_PER_RUN:
        return None
    poses = [moment.left_from_drogue for moment in run if moment.left_from_drogue is not None]
    truth = smoothing_spline(times, _components(poses), period_s)
    found = _components([estimates[run[k].frame_index].left_from_drogue for k in chosen])
    sums = np.empty((len(COMPONENTS), len(_SHIFTS)))
    for k, shift_s in enumerate(_SHIFTS):
        errors = found - truth(times[chosen] - shift_s)
        # Estimates may stand on the other side of the turn.
        errors[:, 3:] = 180.0 - np.mod(180.0 - errors[:, 3:], 360.0)
        sums[:, k] = np.square(errors - errors.mean(axis=0)).sum(axis=0)
    return sums, len(chosen)


def _components(poses: Sequence[RigidTransform]) -> Array:
    """(n, 5) X, Y, Z [m], pitch and yaw, the yaw without jumps. [deg]"""
    pitch, yaw = angles_from_axis(np.array([pose.rotation[:, 2] for pose in poses]))
    places = np.array([pose.translation_m for pose in poses])
    return np.column_stack([places, np.rad2deg(pitch), np.rad2deg(np.unwrap(yaw))])


def _lag(sums: Array, times: np.ndarray[tuple[int, int], np.dtype[np.int64]]) -> Lag:
    """Of one component from the (S, 201) sums of its sequences, and (R, S) how often each is drawn."""
    best = _vertex(sums.sum(axis=0))
    if best is None or len(sums) < 2:
        return Lag(lag_s=best, interval=None)
    drawn = [shift for shift in (_vertex(total) for total in times @ sums) if shift is not None]
    if len(drawn) < CONFIDENCE * len(times):
        return Lag(lag_s=best, interval=None)
    low, high = np.percentile(drawn, (50 * (1 - CONFIDENCE), 50 * (1 + CONFIDENCE)))
    return Lag(lag_s=best, interval=(float(low), float(high)))


def _vertex(total: Array) -> float | None:
    """The shift with the least sum; None where it lies at an end of what was tried, or all are alike."""
    k = int(np.argmin(total))
    if not 0 < k < len(total) - 1:
        return None
    before, here, after = total[k - 1 : k + 2]
    bend = before - 2 * here + after
    if bend < _LEAST_BEND:
        return None
    return float(_SHIFTS[k] + (before - after) / (2 * bend) * (_SHIFTS[1] - _SHIFTS[0]))
