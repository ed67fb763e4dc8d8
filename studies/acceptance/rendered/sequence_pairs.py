"""Every pair of a sequence scored against its record; the criteria of whole flights are computed from these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import Estimate, PoseEstimate, read_estimates
from droguekit.scoring.poses.centroid_errors import centroid_errors
from droguekit.scoring.poses.cramer_rao import component_deviations
from droguekit.scoring.poses.drogue_truth import DrogueTruth, drogue_truth
from droguekit.scoring.poses.pose_errors import estimates_by_method, pose_error
from droguekit.scoring.poses.reference import build_reference
from droguekit.scoring.sequences.sequence_latency import processing_time_s
from droguekit.scoring.sequences.sequence_truth import Visibility, true_state
from geometry.se3 import Array
from studies.acceptance.rendered.scored_frames import BEST

# Our best method, with the filter behind it.
FILTERED = f"{BEST}+filter"
LEAST_MARKERS = 4
"""Of the bars: "at least four markers and the hub in view", in both images."""


@dataclass(frozen=True, eq=False)
class TruePair:
    """The truth of one pair.

    Attributes:
        frame_index: of the pair.
        sequence_id: of its sequence; a pair that belongs to none is one of its own.
        family: of its conditions.
        truth: of the drogue.
        rim_radius_m: of the drogue. [m]
        in_view: whether both images show four markers and the hub, if the drogue has one, and the sun dazzles neither.
        visibility: of the pair; `seen` for a single one.
    """

    frame_index: int
    sequence_id: int
    family: str
    truth: DrogueTruth
    rim_radius_m: float
    in_view: bool
    visibility: Visibility

    @property
    def distance_m(self) -> float:
        """Z of the rim's centre. [m]"""
        return self.truth.distance_m


@dataclass(frozen=True, eq=False)
class ScoredPair:
    """One method's estimate of a pair.

    Attributes:
        pair: the truth.
        error: (5,) X, Y, Z [m], pitch and yaw [deg], estimate minus truth; None without a pose.
        sd_m: root of the trace of the position's reported covariance; None without one. [m]
        over_bound: (5,) error over its bound at the noise measured in its family, of markers and of hubs; None without.
        reason: why there is no pose; empty where there is one or the method gave no estimate.
        work_s: processing time without waiting; None where it is not reported. [s]
    """

    pair: TruePair
    error: Array | None
    sd_m: float | None
    over_bound: Array | None
    reason: str
    work_s: float | None

    @property
    def position_m(self) -> float:
        """Length of the position error, of a pair with a pose. [m]"""
        assert self.error is not None
        return float(np.linalg.norm(self.error[:3]))


Scores = Mapping[str, Sequence[ScoredPair]]


def score_pairs(dataset: Path, estimates: Path) -> dict[str, list[ScoredPair]]:
    """Every method's scores of all pairs that show a drogue, in the order of frames.

    Raises:
        ValueError: a dataset or estimates that cannot be read.
    """
    data = Dataset(dataset)
    found = estimates_by_method(read_estimates(estimates), data.frame_indices, str(estimates))
    pairs = [pair for pair in (_true_pair(data, index) for index in data.frame_indices) if pair is not None]
    bounds = _bounds(pairs, found)
    return {
        name: [_scored(pair, estimated.get(pair.frame_index), bounds[pair.frame_index]) for pair in pairs]
        for name, estimated in found.items()
    }


def shows_enough(truth: DrogueTruth) -> bool:
    """Whether both images show at least four markers, and the hub if the drogue has one."""
    markers = truth.visible[:, : truth.layout.count].sum(axis=1)
    return bool((markers >= LEAST_MARKERS).all() and truth.visible[:, truth.layout.count :].all())


def _true_pair(data: Dataset, index: int) -> TruePair | None:
    record = data.record(index)
    truth, flown, drogue = drogue_truth(record), true_state(record), record.frame.drogue
    if truth is None or drogue is None:
        return None
    visibility: Visibility = "seen" if flown is None else flown.visibility
    return TruePair(
        frame_index=index,
        sequence_id=index if record.sequence_id is None else record.sequence_id,
        family=record.conditions.family,
        truth=truth,
        rim_radius_m=drogue.rim_radius_m,
        in_view=shows_enough(truth) and visibility != "dazzled",
        visibility=visibility,
    )


def _bounds(pairs: Sequence[TruePair], methods: Mapping[str, Mapping[int, Estimate]]) -> dict[int, Array | None]:
    """(5,) bound of every pair, the same for all methods, by the noise of its family's best markers and hubs."""
    bounds: dict[int, Array | None] = {}
    for family in sorted({pair.family for pair in pairs}):
        truths = {pair.frame_index: pair.truth for pair in pairs if pair.family == family}
        centroids = {
            name: {
                index: centroid_errors(truth, estimated[index].features if index in estimated else ())
                for index, truth in truths.items()
            }
            for name, estimated in methods.items()
        }
        for index, covariance in build_reference(truths, centroids).covariances.items():
            pose = truths[index].left_from_drogue
            bounds[index] = None if covariance is None else component_deviations(pose, covariance)
    return bounds


def _scored(pair: TruePair, estimate: Estimate | None, bound: Array | None) -> ScoredPair:
    work_s = None if estimate is None else processing_time_s(estimate.stage_s)
    if not isinstance(estimate, PoseEstimate):
        reason = "" if estimate is None else estimate.reason
        return ScoredPair(pair, None, None, None, reason, work_s)
    error = pose_error(estimate.left_from_drogue, pair.truth.left_from_drogue).components
    sd_m = None if estimate.covariance is None else float(np.sqrt(max(np.trace(estimate.covariance[:3, :3]), 0.0)))
    return ScoredPair(pair, error, sd_m, None if bound is None else error / bound, "", work_s)
