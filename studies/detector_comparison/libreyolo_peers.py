"""Networks of libreyolo as detectors: D-FINE [1] and RTMDet [2].

[1] Y. Peng et al., D-FINE: Redefine Regression Task in DETRs as Fine-grained Distribution Refinement,
    https://doi.org/10.48550/arXiv.2410.13842
[2] C. Lyu et al., RTMDet: An Empirical Study of Designing Real-Time Object Detectors,
    https://doi.org/10.48550/arXiv.2212.07784
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.detector.input_image import network_input
from studies.detector_comparison.peer_detector import PeerDetector, corners_to_boxes, non_maximum_suppression

# IoU of RTMDet's non-maximum suppression, and mean and spread of its input's blue, green and red: mmdetection's
# configs/rtmdet/rtmdet_l_8xb32-300e_coco.py.
_MAX_IOU = 0.65
_BGR_MEAN_DN = np.array([103.53, 116.28, 123.675]).reshape(3, 1, 1)
_BGR_SPREAD_DN = np.array([57.375, 57.12, 58.395]).reshape(3, 1, 1)
_BGR_SCALE = (255 / _BGR_SPREAD_DN).astype(np.float32)
_BGR_SHIFT = (_BGR_MEAN_DN / _BGR_SPREAD_DN).astype(np.float32)


class DfineDetector(PeerDetector):
    """D-FINE: a set of queries, each with a box of its own, so that nothing is suppressed."""

    _output_count = 2

    def _decode(self, outputs: Sequence[NDArray[np.float32]], least_score: float) -> tuple[Array, Array]:
        logits, boxes = outputs
        return decode_queries(logits, boxes, self.input_size_px, least_score)


class RtmdetDetector(PeerDetector):
    """RTMDet: a box at every cell of three scales."""

    def _batch(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        batch = network_input(images)
        normalised = np.empty_like(batch)
        np.multiply(batch[:, ::-1], _BGR_SCALE, out=normalised)
        normalised -= _BGR_SHIFT
        return normalised

    def _decode(self, outputs: Sequence[NDArray[np.float32]], least_score: float) -> tuple[Array, Array]:
        (rows,) = outputs
        return decode_cells(rows, self.input_size_px, least_score)


def decode_queries(
    logits: NDArray[np.float32], boxes: NDArray[np.float32], size_px: tuple[int, int], least_score: float
) -> tuple[Array, Array]:
    """Decode the boxes and scores of one image of D-FINE.

    Args:
        logits: (n, classes) of which the first class is the drogue.
        boxes: (n, 4) centre x, y, width, height as fractions of the input.
        size_px: width and height of the input.
        least_score: boxes with a lower score are left out.

    Returns:
        (m, 4) low corner, width, height in corner coordinates of the input, and (m,) scores, descending.
    """
    scores = 1 / (1 + np.exp(-logits[:, 0].astype(np.float64)))
    order = np.argsort(-scores, kind="stable")
    order = order[scores[order] >= least_score]
    kept = boxes[order].astype(np.float64) * np.tile(size_px, 2)
    return np.hstack((kept[:, :2] - kept[:, 2:] / 2, kept[:, 2:])), scores[order]


def decode_cells(rows: NDArray[np.float32], size_px: tuple[int, int], least_score: float) -> tuple[Array, Array]:
    """Decode the boxes and scores of one image of RTMDet.

    Args:
        rows: (n, 4 + classes) low and high corner in corner coordinates of the input, and the scores of the classes, of
            which the first is the drogue.
        size_px: width and height of the input, to which boxes are cut.
        least_score: boxes with a lower score are left out.

    Returns:
        (m, 4) low corner, width, height, and (m,) scores, descending.
    """
    kept = rows[rows[:, 4] >= least_score].astype(np.float64)
    boxes = corners_to_boxes(np.clip(kept[:, :4], 0, np.tile(size_px, 2)))
    is_inside = (boxes[:, 2:] > 0).all(axis=1)
    return non_maximum_suppression(boxes[is_inside], kept[is_inside, 4], _MAX_IOU)
