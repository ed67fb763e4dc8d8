"""What every tracker of the drogue's box answers."""

from __future__ import annotations

from typing import Protocol

from datasets_manifest.types.images import StereoImages
from nav.detector.detector import StereoDetection


class Tracker(Protocol):
    """Follows one drogue through the pairs of a sequence, in both eyes."""

    name: str

    def start(self, images: StereoImages, found: StereoDetection) -> None:
        """Begin anew with the boxes of a pair.

        Args:
            images: the pair.
            found: its boxes; an eye without one is not followed until `correct` gives it one.
        """
        ...

    def follow(self, images: StereoImages, predicted: StereoDetection) -> StereoDetection:
        """Boxes in the next pair.

        Args:
            images: the next pair in time.
            predicted: boxes where the motion so far lets the drogue be expected; None for an eye of which nothing is
                known.

        Returns:
            The boxes; None for an eye in which the drogue is lost.
        """
        ...

    def correct(self, images: StereoImages, found: StereoDetection) -> None:
        """Learn from boxes of the pair of the last `follow` that are better than its answer, such as a pose's.

        Args:
            images: that pair.
            found: better boxes; None for an eye of which nothing better is known.
        """
        ...
