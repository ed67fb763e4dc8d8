"""Errors of filtered estimates: velocity and rate, covariances, lag, and position relative to unfiltered poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from datasets_manifest.random_streams import named_generator
from datasets_manifest.types.estimates import Estimate, PoseEstimate
from droguekit.scoring.confidence_intervals import CONFIDENCE, RESAMPLES, mean_interval, root_mean_square
from droguekit.scoring.poses.drogue_truth import DrogueTruth
from droguekit.scoring.poses.method_scores import PairGroups, compare_methods
from droguekit.scoring.poses.pose_errors import COMPONENTS, PoseError, nees_parts, normalized_squares, pose_error
from droguekit.scoring.results.pose_result import MethodComparison
from droguekit.scoring.results.sequence_result import CameraAxes, FilterErrors, Lag, MotionBin, MotionNees, MotionRow
from droguekit.scoring.sequences.sequence_truth import (
    MOTION_PARTS,
    TrueMotion,
    TrueSequence,
    TrueState,
    motion_errors,
    smoothing_spline,
)
from geometry.se3 import Array, RigidTransform, angles_from_axis

MOST_LAG_S = 0.5
"""Largest shift that is tried, forward and back. [s]"""
_SHIFTS: Array = np.linspace(-MOST_LAG_S, MOST_LAG_S, 201)
# A smaller bend is rounding: the drogue does not move, or moves evenly. [m^2, deg^2]
_LEAST_BEND = 1e-12
# With fewer estimates the lag is unknown; a second at 25 Hz.
_FEWEST = 25
_FEWEST_PER_RUN = 5
# Between the name of a method and that of the filter on its poses.
_FILTER_SEPARATOR = "+"


class SequenceData(NamedTuple):
    """The truth that all methods are scored with over sequences.

    Attributes:
        sequences: in the order of their numbers.
        drogues: of all pairs of the dataset that show one.
        motions: true ones by frame.
        groups: the pairs' bins and sequences.
    """

    sequences: Sequence[TrueSequence]
    drogues: Mapping[int, DrogueTruth]
    motions: Mapping[int, TrueMotion]
    groups: PairGroups

    def sequence_of(self, frame_index: int) -> int:
        """The number of a pair's sequence."""
        number = self.groups.sequence_of_frame[frame_index]
        return -1 if number is None else number


class _MotionScore(NamedTuple):
    frame_index: int
    error: Array
    squares: Array | None


def filter_errors(data: SequenceData, name: str, methods: Mapping[str, Mapping[int, Estimate]]) -> FilterErrors | None:
    """The scores of a method that reports motion; None where it does not.

    Args:
        data: the truth.
        name: of the method.
        methods: all of the file.
    """
    estimates = {i: e for i, e in methods[name].items() if isinstance(e, PoseEstimate)}
    if all(estimate.motion is None for estimate in estimates.values()):
        return None
    scores = _motion_scores(data, estimates)
    bins = []
    for k, place in enumerate(data.groups.bins):
        inside = [score for score in scores if data.groups.bin_of_frame[score.frame_index] == k]
        if inside:
            of = sum(data.groups.bin_of_frame[index] == k for index in data.motions)
            row = _motion_row(data, inside, of)
            bins.append(MotionBin(**dict(row), low_m=place.low_m, high_m=place.high_m))
    return FilterErrors(
        motion=_motion_row(data, scores, len(data.motions)) if scores else None,
        bins=tuple(bins),
        nees=_motion_nees(data, scores) if scores else None,
        lags=lags(data.sequences, estimates, f"{name}, lag"),
        raw=_against_raw(data, name, methods),
    )


