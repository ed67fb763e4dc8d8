"""Detectors by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from drogue_models.parameters import DrogueParameters
from nav.detector.detector import Detector

COLOR_BLOB = "color-blob"
DEFAULT_DETECTOR = "mobile-s"
# Networks that belong to the package lie here, each under its name.
_WEIGHTS = Path(__file__).parent / "weights"
_SUFFIX = ".onnx"


def detector_names() -> tuple[str, ...]:
    """Names that `open_detector` knows."""
    return (COLOR_BLOB, *sorted(file.stem for file in _WEIGHTS.glob(f"*{_SUFFIX}")))


def network_file(name_or_file: str) -> Path | None:
    """Where the network of a name of `detector_factory` lies; None for a name without one."""
    if name_or_file.endswith(_SUFFIX):
        return Path(name_or_file)
    return _WEIGHTS / f"{name_or_file}{_SUFFIX}" if name_or_file in detector_names()[1:] else None


def open_detector(name_or_file: str, drogue: DrogueParameters, threads: int = 1) -> Detector:
    """A detector of one drogue, see `detector_factory`."""
    return detector_factory(name_or_file, threads)(drogue)


def detector_factory(name_or_file: str, threads: int = 1) -> Callable[[DrogueParameters], Detector]:
    """What makes detectors of the drogue that it is told; a network is opened once, and is the same for all.

    Args:
        name_or_file: one of `detector_names`, or a file `*.onnx` with the contract of docs/reference/detectors.md.
        threads: of a network.

    Raises:
        ValueError: no such name, or a file that is missing or no such network; names it.
    """
    if name_or_file == COLOR_BLOB:
        from nav.detector.color_blob import ColorBlobDetector

        return ColorBlobDetector
    file = network_file(name_or_file)
    if file is None:
        names = ", ".join(detector_names())
        raise ValueError(f"detector: must be one of {names} or a file *{_SUFFIX}, got {name_or_file!r}")
    from nav.detector.onnx_detector import OnnxDetector

    network = OnnxDetector(file, file.stem, threads)
    return lambda drogue: network
