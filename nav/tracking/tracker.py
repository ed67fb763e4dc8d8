"""Trackers by name: their interface, and the one that joins a tracker of each eye and checks that both agree.

Also when a sequence begins, and when the detector checks a tracker.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from datasets_manifest.types.images import StereoImages
from geometry.boxes import intersection_over_union
from geometry.stereo import EYES, Eye
from nav.detector.detector import Detection, StereoDetection
from nav.numerics.eye_threads import map_eyes
from nav.tracking.region import Box, EyeImage, box_center, box_size, eye_image, move_box

BERNOULLI, FLOW, MIL, POSE_PREDICT = "bernoulli", "flow", "mil", "pose-predict"
REDETECT_EVERY = 25
"""The detector checks a tracker after this many pairs: once a second at the seed paper's 25 pairs a second."""
MOST_UNCONFIRMED = 3 * REDETECT_EVERY
"""After this many pairs without any detection, what is followed is given up.

A detector may overlook a drogue that is near or blurred, but a false detection would be followed for ever. To give up a
drogue costs little: from then on the detector looks for it at every pair.
"""
# A longer time between two pairs separates two sequences. [s]
_LONGEST_GAP_S = 1.0
# Boxes with a smaller intersection over union show different things.
_SAME_PLACE_IOU = 0.5
# Boxes of one drogue lie at the same height in both images and have the same size. These changes of offset, in box
# sides plus pixels, and of log-scale cover the noise of every tracker and a badly calibrated rig.
_LARGEST_OFFSET_CHANGE, _LARGEST_OFFSET_CHANGE_PX, _LARGEST_SCALE_CHANGE = 0.12, 3.0, 0.2
# The offset tolerance is this many standard deviations of the box that one eye predicts for the other.
_TOLERANCE_SIGMAS = 3.0
# Boxes with less of their width or height on the image are not followed.
_SMALLEST_VISIBLE_PX = 4.0


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


class EyeTracker(Protocol):
    """Follows the drogue in the images of one eye; `locate` may be called repeatedly, `learn` once for each image.

    `locate` of both eyes' trackers may run at the same time.
    """

    def locate(self, image: EyeImage, predicted: Box | None, sd_px: float | None) -> Detection | None:
        """The box in the next image, or in the same one with a better prediction; None where it is not found.

        Args:
            image: of one eye.
            predicted: where the box is expected; None leaves that to the tracker.
            sd_px: standard deviation of its centre; None leaves that to the tracker. [px]
        """
        ...

    def learn(self, image: EyeImage, found: Detection | None) -> None:
        """Learn from the accepted answer of `locate` to this image; None where the drogue is lost."""
        ...

    def correct(self, image: EyeImage, box: Box) -> None:
        """Learn from a better box of the same image."""
        ...


@dataclass(frozen=True)
class _StereoOffset:
    """Right eye's box against the left one's.

    Attributes:
        disparity: how far left of it. [box sides]
        rows: how far below it. [box sides]
        log_scale: how much larger it is.
    """

    disparity: float
    rows: float
    log_scale: float


