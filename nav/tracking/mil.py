"""OpenCV's MIL tracker as a baseline: it keeps the box's size, and does not say that it lost its object.

Babenko et al., "Robust object tracking with online multiple instance learning", doi:10.1109/TPAMI.2010.226.
"""

from __future__ import annotations

import ctypes

import cv2
import numpy as np

from geometry.se3 import Array
from nav.detector.detector import Detection
from nav.tracking.appearance_model import ALIKE, Likeness
from nav.tracking.region import Box, EyeImage, ImageRegion, box_around, box_center, box_size, image_region

# Any will do. With each of them MIL loses at once one in ten of the boxes that reach over an image's edge; which ones
# changes with the seed.
_SEED = 5
# The box is looked at with so many pixels across it, not enlarged.
_GRID = 64
# How far it searches about the last place, on that grid; OpenCV's own choice, whose square is its cost.
_SEARCH = 25
# OpenCV's feature sampler never ends in a box of 4 px, and finds no places beside a box that fills the image.
_LEAST_SIDE, _LEAST_ROOM = 8, 8
# A better box of another size than this begins anew, for it cannot change its own.
_SAME_LOG_SCALE = 0.1
# Its answers are whole pixels of the grid: a box this near, in its pixels, tells it nothing.
_SAME_PLACE = 2.0


class MilEyeTracker:
    """One eye of the tracker `mil`; what tells whether the drogue is still there is `nav.tracking.appearance_model`."""

    _box: Box
    _step_px: float
    _likeness: Likeness
    # None for a box that it cannot be started with.
    _mil: cv2.TrackerMIL | None
    # From the middle of what it follows, which must lie on the image, to the middle of the box. [px]
    _offset_px: Array
    _is_lost: bool
    # MIL learns from whatever it looks at, so it looks once at an image; then its answer is here.
    _answers: list[Detection | None]

    def __init__(self, image: EyeImage, box: Box) -> None:
        self._restart(image, box)

    def look(self, image: EyeImage, predicted: Box | None, sd_px: float | None) -> Detection | None:
        """See `EyeTracker`. MIL looks about its own last place, whatever is predicted."""
        if not self._answers:
            self._answers.append(self._found(image))
        return self._answers[0]

    def learn(self, image: EyeImage, found: Detection | None) -> None:
        """See `EyeTracker`."""
        self._is_lost, self._answers = found is None, []
        if found is not None:
            self._box = found.box_xywh_px
            self._likeness.learn(image, self._box)

    def correct(self, image: EyeImage, box: Box) -> None:
        """See `EyeTracker`; where MIL itself is, once it is lost, nobody knows."""
        off = np.linalg.norm(box_center(box) - box_center(self._box)) / self._step_px
        is_other = off > _SAME_PLACE or abs(np.log(box_size(box) / box_size(self._box))) > _SAME_LOG_SCALE
        if is_other or self._is_lost:
            self._restart(image, box)

    def _found(self, image: EyeImage) -> Detection | None:
        if self._mil is None:
            return None
        region = self._whole(image)
        _begin_draws()
        found, answer = self._mil.update(region.pixels)
        if not found:
            return None
        x, y, width, height = answer
        center = region.image(np.array([x + (width - 1) / 2, y + (height - 1) / 2]))
        box = box_around(center + self._offset_px, self._box[2], self._box[3])
        likeness = self._likeness.of(image, box)
        return None if likeness < ALIKE else Detection(box, min(likeness, 1.0))

    def _restart(self, image: EyeImage, box: Box) -> None:
        self._box, self._is_lost, self._answers = box, False, []
        self._step_px = max(1.0, box_size(box) / _GRID)
        self._likeness = Likeness(image, box)
        region = self._whole(image)
        # The part of the box that lies on the image.
        low = np.round(region.grid(np.array(box[:2]) + 0.5 * region.step_px)).astype(int)
        high = np.minimum(low + np.round(np.array(box[2:]) / region.step_px).astype(int), region.size)
        low = np.maximum(low, 0)
        size = high - low
        self._offset_px = box_center(box) - region.image(low + (size - 1) / 2)
        self._mil = None
        if size.min() >= _LEAST_SIDE and (np.array(region.size) - size).min() >= _LEAST_ROOM:
            settings = cv2.TrackerMIL.Params()
            settings.samplerSearchWinSize = _SEARCH
            _begin_draws()
            self._mil = cv2.TrackerMIL.create(settings)
            self._mil.init(region.pixels, (int(low[0]), int(low[1]), int(size[0]), int(size[1])))

    def _whole(self, image: EyeImage) -> ImageRegion:
        """The whole image on the tracker's grid: its memory is in the coordinates of it."""
        height, width = image.pixels.shape[:2]
        region = image_region(image, (-0.5, -0.5, float(width), float(height)), self._step_px)
        assert region is not None
        # It works on grey, and takes nothing but three channels or one.
        return ImageRegion(region.grey(), region.origin_px, region.step_px)


def _begin_draws() -> None:
    """Let OpenCV draw the same features and samples whatever ran before.

    It takes them from its own generator and from the C library's, which both belong to the process; nothing else here
    draws from either.
    """
    cv2.setRNGSeed(_SEED)
    ctypes.CDLL(None).srand(_SEED)
