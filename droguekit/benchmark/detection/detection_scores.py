"""The numbers of one detector on one dataset."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

from droguekit.benchmark.detection.detection_curve import best_f1, operating_point
from droguekit.benchmark.detection.detection_intervals import average_precision_interval, scene_count
from droguekit.benchmark.detection.detection_matching import AT_50, IOU_THRESHOLDS, Evaluation, Matches
from droguekit.benchmark.detection.detection_truth import ImageTruth
from droguekit.benchmark.results.detection_result import (
    BestF1,
    DetectionRow,
    DetectorResult,
    DistanceRow,
    FalseAlarms,
)
from droguekit.benchmark.statistics import fraction_interval
from geometry.stereo import EYES

DISTANCE_EDGES_M = (0.0, 3.0, 5.0, 10.0, 20.0, 30.0, 40.0, math.inf)
"""The same for every dataset, so that detectors can be compared across them. [m]"""
LEAST_BOXES, LEAST_SCENES = 300, 5
"""A row with fewer says little: at 300 boxes a recall of 99 % is known within 1 to 2 %."""
FALSE_ALARM_FRAMES = 600

SPLITS = ("train", "val", "test")

Images = Sequence[ImageTruth]


class Threshold(NamedTuple):
    """The score from which boxes count, and where it is from."""

    score: float
    source: Literal["given", "detector", "val", "scored images"]


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
    """The split that is meant: by None `test` where a dataset has one, else `all`.

    Raises:
        ValueError: no image of that split, or none that shows a drogue.
    """
    if split is None:
        split = "test" if any(image.split == "test" for image in images) else "all"
    if all(image.box_xywh is None for image in images_of_split(images, split)):
        raise ValueError(f"dataset: no image of the split {split!r} shows a drogue that must be found")
    return split


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
    # The images of a pair are not independent, nor are the boxes of an image: pairs with any are.
    low, high = fraction_interval(len(set(hit)), len(frames))
    return FalseAlarms(
        frames=len(frames),
        boxes=len(hit),
        frames_with_any=len(set(hit)),
        boxes_per_600_frames=FALSE_ALARM_FRAMES * len(hit) / len(frames),
        frames_with_any_per_600=FALSE_ALARM_FRAMES * len(set(hit)) / len(frames),
        interval_per_600_frames=(FALSE_ALARM_FRAMES * low, FALSE_ALARM_FRAMES * high),
    )


def _best_threshold(evaluation: Evaluation, images: Images, split: str) -> Threshold:
    held_out = [image for image in images if image.split == "val"] if split == "test" else []
    best = best_f1(evaluation.matches(held_out))
    if best is not None:
        return Threshold(best.threshold, "val")
    best = best_f1(evaluation.matches(images_of_split(images, split)))
    # Without a single right box any threshold is as good: all boxes count.
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
