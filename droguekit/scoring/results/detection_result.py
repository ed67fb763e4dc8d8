"""The files of detectors: the boxes that they found, and their scores."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import Field

from datasets_manifest.atomic import open_text_atomic
from datasets_manifest.types.records import PixelBox
from drogue_models.untrusted_files import MOST_BYTES, parse_json, read_text
from droguekit.scoring.confidence_intervals import Interval
from droguekit.scoring.results.pose_result import ResultModel
from droguekit.scoring.results.sequence_result import Tracking
from geometry.stereo import EYES, Eye

DROGUE_CATEGORY = 1
# COCO counts from the image's corner, records from the centre of the first pixel.
CORNER_FROM_CENTER_PX = 0.5
# Finer than any detector's box is meant, and files stay small.
_BOX_DECIMALS = 3
_SCORE_DECIMALS = 6


class DetectedBox(NamedTuple):
    """One box.

    Attributes:
        image_id: of the image, as in the COCO files of the dataset.
        box_xywh: low corner and size, counted from the image's corner. [px]
        score: 0 to 1.
    """

    image_id: int
    box_xywh: PixelBox
    score: float


class DetectionDataset(ResultModel):
    """The dataset that was scored on.

    Attributes:
        sha256: null for an imported dataset.
        split: whose images the rows are of, `all` for every one.
        images, boxes: number of images in that split, and of drogues to be found in them.
        ignored: drogues of which too little is seen, see `least_seen_fraction`.
        empty_frames: pairs without a drogue in that split.
    """

    name: str
    sha256: str | None
    split: str
    images: int
    boxes: int
    ignored: int
    empty_frames: int


class DetectionRow(ResultModel):
    """A detector on some images.

    Attributes:
        images, boxes, scenes: images, drogues to be found, and scenes that show one.
        ap, ap50, ap75: average precision over overlaps 0.5 to 0.95, and at two of them; null without drogues.
        ap_interval: of `ap`; the overall row alone has one.
        ap50_interval: null with fewer than two scenes, or where all resamples of scenes are alike.
        precision, recall: at overlap 0.5, of boxes with at least the operating threshold; null without any.
        recall_interval: Wilson's, which takes images as independent.
        note: why the row is uncertain, or null.
    """

    images: int
    boxes: int
    scenes: int
    ap: float | None
    ap50: float | None
    ap75: float | None
    ap_interval: Interval | None = None
    ap50_interval: Interval | None
    precision: float | None
    recall: float | None
    recall_interval: Interval | None
    note: str | None


class DistanceRow(DetectionRow):
    """The images of pairs whose drogue is from `low_m` to below `high_m`; null has no limit. [m]"""

    low_m: float
    high_m: float | None


class BestF1(ResultModel):
    """Where the harmonic mean of precision and recall is highest on the scored images."""

    threshold: float
    precision: float
    recall: float
    f1: float


class FalseAlarms(ResultModel):
    """Boxes in pairs without a drogue, at the operating threshold.

    Attributes:
        frames: such pairs.
        boxes: found in them, both images together.
        frames_with_any: pairs with at least one.
        boxes_per_600_frames: the rate of boxes, scaled.
        frames_with_any_per_600, interval_per_600_frames: the share of pairs with at least one, scaled, and Wilson's
            interval of it: boxes of one pair are not independent.
    """

    frames: int
    boxes: int
    frames_with_any: int
    boxes_per_600_frames: float
    frames_with_any_per_600: float
    interval_per_600_frames: Interval


class PairTimes(ResultModel):
    """Median times of finding the drogue in a pair, images already read. [ms]"""

    wall_ms: float
    cpu_ms: float
    pairs: int


class DetectorResult(ResultModel):
    """One detector.

    Attributes:
        operating_threshold: score from which boxes count in precision, recall and false alarms.
        threshold_from: `given`; `detector`, its own; `val`, the best F1 on the dataset's val split; `scored images`, on
            these themselves.
        best_f1: null where no box is right.
        false_alarms: null without empty pairs.
        distances, families, eyes: of the same images as `overall`.
        splits: each over its own images, whatever `dataset.split` says.
        times: where the detector was run for this result.
        parameters: weights and biases of the network's layers, counted where `gflops_per_image` is.
        gflops_per_image: multiplications and additions of the network for one image, in 10^9; null where there is none,
            or where only its boxes are known, or where an operation cannot be counted.
        sequences: its best box of each image of the scored split that passes the threshold, as a tracker's; left out
            without sequences.
    """

    operating_threshold: float
    threshold_from: Literal["given", "detector", "val", "scored images"]
    overall: DetectionRow
    best_f1: BestF1 | None
    false_alarms: FalseAlarms | None
    distances: tuple[DistanceRow, ...]
    families: dict[str, DetectionRow]
    eyes: dict[str, DetectionRow]
    splits: dict[str, DetectionRow]
    times: PairTimes | None = None
    parameters: int | None = None
    gflops_per_image: float | None = None
    sequences: Tracking | None = Field(default=None, exclude_if=lambda tracking: tracking is None)


class DetectionResult(ResultModel):
    """The whole file.

    Attributes:
        least_seen_fraction: drogues seen less than that are ignored.
    """

    schema_version: Literal[1] = Field(default=1, alias="schema")
    kind: Literal["detections"] = "detections"
    dataset: DetectionDataset
    code_version: str
    confidence: float
    least_seen_fraction: float
    detectors: dict[str, DetectorResult]

    def to_json(self) -> str:
        """The text of the file."""
        return json.dumps(self.model_dump(mode="json", by_alias=True), indent=1, allow_nan=False) + "\n"


def image_id_of(frame_index: int, eye: Eye) -> int:
    """Id of an image in the COCO files of a dataset."""
    return 2 * frame_index + EYES.index(eye) + 1


def corner_box(box_px: PixelBox) -> PixelBox:
    """A box in pixel-centre coordinates, counted from the image's corner instead."""
    x, y, width, height = box_px
    return (x + CORNER_FROM_CENTER_PX, y + CORNER_FROM_CENTER_PX, width, height)


