"""Registry of detectors: opens one by its name, or from a network file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from drogue_models.parameters import DrogueParameters
from nav.detector.detector import Detector

COLOR_BLOB, PEAK_RING = "color-blob", "peak-ring"
DEFAULT_DETECTOR = "mobile-s"
# The networks that ship with the package, one file for each name.
_WEIGHTS = Path(__file__).parent / "weights"
_SUFFIX = ".onnx"


def detector_names() -> tuple[str, ...]:
    """Names that `open_detector` accepts."""
    return (COLOR_BLOB, PEAK_RING, *sorted(file.stem for file in _WEIGHTS.glob(f"*{_SUFFIX}")))


def network_file(name_or_file: str) -> Path | None:
    """The network file of a detector; None for a detector that is not a network, or an unknown name."""
    if name_or_file.endswith(_SUFFIX):
        return Path(name_or_file)
    return _WEIGHTS / f"{name_or_file}{_SUFFIX}" if name_or_file in detector_names()[2:] else None


def open_detector(name_or_file: str, drogue: DrogueParameters, threads: int = 1) -> Detector:
    """The detector of one drogue; see `detector_factory`."""
    return detector_factory(name_or_file, threads)(drogue)


def detector_factory(name_or_file: str, threads: int = 1) -> Callable[[DrogueParameters], Detector]:
    """A function that returns the detector of a drogue; a network is opened once and shared by all drogues.

    Args:
        name_or_file: one of `detector_names`, or a file `*.onnx` with the contract of docs/reference/detectors.md.
        threads: that a network computes with.

    Raises:
        ValueError: an unknown name, or a file that is missing or not such a network; the message names it.
    """
    if name_or_file == COLOR_BLOB:
        from nav.detector.ring_detectors import ColorBlobDetector

        return ColorBlobDetector
    if name_or_file == PEAK_RING:
        from nav.detector.ring_detectors import PeakRingDetector

        return PeakRingDetector
    file = network_file(name_or_file)
    if file is None:
        names = ", ".join(detector_names())
        raise ValueError(f"detector: must be one of {names} or a file *{_SUFFIX}, got {name_or_file!r}")
    from nav.detector.onnx_detector import OnnxDetector

    network = OnnxDetector(file, file.stem, threads)
    return lambda drogue: network
