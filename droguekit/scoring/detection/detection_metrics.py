"""Matching of boxes with drogues, precision and recall, average precision and its intervals.

pycocotools matches the boxes of every image once, by descending score, at ten overlaps from 0.5 to 0.95. Scores of a
family, a distance or an eye accumulate the same matches over fewer images. Intervals come from resampled scenes, as
images of one scene are not independent.
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
from scipy.sparse import csr_matrix

from datasets_manifest.random_streams import named_generator
from droguekit.scoring.confidence_intervals import CONFIDENCE, RESAMPLES, Interval
from droguekit.scoring.detection.detection_truth import ImageTruth, scored_boxes
from droguekit.scoring.results.detection_result import DROGUE_CATEGORY, DetectedBox
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
# Above all ids of images; pycocotools keeps ids in float64.
_OTHER_ID_STEP = 2**40
Counts = NDArray[np.signedinteger[Any]]
# Numbers held at once: some tens of megabytes.
_NUMBERS_AT_ONCE = 4_000_000


class AveragePrecision(NamedTuple):
    """COCO's average precision: the mean over overlaps 0.5 to 0.95, and at two of them; None without drogues."""

    ap: float | None
    ap50: float | None
    ap75: float | None


@dataclass(frozen=True, eq=False)
class Matches:
    """The boxes found on some images, best first, and which of them are drogues.

    Attributes:
        images: the images.
        image: (n,) place of each box's image among them.
        score: (n,) descending.
        is_true: (10, n) whether it is the first box on its drogue, at each of `IOU_THRESHOLDS`.
        box: (n,) the boxes themselves.
        has_drogue: (len(images),) whether the one that is sought is to be found.
        is_sought: (n,) whether it is the first box on the sought drogue at overlap 0.5, not on one beside it.
    """

    images: tuple[ImageTruth, ...]
    image: NDArray[np.intp]
    score: Array
    is_true: NDArray[np.bool_]
    box: tuple[DetectedBox, ...]
    has_drogue: NDArray[np.bool_]
    is_sought: NDArray[np.bool_]

    @property
    def drogues(self) -> int:
        """How many there are to be found."""
        return int(self.counts().sum())

    def counts(self) -> NDArray[np.int64]:
        """(len(images),) drogues to be found in each image, sought or not."""
        others = np.array([len(image.others_xywh) for image in self.images], dtype=np.int64)
        return self.has_drogue.astype(np.int64) + others

    def found_scores(self) -> Array:
        """(len(images),) score of the box on each image's sought drogue at overlap 0.5; -inf where it is not found."""
        scores = np.full(len(self.images), -np.inf)
        true = self.is_sought
        scores[self.image[true]] = self.score[true]
        return scores


class Evaluation:
    """A detector's boxes on a dataset, matched with the true ones."""

    def __init__(self, images: Sequence[ImageTruth], found: Sequence[DetectedBox]) -> None:
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
        sought: list[NDArray[np.bool_]] = []
        for k, image in enumerate(images):
            entry = self._entries.get(image.image_id)
            if entry is None or not entry["dtIds"]:
                continue
            place += [k] * len(entry["dtIds"])
            score += entry["dtScores"]
            box += [self._boxes[number] for number in entry["dtIds"]]
            matched = np.asarray(entry["dtMatches"])
            true.append(matched > 0)
            # The sought drogue's id is its image's.
            sought.append(matched[AT_50] == image.image_id)
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
            is_sought=(np.concatenate(sought) if sought else np.zeros(0, dtype=np.bool_))[order],
            has_drogue=np.array([image.box_xywh is not None for image in images], dtype=np.bool_),
        )


class OperatingPoint(NamedTuple):
    """Precision and recall of the boxes with at least a score.

    Attributes:
        threshold: the score.
        precision: share of the boxes that are drogues; None without boxes.
        recall: share of the drogues that were found; None without drogues.
        f1: harmonic mean of the two, 0 where nothing is right; None where recall is.
    """

    threshold: float
    precision: float | None
    recall: float | None
    f1: float | None


class PrecisionRecallCurve(NamedTuple):
    """A point for every score that was given, highest first.

    Attributes:
        threshold, precision, recall: (m,) of boxes with at least that score.
    """

    threshold: Array
    precision: Array
    recall: Array


def precision_recall(matches: Matches) -> PrecisionRecallCurve:
    """The curve of all boxes; empty without boxes or without drogues."""
    if not matches.drogues:
        return PrecisionRecallCurve(np.zeros(0), np.zeros(0), np.zeros(0))
    threshold, boxes, true = _passing(matches)
    return PrecisionRecallCurve(threshold, true / boxes, true / matches.drogues)


def best_f1(matches: Matches) -> OperatingPoint | None:
    """The threshold with the highest F1, midway to the next lower score or to 0; None where no box is right.

    Of equally good thresholds it is the lowest: half of the boxes that it adds are right.
    """
    threshold, boxes, true = _passing(matches)
    if not true.any():
        return None
    f1 = 2 * true / (boxes + matches.drogues)
    best = int(len(f1) - 1 - np.argmax(f1[::-1]))
    # Files of others may have scores below 0.
    below = float(threshold[best + 1]) if best + 1 < len(f1) else min(0.0, float(threshold[best]))
    return operating_point(matches, (float(threshold[best]) + below) / 2)


