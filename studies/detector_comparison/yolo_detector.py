"""A YOLOv8 network as ultralytics exports it, run like our own: same picture, same run time, both eyes in one pass."""

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

# ultralytics' own: boxes that overlap a better one by more are dropped, and no more than so many stay.
_MOST_OVERLAP = 0.7
_MOST_BOXES = 300
_USUAL_THRESHOLD = 0.25


def open_session(file: Path, threads: int) -> onnxruntime.InferenceSession:
    """A network whose idle threads do not spin, so that what is timed beside it is not slowed.

    Raises:
        ValueError: the file is missing or no ONNX network; names it.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(file.read_bytes(), options, providers=["CPUExecutionProvider"])
    except OSError as error:
        raise ValueError(f"{file}: cannot be read: {error.strerror}") from error
    except Exception as error:  # onnxruntime's faults have no common base but this one
        raise ValueError(f"{file}: is no ONNX network: {str(error).splitlines()[0]}") from error


class YoloDetector:
    """Both eyes in one pass.

    Attributes:
        name: how it is called in results.
        input_size_px: width, height. [px]
    """

    def __init__(self, file: Path, threads: int) -> None:
        """Open a network of two images.

        Raises:
            ValueError: the file is missing, or no network of two images with one class; names it.
        """
        self.name = file.stem
        self._session = open_session(file, threads)
        (entry,), (answer,) = self._session.get_inputs(), self._session.get_outputs()
        shape, rows = entry.shape, answer.shape
        if len(shape) != 4 or shape[:2] != [len(EYES), 3] or len(rows) != 3:
            raise ValueError(f"{file}: must take two images and give rows of boxes, got {shape} and {rows}")
        self._input_name = entry.name
        self.input_size_px = (int(shape[3]), int(shape[2]))

    def detect(self, images: StereoImages) -> StereoDetection:
        """The best box in each image, where it scores as much as ultralytics asks for."""
        found = self.candidates(images, _USUAL_THRESHOLD)
        return StereoDetection(*(next(iter(found[eye]), None) for eye in EYES))

    def candidates(self, images: StereoImages, least_score: float) -> dict[Eye, tuple[Detection, ...]]:
        """Boxes of each image, the best first, without those that overlap a better one."""
        pictures, places = zip(*(input_image(images, eye, self.input_size_px) for eye in EYES), strict=True)
        (answer,) = self._session.run(None, {self._input_name: network_input(pictures)})
        found: dict[Eye, tuple[Detection, ...]] = {}
        for eye, place, rows in zip(EYES, places, answer, strict=True):
            boxes, scores = decode_rows(rows, least_score)
            found[eye] = tuple(
                Detection((x, y, width, height), score)
                for (x, y, width, height), score in zip(place.to_image(boxes).tolist(), scores.tolist(), strict=True)
            )
        return found


def decode_rows(rows: NDArray[np.float32], least_score: float) -> tuple[Array, Array]:
    """Boxes and scores of one image's answer.

    Args:
        rows: (4 + classes, n) middle x, y, width, height in corner coordinates of the input, and the scores of the
            classes, of which the first is the drogue.
        least_score: what scores lower is left out.

    Returns:
        (m, 4) low corner, width, height, and (m,) scores, descending.
    """
    scores = rows[4].astype(np.float64)
    keep = np.flatnonzero(scores >= least_score)
    middle, size = rows[:2, keep].T.astype(np.float64), rows[2:4, keep].T.astype(np.float64)
    boxes, scores = np.hstack((middle - size / 2, size)), scores[keep]
    if len(boxes):
        stay = np.asarray(cv2.dnn.NMSBoxes(boxes.tolist(), scores.tolist(), 0.0, _MOST_OVERLAP), dtype=np.intp)
        stay = stay[np.argsort(-scores[stay], kind="stable")][:_MOST_BOXES]
        boxes, scores = boxes[stay], scores[stay]
    return boxes, scores
