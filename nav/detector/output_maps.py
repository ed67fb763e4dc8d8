"""The output of a detector network, and how boxes are decoded from it, in numpy.

A network has one output map for each stride. A cell (row i, column j) of stride s has its anchor point at
`((j + 0.5) s, (i + 0.5) s)` in the input image, counted from the image's corner. Its five channels are the logit of the
score and the logarithms of the distances, in strides, from the anchor point to the left, top, right and bottom side of
the box.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geometry.boxes import intersection_area
from geometry.se3 import Array

STRIDES = (8, 16, 32)
"""Distance between neighbouring cells in the input image, for each map. [px]"""

MAP_CHANNELS = 5
"""Logit of the score, then left, top, right, bottom."""

SIZE_STEP_PX = STRIDES[-1]
"""Width and height of an input image are multiples of this. [px]"""

MAX_SIDE_PX = 4096
"""Largest width and height of an input image: a wrong size is refused before memory is allocated for it. [px]"""

LOG_DISTANCE_RANGE = (-6.0, 6.0)
"""The logarithm of a distance is clipped to this range: from a 400th of a stride to 400 strides."""


# Boxes of two drogues do not overlap more than this; boxes that cells predict for one drogue nearly coincide.
_MAX_IOU = 0.5
# Number of best cells that are decoded: a drogue over the whole image takes a few hundred.
_MAX_CELLS = 1000


def decode_maps(
    maps: Sequence[NDArray[np.floating[Any]]], least_score: float, max_boxes: int = 20
) -> list[tuple[Array, Array]]:
    """Decode the boxes and scores of every image, the best first, with non-maximum suppression.

    Args:
        maps: three times (B, 5, H, W); see the docstring of this module.
        least_score: boxes with a lower score are left out.
        max_boxes: largest number of boxes of an image.

    Returns:
        For each image (n, 4) boxes x, y, width, height in corner coordinates of the network's input [px], and (n,)
        scores.
    """
    return [_decode_one([each[index] for each in maps], least_score, max_boxes) for index in range(maps[0].shape[0])]


def _decode_one(maps: Sequence[NDArray[np.floating[Any]]], least_score: float, max_boxes: int) -> tuple[Array, Array]:
    scores, boxes = [], []
    for stride, each in zip(STRIDES, maps, strict=True):
        score = _sigmoid(each[0].astype(np.float64))
        # NaN compares as false, so it never becomes a box.
        rows, columns = np.nonzero(score >= least_score)
        centers = (np.stack((columns, rows), axis=1) + 0.5) * stride
        distances = np.exp(np.clip(each[1:, rows, columns].T.astype(np.float64), *LOG_DISTANCE_RANGE)) * stride
        scores.append(score[rows, columns])
        boxes.append(np.hstack((centers - distances[:, :2], distances[:, :2] + distances[:, 2:])))
    all_scores, all_boxes = np.concatenate(scores), np.concatenate(boxes)
    finite = np.isfinite(all_boxes).all(axis=1)
    all_scores, all_boxes = all_scores[finite], all_boxes[finite]
    order = np.argsort(-all_scores, kind="stable")[:_MAX_CELLS]
    kept = non_maximum_suppression(all_boxes[order], max_boxes)
    return all_boxes[order][kept], all_scores[order][kept]


def non_maximum_suppression(boxes: Array, max_boxes: int) -> list[int]:
    """Indices of the boxes, sorted best first, whose IoU with every better box that is kept is small."""
    area = boxes[:, 2] * boxes[:, 3]
    is_open = np.ones(len(boxes), dtype=bool)
    kept: list[int] = []
    for index in range(len(boxes)):
        if not is_open[index]:
            continue
        kept.append(index)
        if len(kept) == max_boxes:
            break
        shared = intersection_area(boxes[index], boxes)
        is_open &= shared <= _MAX_IOU * (area[index] + area - shared)
    return kept


def _sigmoid(logits: Array) -> Array:
    """Logistic function without overflow for any number."""
    scores: Array = 0.5 * (1 + np.tanh(0.5 * logits))
    return scores
