"""A detector network in an ONNX file, run by onnxruntime; docs/reference/detectors.md has the contract of the file."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from datasets_manifest.types.images import StereoImages
from drogue_models.untrusted_files import limited_memory, read_regular
from geometry.stereo import EYES, Eye
from nav.detector.coarse_to_fine import FINE_SCALE, LEAST_CANDIDATE, WINDOW_PX, SecondLook, detect_again
from nav.detector.detector import Detection, StereoDetection
from nav.detector.input_image import Letterbox, input_image, letterbox, letterbox_image, network_input
from nav.detector.model_metadata import METADATA_KEY, ModelMetadata
from nav.detector.multiscale_inference import ScoredBoxes, detect_multiscale, pass_sizes
from nav.detector.output_maps import MAP_CHANNELS, MAX_SIDE_PX, SIZE_STEP_PX, STRIDES

_ORT_ERRORS = (
    ort_errors.EPFail, ort_errors.Fail, ort_errors.InvalidArgument, ort_errors.InvalidGraph, ort_errors.InvalidProtobuf,
    ort_errors.NotImplemented, ort_errors.RuntimeException, RuntimeError,
)  # fmt: skip
# Errors only: the exception reports a file that cannot be used.
_LOG_ERRORS = 4
_MOST_BOXES = 20
# Longest side of a single picture over that of the images of a pair.
_MOST_ENLARGED_INPUT = 2


class OnnxDetector:
    """Runs a network on both images of a pair in one batch.

    Attributes:
        name: how it is called in results.
        metadata: of the file.
        input_size_px: width, height of the network's input. [px]
        pass_sizes_px: input sizes of all passes for a pair; more than one where the file asks for them.
    """

    def __init__(
        self, file: Path, name: str = "", threads: int = 1, input_size_px: tuple[int, int] | None = None
    ) -> None:
        """Open a network.

        Args:
            file: the network, with all its weights inside.
            name: by default the file's name.
            threads: of onnxruntime in one pass.
            input_size_px: width, height, multiples of 32; by default the size that the file states.

        Raises:
            ValueError: the file is missing, truncated, or not a network of this kind; the message names the file.
        """
        if threads < 1:
            raise ValueError(f"threads: must be at least 1, got {threads}")
        self.name = name or file.stem
        self._file = file
        self._session, self._file_bytes = _open_session(file, threads)
        self._input_name, fixed_size = _checked_input(file, self._session)
        self._least_batch = len(EYES) if self._session.get_inputs()[0].shape[0] == len(EYES) else 1
        self.metadata = _read_metadata(file, self._session, fixed_size)
        self.input_size_px = input_size_px or fixed_size or self.metadata.input_size_px
        if fixed_size and self.input_size_px != fixed_size:
            width, height = self.input_size_px
            raise ValueError(f"{file}: takes {fixed_size[0]}x{fixed_size[1]} px only, asked for {width}x{height} px")
        letterbox(self.input_size_px, self.input_size_px)
        if fixed_size and self.metadata.large_from_px:
            raise ValueError(
                f"{file}: large_from_px: takes {fixed_size[0]}x{fixed_size[1]} px only, and not half of it"
            )
        if fixed_size and self.metadata.small_below_px:
            raise ValueError(
                f"{file}: small_below_px: takes {fixed_size[0]}x{fixed_size[1]} px only, and no windows of "
                f"{WINDOW_PX}x{WINDOW_PX} px"
            )
        self._fixed_size = fixed_size
        self.pass_sizes_px = self._pass_sizes(self.input_size_px)
        probe = fixed_size or (SIZE_STEP_PX, 2 * SIZE_STEP_PX)
        self._check_maps(self._run(np.zeros((len(EYES), 3, probe[1], probe[0]), np.float32)), probe)

    def detect(self, images: StereoImages) -> StereoDetection:
        """The best box in each image, if it reaches the score threshold of the file."""
        found = self._candidates(images, EYES, self.metadata.score_threshold, max_boxes=1)
        return StereoDetection(*(next(iter(found[eye]), None) for eye in EYES))

    def candidates(self, images: StereoImages, least_score: float) -> dict[Eye, tuple[Detection, ...]]:
        """The boxes of each image after non-maximum suppression, the best first."""
        return self._candidates(images, EYES, least_score, _MOST_BOXES)

    def candidates_in_picture(self, picture: NDArray[np.uint8], least_score: float) -> tuple[Detection, ...]:
        """The boxes of a single picture (H, W, 3) or (H, W), the best first, sought at its own size.

        A picture that is larger than the images of a pair is reduced to twice their size at most, a smaller one is
        enlarged to their size: small drogues need their pixels.
        """
        height, width = picture.shape[:2]
        size = self._fixed_size or self._picture_size(width, height)
        image, placement = letterbox_image(picture, size)
        # A network whose batch is fixed takes both eyes.
        fine = partial(_letterboxed, picture, size)
        (found, *_) = self._detect([image] * self._least_batch, [fine] * self._least_batch, least_score, _MOST_BOXES)
        return _placed(found, placement)

    def _picture_size(self, width: int, height: int) -> tuple[int, int]:
        widest, most = max(self.input_size_px), min(_MOST_ENLARGED_INPUT * max(self.input_size_px), MAX_SIDE_PX)
        scale = min(max(width, height, widest), most) / max(width, height)
        wanted = (max(round(scale * side), 1) for side in (width, height))
        in_width, in_height = (-(-side // SIZE_STEP_PX) * SIZE_STEP_PX for side in wanted)
        return in_width, in_height

    def _pass_sizes(self, size_px: tuple[int, int]) -> tuple[tuple[int, int], ...]:
        return pass_sizes(size_px, self.metadata.input_size_px) if self.metadata.large_from_px else (size_px,)

    def _candidates(
        self, images: StereoImages, eyes: Sequence[Eye], least_score: float, max_boxes: int
    ) -> dict[Eye, tuple[Detection, ...]]:
        """The boxes in the images of some eyes, which pass through the network together."""
        inputs, placements = zip(*(input_image(images, eye, self.input_size_px) for eye in eyes), strict=True)
        fine = [partial(_input_pixels, images, eye, self.input_size_px) for eye in eyes]
        found = self._detect(inputs, fine, least_score, max_boxes)
        return {eye: _placed(some, placement) for eye, some, placement in zip(eyes, found, placements, strict=True)}

    def _detect(
        self,
        inputs: Sequence[NDArray[np.uint8]],
        fine: Sequence[Callable[[], NDArray[np.uint8]]],
        least_score: float,
        max_boxes: int,
    ) -> list[ScoredBoxes]:
        """For each image the boxes in corner coordinates of the input, and their scores.

        Args:
            inputs: of the network.
            fine: functions that return the same images at twice the scale.
            least_score: boxes with a lower score are left out.
            max_boxes: largest number of boxes of an image.
        """
        height, width = inputs[0].shape[:2]
        passes = len(self._pass_sizes((width, height)))
        large_from_px = self.metadata.large_from_px
        if not self._looks_again((width, height)):
            return detect_multiscale(inputs, self._run_images, large_from_px, least_score, max_boxes, passes)
        least = min(least_score, LEAST_CANDIDATE)
        found = detect_multiscale(inputs, self._run_images, large_from_px, least, _MOST_BOXES, passes)
        look = SecondLook(_fine_size((width, height)), self.metadata.small_below_px, self.metadata.score_threshold)
        return detect_again(found, fine, self._run_in_pairs, look, least_score, max_boxes)

    def _looks_again(self, size_px: tuple[int, int]) -> bool:
        """Whether small boxes in inputs of a width and height are looked at again; very large inputs show enough."""
        return self.metadata.small_below_px > 0 and max(_fine_size(size_px)) <= MAX_SIDE_PX

    def _run_images(self, images: Sequence[NDArray[np.uint8]]) -> list[NDArray[Any]]:
        return self._run(network_input(images))

    def _run_in_pairs(self, images: Sequence[NDArray[np.uint8]]) -> list[NDArray[Any]]:
        """The maps of any number of images of one size, two a batch; a fixed batch is filled with the same again."""
        pairs = [images[start : start + len(EYES)] for start in range(0, len(images), len(EYES))]
        maps = [self._run_images([*pair, *pair][: max(len(pair), self._least_batch)]) for pair in pairs]
        return [np.concatenate(each)[: len(images)] for each in zip(*maps, strict=True)]

    def _run(self, batch: NDArray[np.float32]) -> list[NDArray[Any]]:
        try:
            with limited_memory(self._file_bytes + batch.nbytes):
                return _run_until_interrupt(self._session, {self._input_name: batch})
        except (*_ORT_ERRORS, ValueError) as error:
            raise ValueError(f"{self._file}: does not run on {batch.shape}: {_first_line(error)}") from error

    def _check_maps(self, maps: list[NDArray[Any]], size_px: tuple[int, int]) -> None:
        want = [(len(EYES), MAP_CHANNELS, size_px[1] // stride, size_px[0] // stride) for stride in STRIDES]
        got = [np.shape(each) for each in maps]
        if got != want or any(not np.issubdtype(each.dtype, np.floating) for each in maps):
            raise ValueError(
                f"{self._file}: outputs must be maps of numbers {want}, got {got}; see docs/reference/detectors.md"
            )


def _fine_size(input_size_px: tuple[int, int]) -> tuple[int, int]:
    width, height = input_size_px
    return FINE_SCALE * width, FINE_SCALE * height


def _input_pixels(images: StereoImages, eye: Eye, size_px: tuple[int, int]) -> NDArray[np.uint8]:
    return input_image(images, eye, size_px, FINE_SCALE)[0]


def _letterboxed(picture: NDArray[np.uint8], size_px: tuple[int, int]) -> NDArray[np.uint8]:
    return letterbox_image(picture, size_px, FINE_SCALE)[0]


def _placed(found: ScoredBoxes, placement: Letterbox) -> tuple[Detection, ...]:
    """Boxes and scores in an input as detections in its image."""
    boxes, scores = found
    return tuple(
        Detection((x, y, width, height), score)
        for (x, y, width, height), score in zip(placement.to_image(boxes).tolist(), scores.tolist(), strict=True)
    )


def _open_session(file: Path, threads: int) -> tuple[onnxruntime.InferenceSession, int]:
    """The network, and the size of its file. [bytes]"""
    try:
        content = read_regular(file)
    except OSError as error:
        raise ValueError(f"{file}: cannot be read: {error.strerror}") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _LOG_ERRORS
    # Waiting threads must not occupy the cores that rendering or another measurement uses.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # No folder: a network from memory would take weights from files below the working directory.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)
    try:
        # It computes what is constant in a network, which may be of any size.
        with limited_memory(len(content)):
            session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except (*_ORT_ERRORS, ValueError) as error:
        raise ValueError(f"{file}: is truncated or not an ONNX network: {_first_line(error)}") from error
    return session, len(content)


def _run_until_interrupt(
    session: onnxruntime.InferenceSession, inputs: dict[str, NDArray[np.float32]]
) -> list[NDArray[Any]]:
    """The outputs of a network; Ctrl-C ends one that would run for ever.

    Python hears of signals between its own instructions alone, and a network is none: it runs in another thread.
    """
    if threading.current_thread() is not threading.main_thread():
        return list(session.run(None, inputs))
    options, ended = onnxruntime.RunOptions(), Future[list[NDArray[Any]]]()

    def run() -> None:
        try:
            ended.set_result(session.run(None, inputs, options))
        except BaseException as error:
            ended.set_exception(error)

    try:
        threading.Thread(target=run, name="network", daemon=True).start()
        return ended.result()
    except KeyboardInterrupt:
        options.terminate = True
        raise


def _checked_input(file: Path, session: onnxruntime.InferenceSession) -> tuple[str, tuple[int, int] | None]:
    """Name of the only input, and its (width, height) where they are fixed."""
    inputs = session.get_inputs()
    shape = list(inputs[0].shape) if len(inputs) == 1 else []
    if len(shape) != 4 or shape[1] != 3 or inputs[0].type != "tensor(float)":
        got = ", ".join(f"{each.name}: {each.type} {each.shape}" for each in inputs)
        raise ValueError(
            f"{file}: must have one float32 input (B, 3, H, W), got {got}; see docs/reference/detectors.md"
        )
    if shape[0] == 1:
        raise ValueError(f"{file}: takes one image a pass, must take both eyes; export it with a dynamic batch")
    width, height = shape[3], shape[2]
    if isinstance(width, int) != isinstance(height, int):
        raise ValueError(f"{file}: width and height must both be fixed or both dynamic, got {width}x{height}")
    if not (isinstance(width, int) and isinstance(height, int)):
        return inputs[0].name, None
    if width % SIZE_STEP_PX or height % SIZE_STEP_PX:
        raise ValueError(f"{file}: width and height must be multiples of {SIZE_STEP_PX}, got {width}x{height}")
    if max(width, height) > MAX_SIDE_PX:
        raise ValueError(f"{file}: width and height must be at most {MAX_SIDE_PX}, got {width}x{height}")
    return inputs[0].name, (width, height)


def _read_metadata(
    file: Path, session: onnxruntime.InferenceSession, fixed_size: tuple[int, int] | None
) -> ModelMetadata:
    text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
    if text is None and fixed_size is None:
        raise ValueError(f"{file}: takes any size and has no metadata {METADATA_KEY!r} that names one; add it")
    try:
        if text is None and fixed_size is not None:
            return ModelMetadata(input_size_px=fixed_size)
        return ModelMetadata.from_json(text or "")
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
