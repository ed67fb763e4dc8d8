"""Tracker `mil`: OpenCV's MIL tracker as a baseline, which keeps the box's size and does not detect loss.

Babenko et al., "Robust object tracking with online multiple instance learning", doi:10.1109/TPAMI.2010.226.
"""

from __future__ import annotations

import ctypes

import cv2
import numpy as np

from geometry.se3 import Array
from nav.detector.detector import Detection
from nav.tracking.appearance_model import LEAST_CORRELATION, AppearanceModel
from nav.tracking.region import Box, EyeImage, ImageRegion, box_center, box_from_center, box_size, image_region

# Arbitrary. With any seed MIL immediately loses one in ten of the boxes that reach over the image's edge; which ones
# depends on the seed.
_SEED = 5
# The box is resampled to at most this many pixels across it, never enlarged.
_GRID = 64
# Search radius on that grid, OpenCV's default; the cost grows with its square.
_SEARCH = 25
# OpenCV's feature sampler never ends in a box of 4 px, and finds no background beside a box that fills the image.
_LEAST_SIDE, _LEAST_ROOM = 8, 8
# A correction that changes the size by more than this restarts MIL, which cannot change its size.
_SAME_LOG_SCALE = 0.1
# MIL answers in whole pixels of the grid: a correction by less than this many pixels is ignored.
_SAME_CENTER = 2.0


class MilEyeTracker:
    """One eye of the tracker `mil`; loss is detected by `nav.tracking.appearance_model`."""

    _box: Box
    _step_px: float
    _appearance: AppearanceModel
    # None for a box that MIL cannot be started with.
    _mil: cv2.TrackerMIL | None
    # From the centre of the part of the box on the image, which MIL follows, to the centre of the box. [px]
    _offset_px: Array
    _is_lost: bool
    # MIL learns at every update, so it is updated once per image and its answer kept here.
    _answers: list[Detection | None]

    def __init__(self, image: EyeImage, box: Box) -> None:
        self._restart(image, box)

    def locate(self, image: EyeImage, predicted: Box | None, sd_px: float | None) -> Detection | None:
        """See `EyeTracker`. MIL searches about its own last position and ignores predictions."""
        if not self._answers:
            self._answers.append(self._track(image))
        return self._answers[0]

    def learn(self, image: EyeImage, found: Detection | None) -> None:
        """See `EyeTracker`."""
        self._is_lost, self._answers = found is None, []
        if found is not None:
            self._box = found.box_xywh_px
            self._appearance.learn(image, self._box)

    def correct(self, image: EyeImage, box: Box) -> None:
        """See `EyeTracker`; restarts MIL after a loss, since its own position is then unknown."""
        distance = np.linalg.norm(box_center(box) - box_center(self._box)) / self._step_px
        differs = distance > _SAME_CENTER or abs(np.log(box_size(box) / box_size(self._box))) > _SAME_LOG_SCALE
        if differs or self._is_lost:
            self._restart(image, box)

    def _track(self, image: EyeImage) -> Detection | None:
        if self._mil is None:
            return None
        region = self._resampled(image)
        _seed_generators()
        found, answer = self._mil.update(region.pixels)
        if not found:
            return None
        x, y, width, height = answer
        center = region.to_image(np.array([x + (width - 1) / 2, y + (height - 1) / 2]))
        box = box_from_center(center + self._offset_px, self._box[2], self._box[3])
        correlation = self._appearance.correlation(image, box)
        return None if correlation < LEAST_CORRELATION else Detection(box, min(correlation, 1.0))

    def _restart(self, image: EyeImage, box: Box) -> None:
        self._box, self._is_lost, self._answers = box, False, []
        self._step_px = max(1.0, box_size(box) / _GRID)
        self._appearance = AppearanceModel(image, box)
        region = self._resampled(image)
        # The part of the box that lies on the image.
        low = np.round(region.to_grid(np.array(box[:2]) + 0.5 * region.step_px)).astype(int)
        high = np.minimum(low + np.round(np.array(box[2:]) / region.step_px).astype(int), region.size)
        low = np.maximum(low, 0)
        size = high - low
        self._offset_px = box_center(box) - region.to_image(low + (size - 1) / 2)
        self._mil = None
        if size.min() >= _LEAST_SIDE and (np.array(region.size) - size).min() >= _LEAST_ROOM:
            settings = cv2.TrackerMIL.Params()
            settings.samplerSearchWinSize = _SEARCH
            _seed_generators()
            self._mil = cv2.TrackerMIL.create(settings)
            self._mil.init(region.pixels, (int(low[0]), int(low[1]), int(size[0]), int(size[1])))

    def _resampled(self, image: EyeImage) -> ImageRegion:
        """The whole image on MIL's grid, in whose coordinates MIL keeps its state."""
        height, width = image.pixels.shape[:2]
        region = image_region(image, (-0.5, -0.5, float(width), float(height)), self._step_px)
        assert region is not None
        # MIL works on grey, and accepts only one channel or three.
        return ImageRegion(region.grey(), region.origin_px, region.step_px)


def _seed_generators() -> None:
    """Seed the generators of MIL's features and samples, so that results do not depend on what ran before.

    These are OpenCV's and the C library's, both global to the process; nothing else here uses either.
    """
    cv2.setRNGSeed(_SEED)
    ctypes.CDLL(None).srand(_SEED)
