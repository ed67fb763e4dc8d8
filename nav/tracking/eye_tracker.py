"""Both eyes of a tracker that follows each for itself: they help each other, and must agree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from datasets_manifest.types.images import StereoImages
from geometry.stereo import EYES, Eye
from nav.detector.detector import Detection, StereoDetection
from nav.tracking.region import Box, EyeImage, box_center, box_size, eye_image, moved

# Boxes of one drogue have the same height on both images and the same size; what may be off, in box sides (and pixels)
# and as a log-scale, covers the noise of every tracker and a rig that is calibrated badly.
_MOST_ROW_CHANGE, _MOST_ROW_CHANGE_PX, _MOST_SIZE_CHANGE = 0.12, 3.0, 0.2
# What may be off is so many standard deviations of where one eye says that the other must see the drogue.
_HINT_SD = 3.0

# Boxes of which the image shows less, in width or height, are not followed.
_LEAST_SHOWN_PX = 4.0


class EyeTracker(Protocol):
    """Follows the drogue in the images of one eye: looks as often as it is asked to, and learns once a pair."""

    def look(self, image: EyeImage, predicted: Box | None, sd_px: float | None) -> Detection | None:
        """The box in the next image, or in the same one again with a better prediction; None where it is not found.

        Args:
            image: of one eye.
            predicted: where it is expected; None leaves that to the tracker.
            sd_px: standard deviation of the prediction's middle; None leaves that to the tracker. [px]
        """
        ...

    def learn(self, image: EyeImage, found: Detection | None) -> None:
        """Learn from that answer of `look` to this image that holds; None where the drogue is lost."""
        ...

    def correct(self, image: EyeImage, box: Box) -> None:
        """Learn from a better box of the same image."""
        ...


@dataclass(frozen=True)
class _Apart:
    """How the right eye's box lies against the left one's.

    Attributes:
        disparity: in box sides, how far left of it.
        rows: in box sides, how far below it.
        log_scale: how much larger.
    """

    disparity: float
    rows: float
    log_scale: float


class StereoTracker:
    """A `Tracker` out of a tracker for each eye.

    Attributes:
        name: of the tracker.
    """

    def __init__(self, name: str, start_eye: Callable[[EyeImage, Box], EyeTracker]) -> None:
        """Follow nothing yet.

        Args:
            name: of the tracker.
            start_eye: begins to follow a box in an eye's image.
        """
        self.name = name
        self._start_eye = start_eye
        self._eyes: dict[Eye, EyeTracker] = {}
        self._apart: _Apart | None = None

    def start(self, images: StereoImages, found: StereoDetection) -> None:
        """See `Tracker`."""
        self._eyes, self._apart = {}, None
        self.correct(images, found)

    def follow(self, images: StereoImages, predicted: StereoDetection) -> StereoDetection:
        """See `Tracker`; an eye that lost the drogue looks again where the other eye says that it is."""
        answers: dict[Eye, Detection | None] = dict.fromkeys(EYES)
        for eye, tracker in self._eyes.items():
            expected = predicted.of(eye)
            box = None if expected is None else expected.box_xywh_px
            is_of_use = box is not None and _is_on_image(box, images.size_px)
            answers[eye] = tracker.look(eye_image(images, eye), box if is_of_use else None, None)
        agreed = self._agreed(images, StereoDetection(answers["left"], answers["right"]))
        for eye, tracker in self._eyes.items():
            tracker.learn(eye_image(images, eye), agreed.of(eye))
        if agreed.left is not None and agreed.right is not None:
            self._apart = _apart(agreed.left.box_xywh_px, agreed.right.box_xywh_px)
        return agreed

    def correct(self, images: StereoImages, found: StereoDetection) -> None:
        """See `Tracker`; an eye that was not followed is from now on."""
        better = {eye: found.of(eye) for eye in EYES}
        shown = {
            eye: one.box_xywh_px
            for eye, one in better.items()
            if one is not None and _is_on_image(one.box_xywh_px, images.size_px)
        }
        for eye, box in shown.items():
            image = eye_image(images, eye)
            if eye in self._eyes:
                self._eyes[eye].correct(image, box)
            else:
                self._eyes[eye] = self._start_eye(image, box)
        if len(shown) == len(EYES):
            self._apart = _apart(shown["left"], shown["right"])

    def _agreed(self, images: StereoImages, found: StereoDetection) -> StereoDetection:
        """Both answers if they can be of one drogue, or else after one eye looked again where the other one sees it.

        The eye with the higher score is believed first. Where neither lets the other find it, its answer stays alone.
        """
        apart = self._apart
        seen = [(one, eye) for eye in EYES if (one := found.of(eye)) is not None]
        if apart is None or not seen or _may_be_one(apart, found):
            return found
        seen.sort(key=lambda each: -each[0].score)
        for one, eye in seen:
            other: Eye = "right" if eye == "left" else "left"
            if other not in self._eyes:
                break
            hint = _other_box(one.box_xywh_px, apart, other)
            again = self._eyes[other].look(eye_image(images, other), hint, _most_change_px(box_size(hint)) / _HINT_SD)
            both = _of_eyes({eye: one, other: again})
            if _may_be_one(apart, both):
                return both
        best, eye = seen[0]
        return _of_eyes({eye: best})


def _is_on_image(box: Box, size_px: tuple[int, int]) -> bool:
    """Whether it shows enough to be followed: so many pixels of width and height."""
    shown = [min(box[i] + box[2 + i], size_px[i] - 0.5) - max(box[i], -0.5) for i in (0, 1)]
    return min(shown) >= _LEAST_SHOWN_PX


def _apart(left: Box, right: Box) -> _Apart:
    size = box_size(left)
    x, y = (box_center(right) - box_center(left)) / size
    return _Apart(-float(x), float(y), float(np.log(box_size(right) / size)))


def _of_eyes(found: dict[Eye, Detection | None]) -> StereoDetection:
    return StereoDetection(found.get("left"), found.get("right"))


def _most_change_px(size_px: float) -> float:
    """How far a box may be off where the other eye's box and the last disparity put it. [px]"""
    return _MOST_ROW_CHANGE * size_px + _MOST_ROW_CHANGE_PX


def _may_be_one(before: _Apart, found: StereoDetection) -> bool:
    """Whether both eyes have a box, and one drogue can have come there from where the boxes were apart before."""
    if found.left is None or found.right is None:
        return False
    now, size_px = _apart(found.left.box_xywh_px, found.right.box_xywh_px), box_size(found.left.box_xywh_px)
    most = _most_change_px(size_px) / size_px
    # Disparity grows in proportion to size, but a badly calibrated rig adds some pixels to it.
    return (
        abs(now.rows - before.rows) < most
        and abs(now.disparity - before.disparity) < most
        and abs(now.log_scale - before.log_scale) < _MOST_SIZE_CHANGE
    )


def _other_box(seen: Box, apart: _Apart, lost: Eye) -> Box:
    """Where one eye must see what the other one does."""
    scale = float(np.exp(apart.log_scale if lost == "right" else -apart.log_scale))
    shift = np.array([-apart.disparity, apart.rows])
    left_size = box_size(seen) * (1.0 if lost == "right" else scale)
    center = box_center(seen) + (shift if lost == "right" else -shift) * left_size
    return moved(seen, center, scale)
