"""The scores of each method, pair by pair and over the pairs of a bin, and methods compared on the same pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.estimates import Estimate, PoseEstimate
from droguekit.scoring.confidence_intervals import (
    Interval,
    fraction_interval,
    mean_interval,
    percentile_intervals,
    ratio_intervals,
    rms_interval,
    root_mean_square,
)
from droguekit.scoring.poses.centroid_errors import CentroidErrors, centroid_statistics, position_error_from_centroids
from droguekit.scoring.poses.cramer_rao import FeatureNoise, component_deviations
from droguekit.scoring.poses.drogue_truth import DrogueTruth
from droguekit.scoring.poses.pose_errors import (
    COMPONENTS,
    FlipTrials,
    PoseError,
    RangefinderSample,
    flip_statistics,
    flip_trials,
    nees,
    normalized_errors,
    pose_error,
    rangefinder_errors,
    ring_tilt_scale,
    squared_errors,
)
from droguekit.scoring.poses.reference import DistanceBin, Reference, bound_covariance, feature_noise, mean_bound
from droguekit.scoring.results.benchmark_result import MethodResult, PoseRow
from droguekit.scoring.results.pose_result import (
    BinRatios,
    Bound,
    ComponentErrors,
    ComponentRatios,
    MeanRatios,
    MethodComparison,
)
from geometry.se3 import Array

UNITS = {"x": "m", "y": "m", "z": "m", "pitch": "deg", "yaw": "deg"}
_PERCENTILES = (95.0, 99.0)


@dataclass(frozen=True, eq=False)
class PoseScore:
    """Scores of one pose.

    Attributes:
        error: estimate minus truth.
        common_bound: (5,) bound of all visible features, markers and hub each at its own noise, or None. [m, deg]
        own_bound: (5,) bound of the features that the method used, at its own noise, or None. [m, deg]
        has_covariance: whether the estimate carries one.
        squared_errors: (3,) see `consistency.squared_errors`.
        flips: None where no bound is known.
        depth: with the rangefinder's reading, or None without one.
    """

    error: PoseError
    common_bound: Array | None
    own_bound: Array | None
    has_covariance: bool
    squared_errors: Array | None
    flips: FlipTrials | None
    depth: RangefinderSample | None


@dataclass(frozen=True, eq=False)
class FrameScore:
    """Scores of one method in one pair that shows a drogue.

    Attributes:
        block: see `block_of_pair`.
        pose: scores of its pose, or None without one.
        bound: (5,) Cramer-Rao bound at the noise of the pair's bin [m, deg], or None where there is none.
        centroids: errors of its features.
        from_centroids_m: (3,) position error that its centroids alone would make, or None. [m]
    """

    block: int
    pose: PoseScore | None
    bound: Array | None
    centroids: CentroidErrors
    from_centroids_m: Array | None


def block_of_pair(index: int, sequence_id: int | None) -> int:
    """What a pair's errors depend on each other in: its sequence, or itself; the sign keeps the two apart."""
    return -1 - index if sequence_id is None else sequence_id


def frame_scores(
    drogues: Mapping[int, DrogueTruth],
    estimates: Mapping[int, Estimate],
    centroids: Mapping[int, CentroidErrors],
    reference: Reference,
) -> dict[int, FrameScore]:
    """Score a method on every pair that shows a drogue.

    Args:
        drogues: the truth by frame.
        estimates: of the method, by frame; one may be missing.
        centroids: of the method, for every frame of `drogues`.
        reference: of the file.
    """
    noise = [
        _used_noise([centroids[i] for i in drogues if reference.bin_of_frame[i] == k])
        for k in range(len(reference.bins))
    ]
    scores = {}
    for index, truth in drogues.items():
        estimate, found = estimates.get(index), centroids[index]
        pose = None
        if isinstance(estimate, PoseEstimate):
            own_noise = noise[reference.bin_of_frame[index]]
            pose = _pose_score(estimate, truth, found, own_noise, reference.covariances[index])
        scores[index] = FrameScore(
            block=block_of_pair(index, truth.sequence_id),
            pose=pose,
            bound=reference.bounds[index],
            centroids=found,
            from_centroids_m=position_error_from_centroids(truth, found),
        )
    return scores