class StereoTracker:
    """A `Tracker` made of one `EyeTracker` for each eye.

    Attributes:
        name: of the tracker.
    """

    def __init__(self, name: str, start_eye: Callable[[EyeImage, Box], EyeTracker]) -> None:
        """Create a tracker that follows nothing yet.

        Args:
            name: of the tracker.
            start_eye: makes an `EyeTracker` from a box in an eye's image.
        """
        self.name = name
        self._start_eye = start_eye
        self._eyes: dict[Eye, EyeTracker] = {}
        self._stereo_offset: _StereoOffset | None = None

    def start(self, images: StereoImages, found: StereoDetection) -> None:
        """See `Tracker`."""
        self._eyes, self._stereo_offset = {}, None
        self.correct(images, found)

    def follow(self, images: StereoImages, predicted: StereoDetection) -> StereoDetection:
        """See `Tracker`; an eye that lost the drogue searches again where the other eye's box predicts it."""
        boxes = {
            eye: found.box_xywh_px
            for eye in self._eyes
            if (found := predicted.of(eye)) is not None and _is_on_image(found.box_xywh_px, images.size_px)
        }
        answers = map_eyes(
            lambda eye: self._eyes[eye].locate(eye_image(images, eye), boxes.get(eye), None),
            self._eyes,
            max((box[2] * box[3] for box in boxes.values()), default=0.0),
        )
        consistent = self._consistent(images, _stereo_detection(answers))
        for eye, tracker in self._eyes.items():
            tracker.learn(eye_image(images, eye), consistent.of(eye))
        if consistent.left is not None and consistent.right is not None:
            self._stereo_offset = _stereo_offset(consistent.left.box_xywh_px, consistent.right.box_xywh_px)
        return consistent

    def correct(self, images: StereoImages, found: StereoDetection) -> None:
        """See `Tracker`; starts an eye that was not followed."""
        better = {eye: found.of(eye) for eye in EYES}
        visible = {
            eye: detection.box_xywh_px
            for eye, detection in better.items()
            if detection is not None and _is_on_image(detection.box_xywh_px, images.size_px)
        }
        for eye, box in visible.items():
            image = eye_image(images, eye)
            if eye in self._eyes:
                self._eyes[eye].correct(image, box)
            else:
                self._eyes[eye] = self._start_eye(image, box)
        if len(visible) == len(EYES):
            self._stereo_offset = _stereo_offset(visible["left"], visible["right"])

    def _consistent(self, images: StereoImages, found: StereoDetection) -> StereoDetection:
        """Both boxes if they are consistent with one drogue; else one eye searches again where the other sees it.

        The box with the higher score is tried first. Where neither leads to a consistent pair, that box is kept alone.
        """
        offset = self._stereo_offset
        detections = [(detection, eye) for eye in EYES if (detection := found.of(eye)) is not None]
        if offset is None or not detections or _is_consistent(offset, found):
            return found
        detections.sort(key=lambda each: -each[0].score)
        for detection, eye in detections:
            other: Eye = "right" if eye == "left" else "left"
            if other not in self._eyes:
                break
            hint = _box_in_other_eye(detection.box_xywh_px, offset, other)
            sd_px = _offset_tolerance_px(box_size(hint)) / _TOLERANCE_SIGMAS
            found_again = self._eyes[other].locate(eye_image(images, other), hint, sd_px)
            both = _stereo_detection({eye: detection, other: found_again})
            if _is_consistent(offset, both):
                return both
        best, eye = detections[0]
        return _stereo_detection({eye: best})


def _is_on_image(box: Box, size_px: tuple[int, int]) -> bool:
    """Whether enough of a box lies on the image for it to be followed."""
    visible = [min(box[i] + box[2 + i], size_px[i] - 0.5) - max(box[i], -0.5) for i in (0, 1)]
    return min(visible) >= _SMALLEST_VISIBLE_PX


def _stereo_offset(left: Box, right: Box) -> _StereoOffset:
    size = box_size(left)
    x, y = (box_center(right) - box_center(left)) / size
    return _StereoOffset(-float(x), float(y), float(np.log(box_size(right) / size)))


def _stereo_detection(found: dict[Eye, Detection | None]) -> StereoDetection:
    return StereoDetection(found.get("left"), found.get("right"))


def _offset_tolerance_px(size_px: float) -> float:
    """Tolerance on a box against its prediction from the other eye's box and the last offset. [px]"""
    return _LARGEST_OFFSET_CHANGE * size_px + _LARGEST_OFFSET_CHANGE_PX


def _is_consistent(last: _StereoOffset, found: StereoDetection) -> bool:
    """Whether both eyes have a box, and their offset has changed no more than that of one drogue can."""
    if found.left is None or found.right is None:
        return False
    current, size_px = _stereo_offset(found.left.box_xywh_px, found.right.box_xywh_px), box_size(found.left.box_xywh_px)
    tolerance = _offset_tolerance_px(size_px) / size_px
    # Disparity grows in proportion to size, but a badly calibrated rig adds some pixels to it.
    return (
        abs(current.rows - last.rows) < tolerance
        and abs(current.disparity - last.disparity) < tolerance
        and abs(current.log_scale - last.log_scale) < _LARGEST_SCALE_CHANGE
    )


def _box_in_other_eye(seen: Box, offset: _StereoOffset, eye: Eye) -> Box:
    """Box in an eye, predicted from the one that the other eye sees."""
    scale = float(np.exp(offset.log_scale if eye == "right" else -offset.log_scale))
    shift = np.array([-offset.disparity, offset.rows])
    left_size = box_size(seen) * (1.0 if eye == "right" else scale)
    center = box_center(seen) + (shift if eye == "right" else -shift) * left_size
    return move_box(seen, center, scale)


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


def is_same_place(one: Box, other: Box) -> bool:
    """Whether two boxes of one image overlap enough to show the same thing."""
    return bool(intersection_over_union(one, other) >= _SAME_PLACE_IOU)
