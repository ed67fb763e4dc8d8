"""Which of the boxes found are drogues, and average precision: both by pycocotools.

pycocotools matches the boxes of every image once, by descending score, at ten overlaps from 0.5 to 0.95. What is
counted under a family, a distance or an eye accumulates the same matches over fewer images.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from droguekit.benchmark.detection.detection_truth import ImageTruth, scored_boxes
from droguekit.benchmark.results.detection_boxes import DROGUE_CATEGORY, FoundBox
from geometry.se3 import Array

IOU_THRESHOLDS: tuple[float, ...] = tuple(np.linspace(0.5, 0.95, 10).tolist())
"""Overlaps (intersection over union) from which a box counts as the drogue's."""
AT_50, AT_75 = 0, 5
"""Places of 0.5 and 0.75 among them."""
RECALLS: Array = np.linspace(0.0, 1.0, 101)
"""Recalls at which COCO samples precision."""
MOST_BOXES = 100
"""Of an image, the best ones: COCO's limit."""
_ALL_AREAS = (0.0, 1e10)


class AveragePrecision(NamedTuple):
    """COCO's average precision: the mean over overlaps 0.5 to 0.95, and at two of them; None without drogues."""

    ap: float | None
    ap50: float | None
    ap75: float | None


@dataclass(frozen=True, eq=False)
class Matches:
    """The boxes found on some images, best first, and which of them are drogues.

    Attributes:
        images: those that were looked at.
        image: (n,) place of each box's image among them.
        score: (n,) descending.
        is_true: (10, n) whether it is the first box on its drogue, at each of `IOU_THRESHOLDS`.
        box: (n,) the boxes themselves.
        has_drogue: (len(images),) whether there is one to be found.
    """

    images: tuple[ImageTruth, ...]
    image: NDArray[np.intp]
    score: Array
    is_true: NDArray[np.bool_]
    box: tuple[FoundBox, ...]
    has_drogue: NDArray[np.bool_]

    @property
    def drogues(self) -> int:
        """How many there are to be found."""
        return int(self.has_drogue.sum())

    def found_scores(self) -> Array:
        """(len(images),) score of the box on each image's drogue at overlap 0.5; -inf where it was not found."""
        scores = np.full(len(self.images), -np.inf)
        true = self.is_true[AT_50]
        scores[self.image[true]] = self.score[true]
        return scores


class Evaluation:
    """A detector's boxes on a dataset, matched."""

    def __init__(self, images: Sequence[ImageTruth], found: Sequence[FoundBox]) -> None:
        """Match boxes with truth; those on ignored drogues and on images that are not given do not count."""
        self._images = {image.image_id: image for image in images}
        counted = scored_boxes(images, found)
        # Ids from 1 on: pycocotools takes a match with annotation 0 for none.
        self._boxes = dict(enumerate(counted, start=1))
        self._evaluator = _evaluator(list(self._images.values()), self._boxes)
        self._entries: dict[int, dict[str, Any]] = {
            entry["image_id"]: entry for entry in self._evaluator.evalImgs if entry is not None
        }

    def average_precision(self, images: Sequence[ImageTruth]) -> AveragePrecision:
        """Over some of the images."""
        precision = self.precision(images)
        if precision is None:
            return AveragePrecision(None, None, None)
        by_overlap = precision.mean(axis=1)
        return AveragePrecision(float(by_overlap.mean()), float(by_overlap[AT_50]), float(by_overlap[AT_75]))

    def precision(self, images: Sequence[ImageTruth]) -> Array | None:
        """(10, 101) precision at each of `IOU_THRESHOLDS` and `RECALLS`; None without drogues."""
        evaluator = self._evaluator
        ids = [image.image_id for image in images]
        evaluator.params.imgIds = ids
        evaluator._paramsEval.imgIds = ids
        evaluator.evalImgs = [self._entries.get(image_id) for image_id in ids]
        with contextlib.redirect_stdout(io.StringIO()):
            evaluator.accumulate()
        precision = np.asarray(evaluator.eval["precision"], dtype=np.float64)[:, :, 0, 0, 0]
        return None if (precision < 0).all() else precision

    def matches(self, images: Sequence[ImageTruth]) -> Matches:
        """The matches on some of the images."""
        place, score, box = [], [], []
        true: list[NDArray[np.bool_]] = []
        for k, image in enumerate(images):
            entry = self._entries.get(image.image_id)
            if entry is None or not entry["dtIds"]:
                continue
            place += [k] * len(entry["dtIds"])
            score += entry["dtScores"]
            box += [self._boxes[number] for number in entry["dtIds"]]
            true.append(np.asarray(entry["dtMatches"]) > 0)
        scores = np.asarray(score, dtype=np.float64)
        # Stable, like pycocotools: equal scores stay in the order of the images.
        order = np.argsort(-scores, kind="stable")
        is_true = np.concatenate(true, axis=1) if true else np.zeros((len(IOU_THRESHOLDS), 0), dtype=np.bool_)
        return Matches(
            images=tuple(images),
            image=np.asarray(place, dtype=np.intp)[order],
            score=scores[order],
            is_true=is_true[:, order],
            box=tuple(box[k] for k in order),
            has_drogue=np.array([image.box_xywh is not None for image in images], dtype=np.bool_),
        )


def _evaluator(images: Sequence[ImageTruth], boxes: dict[int, FoundBox]) -> COCOeval:
    """The evaluator, with all images evaluated."""
    truth = [(image.image_id, image.image_id, image.box_xywh) for image in images if image.box_xywh is not None]
    found = [(number, box.image_id, box.box_xywh, box.score) for number, box in boxes.items()]
    with contextlib.redirect_stdout(io.StringIO()):
        evaluator = COCOeval(_coco(images, truth), _coco(images, found), iouType="bbox")
        evaluator.params.iouThrs = np.asarray(IOU_THRESHOLDS)
        evaluator.params.areaRng, evaluator.params.areaRngLbl = [list(_ALL_AREAS)], ["all"]
        evaluator.params.maxDets = [MOST_BOXES]
        evaluator.evaluate()
    return evaluator


def _coco(images: Sequence[ImageTruth], boxes: Sequence[tuple[Any, ...]]) -> COCO:
    """An index of boxes: id, image's id, box, and the score where there is one."""
    table = COCO()
    table.dataset = {
        "images": [{"id": image.image_id} for image in images],
        "categories": [{"id": DROGUE_CATEGORY}],
        "annotations": [
            {
                "id": number,
                "image_id": image_id,
                "category_id": DROGUE_CATEGORY,
                "bbox": list(box),
                "area": box[2] * box[3],
                "iscrowd": 0,
                **({"score": score[0]} if score else {}),
            }
            for number, image_id, box, *score in boxes
        ],
    }
    table.createIndex()
    return table
