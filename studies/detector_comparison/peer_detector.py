"""Networks of other projects as detectors.

A network runs like ours: same resized picture, same runtime, both eyes in one batch.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
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

# Default score threshold of ultralytics and of libreyolo, and their largest number of boxes.
_DEFAULT_THRESHOLD = 0.25
_MAX_BOXES = 300


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


class PeerDetector(ABC):
    """Runs a network on both images of a pair in one batch.

    Attributes:
        name: how it is called in results.
        input_size_px: width, height. [px]
    """

    _output_count = 1

    def __init__(self, file: Path, threads: int) -> None:
        """Open a network of two images.

        Raises:
            ValueError: the file is missing, or not a network of two images with one class; the message names it.
        """
        self.name = file.stem
        self._session = open_session(file, threads)
        entries, outputs = self._session.get_inputs(), self._session.get_outputs()
        shape, rows = entries[0].shape, [output.shape for output in outputs]
        is_batch = len(entries) == 1 and len(shape) == 4 and shape[:2] == [len(EYES), 3]
        if not is_batch or len(rows) != self._output_count or any(len(each) != 3 for each in rows):
            raise ValueError(f"{file}: must take two images and give rows of boxes, got {shape} and {rows}")
        self._input_name = entries[0].name
        self.input_size_px = (int(shape[3]), int(shape[2]))

    def detect(self, images: StereoImages) -> StereoDetection:
        """The best box in each image, if it reaches the default threshold of the projects."""
        found = self.candidates(images, _DEFAULT_THRESHOLD)
        return StereoDetection(*(next(iter(found[eye]), None) for eye in EYES))

    def candidates(self, images: StereoImages, least_score: float) -> dict[Eye, tuple[Detection, ...]]:
        """The boxes of each image, without doubles, the best first."""
        inputs, placements = zip(*(input_image(images, eye, self.input_size_px) for eye in EYES), strict=True)
        outputs = self._session.run(None, {self._input_name: self._batch(inputs)})
        found: dict[Eye, tuple[Detection, ...]] = {}
        for eye, placement, rows in zip(EYES, placements, zip(*outputs, strict=True), strict=True):
            boxes, scores = self._decode(rows, least_score)
            found[eye] = tuple(
                Detection((x, y, width, height), score)
                for (x, y, width, height), score in zip(
                    placement.to_image(boxes).tolist(), scores.tolist(), strict=True
                )
            )
        return found

    def _batch(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """The network's input (2, 3, H, W) of two images (H, W, 3)."""
        return network_input(images)

    @abstractmethod
    def _decode(self, outputs: Sequence[NDArray[np.float32]], least_score: float) -> tuple[Array, Array]:
        """Boxes and scores of one image.

        Args:
            outputs: of the network for this image.
            least_score: boxes with a lower score are left out.

        Returns:
            (m, 4) low corner, width, height in corner coordinates of the input, and (m,) scores, descending.
        """


def non_maximum_suppression(boxes: Array, scores: Array, max_iou: float) -> tuple[Array, Array]:
    """The boxes that overlap no better one by more than `max_iou`, the best first, at most 300.

    Args:
        boxes: (n, 4) low corner, width, height.
        scores: (n,).
        max_iou: intersection over union.
    """
    if not len(boxes):
        return boxes, scores
    stay = np.asarray(cv2.dnn.NMSBoxes(boxes.tolist(), scores.tolist(), 0.0, max_iou), dtype=np.intp)
    stay = stay[np.argsort(-scores[stay], kind="stable")][:_MAX_BOXES]
    return boxes[stay], scores[stay]


def corners_to_boxes(corners: Array) -> Array:
    """(n, 4) low corner, width, height from (n, 4) low and high corners."""
    return np.hstack((corners[:, :2], corners[:, 2:4] - corners[:, :2]))
