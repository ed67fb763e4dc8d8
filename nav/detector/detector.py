"""The interface of all detectors, and the boxes that they return."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from datasets_manifest.types.images import StereoImages
from geometry.stereo import Eye


@dataclass(frozen=True)
class Detection:
    """The drogue in one image.

    Attributes:
        box_xywh_px: x, y of the low corner, width, height in pixel-centre coordinates; may extend beyond the image.
        score: 0 to 1.
    """

    box_xywh_px: tuple[float, float, float, float]
    score: float


@dataclass(frozen=True)
class StereoDetection:
    """The drogue in both images; None where it was not found."""

    left: Detection | None
    right: Detection | None

    def of(self, eye: Eye) -> Detection | None:
        """The detection of one eye."""
        return self.left if eye == "left" else self.right


class Detector(Protocol):
    """Finds a drogue of known geometry."""

    name: str

    def detect(self, images: StereoImages) -> StereoDetection:
        """Boxes around the drogue in both images."""
        ...

    def candidates(self, images: StereoImages, least_score: float) -> dict[Eye, tuple[Detection, ...]]:
        """All boxes in either image that may be the drogue; average precision is computed from them.

        Args:
            images: the pair.
            least_score: boxes with a lower score are left out.

        Returns:
            The candidates of each eye, the best first.
        """
        ...
