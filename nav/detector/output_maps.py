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
"""Pixels of the input image between cells, by map. [px]"""

MAP_CHANNELS = 5
"""Logit of the score, then left, top, right, bottom."""

SIZE_STEP_PX = STRIDES[-1]
"""Width and height of an input image are multiples of it. [px]"""

MOST_SIDE_PX = 4096
"""Width and height of an input image are at most this: a wrong number is refused before it asks for memory. [px]"""

LOG_DISTANCE_RANGE = (-6.0, 6.0)
"""Beyond it a logarithm of a distance is cut: from a 400th of a stride to 400 strides."""


# Two drogues cannot overlap more than this; cells of one drogue answer boxes that nearly coincide.
_MOST_OVERLAP = 0.5
# Best cells that are looked at: a drogue over the whole image takes a few hundred.
_MOST_CELLS = 1000


def decode_maps(
    maps: Sequence[NDArray[np.floating[Any]]], least_score: float, most: int = 20
) -> list[tuple[Array, Array]]:
    """Boxes and scores of every image, the best first, without those that overlap a better one.

    Args:
        maps: three times (B, 5, H, W), see `nav.detector.output_maps`.
        least_score: what scores lower is left out.
        most: how many boxes an image has at most.

    Returns:
        Of each image (n, 4) boxes x, y, width, height in corner coordinates of the network's input, and (n,) scores.
        [px]
    """
    return [_decode_one([each[index] for each in maps], least_score, most) for index in range(maps[0].shape[0])]


def _decode_one(maps: Sequence[NDArray[np.floating[Any]]], least_score: float, most: int) -> tuple[Array, Array]:
    scores, boxes = [], []
    for stride, each in zip(STRIDES, maps, strict=True):
        score = _sigmoid(each[0].astype(np.float64))
        # Not a number compares as false, so it never becomes a box.
        rows, columns = np.nonzero(score >= least_score)
        centers = (np.stack((columns, rows), axis=1) + 0.5) * stride
        distances = np.exp(np.clip(each[1:, rows, columns].T.astype(np.float64), *LOG_DISTANCE_RANGE)) * stride
        scores.append(score[rows, columns])
        boxes.append(np.hstack((centers - distances[:, :2], distances[:, :2] + distances[:, 2:])))
    all_scores, all_boxes = np.concatenate(scores), np.concatenate(boxes)
    finite = np.isfinite(all_boxes).all(axis=1)
    all_scores, all_boxes = all_scores[finite], all_boxes[finite]
    order = np.argsort(-all_scores, kind="stable")[:_MOST_CELLS]
    kept = non_maximum_suppression(all_boxes[order], most)
    return all_boxes[order][kept], all_scores[order][kept]


def non_maximum_suppression(boxes: Array, most: int) -> list[int]:
    """Indices of the boxes, best first, that overlap no better one (non-maximum suppression)."""
    area = boxes[:, 2] * boxes[:, 3]
    open_ = np.ones(len(boxes), dtype=bool)
    kept: list[int] = []
    for index in range(len(boxes)):
        if not open_[index]:
            continue
        kept.append(index)
        if len(kept) == most:
            break
        shared = intersection_area(boxes[index], boxes)
        open_ &= shared <= _MOST_OVERLAP * (area[index] + area - shared)
    return kept


def _sigmoid(logits: Array) -> Array:
    """Without overflow for any number."""
    scores: Array = 0.5 * (1 + np.tanh(0.5 * logits))
    return scores
