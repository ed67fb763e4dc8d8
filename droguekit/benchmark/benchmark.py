"""A dataset and a file of estimates in, the numbers of `benchmark.json` out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.estimates import Estimate, PoseEstimate, read_estimates
from droguekit.benchmark.poses.centroid_errors import CentroidErrors, centroid_errors
from droguekit.benchmark.poses.comparisons import PairGroups, compare
from droguekit.benchmark.poses.distance_bins import DistanceBin
from droguekit.benchmark.poses.frame_scores import frame_scores
from droguekit.benchmark.poses.frame_truth import DrogueTruth, drogue_truth
from droguekit.benchmark.poses.pose_errors import by_method
from droguekit.benchmark.poses.ranking import PAPER_METHOD, best_method
from droguekit.benchmark.poses.reference import Reference, build_reference
from droguekit.benchmark.poses.summary import FrameScore, summarize
from droguekit.benchmark.results.benchmark_result import (
    BenchmarkResult,
    BinRow,
    DatasetFacts,
    EmptyFrames,
    MethodResult,
)
from droguekit.benchmark.results.result_parts import Comparison
from droguekit.benchmark.sequences.sequence_scores import score_sequences
from droguekit.benchmark.sequences.sequence_truth import TrueSequence, moment, true_sequences
from droguekit.benchmark.statistics import CONFIDENCE, fraction_interval

__all__ = ["BenchmarkResult", "run_benchmark", "score"]

Truths = Mapping[int, DrogueTruth | None]


def run_benchmark(dataset: Location, estimates: Path) -> BenchmarkResult:
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
    truths, moments = {}, []
    for index in data.frame_indices:
        record = data.record(index)
        truths[index] = drogue_truth(record)
        moments.append(moment(record))
    facts = DatasetFacts(name=data.manifest.name, sha256=data.manifest.dataset_sha256, pairs=len(data.frame_indices))
    return score(facts, truths, methods, true_sequences(moments))


def score(
    facts: DatasetFacts,
    truths: Truths,
    methods: Mapping[str, Mapping[int, Estimate]],
    sequences: Sequence[TrueSequence] = (),
) -> BenchmarkResult:
    """Score estimates that are sorted by method and frame against the truth of each frame.

    Args:
        facts: of the dataset.
        truths: by frame.
        methods: estimates by method and frame.
        sequences: the same frames as they follow each other, where they do.

    Raises:
        ValueError: no pair shows a drogue, or a feature that the drogue does not have.
    """
    drogues = {index: truth for index, truth in sorted(truths.items()) if truth is not None}
    if not drogues:
        raise ValueError("dataset: no pair shows a drogue, so there is nothing to compare poses with")
    centroids = {name: _centroids(name, drogues, estimates) for name, estimates in methods.items()}
    reference = build_reference(drogues, centroids)
    scores = {name: frame_scores(drogues, methods[name], centroids[name], reference) for name in methods}
    rows = {
        name: MethodResult(**_rows(scores[name], reference), empty_frames=_empty_frames(truths, estimates))
        for name, estimates in methods.items()
    }
    return BenchmarkResult(
        dataset=facts,
        code_version=version("droguekit"),
        confidence=CONFIDENCE,
        reference=reference.bins,
        methods=rows,
        comparisons=_comparisons(drogues, rows, scores, reference),
        sequences=score_sequences(sequences, drogues, methods),
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


def _rows(scores: Mapping[int, FrameScore], reference: Reference) -> dict[str, object]:
    spread, bins = reference.truth_spread, []
    for k, place in enumerate(reference.bins):
        inside = [score for index, score in scores.items() if reference.bin_of_frame[index] == k]
        bins.append(BinRow(**dict(summarize(inside, spread, f"bin {k}")), low_m=place.low_m, high_m=place.high_m))
    return {"overall": summarize(list(scores.values()), spread, "overall"), "bins": bins}


def _comparisons(
    drogues: Mapping[int, DrogueTruth],
    rows: Mapping[str, MethodResult],
    scores: Mapping[str, Mapping[int, FrameScore]],
    reference: Reference,
) -> list[Comparison]:
    """Every method beside the best one and beside the seed paper's."""
    errors = {
        name: {index: score.pose.error for index, score in frames.items() if score.pose is not None}
        for name, frames in scores.items()
    }
    groups = PairGroups(
        [DistanceBin(place.low_m, place.high_m) for place in reference.bins],
        reference.bin_of_frame,
        {index: truth.sequence_id for index, truth in drogues.items()},
    )
    best = best_method(rows)
    return compare(errors, [name for name in (best, PAPER_METHOD) if name in errors], groups)


def _empty_frames(truths: Truths, estimates: Mapping[int, Estimate]) -> EmptyFrames:
    empty = [index for index, truth in truths.items() if truth is None]
    false = sum(isinstance(estimates.get(index), PoseEstimate) for index in empty)
    return EmptyFrames(
        n=len(empty),
        false_fixes=false,
        false_fix_fraction=false / len(empty) if empty else None,
        interval=fraction_interval(false, len(empty)) if empty else None,
    )
