"""A dataset and a file of estimates in, the numbers of `benchmark.json` out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from datasets_manifest.estimates import Estimate, PoseEstimate, read_estimates
from datasets_manifest.reader import Dataset
from droguekit.benchmark.bounds import pose_bound
from droguekit.benchmark.centroid_errors import (
    CentroidErrors,
    CentroidStatistics,
    centroid_errors,
    centroid_statistics,
    position_error_from_centroids,
)
from droguekit.benchmark.distance_bins import DistanceBin, distance_bins
from droguekit.benchmark.frame_truth import DrogueTruth, drogue_truth
from droguekit.benchmark.pose_errors import by_method, pose_error
from droguekit.benchmark.result import BenchmarkResult, BinRow, DatasetFacts, EmptyFrames, MethodResult, ReferenceBin
from droguekit.benchmark.statistics import CONFIDENCE, fraction_interval
from droguekit.benchmark.summary import FrameScore, mean_bound, summarize
from geometry.se3 import Array

__all__ = ["BenchmarkResult", "run_benchmark", "score"]

# A method whose centroids are the best of the file, but which shows only the easy ones, sets no standard.
_FEWEST_OF_MOST = 0.5

Truths = Mapping[int, DrogueTruth | None]


@dataclass(frozen=True, eq=False)
class _Reference:
    """What all methods of a file are measured against.

    Attributes:
        bins: with their noise and bound.
        bin_of_frame: for pairs that show a drogue.
        bounds: (5,) by frame, at the noise of its bin; None where there is none.
    """

    bins: list[ReferenceBin]
    bin_of_frame: dict[int, int]
    bounds: dict[int, Array | None]


def run_benchmark(dataset: Path, estimates: Path) -> BenchmarkResult:
    """Score every method of a file of estimates on a dataset.

    Args:
        dataset: the dataset's folder.
        estimates: a JSON-lines file, whoever wrote it. A pair without an estimate of a method counts as not fixed.

    Raises:
        ValueError: the dataset or the file cannot be read, the file is empty, names pairs that the dataset lacks, or
            names one twice for a method.
    """
    data = Dataset(dataset)
    methods = by_method(read_estimates(estimates), data.frame_indices, str(estimates))
    truths = {index: drogue_truth(data.record(index)) for index in data.frame_indices}
    facts = DatasetFacts(name=data.manifest.name, sha256=data.manifest.dataset_sha256, pairs=len(data.frame_indices))
    return score(facts, truths, methods)


def score(facts: DatasetFacts, truths: Truths, methods: Mapping[str, Mapping[int, Estimate]]) -> BenchmarkResult:
    """Score estimates that are sorted by method and frame against the truth of each frame.

    Raises:
        ValueError: no pair shows a drogue, or a feature that the drogue does not have.
    """
    drogues = {index: truth for index, truth in sorted(truths.items()) if truth is not None}
    if not drogues:
        raise ValueError("dataset: no pair shows a drogue, so there is nothing to compare poses with")
    centroids = {name: _centroids(name, drogues, estimates) for name, estimates in methods.items()}
    reference = _reference(drogues, centroids)
    return BenchmarkResult(
        dataset=facts,
        code_version=version("droguekit"),
        confidence=CONFIDENCE,
        reference=reference.bins,
        methods={
            name: MethodResult(
                **_rows(_scores(drogues, estimates, centroids[name], reference), reference),
                empty_frames=_empty_frames(truths, estimates),
            )
            for name, estimates in methods.items()
        },
    )


def _centroids(
    method: str, drogues: Mapping[int, DrogueTruth], estimates: Mapping[int, Estimate]
) -> dict[int, CentroidErrors]:
    found = {}
    for index, truth in drogues.items():
        estimate = estimates.get(index)
        try:
            found[index] = centroid_errors(truth, estimate.features if estimate is not None else ())
        except ValueError as error:
            raise ValueError(f"estimates: method {method!r}: frame {index}: {error}") from error
    return found


def _reference(drogues: Mapping[int, DrogueTruth], centroids: Mapping[str, Mapping[int, CentroidErrors]]) -> _Reference:
    bins, labels = distance_bins([truth.distance_m for truth in drogues.values()])
    bin_of_frame = dict(zip(drogues, labels, strict=True))
    unit_bounds = {i: pose_bound(t.rig, t.left_from_drogue, t.layout, t.visible) for i, t in drogues.items()}
    rows: list[ReferenceBin] = []
    bounds: dict[int, Array | None] = {}
    for k, place in enumerate(bins):
        frames = [index for index in drogues if bin_of_frame[index] == k]
        method, sigma = _best_centroids({name: [errors[i] for i in frames] for name, errors in centroids.items()})
        for i in frames:
            unit = unit_bounds[i]
            bounds[i] = None if unit is None or sigma is None else sigma * unit
        rows.append(_reference_bin(place, method, sigma, [bounds[i] for i in frames]))
    return _Reference(rows, bin_of_frame, bounds)


def _reference_bin(
    place: DistanceBin, method: str | None, sigma: float | None, bounds: Sequence[Array | None]
) -> ReferenceBin:
    return ReferenceBin(
        low_m=place.low_m,
        high_m=place.high_m,
        n=len(bounds),
        centroid_sigma_px=sigma,
        centroid_method=method,
        bound=mean_bound(bounds),
    )


def _best_centroids(errors: Mapping[str, Sequence[CentroidErrors]]) -> tuple[str | None, float | None]:
    """The method with the least noise among those that measured enough markers, and that noise. [px]"""
    found: dict[str, CentroidStatistics] = {name: centroid_statistics(rows) for name, rows in errors.items()}
    most = max(statistics.count for statistics in found.values())
    sigmas = {
        name: s.sigma_px for name, s in found.items() if s.sigma_px is not None and s.count >= _FEWEST_OF_MOST * most
    }
    if not sigmas:
        return None, None
    best = min(sigmas, key=lambda name: sigmas[name])
    return best, sigmas[best]


def _scores(
    drogues: Mapping[int, DrogueTruth],
    estimates: Mapping[int, Estimate],
    centroids: Mapping[int, CentroidErrors],
    reference: _Reference,
) -> dict[int, FrameScore]:
    scores = {}
    for index, truth in drogues.items():
        estimate = estimates.get(index)
        fix = estimate.left_from_drogue if isinstance(estimate, PoseEstimate) else None
        scores[index] = FrameScore(
            error=None if fix is None else pose_error(fix, truth.left_from_drogue),
            bound=reference.bounds[index],
            centroids=centroids[index],
            from_centroids_m=position_error_from_centroids(truth, centroids[index]),
        )
    return scores


def _rows(scores: Mapping[int, FrameScore], reference: _Reference) -> dict[str, object]:
    bins = []
    for k, place in enumerate(reference.bins):
        row = summarize([score for index, score in scores.items() if reference.bin_of_frame[index] == k], f"bin {k}")
        bins.append(BinRow(**dict(row), low_m=place.low_m, high_m=place.high_m))
    return {"overall": summarize(list(scores.values()), "overall"), "bins": bins}


def _empty_frames(truths: Truths, estimates: Mapping[int, Estimate]) -> EmptyFrames:
    empty = [index for index, truth in truths.items() if truth is None]
    false = sum(isinstance(estimates.get(index), PoseEstimate) for index in empty)
    return EmptyFrames(
        n=len(empty),
        false_fixes=false,
        false_fix_fraction=false / len(empty) if empty else None,
        interval=fraction_interval(false, len(empty)) if empty else None,
    )
