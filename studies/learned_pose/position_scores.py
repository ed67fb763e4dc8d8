"""Errors of all estimators against the bound of the stereo pair, by distance."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from datasets_manifest.types.records import PairRecord
from droguekit.scoring.poses.cramer_rao import pose_covariance
from droguekit.scoring.poses.drogue_truth import drogue_truth
from droguekit.scoring.poses.pose_errors import pose_error
from geometry.se3 import RigidTransform
from studies.acceptance.rendered.scored_frames import center_bounds_px
from studies.learned_pose.estimators import Poses

BINS_M = ((2.0, 5.0), (5.0, 10.0), (10.0, 20.0), (20.0, 30.0), (30.0, 40.0))
_PERCENTILES = (50.0, 95.0)
# Shown instead of a percentile that a missing pose occupies.
_NO_POSE = "none"


@dataclass(frozen=True)
class PoseDeviation:
    """One pose against the truth; both errors are infinite where there is no pose.

    Attributes:
        position_m: length of the error of the rim's centre. [m]
        axis_deg: angle between the axes. [deg]
    """

    position_m: float
    axis_deg: float


@dataclass(frozen=True)
class PairScores:
    """One pair.

    Attributes:
        distance_m: Z of the rim's centre in the left camera. [m]
        bound_m: root of the summed variances of X, Y and Z by the Cramer-Rao bound. [m]
        scores: by estimator, one for each of its poses.
    """

    distance_m: float
    bound_m: float
    scores: Mapping[str, tuple[PoseDeviation, ...]]


def stereo_bound_m(record: PairRecord) -> float:
    """Smallest standard deviation of the position from the markers in both eyes. [m]

    Each marker's centre has the smallest error that its own light allows; the hub does not count.

    Raises:
        ValueError: a record without a drogue, or whose markers leave the pose open.
    """
    truth = drogue_truth(record)
    if truth is None:
        raise ValueError(f"frame {record.frame_index}: shows no drogue")
    count = truth.layout.count
    sigmas_px = center_bounds_px(record)
    usable = truth.visible[:, :count] & np.isfinite(sigmas_px)
    whitened = (truth.jacobian[:, :count] / sigmas_px[..., None, None])[usable]
    covariance = pose_covariance(whitened)
    if covariance is None:
        raise ValueError(f"frame {record.frame_index}: too few markers are visible")
    return float(np.sqrt(np.trace(covariance[:3, :3])))


def score_pose(pose: RigidTransform | None, truth: RigidTransform) -> PoseDeviation:
    """Errors of one pose; roll does not count."""
    if pose is None:
        return PoseDeviation(math.inf, math.inf)
    sine = np.linalg.norm(np.cross(pose.rotation[:, 2], truth.rotation[:, 2]))
    cosine = pose.rotation[:, 2] @ truth.rotation[:, 2]
    return PoseDeviation(pose_error(pose, truth).position_m, float(np.rad2deg(np.arctan2(sine, cosine))))


def score_pair(record: PairRecord, poses: Mapping[str, Poses]) -> PairScores:
    """All estimators on one pair.

    Raises:
        ValueError: as `stereo_bound_m`.
    """
    bound_m, truth = stereo_bound_m(record), record.left_from_drogue
    assert truth is not None
    scores = {name: tuple(score_pose(pose, truth) for pose in found) for name, found in poses.items()}
    return PairScores(float(truth.translation_m[2]), bound_m, scores)


def percentile(values: Sequence[float], percent: float) -> float:
    """The smallest value that at least this share does not exceed; infinite where that is a missing pose."""
    return float(np.percentile(values, percent, method="inverted_cdf"))


def in_bin(pairs: Sequence[PairScores], low_m: float, high_m: float) -> list[PairScores]:
    """The pairs whose distance lies in [low, high)."""
    return [pair for pair in pairs if low_m <= pair.distance_m < high_m]


def table_lines(pairs: Sequence[PairScores], names: Sequence[str], quantity: str) -> Iterator[str]:
    """A Markdown table of median and 95th percentile by distance.

    Args:
        pairs: of all distances.
        names: of the estimators, a row each.
        quantity: `bound` for the position error over the bound, `cm` for it in centimetres, `deg` for the axis.
    """
    groups = [in_bin(pairs, low, high) for low, high in BINS_M]
    yield f"| | {' | '.join(f'{low:g} to {high:g} m' for low, high in BINS_M)} |"
    yield f"|---|{'---|' * len(BINS_M)}"
    for name in names:
        cells = (_cell([value for pair in group for value in _values(pair, name, quantity)]) for group in groups)
        yield f"| {name} | {' | '.join(cells)} |"


def _values(pair: PairScores, name: str, quantity: str) -> list[float]:
    scores = pair.scores[name]
    if quantity == "deg":
        return [score.axis_deg for score in scores]
    unit_m = pair.bound_m if quantity == "bound" else 0.01
    return [score.position_m / unit_m for score in scores]


def _cell(values: Sequence[float]) -> str:
    return ", ".join(_number(percentile(values, percent)) for percent in _PERCENTILES) if values else "-"


def _number(value: float) -> str:
    """Three significant digits without an exponent."""
    if not math.isfinite(value):
        return _NO_POSE
    digits = 2 - math.floor(math.log10(value)) if value > 0 else 0
    return f"{value:,.{max(0, digits)}f}"


def missing_lines(pairs: Sequence[PairScores], names: Sequence[str]) -> Iterator[str]:
    """For each estimator, of how many images or pairs it has no pose."""
    for name in names:
        scores = [score for pair in pairs for score in pair.scores[name]]
        missing = sum(not math.isfinite(score.position_m) for score in scores)
        yield f"{name}: no pose in {missing} of {len(scores)}"
