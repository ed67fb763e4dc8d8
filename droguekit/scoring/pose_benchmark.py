"""Scores a file of pose estimates on a dataset; the result is the content of `benchmark.json`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

from datasets_manifest.storage.pair_faults import PairFaults, read_or_note
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.estimates import Estimate, PoseEstimate, read_estimates
from droguekit.scoring.confidence_intervals import CONFIDENCE, fraction_interval
from droguekit.scoring.poses.centroid_errors import CentroidErrors, centroid_errors
from droguekit.scoring.poses.drogue_truth import DrogueTruth, drogue_truth
from droguekit.scoring.poses.method_scores import (
    PAPER_METHOD,
    FrameScore,
    PairGroups,
    best_method,
    compare_methods,
    frame_scores,
    summarize,
)
from droguekit.scoring.poses.pose_errors import estimates_by_method
from droguekit.scoring.poses.reference import DistanceBin, Reference, build_reference, distance_bins
from droguekit.scoring.results.benchmark_result import BenchmarkResult, DatasetFacts, EmptyFrames, MethodResult, PoseBin
from droguekit.scoring.results.pose_result import MethodComparison
from droguekit.scoring.results.sequence_result import HiddenPairs, MethodSequences, SequencesResult
from droguekit.scoring.sequences.docking_errors import docking_errors, true_dockings
from droguekit.scoring.sequences.filter_errors import SequenceData, filter_errors, rms_length
from droguekit.scoring.sequences.sequence_latency import latency
from droguekit.scoring.sequences.sequence_truth import (
    TrueSequence,
    TrueState,
    true_motions,
    true_sequences,
    true_state,
)
from droguekit.scoring.sequences.tracking_scores import has_found, reacquisition, score_regions

Methods = Mapping[str, Mapping[int, Estimate]]
Truths = Mapping[int, DrogueTruth | None]


def run_benchmark(dataset: Location, estimates: Path, faults: PairFaults | None = None) -> BenchmarkResult:
    """Score every method of a file of estimates on a dataset.

    Args:
        dataset: the dataset's folder.
        estimates: a JSON-lines file, whoever wrote it. A pair without an estimate of a method counts as not fixed.
        faults: count pairs whose record is damaged, which are then left out; without, such a pair is an error.

    Raises:
        ValueError: the dataset or the file cannot be read, the file is empty, names pairs that the dataset lacks, or
            names one twice for a method.
    """
    return score_estimates(Dataset(dataset), read_estimates(estimates), str(estimates), faults=faults)


def score_estimates(
    data: Dataset,
    estimates: Iterable[Estimate],
    source: str,
    frame_indices: Sequence[int] | None = None,
    faults: PairFaults | None = None,
) -> BenchmarkResult:
    """Score every method of these estimates.

    Args:
        data: the dataset.
        estimates: of any number of methods. A pair without an estimate of a method counts as not fixed.
        source: what to call the estimates in errors.
        frame_indices: pairs to score on; all of the dataset when None.
        faults: as for `run_benchmark`.

    Raises:
        ValueError: a record cannot be read, no pair shows a drogue, there are no estimates, or they name other pairs
            than these or one of them twice for a method.
    """
    indices = data.frame_indices if frame_indices is None else frame_indices
    methods = estimates_by_method(estimates, indices, source)
    truths, states = {}, []
    for index in indices:
        record = read_or_note(index, data.unchanged_record, faults)
        if record is None:
            continue
        truths[index] = drogue_truth(record)
        states.append(true_state(record))
    if faults is not None and faults.count and not any(truth is not None for truth in truths.values()):
        raise ValueError(
            f"{data.path}: no pair that can be read shows a drogue, so there is nothing to compare poses with: "
            f"{faults.line()}"
        )
    facts = DatasetFacts(name=data.manifest.name, sha256=data.manifest.dataset_sha256, pairs=len(truths))
    return score_methods(facts, truths, methods, true_sequences(states), source)


def score_methods(
    facts: DatasetFacts,
    truths: Truths,
    methods: Mapping[str, Mapping[int, Estimate]],
    sequences: Sequence[TrueSequence] = (),
    source: str = "estimates",
) -> BenchmarkResult:
    """Score estimates that are sorted by method and frame against the truth of each frame.

    Args:
        facts: of the dataset.
        truths: by frame.
        methods: estimates by method and frame.
        sequences: the same frames as they follow each other, where they do.
        source: what to call the estimates in errors.

    Raises:
        ValueError: no pair shows a drogue, or a feature that the drogue does not have.
    """
    drogues = {index: truth for index, truth in sorted(truths.items()) if truth is not None}
    if not drogues:
        raise ValueError("dataset: no pair shows a drogue, so there is nothing to compare poses with")
    centroids = {name: _centroids(name, drogues, estimates, source) for name, estimates in methods.items()}
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


def score_sequences(
    sequences: Sequence[TrueSequence], drogues: Mapping[int, DrogueTruth], methods: Methods
) -> SequencesResult | None:
    """Score boxes, motion, docking quantities and times of estimates over sequences.

    Args:
        sequences: of the dataset.
        drogues: the truth of all pairs that show one, in ascending order of frames.
        methods: estimates by method and frame.

    Returns:
        None where there are no sequences, or no estimate of one has any of these.
    """
    if not sequences:
        return None
    data = sequence_data(sequences, drogues)
    dockings = true_dockings(sequences, data.motions)
    # Where some methods report boxes, the others count as having lost the drogue.
    has_regions = any(estimate.regions for estimates in methods.values() for estimate in estimates.values())
    scored: dict[str, MethodSequences] = {}
    for name, estimates in methods.items():
        parts = {
            "tracking": score_regions(sequences, estimates) if has_regions else None,
            "filtering": filter_errors(data, name, methods),
            "docking": docking_errors(data, dockings, estimates),
            "latency": latency(data, estimates),
        }
        if any(part is not None for part in parts.values()):
            scored[name] = MethodSequences(hiding=_hidden_pairs(sequences, estimates), **parts)
    if not scored:
        return None
    spans = [sequence.states[-1].time_s - sequence.states[0].time_s for sequence in sequences]
    return SequencesResult(
        count=len(sequences),
        pairs=sum(len(sequence.states) for sequence in sequences),
        minutes=float(np.sum(spans)) / 60,
        vibration_rms_m_s=rms_length(
            [motion.vibration_m_s for motion in data.motions.values() if motion.vibration_m_s is not None]
        ),
        methods=scored,
    )


def sequence_data(sequences: Sequence[TrueSequence], drogues: Mapping[int, DrogueTruth]) -> SequenceData:
    """The truth that sequences are scored with; arguments as those of `score_sequences`."""
    bins, labels = distance_bins([truth.distance_m for truth in drogues.values()])
    groups = PairGroups(
        bins,
        dict(zip(drogues, labels, strict=True)),
        {index: truth.sequence_id for index, truth in drogues.items()},
    )
    return SequenceData(sequences, drogues, true_motions(sequences), groups)


def _rows(scores: Mapping[int, FrameScore], reference: Reference) -> dict[str, object]:
    spread, bins = reference.truth_spread, []
    for k, place in enumerate(reference.bins):
        inside = [score for index, score in scores.items() if reference.bin_of_frame[index] == k]
        bins.append(PoseBin(**dict(summarize(inside, spread, f"bin {k}")), low_m=place.low_m, high_m=place.high_m))
    return {"overall": summarize(list(scores.values()), spread, "overall"), "bins": bins}


def _comparisons(
    drogues: Mapping[int, DrogueTruth],
    rows: Mapping[str, MethodResult],
    scores: Mapping[str, Mapping[int, FrameScore]],
    reference: Reference,
) -> list[MethodComparison]:
    """Every method compared with the best one and with the seed paper's."""
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
    return compare_methods(errors, [name for name in (best, PAPER_METHOD) if name in errors], groups)


