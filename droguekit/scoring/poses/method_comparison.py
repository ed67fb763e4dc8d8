"""Methods of one file compared: ratios of mean errors on the same pairs, and which method is best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from droguekit.scoring.confidence_intervals import Interval, ratio_intervals
from droguekit.scoring.poses.pose_errors import PoseError
from droguekit.scoring.poses.reference import DistanceBin
from droguekit.scoring.results.benchmark_result import MethodResult
from droguekit.scoring.results.pose_result import BinRatios, MeanRatios, MethodComparison
from geometry.se3 import Array

Errors = Mapping[str, Mapping[int, PoseError]]
# Every method is also compared with the seed paper's.
PAPER_METHOD = "paper"
# A method that finds the drogue in easy pairs only cannot be the best one.
_FIXES_OF_MOST = 0.9


@dataclass(frozen=True)
class PairGroups:
    """Bins and sequences of a dataset's pairs.

    Attributes:
        bins: of distance.
        bin_of_frame: place in `bins`.
        sequence_of_frame: the sequence, or None for a pair that belongs to none.
    """

    bins: Sequence[DistanceBin]
    bin_of_frame: Mapping[int, int]
    sequence_of_frame: Mapping[int, int | None]


def best_method(methods: Mapping[str, MethodResult]) -> str | None:
    """Smallest mean position error among the methods that found nearly as many poses as any; None without a pose."""
    most = max(method.overall.fix_fraction for method in methods.values())
    means = {
        name: method.overall.position_mean_m
        for name, method in methods.items()
        if method.overall.position_mean_m is not None and method.overall.fix_fraction >= _FIXES_OF_MOST * most
    }
    return min(means, key=lambda name: means[name]) if means else None


def compare_methods(errors: Errors, against: Sequence[str], groups: PairGroups) -> list[MethodComparison]:
    """Every method compared with each of some others, on the pairs in which both found a pose.

    Args:
        errors: by method and frame, of the pairs with a pose.
        against: methods of `errors`.
        groups: of the pairs.
    """
    return [
        _comparison(name, other, errors, groups) for other in dict.fromkeys(against) for name in errors if name != other
    ]


def _comparison(name: str, other: str, errors: Errors, groups: PairGroups) -> MethodComparison:
    common = sorted(errors[name].keys() & errors[other].keys())
    above, below = (_sizes([errors[method][i] for i in common]) for method in (name, other))
    bins = np.array([groups.bin_of_frame[i] for i in common], dtype=np.intp)
    # Single pairs are blocks of their own; their sign separates them from sequences.
    sequences = [groups.sequence_of_frame[i] for i in common]
    blocks = np.array([-1 - i if s is None else s for i, s in zip(common, sequences, strict=True)], dtype=np.int64)
    rows = []
    for k, place in enumerate(groups.bins):
        inside = bins == k
        ratios = _ratios(above[inside], below[inside], blocks[inside].tolist(), f"{name} / {other}, bin {k}")
        rows.append(BinRatios(**dict(ratios), low_m=place.low_m, high_m=place.high_m))
    overall = _ratios(above, below, blocks.tolist(), f"{name} / {other}")
    return MethodComparison(method=name, against=other, overall=overall, bins=rows)


def _sizes(errors: Sequence[PoseError]) -> Array:
    """(n, 2) lengths of the position errors [m] and of pitch and yaw errors together [deg]."""
    sizes = [(error.position_m, float(np.hypot(*error.components[3:]))) for error in errors]
    return np.array(sizes, dtype=np.float64).reshape(-1, 2)


def _ratios(above: Array, below: Array, blocks: list[int], key: str) -> MeanRatios:
    intervals = ratio_intervals(above, below, blocks, key)
    (position, position_ends), (attitude, attitude_ends) = (
        _with_ends(float(above[:, c].sum()), float(below[:, c].sum()), intervals[c]) for c in range(2)
    )
    return MeanRatios(
        n=len(above),
        blocks=len(set(blocks)),
        position=position,
        position_interval=position_ends,
        attitude=attitude,
        attitude_interval=attitude_ends,
    )


def _with_ends(above: float, below: float, ends: Interval | None) -> tuple[float | None, Interval | None]:
    return (above / below, ends) if below > 0 else (None, None)
