"""Scores of detectors on a dataset: overall, by distance, family, eye and split, with the operating threshold."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version
from itertools import pairwise
from typing import Literal, NamedTuple

from droguekit.scoring.confidence_intervals import CONFIDENCE, fraction_interval
from droguekit.scoring.detection.detection_metrics import (
    AT_50,
    IOU_THRESHOLDS,
    Evaluation,
    Matches,
    average_precision_interval,
    best_f1,
    operating_point,
    scene_count,
)
from droguekit.scoring.detection.detection_truth import DetectionTruth, ImageTruth
from droguekit.scoring.poses.drogue_truth import LEAST_SEEN_FRACTION
from droguekit.scoring.results.detection_result import (
    BestF1,
    DetectedBox,
    DetectionDataset,
    DetectionResult,
    DetectionRow,
    DetectorResult,
    DistanceRow,
    FalseAlarms,
    PairTimes,
)
from droguekit.scoring.sequences.tracking_scores import score_detected_boxes
from geometry.stereo import EYES

DISTANCE_EDGES_M = (0.0, 3.0, 5.0, 10.0, 20.0, 30.0, 40.0, math.inf)
"""The same for every dataset, so that detectors can be compared across them. [m]"""
LEAST_BOXES, LEAST_SCENES = 300, 5
"""A row with fewer gets a note: at 300 boxes a recall of 99 % is known within 1 to 2 %."""
FALSE_ALARM_FRAMES = 600
SPLITS = ("train", "val", "test")
Images = Sequence[ImageTruth]


class Threshold(NamedTuple):
    """The score from which boxes count, and its source."""

    score: float
    source: Literal["given", "detector", "val", "scored images"]


class DetectorOutput(NamedTuple):
    """Output of a detector on a dataset.

    Attributes:
        boxes: in all images.
        times: of a pair, where the detector was run for this result.
        score_threshold: the detector's own threshold, or None.
        parameters, gflops_per_image: of its network, where they could be counted.
    """

    boxes: Sequence[DetectedBox]
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
    runs: Mapping[str, DetectorOutput],
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
    sequences = [sequence for sequence in truth.sequences if sequence.states[0].frame_index in frames]

    def scored(name: str) -> DetectorResult:
        run = runs[name]
        row = score_detector(evaluations[name], truth.images, chosen_split, _requested_threshold(threshold, run))
        return row.model_copy(
            update={
                "times": run.times,
                "parameters": run.parameters,
                "gflops_per_image": run.gflops_per_image,
                "sequences": score_detected_boxes(sequences, run.boxes, row.operating_threshold),
            }
        )

    result = DetectionResult(
        dataset=DetectionDataset(
            name=truth.name,
            sha256=truth.sha256,
            split=chosen_split,
            images=len(chosen),
            boxes=sum((image.box_xywh is not None) + len(image.others_xywh) for image in chosen),
            ignored=sum((image.ignored_xywh is not None) + len(image.ignored_others_xywh) for image in chosen),
            empty_frames=len({image.frame_index for image in chosen if image.is_known_empty}),
        ),
        code_version=version("droguekit"),
        confidence=CONFIDENCE,
        least_seen_fraction=LEAST_SEEN_FRACTION,
        detectors={name: scored(name) for name in runs},
    )
    return ScoredDetections(result, evaluations, chosen)


def score_detector(
    evaluation: Evaluation, images: Images, split: str, threshold: Threshold | None = None
) -> DetectorResult:
    """Score what a detector found.

    Args:
        evaluation: of its boxes on all images.
        images: all of the dataset.
        split: to score on, see `split_to_score`.
        threshold: from which boxes count, or None to choose it on the val split, or on the scored images without one.

    """
    chosen = images_of_split(images, split)
    matches = evaluation.matches(chosen)
    operating = threshold or _best_threshold(evaluation, images, split)

    def row(some: Images, key: str) -> DetectionRow:
        return _row(evaluation, some, operating.score, key)

    overall = row(chosen, "overall").model_copy(
        update={"ap_interval": average_precision_interval(matches, tuple(range(len(IOU_THRESHOLDS))), "overall ap")}
    )
    best = best_f1(matches)
    return DetectorResult(
        operating_threshold=operating.score,
        threshold_from=operating.source,
        overall=overall,
        best_f1=BestF1(
            threshold=best.threshold, precision=best.precision or 0.0, recall=best.recall or 0.0, f1=best.f1 or 0.0
        )
        if best is not None
        else None,
        false_alarms=false_alarms(matches, operating.score),
        distances=tuple(_distance_rows(chosen, row)),
        families={
            family: row([image for image in chosen if image.family == family], f"family {family}")
            for family in sorted({image.family for image in chosen})
        },
        eyes={eye: row([image for image in chosen if image.eye == eye], f"eye {eye}") for eye in EYES},
        splits={
            name: row([image for image in images if image.split == name], f"split {name}")
            for name in SPLITS
            if any(image.split == name for image in images)
        },
    )


def false_alarms(matches: Matches, threshold: float) -> FalseAlarms | None:
    """Boxes in the pairs without a drogue; None without such pairs."""
    frames = {image.frame_index for image in matches.images if image.is_known_empty}
    if not frames:
        return None
    passing = matches.image[matches.score >= threshold]
    hit = [matches.images[k].frame_index for k in passing.tolist() if matches.images[k].is_known_empty]
    # Images of a pair and boxes of an image are not independent, so pairs with any box are counted.
    low, high = fraction_interval(len(set(hit)), len(frames))
    return FalseAlarms(
        frames=len(frames),
        boxes=len(hit),
        frames_with_any=len(set(hit)),
        boxes_per_600_frames=FALSE_ALARM_FRAMES * len(hit) / len(frames),
        frames_with_any_per_600=FALSE_ALARM_FRAMES * len(set(hit)) / len(frames),
        interval_per_600_frames=(FALSE_ALARM_FRAMES * low, FALSE_ALARM_FRAMES * high),
    )


def images_of_split(images: Images, split: str) -> list[ImageTruth]:
    """The images of a split, all of them for `all`.

    Raises:
        ValueError: there are none.
    """
    chosen = [image for image in images if split in ("all", image.split)]
    if not chosen:
        there = ", ".join(sorted({image.split for image in images}))
        raise ValueError(f"--split: the dataset has no pairs of {split!r}; it has {there}, or take all")
    return chosen


def split_to_score(images: Images, split: str | None) -> str:
    """The split to score on; None means `test` where a dataset has it, else `all`.

    Raises:
        ValueError: no image of that split, or none that shows a drogue.
    """
    if split is None:
        split = "test" if any(image.split == "test" for image in images) else "all"
    if all(image.box_xywh is None for image in images_of_split(images, split)):
        raise ValueError(f"dataset: no image of the split {split!r} shows a drogue that must be found")
    return split


def _best_threshold(evaluation: Evaluation, images: Images, split: str) -> Threshold:
    held_out = [image for image in images if image.split == "val"] if split == "test" else []
    best = best_f1(evaluation.matches(held_out))
    if best is not None:
        return Threshold(best.threshold, "val")
    best = best_f1(evaluation.matches(images_of_split(images, split)))
    # Without a single right box every threshold is equally good: all boxes count.
    return Threshold(best.threshold if best is not None else 0.0, "scored images")


def _row(evaluation: Evaluation, images: Images, threshold: float, key: str) -> DetectionRow:
    matches = evaluation.matches(images)
    precision = evaluation.average_precision(images)
    point = operating_point(matches, threshold)
    boxes, scenes = matches.drogues, scene_count(matches)
    found = round((point.recall or 0.0) * boxes)
    return DetectionRow(
        images=len(images),
        boxes=boxes,
        scenes=scenes,
        ap=precision.ap,
        ap50=precision.ap50,
        ap75=precision.ap75,
        ap50_interval=average_precision_interval(matches, (AT_50,), key) if boxes else None,
        precision=point.precision,
        recall=point.recall,
        recall_interval=fraction_interval(found, boxes) if boxes else None,
        note=_note(boxes, scenes),
    )


def _note(boxes: int, scenes: int) -> str | None:
    few = [f"fewer than {LEAST_BOXES} boxes"] if boxes < LEAST_BOXES else []
    few += [f"fewer than {LEAST_SCENES} scenes"] if scenes < LEAST_SCENES else []
    return ", ".join(few) or None


def _distance_rows(images: Images, row: Callable[[Images, str], DetectionRow]) -> Iterable[DistanceRow]:
    """Bins that hold an image."""
    for low_m, high_m in pairwise(DISTANCE_EDGES_M):
        inside = [image for image in images if image.distance_m is not None and low_m <= image.distance_m < high_m]
        if inside:
            yield DistanceRow(
                **dict(row(inside, f"distance {low_m:g}")), low_m=low_m, high_m=high_m if high_m < math.inf else None
            )


def _requested_threshold(threshold: float | None, run: DetectorOutput) -> Threshold | None:
    if threshold is not None:
        return Threshold(threshold, "given")
    return None if run.score_threshold is None else Threshold(run.score_threshold, "detector")
