"""The interface of trackers, trackers by name, and when the detector starts or checks one."""

from __future__ import annotations

from typing import Protocol

from datasets_manifest.types.images import StereoImages
from geometry.boxes import intersection_over_union
from nav.detector.detector import StereoDetection
from nav.tracking.eye_tracker import StereoTracker

BERNOULLI, FLOW, MIL, POSE_PREDICT = "bernoulli", "flow", "mil", "pose-predict"
REDETECT_EVERY = 25
"""The detector checks a tracker after this many pairs: once a second at the seed paper's 25 pairs a second."""
# A longer time between two pairs separates two sequences. [s]
_LONGEST_GAP_S = 1.0
# Boxes with a smaller intersection over union show different things.
_SAME_PLACE_IOU = 0.5

PixelBox = tuple[float, float, float, float]


class Tracker(Protocol):
    """Follows one drogue through the pairs of a sequence, in both eyes."""

    name: str

    def start(self, images: StereoImages, found: StereoDetection) -> None:
        """Start anew with the boxes of a pair.

        Args:
            images: the pair.
            found: its boxes; an eye without one is not followed until `correct` gives it one.
        """
        ...

    def follow(self, images: StereoImages, predicted: StereoDetection) -> StereoDetection:
        """Boxes in the next pair.

        Args:
            images: the next pair in time.
            predicted: boxes where a motion estimate expects the drogue; None for an eye without a prediction.

        Returns:
            The boxes; None for an eye in which the drogue is lost.
        """
        ...

    def correct(self, images: StereoImages, found: StereoDetection) -> None:
        """Learn from boxes of the last `follow`'s pair that are better than its answer, such as those of a pose.

        Args:
            images: that pair.
            found: better boxes; None for an eye without one.
        """
        ...


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
        from nav.tracking.opencv_trackers import MedianFlowEyeTracker

        return StereoTracker(name, MedianFlowEyeTracker)
    if name == MIL:
        from nav.tracking.opencv_trackers import MilEyeTracker

        return StereoTracker(name, MilEyeTracker)
    if name == POSE_PREDICT:
        from nav.tracking.pose_predict import PosePredictEyeTracker

        return StereoTracker(name, PosePredictEyeTracker)
    raise ValueError(f"tracker: must be one of {', '.join(tracker_names())}, got {name!r}")


def begins_sequence(last_s: float | None, now_s: float) -> bool:
    """Whether a pair is the first of a sequence: its time is not after the last pair's, or a gap separates them.

    Args:
        last_s: time of the pair before; None where there is none. [s]
        now_s: time of the pair. [s]
    """
    return last_s is None or not 0 < now_s - last_s <= _LONGEST_GAP_S


def is_same_place(one: PixelBox, other: PixelBox) -> bool:
    """Whether two boxes of one image overlap enough to show the same thing."""
    return bool(intersection_over_union(one, other) >= _SAME_PLACE_IOU)
