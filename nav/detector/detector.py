"""What every detector of the drogue answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from datasets_manifest.types.images import StereoImages
from geometry.stereo import Eye


@dataclass(frozen=True)
class Detection:
    """The drogue in one image.

    Attributes:
        box_xywh_px: x, y of the low corner, width, height in pixel-centre coordinates; may reach over the image's edge.
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
    """Finds one known drogue."""

    name: str

    def detect(self, images: StereoImages) -> StereoDetection:
        """Boxes around the drogue in both images."""
        ...

    def candidates(self, images: StereoImages, least_score: float) -> dict[Eye, tuple[Detection, ...]]:
        """Everything in either image that may be the drogue, from which average precision is computed.

        Args:
            images: the pair.
            least_score: what scores lower is left out.

        Returns:
            Of each eye its candidates, the best first.
        """
        ...