def summarize(scores: Sequence[FrameScore], truth_spread: Array, key: str) -> PoseRow:
    """The row of some pairs, of which there is at least one.

    Args:
        scores: one for each pair; their order does not matter.
        truth_spread: (5,) what a pair without a pose counts with in `rmse_with_failures`. [m, deg]
        key: of the bootstrap's random stream.
    """
    fixed = [score for score in scores if score.pose is not None]
    poses = [score.pose for score in scores if score.pose is not None]
    numbers: dict[str, float] = {}
    intervals: dict[str, Interval] = {"fix_fraction": fraction_interval(len(fixed), len(scores))}
    bound = mean_bound([score.bound for score in fixed])
    bounded = [score.pose.error for score in fixed if score.pose is not None and score.bound is not None]
    if poses:
        numbers, error_intervals = _error_numbers([pose.error for pose in poses], [score.block for score in fixed], key)
        intervals |= error_intervals
    return PoseRow.model_validate(
        {
            "n": len(scores),
            "fixes": len(fixed),
            "fix_fraction": len(fixed) / len(scores),
            **numbers,
            "intervals": intervals,
            "bound": bound,
            "bound_ratio": _ratios(bounded, bound),
            "centroids": centroid_statistics([score.centroids for score in scores]),
            **_centroid_share(fixed),
            **_checks(poses),
            "failures": len(scores) - len(poses),
            "rmse_with_failures": _with_failures(poses, len(scores), truth_spread),
            "rangefinder": rangefinder_errors([pose.depth for pose in poses if pose.depth is not None]),
        }
    )


def _pose_score(
    estimate: PoseEstimate,
    truth: DrogueTruth,
    centroids: CentroidErrors,
    noise: FeatureNoise | None,
    common: Array | None,
) -> PoseScore:
    pose = estimate.left_from_drogue
    error = pose_error(pose, truth.left_from_drogue)
    own = bound_covariance(truth, _used(truth, centroids), noise)
    covariance = common if own is None else own
    reading_m = truth.rangefinder_reading_m
    scale_rad = None if noise is None else ring_tilt_scale(truth, centroids, noise.marker_px)
    return PoseScore(
        error=error,
        common_bound=None if common is None else component_deviations(truth.left_from_drogue, common),
        own_bound=None if own is None else component_deviations(truth.left_from_drogue, own),
        has_covariance=estimate.covariance is not None,
        squared_errors=squared_errors(estimate, error),
        flips=None if covariance is None else flip_trials(pose, truth, covariance, scale_rad),
        depth=None
        if reading_m is None
        else RangefinderSample(float(pose.translation_m[2]), truth.distance_m, reading_m),
    )


def _used(truth: DrogueTruth, centroids: CentroidErrors) -> NDArray[np.bool_]:
    used = np.zeros_like(truth.visible)
    used[centroids.eye[centroids.used], centroids.feature[centroids.used]] = True
    return used


def _used_noise(errors: Sequence[CentroidErrors]) -> FeatureNoise | None:
    """Noise of the centroids on which a method's poses rest."""
    offsets = np.concatenate([e.offset_px[e.used] for e in errors])
    hub = np.concatenate([e.is_hub[e.used] for e in errors])
    marker_px, hub_px = (root_mean_square(part) if len(part) else None for part in (offsets[~hub], offsets[hub]))
    return feature_noise(marker_px, hub_px)


def _error_numbers(
    errors: Sequence[PoseError], blocks: Sequence[int], key: str
) -> tuple[dict[str, float], dict[str, Interval]]:
    position = np.array([error.position_m for error in errors])
    columns = np.column_stack([position, np.stack([error.components for error in errors])])
    names = [("position", "m"), *UNITS.items()]
    rank_ends = percentile_intervals(columns, _PERCENTILES, blocks, key)
    numbers: dict[str, float] = {}
    intervals: dict[str, Interval] = {}
    for k, (name, unit) in enumerate(names):
        column, is_length = columns[:, k], name == "position"
        average = f"{name}_mean_{unit}" if is_length else f"{name}_bias_{unit}"
        numbers[average] = float(column.mean())
        mean_ends = mean_interval(column, blocks, (0.0 if is_length else -math.inf, math.inf))
        if mean_ends is not None:
            intervals[average] = mean_ends
        numbers[f"{name}_rmse_{unit}"] = root_mean_square(column)
        intervals[f"{name}_rmse_{unit}"] = rms_interval(column, blocks)
        for p, percent in enumerate(_PERCENTILES):
            rank = f"{name}_p{percent:.0f}_{unit}"
            numbers[rank] = float(np.percentile(np.abs(column), percent))
            if rank_ends is not None:
                intervals[rank] = tuple(rank_ends[k, p].tolist())
        numbers[f"{name}_max_{unit}"] = float(np.abs(column).max())
    transverse = np.array([error.transverse_m for error in errors])
    numbers["transverse_rmse_m"] = root_mean_square(transverse)
    intervals["transverse_rmse_m"] = rms_interval(transverse, blocks)
    return numbers, intervals


