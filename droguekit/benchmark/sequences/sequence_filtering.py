"""What a filter makes of poses: velocity and rate, their covariances, lag, and its errors beside the raw ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from datasets_manifest.types.estimates import Estimate, PoseEstimate
from droguekit.benchmark.poses.comparisons import PairGroups, compare
from droguekit.benchmark.poses.consistency import nees_parts, normalized_squares
from droguekit.benchmark.poses.frame_truth import DrogueTruth
from droguekit.benchmark.poses.pose_errors import PoseError, pose_error
from droguekit.benchmark.results.result_parts import Comparison
from droguekit.benchmark.results.sequence_result import Axes, Filtering, MotionBin, MotionNees, MotionRow
from droguekit.benchmark.sequences.sequence_lag import lags
from droguekit.benchmark.sequences.sequence_motion import MOTION_PARTS, TrueMotion, motion_errors
from droguekit.benchmark.sequences.sequence_truth import TrueSequence
from droguekit.benchmark.statistics import mean_interval, root_mean_square
from geometry.se3 import Array

# A method that works on the poses of another is called by its name, this, and its own.
_BEHIND = "+"


class SequenceData(NamedTuple):
    """The truth that sequences are scored with.

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


def filtering(data: SequenceData, name: str, methods: Mapping[str, Mapping[int, Estimate]]) -> Filtering | None:
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
            row = _motion_row(data, inside, of, f"{name}, bin {k}")
            bins.append(MotionBin(**dict(row), low_m=place.low_m, high_m=place.high_m))
    return Filtering(
        motion=_motion_row(data, scores, len(data.motions), name) if scores else None,
        bins=tuple(bins),
        nees=_motion_nees(data, scores, name) if scores else None,
        lags=lags(data.sequences, estimates, f"{name}, lag"),
        raw=_against_raw(data, name, methods),
    )


def _motion_scores(data: SequenceData, estimates: Mapping[int, PoseEstimate]) -> list[_MotionScore]:
    scores = []
    for index, truth in sorted(data.motions.items()):
        motion = estimates[index].motion if index in estimates else None
        if motion is not None:
            error = motion_errors(motion, truth)
            scores.append(_MotionScore(index, error, normalized_squares(error, motion.covariance, MOTION_PARTS)))
    return scores


def _motion_row(data: SequenceData, scores: Sequence[_MotionScore], of: int, key: str) -> MotionRow:
    errors = np.array([score.error for score in scores])
    errors[:, 3:] = np.rad2deg(errors[:, 3:])
    blocks = [data.sequence_of(score.frame_index) for score in scores]
    rms = np.sqrt(np.square(errors).mean(axis=0)).tolist()
    squares = {part: np.square(errors[:, MOTION_PARTS[part]]).sum(axis=1) for part in ("velocity", "rate")}
    ends = {part: mean_interval(values, blocks, f"{key}, {part}") for part, values in squares.items()}
    roots = {part: None if e is None else (float(np.sqrt(e[0])), float(np.sqrt(e[1]))) for part, e in ends.items()}
    return MotionRow(
        n=len(scores),
        of=of,
        velocity_rmse_m_s=Axes(x=rms[0], y=rms[1], z=rms[2]),
        speed_rmse_m_s=float(np.sqrt(squares["velocity"].mean())),
        speed_interval=roots["velocity"],
        rate_rmse_deg_s=Axes(x=rms[3], y=rms[4], z=rms[5]),
        turn_rmse_deg_s=float(np.sqrt(squares["rate"].mean())),
        turn_interval=roots["rate"],
    )


def _motion_nees(data: SequenceData, scores: Sequence[_MotionScore], key: str) -> MotionNees:
    usable = [(data.sequence_of(score.frame_index), score.squares) for score in scores if score.squares is not None]
    squares = np.array([row for _, row in usable])
    parts = nees_parts(squares, MOTION_PARTS)
    interval = None
    if usable:
        per_freedom = squares[:, 2] / parts["motion"].freedom
        interval = mean_interval(per_freedom, [block for block, _ in usable], f"{key}, motion nees")
    return MotionNees(
        n=len(usable),
        unusable=len(scores) - len(usable),
        velocity=parts.get("velocity"),
        rate=parts.get("rate"),
        motion=parts.get("motion"),
        interval=interval,
    )


def _against_raw(data: SequenceData, name: str, methods: Mapping[str, Mapping[int, Estimate]]) -> Comparison | None:
    raw = name.rpartition(_BEHIND)[0]
    if raw not in methods:
        return None
    in_sequences = {moment.frame_index for sequence in data.sequences for moment in sequence.moments}
    errors = {
        method: {
            index: _error(estimate, data.drogues[index])
            for index, estimate in methods[method].items()
            if isinstance(estimate, PoseEstimate) and index in data.drogues and index in in_sequences
        }
        for method in (name, raw)
    }
    return compare(errors, [raw], data.groups)[0]


def _error(estimate: PoseEstimate, truth: DrogueTruth) -> PoseError:
    return pose_error(estimate.left_from_drogue, truth.left_from_drogue)


def root_mean_length(vectors: Sequence[Array]) -> float | None:
    """Root mean square of the lengths of vectors; None without any."""
    return root_mean_square(np.linalg.norm(vectors, axis=1)) if len(vectors) else None
