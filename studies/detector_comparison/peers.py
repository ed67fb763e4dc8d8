"""The networks of other projects that the study trains, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from studies.detector_comparison.libreyolo_peers import DfineDetector, RtmdetDetector
from studies.detector_comparison.peer_detector import PeerDetector
from studies.detector_comparison.ultralytics_peers import YoloDetector

ULTRALYTICS_SCRIPT, LIBREYOLO_SCRIPT = (
    Path(__file__).with_name(f"{package}_script.py") for package in ("ultralytics", "libreyolo")
)

ULTRALYTICS_STEP_IMAGES = 64
"""Images whose gradients ultralytics sums up for a step of its optimizer, by default: `nbs`."""


@dataclass(frozen=True)
class Peer:
    """How a network is trained, exported and used.

    Attributes:
        script: trains and exports it.
        config: its name in the script.
        open_detector: opens an exported file for a number of threads.
        is_square: its input is square, with the image in the middle.
        least_side_px: least width of its input. [px]
    """

    script: Path
    config: str
    open_detector: Callable[[Path, int], PeerDetector]
    is_square: bool = False
    least_side_px: int = 32

    def input_size_px(self, size_px: tuple[int, int]) -> tuple[int, int]:
        """Width and height of its input where others have `size_px`."""
        return (max(size_px), max(size_px)) if self.is_square else size_px


PEERS: Mapping[str, Peer] = {
    **{
        name: Peer(ULTRALYTICS_SCRIPT, f"{name}.yaml", YoloDetector)
        for name in ("yolov8s", "yolov8n", "yolo11n", "yolo12n", "yolo26n")
    },
    # libreyolo trains and exports D-FINE on squares only. Its 300 queries are chosen from cells of 16 and 32 px.
    "d-fine-n": Peer(LIBREYOLO_SCRIPT, "d-fine-n", DfineDetector, is_square=True, least_side_px=256),
    "rtmdet-tiny": Peer(LIBREYOLO_SCRIPT, "rtmdet-tiny", RtmdetDetector),
}
