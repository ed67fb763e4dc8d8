"""The interface of trackers, trackers by name, and when the detector starts or checks one."""

from __future__ import annotations

from typing import Protocol

from datasets_manifest.types.images import StereoImages
from geometry.boxes import intersection_over_union
from nav.detector.detector import StereoDetection
from nav.tracking.eye_tracker import StereoTracker


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


BERNOULLI, FLOW, MIL, POSE_PREDICT = "bernoulli", "flow", "mil", "pose-predict"


def tracker_names() -> tuple[str, ...]:
    """Names that `open_tracker` knows."""
    return (BERNOULLI, FLOW, MIL, POSE_PREDICT)


def open_tracker(name: str) -> Tracker:
    """A tracker that follows nothing yet.

    Raises:
        ValueError: no such name.
    """
    if name == BERNOULLI:
        from nav.tracking.bernoulli import BernoulliEyeTracker

        return StereoTracker(name, BernoulliEyeTracker)
    if name == FLOW:
        from nav.tracking.median_flow import MedianFlowEyeTracker

        return StereoTracker(name, MedianFlowEyeTracker)
    if name == MIL:
        from nav.tracking.mil import MilEyeTracker

        return StereoTracker(name, MilEyeTracker)
    if name == POSE_PREDICT:
        from nav.tracking.pose_predict import PosePredictEyeTracker

        return StereoTracker(name, PosePredictEyeTracker)
    raise ValueError(f"tracker: must be one of {', '.join(tracker_names())}, got {name!r}")


PixelBox = tuple[float, float, float, float]

# A longer time between two pairs parts two sequences. [s]
_LONGEST_GAP_S = 1.0
REDETECT_EVERY = 25
"""The detector checks a tracker after so many pairs without it: a second at the seed paper's 25 pairs a second."""
# Boxes that overlap by less show different things.
_SAME_PLACE = 0.5


def begins_sequence(last_s: float | None, now_s: float) -> bool:
    """Whether a pair is the first of a sequence: its time stamp does not follow the last one's, or only after a gap.

    Args:
        last_s: time of the pair before; None where there is none. [s]
        now_s: time of the pair. [s]
    """
    return last_s is None or not 0 < now_s - last_s <= _LONGEST_GAP_S


def is_same_place(one: PixelBox, other: PixelBox) -> bool:
    """Whether two boxes of one image show the same thing."""
    return bool(intersection_over_union(one, other) >= _SAME_PLACE)
