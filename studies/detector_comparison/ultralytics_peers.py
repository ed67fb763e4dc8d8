"""Networks of ultralytics as detectors.

A network runs like ours: same input image, same runtime, both eyes in one batch.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from datasets_manifest.types.images import StereoImages
from geometry.se3 import Array
from geometry.stereo import EYES, Eye
from nav.detector.detector import Detection, StereoDetection
from nav.detector.input_image import input_image, network_input

PEERS = ("yolov8s", "yolov8n", "yolo11n", "yolo12n", "yolo26n")
"""Names of their configurations."""

# Defaults of ultralytics: IoU of its non-maximum suppression, largest number of boxes, and score threshold.
_MAX_IOU = 0.7
_MAX_BOXES = 300
_DEFAULT_THRESHOLD = 0.25
# Networks that suppress doubles themselves answer with corners, score and class, the best first.
_CORNER_COLUMNS = 6


def open_session(file: Path, threads: int) -> onnxruntime.InferenceSession:
    """Open a network whose idle threads do not spin, so that other detectors are not slowed while they are timed.

    Raises:
        ValueError: the file is missing or not an ONNX network; the message names it.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(file.read_bytes(), options, providers=["CPUExecutionProvider"])
    except OSError as error:
        raise ValueError(f"{file}: cannot be read: {error.strerror}") from error
    except Exception as error:  # onnxruntime's exceptions have no other common base
        raise ValueError(f"{file}: is not an ONNX network: {str(error).splitlines()[0]}") from error


class YoloDetector:
    """Runs a network on both images of a pair in one batch.

    Attributes:
        name: how it is called in results.
        input_size_px: width, height. [px]
    """

    def __init__(self, file: Path, threads: int) -> None:
        """Open a network of two images.

        Raises:
            ValueError: the file is missing, or not a network of two images with one class; the message names it.
        """
        self.name = file.stem
        self._session = open_session(file, threads)
        (entry,), (output,) = self._session.get_inputs(), self._session.get_outputs()
        shape, rows = entry.shape, output.shape
        if len(shape) != 4 or shape[:2] != [len(EYES), 3] or len(rows) != 3:
            raise ValueError(f"{file}: must take two images and give rows of boxes, got {shape} and {rows}")
        self._input_name = entry.name
        self.input_size_px = (int(shape[3]), int(shape[2]))

    def detect(self, images: StereoImages) -> StereoDetection:
        """The best box in each image, if it reaches the default threshold of ultralytics."""
        found = self.candidates(images, _DEFAULT_THRESHOLD)
        return StereoDetection(*(next(iter(found[eye]), None) for eye in EYES))

    def candidates(self, images: StereoImages, least_score: float) -> dict[Eye, tuple[Detection, ...]]:
        """The boxes of each image after non-maximum suppression, the best first."""
        inputs, placements = zip(*(input_image(images, eye, self.input_size_px) for eye in EYES), strict=True)
        (output,) = self._session.run(None, {self._input_name: network_input(inputs)})
        found: dict[Eye, tuple[Detection, ...]] = {}
        for eye, placement, rows in zip(EYES, placements, output, strict=True):
            decode = decode_corners if rows.shape[1] == _CORNER_COLUMNS else decode_rows
            boxes, scores = decode(rows, least_score)
            found[eye] = tuple(
                Detection((x, y, width, height), score)
                for (x, y, width, height), score in zip(
                    placement.to_image(boxes).tolist(), scores.tolist(), strict=True
                )
            )
        return found


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
    boxes, scores = np.hstack((center - size / 2, size)), scores[keep]
    if len(boxes):
        stay = np.asarray(cv2.dnn.NMSBoxes(boxes.tolist(), scores.tolist(), 0.0, _MAX_IOU), dtype=np.intp)
        stay = stay[np.argsort(-scores[stay], kind="stable")][:_MAX_BOXES]
        boxes, scores = boxes[stay], scores[stay]
    return boxes, scores


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
    return np.hstack((kept[:, :2], kept[:, 2:4] - kept[:, :2])), kept[:, 4]
