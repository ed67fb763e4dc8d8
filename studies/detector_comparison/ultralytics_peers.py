"""Networks of ultralytics as detectors, in the two forms of their output."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from studies.detector_comparison.peer_detector import PeerDetector, corners_to_boxes, non_maximum_suppression

# Default IoU of ultralytics' non-maximum suppression.
_MAX_IOU = 0.7
# Networks that suppress doubles themselves answer with corners, score and class, the best first.
_CORNER_COLUMNS = 6


class YoloDetector(PeerDetector):
    """A network of ultralytics."""

    def _decode(self, outputs: Sequence[NDArray[np.float32]], least_score: float) -> tuple[Array, Array]:
        (rows,) = outputs
        decode = decode_corners if rows.shape[1] == _CORNER_COLUMNS else decode_rows
        return decode(rows, least_score)


def decode_rows(rows: NDArray[np.float32], least_score: float) -> tuple[Array, Array]:
    """Decode the boxes and scores of one image.

    Args:
        rows: (4 + classes, n) centre x, y, width, height in corner coordinates of the input, and the scores of the
            classes, of which the first is the drogue.
        least_score: boxes with a lower score are left out.

    Returns:
        (m, 4) low corner, width, height, and (m,) scores, descending.
    """
    scores = rows[4].astype(np.float64)
    keep = np.flatnonzero(scores >= least_score)
    center, size = rows[:2, keep].T.astype(np.float64), rows[2:4, keep].T.astype(np.float64)
    return non_maximum_suppression(np.hstack((center - size / 2, size)), scores[keep], _MAX_IOU)


def decode_corners(rows: NDArray[np.float32], least_score: float) -> tuple[Array, Array]:
    """Decode the boxes and scores of one image of a network that needs no suppression, such as YOLO26.

    Args:
        rows: (n, 6) low and high corner in coordinates of the input, score, class.
        least_score: boxes with a lower score are left out.

    Returns:
        (m, 4) low corner, width, height, and (m,) scores, descending.
    """
    kept = rows[rows[:, 4] >= least_score].astype(np.float64)
    kept = kept[np.argsort(-kept[:, 4], kind="stable")]
    return corners_to_boxes(kept[:, :4]), kept[:, 4]