def _centroids(
    method: str, drogues: Mapping[int, DrogueTruth], estimates: Mapping[int, Estimate], source: str
) -> dict[int, CentroidErrors]:
    found = {}
    for index, truth in drogues.items():
        estimate = estimates.get(index)
        try:
            found[index] = centroid_errors(truth, estimate.features if estimate is not None else ())
        except ValueError as error:
            raise ValueError(f"{source}: method {method!r}: frame {index}: {error}") from error
    return found


def _empty_frames(truths: Truths, estimates: Mapping[int, Estimate]) -> EmptyFrames:
    empty = [index for index, truth in truths.items() if truth is None]
    false = sum(isinstance(estimates.get(index), PoseEstimate) for index in empty)
    return EmptyFrames(
        n=len(empty),
        false_fixes=false,
        false_fix_fraction=false / len(empty) if empty else None,
        interval=fraction_interval(false, len(empty)) if empty else None,
    )


def _hidden_pairs(sequences: Sequence[TrueSequence], estimates: Mapping[int, Estimate]) -> HiddenPairs:
    states = [state for sequence in sequences for state in sequence.states if state.visibility == "hidden"]
    courses = [
        (
            [state.visibility for state in sequence.states],
            [_has_found(state, estimates.get(state.frame_index)) for state in sequence.states],
        )
        for sequence in sequences
    ]
    return HiddenPairs(
        hidden=len(states),
        poses_while_hidden=sum(isinstance(estimates.get(state.frame_index), PoseEstimate) for state in states),
        reacquisition=reacquisition(courses),
    )


def _has_found(state: TrueState, estimate: Estimate | None) -> bool:
    pose, drogue = state.left_from_drogue, state.drogue
    if pose is None or drogue is None or not isinstance(estimate, PoseEstimate):
        return False
    return has_found(estimate.left_from_drogue.translation_m - pose.translation_m, drogue.rim_radius_m)