def center_box(box_xywh: PixelBox) -> PixelBox:
    """The inverse of `corner_box`."""
    x, y, width, height = box_xywh
    return (x - CORNER_FROM_CENTER_PX, y - CORNER_FROM_CENTER_PX, width, height)


def clipped_box(box_xywh: PixelBox, size_px: tuple[int, int]) -> PixelBox | None:
    """The part of a box that lies on the image, counted from its corner; None where a file would hold nothing of it."""
    lows = [min(max(low, 0.0), float(size)) for low, size in zip(box_xywh[:2], size_px, strict=True)]
    highs = [
        min(max(low + extent, 0.0), float(size))
        for low, extent, size in zip(box_xywh[:2], box_xywh[2:], size_px, strict=True)
    ]
    width, height = highs[0] - lows[0], highs[1] - lows[1]
    # What is written must not be rounded to a box without an area.
    return (lows[0], lows[1], width, height) if min(width, height) >= 10**-_BOX_DECIMALS else None


def write_detections(path: Path, boxes: Iterable[DetectedBox]) -> int:
    """Write or replace a file of results by one rename.

    Returns:
        The number of boxes.

    Raises:
        OSError: it cannot be written; it is then left as it was.
    """
    count = 0
    with open_text_atomic(path) as stream:
        stream.write("[")
        for box in boxes:
            entry = {
                "image_id": box.image_id,
                "category_id": DROGUE_CATEGORY,
                "bbox": [round(number, _BOX_DECIMALS) for number in box.box_xywh],
                "score": round(box.score, _SCORE_DECIMALS),
            }
            stream.write((",\n" if count else "\n") + json.dumps(entry, allow_nan=False))
            count += 1
        stream.write("\n]\n")
    return count


def read_detections(path: Path, image_ids: Collection[int]) -> list[DetectedBox]:
    """The boxes of a file of results, whoever wrote it, in its order.

    Args:
        path: the file.
        image_ids: of the dataset.

    Raises:
        ValueError: it cannot be read, is no list of results, or names other images or categories; names the file.
    """
    try:
        table = parse_json(read_text(path, MOST_BYTES), with_nan=True)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ValueError(f"{path}: is truncated or not JSON: {error}") from error
    if not isinstance(table, list):
        raise ValueError(f"{path}: must hold a list of COCO results, got {type(table).__name__}")
    known = frozenset(image_ids)
    boxes = []
    for place, entry in enumerate(table):
        try:
            boxes.append(_found_box(entry, known))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            reason = f"has no {error}" if isinstance(error, KeyError) else str(error)
            raise ValueError(f"{path}: result {place}: {reason}") from error
    return boxes


def _found_box(entry: Any, known: frozenset[int]) -> DetectedBox:
    if not isinstance(entry, dict):
        raise ValueError(f"must be an object, got {type(entry).__name__}")
    image_id, category = entry["image_id"], entry["category_id"]
    if type(image_id) is not int or image_id not in known:
        raise ValueError(f"image_id: must be an image of the dataset's annotations/all.json, got {image_id!r}")
    if category != DROGUE_CATEGORY:
        raise ValueError(f"category_id: must be {DROGUE_CATEGORY}, the drogue, got {category!r}")
    numbers = [*entry["bbox"], entry["score"]]
    if any(type(number) not in (int, float) or not math.isfinite(number) for number in numbers) or len(numbers) != 5:
        raise ValueError(f"bbox, score: must be four finite numbers and one, got {entry['bbox']!r}, {entry['score']!r}")
    x, y, width, height, score = (float(number) for number in numbers)
    if not (width > 0 and height > 0 and max(abs(x), abs(y), width, height) < 1e6):
        raise ValueError(f"bbox: must be x, y, width, height in pixels, got {entry['bbox']!r}")
    return DetectedBox(image_id, (x, y, width, height), score)