def operating_point(matches: Matches, threshold: float) -> OperatingPoint:
    """Precision and recall where boxes of at least `threshold` count."""
    passes = matches.score >= threshold
    true = int(matches.is_true[AT_50][passes].sum())
    boxes = int(passes.sum())
    precision = true / boxes if boxes else None
    if not matches.drogues:
        return OperatingPoint(threshold, precision, None, None)
    recall = true / matches.drogues
    f1 = 2 * true / (boxes + matches.drogues)
    return OperatingPoint(threshold, precision, recall, f1)


def average_precision_interval(matches: Matches, overlaps: tuple[int, ...], key: str) -> Interval | None:
    """Percentile-bootstrap interval of average precision.

    Args:
        matches: on the images of a cell.
        overlaps: places among `IOU_THRESHOLDS` to take the mean over.
        key: of the random stream.

    Returns:
        None with fewer than two scenes that show a drogue, or where all resamples are equal, as without a single
        error: resampled scenes cannot tell how rare an error is that none of them shows.

    Source: B. Efron, Ann. Statist. 7 (1979) 1, doi:10.1214/aos/1176344552; 1000 resamples of scenes.
    """
    scene_ids, _, drogues = _scenes(matches)
    if np.count_nonzero(drogues) < 2:
        return None
    rng = named_generator(key)
    times = rng.multinomial(len(scene_ids), np.full(len(scene_ids), 1 / len(scene_ids)), RESAMPLES)
    # A resample without any drogue has no precision.
    drawn = times[times @ drogues > 0]
    values = np.mean([resampled_precision(matches, overlap, drawn) for overlap in overlaps], axis=0)
    low, high = np.percentile(values, (50 * (1 - CONFIDENCE), 50 * (1 + CONFIDENCE)))
    return (float(low), float(high)) if low < high else None


def resampled_precision(matches: Matches, overlap: int, times: Counts) -> Array:
    """Average precision of resamples, in which a scene occurs several times or not at all.

    Args:
        matches: on the images of a cell.
        overlap: place among `IOU_THRESHOLDS`.
        times: (R, S) how often each scene occurs, in ascending order of their ids; at least one drogue must occur.

    Returns:
        (R,) average precision at that overlap.
    """
    _, scene, drogues = _scenes(matches)
    true = matches.is_true[overlap]
    places = np.flatnonzero(true)
    if not len(places):
        return np.zeros(len(times))
    scene_of_box = scene[matches.image[: places[-1] + 1]]
    # Precision falls between true boxes: only what it is at each of them counts. (S, T) boxes of each scene since the
    # true box before, which is nearly nothing everywhere.
    segment = np.searchsorted(places, np.arange(places[-1] + 1))
    shape = (times.shape[1], len(places))
    all_boxes = csr_matrix((np.ones(len(segment)), (scene_of_box, segment)), shape=shape)
    true_boxes = csr_matrix((np.ones(len(places)), (scene_of_box[places], np.arange(len(places)))), shape=shape)
    step = max(1, _NUMBERS_AT_ONCE // len(places))
    parts = []
    for start in range(0, len(times), step):
        drawn = times[start : start + step].astype(np.float64)
        hits, boxes = (np.cumsum(drawn @ counts, axis=1) for counts in (true_boxes, all_boxes))
        precision = np.divide(hits, boxes, out=np.zeros_like(hits), where=boxes > 0)
        envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
        recall = hits / (drawn @ drogues)[:, None]
        parts.append([_sampled_mean(r, p) for r, p in zip(recall, envelope, strict=True)])
    return np.concatenate(parts)


def scene_count(matches: Matches) -> int:
    """Scenes that show a drogue to be found."""
    return len({matches.images[k].scene_id for k in np.flatnonzero(matches.counts())})


def _evaluator(images: Sequence[ImageTruth], boxes: dict[int, DetectedBox]) -> COCOeval:
    """The evaluator, with all images evaluated."""
    truth = [(image.image_id, image.image_id, image.box_xywh) for image in images if image.box_xywh is not None]
    truth += [
        (_OTHER_ID_STEP * (place + 1) + image.image_id, image.image_id, box)
        for image in images
        for place, box in enumerate(image.others_xywh)
    ]
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


def _passing(matches: Matches) -> tuple[Array, Array, Array]:
    """(m,) scores, highest first, and how many boxes have at least each of them, all and right ones."""
    # Boxes of equal score pass a threshold together.
    last = np.flatnonzero(np.append(np.diff(matches.score) != 0, True)[: len(matches.score)])
    return matches.score[last], last + 1.0, np.cumsum(matches.is_true[AT_50])[last].astype(np.float64)


def _scenes(matches: Matches) -> tuple[Counts, Counts, Counts]:
    """Ids of the scenes, the place of each image's among them, and how many drogues each shows."""
    ids, scene = np.unique([image.scene_id for image in matches.images], return_inverse=True)
    return ids, scene, np.bincount(scene, weights=matches.counts(), minlength=len(ids)).astype(np.int64)


def _sampled_mean(recall: Array, envelope: Array) -> float:
    place = np.searchsorted(recall, RECALLS, side="left")
    return float(envelope[place[place < len(envelope)]].sum() / len(RECALLS))
