"""Trackers by name."""

from __future__ import annotations

from nav.tracking.eye_tracker import StereoTracker
from nav.tracking.tracker import Tracker

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
