"""A dataset and the boxes that detectors found in it, compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import NamedTuple

from droguekit.benchmark.detection.detection_matching import Evaluation
from droguekit.benchmark.detection.detection_scores import Threshold, images_of_split, score_detector, split_to_score
from droguekit.benchmark.detection.detection_truth import DetectionTruth, ImageTruth
from droguekit.benchmark.poses.visibility import LEAST_SEEN_FRACTION
from droguekit.benchmark.results.detection_boxes import FoundBox
from droguekit.benchmark.results.detection_result import DetectionDataset, DetectionResult, DetectorResult, PairTimes
from droguekit.benchmark.sequences.tracking import track_found_boxes
from droguekit.benchmark.statistics import CONFIDENCE


class DetectorRun(NamedTuple):
    """What a detector found.

    Attributes:
        boxes: in all images.
        times: that it took, where it was run just now.
        score_threshold: that the detector asks for itself, or None.
        parameters, gflops_per_image: of its network, where they could be counted.
    """

    boxes: Sequence[FoundBox]
    times: PairTimes | None = None
    score_threshold: float | None = None
    parameters: int | None = None
    gflops_per_image: float | None = None


class ScoredDetections(NamedTuple):
    """The numbers, and the matches behind them by detector, for figures and pictures."""

    result: DetectionResult
    evaluations: Mapping[str, Evaluation]
    images: Sequence[ImageTruth]


def score_detections(
    truth: DetectionTruth,
    runs: Mapping[str, DetectorRun],
    split: str | None = None,
    threshold: float | None = None,
) -> ScoredDetections:
    """Score detectors on a dataset.

    Args:
        truth: of the dataset.
        runs: by the detector's name.
        split: to score on: `train`, `val`, `test` or `all`; `test` where there is one by default.
        threshold: score from which boxes count in precision, recall and false alarms; see `score_detector`.

    Raises:
        ValueError: no image of that split, or none that shows a drogue.
    """
    chosen_split = split_to_score(truth.images, split)
    chosen = images_of_split(truth.images, chosen_split)
    evaluations = {name: Evaluation(truth.images, run.boxes) for name, run in runs.items()}
    frames = {image.frame_index for image in chosen}
    sequences = [sequence for sequence in truth.sequences if sequence.moments[0].frame_index in frames]

    def scored(name: str) -> DetectorResult:
        run = runs[name]
        row = score_detector(evaluations[name], truth.images, chosen_split, _asked(threshold, run))
        return row.model_copy(
            update={
                "times": run.times,
                "parameters": run.parameters,
                "gflops_per_image": run.gflops_per_image,
                "sequences": track_found_boxes(sequences, run.boxes, row.operating_threshold),
            }
        )

    result = DetectionResult(
        dataset=DetectionDataset(
            name=truth.name,
            sha256=truth.sha256,
            split=chosen_split,
            images=len(chosen),
            boxes=sum(image.box_xywh is not None for image in chosen),
            ignored=sum(image.ignored_xywh is not None for image in chosen),
            empty_frames=len({image.frame_index for image in chosen if image.is_known_empty}),
        ),
        code_version=version("droguekit"),
        confidence=CONFIDENCE,
        least_seen_fraction=LEAST_SEEN_FRACTION,
        detectors={name: scored(name) for name in runs},
    )
    return ScoredDetections(result, evaluations, chosen)


def _asked(threshold: float | None, run: DetectorRun) -> Threshold | None:
    if threshold is not None:
        return Threshold(threshold, "given")
    return None if run.score_threshold is None else Threshold(run.score_threshold, "detector")