def _ratios(errors: Sequence[PoseError], bound: Bound | None) -> ComponentRatios | None:
    if bound is None:
        return None
    limits = np.array([getattr(bound, f"{name}_{UNITS[name]}") for name in COMPONENTS])
    rms = np.sqrt(np.mean(np.square([error.components for error in errors]), axis=0))
    return ComponentRatios(**dict(zip(COMPONENTS, (rms / limits).tolist(), strict=True)))


def _checks(poses: Sequence[PoseScore]) -> dict[str, object]:
    """Errors against bounds and covariances, pose by pose, and mirrored tilts."""
    optical = [pose.flips.optical for pose in poses if pose.flips is not None]
    sight = [pose.flips.sight for pose in poses if pose.flips is not None]
    return {
        "normalized": normalized_errors([(p.error, p.common_bound) for p in poses if p.common_bound is not None]),
        "normalized_own": normalized_errors([(p.error, p.own_bound) for p in poses if p.own_bound is not None]),
        "nees": nees([pose.squared_errors for pose in poses if pose.has_covariance]),
        "flips": flip_statistics([trial for trial in optical if trial is not None]),
        "sight_flips": flip_statistics([trial for trial in sight if trial is not None]),
    }


def _with_failures(poses: Sequence[PoseScore], count: int, truth_spread: Array) -> ComponentErrors:
    squares = (count - len(poses)) * truth_spread**2
    for pose in poses:
        squares = squares + pose.error.components**2
    x, y, z, pitch, yaw = np.sqrt(squares / count).tolist()
    return ComponentErrors(x_m=x, y_m=y, z_m=z, pitch_deg=pitch, yaw_deg=yaw)


def _centroid_share(fixed: Sequence[FrameScore]) -> dict[str, float | None]:
    """Share of the position error that centroid errors explain, over the frames where they determine a pose."""
    pairs = [(s.pose.error.components[:3], s.from_centroids_m) for s in fixed if s.pose is not None]
    known = [(error, predicted) for error, predicted in pairs if predicted is not None]
    if not known:
        return {"position_from_centroids_rmse_m": None, "centroid_share": None}
    errors, predicted = np.array([k[0] for k in known]), np.array([k[1] for k in known])
    total, rest = float(np.square(errors).sum()), float(np.square(errors - predicted).sum())
    share = None if total == 0 else max(0.0, 1 - rest / total)
    from_centroids = float(np.sqrt(np.square(predicted).sum(axis=1).mean()))
    return {"position_from_centroids_rmse_m": from_centroids, "centroid_share": share}


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
    blocks = np.array([block_of_pair(i, groups.sequence_of_frame[i]) for i in common], dtype=np.int64)
    rows = []
    for k, place in enumerate(groups.bins):
        inside = bins == k
        ratios = _mean_ratios(above[inside], below[inside], blocks[inside].tolist(), f"{name} / {other}, bin {k}")
        rows.append(BinRatios(**dict(ratios), low_m=place.low_m, high_m=place.high_m))
    overall = _mean_ratios(above, below, blocks.tolist(), f"{name} / {other}")
    return MethodComparison(method=name, against=other, overall=overall, bins=rows)


def _sizes(errors: Sequence[PoseError]) -> Array:
    """(n, 2) lengths of the position errors [m] and of pitch and yaw errors together [deg]."""
    sizes = [(error.position_m, float(np.hypot(*error.components[3:]))) for error in errors]
    return np.array(sizes, dtype=np.float64).reshape(-1, 2)


def _mean_ratios(above: Array, below: Array, blocks: list[int], key: str) -> MeanRatios:
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