def lags(sequences: Sequence[TrueSequence], estimates: Mapping[int, PoseEstimate], key: str) -> dict[str, Lag] | None:
    """Lag of every component of the pose; None where no sequence is long enough.

    The squared error against the truth of `lag` seconds ago is summed over all sequences. A constant error of each
    sequence does not count: on a steady approach it looks like a lag. The truth is without vibration, see
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
    run: Sequence[TrueState], period_s: float, estimates: Mapping[int, PoseEstimate]
) -> tuple[Array, int] | None:
    """(5, 201) squared errors by component and shift, of how many estimates; None where the run is too short."""
    times = np.array([state.time_s for state in run])
    # The same estimates at every shift: those whose truth is known at all of them.
    inside = (times - MOST_LAG_S >= times[0]) & (times + MOST_LAG_S <= times[-1])
    chosen = [k for k, state in enumerate(run) if inside[k] and state.frame_index in estimates]
    if len(chosen) < _FEWEST_PER_RUN:
        return None
    poses = [state.left_from_drogue for state in run if state.left_from_drogue is not None]
    truth = smoothing_spline(times, _components(poses), period_s)
    found = _components([estimates[run[k].frame_index].left_from_drogue for k in chosen])
    sums = np.empty((len(COMPONENTS), len(_SHIFTS)))
    for k, shift_s in enumerate(_SHIFTS):
        errors = found - truth(times[chosen] - shift_s)
        # Angles of estimates may differ by a whole turn.
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


def _motion_scores(data: SequenceData, estimates: Mapping[int, PoseEstimate]) -> list[_MotionScore]:
    scores = []
    for index, truth in sorted(data.motions.items()):
        motion = estimates[index].motion if index in estimates else None
        if motion is not None:
            error = motion_errors(motion, truth)
            scores.append(_MotionScore(index, error, normalized_squares(error, motion.covariance, MOTION_PARTS)))
    return scores


def _motion_row(data: SequenceData, scores: Sequence[_MotionScore], of: int) -> MotionRow:
    errors = np.array([score.error for score in scores])
    errors[:, 3:] = np.rad2deg(errors[:, 3:])
    blocks = [data.sequence_of(score.frame_index) for score in scores]
    rms = np.sqrt(np.square(errors).mean(axis=0)).tolist()
    squares = {part: np.square(errors[:, MOTION_PARTS[part]]).sum(axis=1) for part in ("velocity", "rate")}
    ends = {part: mean_interval(values, blocks, (0.0, math.inf)) for part, values in squares.items()}
    roots = {part: None if e is None else (float(np.sqrt(e[0])), float(np.sqrt(e[1]))) for part, e in ends.items()}
    return MotionRow(
        n=len(scores),
        of=of,
        velocity_rmse_m_s=CameraAxes(x=rms[0], y=rms[1], z=rms[2]),
        speed_rmse_m_s=float(np.sqrt(squares["velocity"].mean())),
        speed_interval=roots["velocity"],
        rate_rmse_deg_s=CameraAxes(x=rms[3], y=rms[4], z=rms[5]),
        turn_rmse_deg_s=float(np.sqrt(squares["rate"].mean())),
        turn_interval=roots["rate"],
    )


def _motion_nees(data: SequenceData, scores: Sequence[_MotionScore]) -> MotionNees:
    usable = [(data.sequence_of(score.frame_index), score.squares) for score in scores if score.squares is not None]
    squares = np.array([row for _, row in usable])
    parts = nees_parts(squares, MOTION_PARTS)
    interval = None
    if usable:
        per_freedom = squares[:, 2] / parts["motion"].freedom
        interval = mean_interval(per_freedom, [block for block, _ in usable], (0.0, math.inf))
    return MotionNees(
        n=len(usable),
        unusable=len(scores) - len(usable),
        velocity=parts.get("velocity"),
        rate=parts.get("rate"),
        motion=parts.get("motion"),
        interval=interval,
    )


def _against_raw(
    data: SequenceData, name: str, methods: Mapping[str, Mapping[int, Estimate]]
) -> MethodComparison | None:
    raw = name.rpartition(_FILTER_SEPARATOR)[0]
    if raw not in methods:
        return None
    in_sequences = {state.frame_index for sequence in data.sequences for state in sequence.states}
    errors = {
        method: {
            index: _error(estimate, data.drogues[index])
            for index, estimate in methods[method].items()
            if isinstance(estimate, PoseEstimate) and index in data.drogues and index in in_sequences
        }
        for method in (name, raw)
    }
    return compare_methods(errors, [raw], data.groups)[0]


def _error(estimate: PoseEstimate, truth: DrogueTruth) -> PoseError:
    return pose_error(estimate.left_from_drogue, truth.left_from_drogue)


def rms_length(vectors: Sequence[Array]) -> float | None:
    """Root mean square of the lengths of vectors; None without any."""
    return root_mean_square(np.linalg.norm(vectors, axis=1)) if len(vectors) else None
