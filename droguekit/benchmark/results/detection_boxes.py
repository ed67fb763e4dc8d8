"""Boxes that a detector found, as the file that `droguekit detect` writes: COCO results.

A JSON list of `{"image_id", "category_id", "bbox", "score"}`. `image_id` is that of `annotations/all.json`,
`category_id` is 1, the drogue, and `bbox` counts from the image's corner (docs/reference/conventions.md).
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from datasets_manifest.atomic import open_text_atomic
from datasets_manifest.types.records import PixelBox
from geometry.stereo import EYES, Eye

DROGUE_CATEGORY = 1
# COCO counts from the image's corner, records from the centre of the first pixel.
CORNER_FROM_CENTER_PX = 0.5
# Finer than any detector's box is meant, and files stay small.
_BOX_DECIMALS = 3
_SCORE_DECIMALS = 6


class FoundBox(NamedTuple):
    """One box.

    Attributes:
        image_id: of the image, as in the COCO files of the dataset.
        box_xywh: low corner and size, counted from the image's corner. [px]
        score: 0 to 1.
    """

    image_id: int
    box_xywh: PixelBox
    score: float


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
    """The part of a corner-counted box that lies on the image, or None where a file would hold nothing of it."""
    lows = [min(max(low, 0.0), float(size)) for low, size in zip(box_xywh[:2], size_px, strict=True)]
    highs = [
        min(max(low + extent, 0.0), float(size))
        for low, extent, size in zip(box_xywh[:2], box_xywh[2:], size_px, strict=True)
    ]
    width, height = highs[0] - lows[0], highs[1] - lows[1]
    # What is written must not be rounded to a box without an area.
    return (lows[0], lows[1], width, height) if min(width, height) >= 10**-_BOX_DECIMALS else None


def write_detections(path: Path, boxes: Iterable[FoundBox]) -> int:
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


def read_detections(path: Path, image_ids: Collection[int]) -> list[FoundBox]:
    """The boxes of a file of results, whoever wrote it, in its order.

    Args:
        path: the file.
        image_ids: of the dataset.

    Raises:
        ValueError: it cannot be read, is no list of results, or names other images or categories; names the file.
    """
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
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


def _found_box(entry: Any, known: frozenset[int]) -> FoundBox:
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
    return FoundBox(image_id, (x, y, width, height), score)
