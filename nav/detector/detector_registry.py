"""Registry of detectors: opens one by its name, or from a network file.

`NAME@HEIGHTxWIDTH` and `FILE.onnx@HEIGHTxWIDTH` let a network look at images of another size than it states, such as
`mobile-s@960x1280`, which finds smaller drogues in four times the time.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from drogue_models.parameters import DrogueParameters
from nav.detector.detector import Detector

if TYPE_CHECKING:
    from nav.detector.onnx_detector import OnnxDetector

COLOR_BLOB, PEAK_RING = "color-blob", "peak-ring"
DEFAULT_DETECTOR = "mobile-s"
# The networks that ship with the package, one file for each name.
_WEIGHTS = Path(__file__).parent / "weights"
_SUFFIX = ".onnx"
_SIZED = re.compile(r"(?P<network>.+)@(?P<height>\d{1,5})x(?P<width>\d{1,5})")


def detector_names() -> tuple[str, ...]:
    """Names that `open_detector` accepts."""
    return (COLOR_BLOB, PEAK_RING, *sorted(file.stem for file in _WEIGHTS.glob(f"*{_SUFFIX}")))


def split_input_size(detector: str) -> tuple[str, tuple[int, int] | None]:
    """A detector's name or file, and the width and height of its input that follow it; None where none do. [px]"""
    sized = _SIZED.fullmatch(detector)
    if sized is None:
        return detector, None
    return sized["network"], (int(sized["width"]), int(sized["height"]))


def network_file(name_or_file: str) -> Path | None:
    """The network file of a detector; None for a detector that is not a network, or an unknown name."""
    if name_or_file.endswith(_SUFFIX):
        return Path(name_or_file)
    return _WEIGHTS / f"{name_or_file}{_SUFFIX}" if name_or_file in detector_names()[2:] else None


def open_detector(name_or_file: str, drogue: DrogueParameters, threads: int = 1) -> Detector:
    """The detector of one drogue; see `detector_factory`."""
    return detector_factory(name_or_file, threads)(drogue)


def open_network(detector: str, threads: int = 1) -> OnnxDetector | None:
    """The network of a detector, at the input size that follows its name; None for an unknown one or no network.

    Raises:
        ValueError: a size that the network cannot take, or a file that is missing or no network; the message names it.
    """
    name_or_file, input_size_px = split_input_size(detector)
    file = network_file(name_or_file)
    if file is None:
        return None
    from nav.detector.output_maps import MAX_SIDE_PX, SIZE_STEP_PX

    if input_size_px and any(side % SIZE_STEP_PX or not SIZE_STEP_PX <= side <= MAX_SIDE_PX for side in input_size_px):
        raise ValueError(
            f"detector: height and width must be multiples of {SIZE_STEP_PX} up to {MAX_SIDE_PX}, got {detector!r}"
        )
    from nav.detector.onnx_detector import OnnxDetector

    # What follows the name is part of it, so that results at two sizes can be told apart.
    return OnnxDetector(file, file.stem + detector[len(name_or_file) :], threads, input_size_px)


def detector_factory(name_or_file: str, threads: int = 1) -> Callable[[DrogueParameters], Detector]:
    """A function that returns the detector of a drogue; a network is opened once and shared by all drogues.

    Args:
        name_or_file: one of `detector_names`, or a file `*.onnx` with the contract of docs/reference/detectors.md; a
            network's may be followed by the size of its input, as in `mobile-s@960x1280`.
        threads: that a network computes with.

    Raises:
        ValueError: an unknown name, a size that the network cannot take, or a file that is missing or not such a
            network; the message names it.
    """
    if name_or_file == COLOR_BLOB:
        from nav.detector.ring_detectors import ColorBlobDetector

        return ColorBlobDetector
    if name_or_file == PEAK_RING:
        from nav.detector.ring_detectors import PeakRingDetector

        return PeakRingDetector
    network = open_network(name_or_file, threads)
    if network is None:
        names = ", ".join(detector_names())
        raise ValueError(
            f"detector: must be one of {names} or a file *{_SUFFIX}, a network also with @HEIGHTxWIDTH behind it, got "
            f"{name_or_file!r}"
        )
    return lambda drogue: network
