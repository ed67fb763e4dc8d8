"""Average precision of boxes by pycocotools, one class."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from nav.training.image_views import Boxes

MOST_BOXES = 10
"""Answers of an image that count, the best first."""


@dataclass(frozen=True)
class AveragePrecision:
    """Fractions, 0 to 1.

    Attributes:
        ap: mean over overlaps from 0.5 to 0.95.
        ap50, ap75: at one overlap.
        recall50: of the drogues, with the lowest scores counted too.
    """

    ap: float
    ap50: float
    ap75: float
    recall50: float


def average_precision(truth: Sequence[Boxes], found: Sequence[tuple[Boxes, Boxes]]) -> AveragePrecision | None:
    """Compare answers with the truth.

    Args:
        truth: of each image (n, 4) boxes x, y, width, height.
        found: of each image (m, 4) boxes and (m,) scores.

    Returns:
        None where there is no true box in any image.
    """
    boxes = [(image, box) for image, own in enumerate(truth, start=1) for box in own.tolist()]
    if not boxes:
        return None
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO()
        coco.dataset = {
            "images": [{"id": image + 1} for image in range(len(truth))],
            "categories": [{"id": 1, "name": "drogue"}],
            "annotations": [
                {"id": number, "image_id": image, "category_id": 1, "bbox": box, "area": box[2] * box[3], "iscrowd": 0}
                for number, (image, box) in enumerate(boxes, start=1)
            ],
        }
        coco.createIndex()
        answers = [
            (image, *box, score, 1)
            for image, (own, scores) in enumerate(found, start=1)
            for box, score in zip(own.tolist(), scores.tolist(), strict=True)
        ]
        if not answers:
            return AveragePrecision(0.0, 0.0, 0.0, 0.0)
        evaluation = COCOeval(coco, coco.loadRes(np.array(answers, dtype=np.float64)), "bbox")
        evaluation.params.maxDets = [1, MOST_BOXES, MOST_BOXES]
        evaluation.params.areaRng = [[0, 1e10]]
        evaluation.params.areaRngLbl = ["all"]
        evaluation.evaluate()
        evaluation.accumulate()
    # (overlap, recall, class, area, most): overlaps are 0.5, 0.55 to 0.95.
    precision = evaluation.eval["precision"][:, :, 0, 0, -1]
    ap50, ap75 = (float(precision[index].mean()) for index in (0, 5))
    return AveragePrecision(float(precision.mean()), ap50, ap75, float(evaluation.eval["recall"][0, 0, 0, -1]))
