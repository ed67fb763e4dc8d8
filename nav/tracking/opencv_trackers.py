"""Baseline trackers on OpenCV: `flow`, the median flow of points, and `mil`, multiple-instance learning.

`flow` moves the box by the median shift and scale of the optical flow of points in it. Points are selected by their
forward-backward error (Kalal et al., "Forward-backward error", doi:10.1109/ICPR.2010.675); the flow is OpenCV's
pyramidal Lucas-Kanade. `mil` keeps the box's size and does not detect loss (Babenko et al., "Robust object tracking
with online multiple instance learning", doi:10.1109/TPAMI.2010.226).
"""

from __future__ import annotations

import ctypes
import threading

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.detector.detector import Detection
from nav.tracking.appearance_model import LEAST_CORRELATION, AppearanceModel
from nav.tracking.box_motion import BoxMotion
from nav.tracking.region import (
    Box,
    EyeImage,
    ImageRegion,
    box_center,
    box_from_center,
    box_size,
    expand_box,
    image_region,
    move_box,
)

# The box is resampled to at most this many pixels across it, never enlarged.
_GRID = 96
_MOST_POINTS = 80
_LEAST_POINTS = 6
_CORNER_QUALITY, _CORNER_GAP = 0.01, 3
_WINDOW, _LEVELS = (15, 15), 3
# Largest deviation of the drogue from its predicted motion between two images. [px]
_REACH_PX = 64.0
# Forward-backward error beyond which a point is lost, in pixels of the region.
_LARGEST_RETURN_ERROR = 1.0
_LARGEST_LOG_SCALE = 0.25
# All MIL trackers of a process share the samples that they compare, in OpenCV's `ClfMilBoost::update`, and the C
# library's generator.
_MIL_LOCK = threading.Lock()


class MedianFlowEyeTracker:
    """One eye of the tracker `flow`."""

    _image: EyeImage
    _box: Box
    _motion: BoxMotion
    _appearance: AppearanceModel

    def __init__(self, image: EyeImage, box: Box) -> None:
        self._restart(image, box)

    def locate(self, image: EyeImage, predicted: Box | None, sd_px: float | None) -> Detection | None:
        """See `EyeTracker`. Flow starts at the last image with the drogue, and has a fixed reach."""
        expected = self._motion.predict(image.time_s).box if predicted is None else predicted
        box = self._track_points(image, expected)
        if box is None:
            return None
        correlation = self._appearance.correlation(image, box)
        return None if correlation < LEAST_CORRELATION else Detection(box, min(correlation, 1.0))

    def learn(self, image: EyeImage, found: Detection | None) -> None:
        """See `EyeTracker`."""
        if found is not None:
            self._update(image, found.box_xywh_px)

    def correct(self, image: EyeImage, box: Box) -> None:
        """See `EyeTracker`."""
        if self._appearance.correlation(image, box) < LEAST_CORRELATION:
            self._restart(image, box)
        else:
            self._update(image, box)

    def _update(self, image: EyeImage, box: Box) -> None:
        self._image, self._box = image, box
        self._motion.update(box, image.time_s)
        self._appearance.learn(image, box)

    def _restart(self, image: EyeImage, box: Box) -> None:
        self._image, self._box = image, box
        self._motion = BoxMotion(box, image.time_s)
        self._appearance = AppearanceModel(image, box)

    def _track_points(self, image: EyeImage, expected: Box) -> Box | None:
        """The last box, shifted and scaled by the flow of its points; None with too few points."""
        step_px = max(1.0, box_size(self._box) / _GRID)
        center, shift = box_center(self._box), box_center(expected) - box_center(self._box)
        window = expand_box(self._box, _REACH_PX, _REACH_PX)
        last = image_region(self._image, window, step_px)
        current = image_region(image, move_box(window, center + shift, 1.0), step_px)
        if last is None or current is None or min(*last.size, *current.size) < _WINDOW[0]:
            return None
        start = _corners(last.grey(), last.to_grid(np.array([self._box[:2], np.add(self._box[:2], self._box[2:])])))
        if len(start) < _LEAST_POINTS:
            return None
        guess = current.to_grid(last.to_image(start) + shift)
        # The windows differ in size where the image's edge cuts one of them.
        size = (max(last.size[0], current.size[0]), max(last.size[1], current.size[1]))
        first, second = _padded(last.grey(), size), _padded(current.grey(), size)
        end, kept = _flow(first, second, start, guess)
        if len(end) < _LEAST_POINTS:
            return None
        return _box_from_flow(self._box, last.to_image(start[kept]), current.to_image(end))


def _corners(grey: NDArray[np.uint8], corners: Array) -> Array:
    """(P, 2) points inside the box (low corner, high corner) with enough texture for optical flow."""
    mask = np.zeros_like(grey)
    middle, half = corners.mean(axis=0), (corners[1] - corners[0]) / 2
    center, axes = (
        tuple(np.round(middle).astype(int).tolist()),
        tuple(np.maximum(np.round(half), 1).astype(int).tolist()),
    )
    cv2.ellipse(mask, center, axes, 0, 0, 360, 255, -1)
    found = cv2.goodFeaturesToTrack(grey, _MOST_POINTS, _CORNER_QUALITY, _CORNER_GAP, mask=mask)
    return np.zeros((0, 2)) if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 2)


def _flow(
    first: NDArray[np.uint8], second: NDArray[np.uint8], start: Array, guess: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """(K, 2) end points, and (P,) which start points could be followed forward and backward."""
    initial_guess, start32 = (guess.astype(np.float32)[:, None], start.astype(np.float32)[:, None])
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    end, seen, _ = cv2.calcOpticalFlowPyrLK(
        first, second, start32, initial_guess.copy(), winSize=_WINDOW, maxLevel=_LEVELS, flags=flags
    )
    returned, seen_returned, _ = cv2.calcOpticalFlowPyrLK(
        second, first, end, start32.copy(), winSize=_WINDOW, maxLevel=_LEVELS, flags=flags
    )
    error = np.linalg.norm(returned - start32, axis=2).ravel()
    followed = (seen.ravel() > 0) & (seen_returned.ravel() > 0)
    limit = min(_LARGEST_RETURN_ERROR, float(np.median(error[followed]))) if followed.any() else 0.0
    kept = followed & (error <= limit)
    return end[kept, 0].astype(np.float64), kept


def _box_from_flow(box: Box, start: Array, end: Array) -> Box:
    """The box, shifted by the median shift of its points and scaled by the median change of their distances."""
    rows, columns = np.triu_indices(len(start), 1)
    before = np.linalg.norm(start[rows] - start[columns], axis=1)
    after = np.linalg.norm(end[rows] - end[columns], axis=1)
    log_scale = float(np.median(np.log(np.maximum(after, 1e-3) / np.maximum(before, 1e-3))))
    scale = float(np.exp(np.clip(log_scale, -_LARGEST_LOG_SCALE, _LARGEST_LOG_SCALE)))
    # Scaling moves the points about the box's centre; what remains is the shift.
    last_center = box_center(box)
    center = last_center + np.median(end - (last_center + scale * (start - last_center)), axis=0)
    return move_box(box, center, scale)


def _padded(grey: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    below, beside = size[1] - grey.shape[0], size[0] - grey.shape[1]
    return np.asarray(cv2.copyMakeBorder(grey, 0, below, 0, beside, cv2.BORDER_REPLICATE), dtype=np.uint8)


# Arbitrary. With any seed MIL immediately loses one in ten of the boxes that reach over the image's edge; which ones
# depends on the seed.
_SEED = 5
# The box is resampled to at most this many pixels across it, never enlarged.
_MIL_GRID = 64
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
        with _MIL_LOCK:
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
        self._step_px = max(1.0, box_size(box) / _MIL_GRID)
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
            self._mil = cv2.TrackerMIL.create(settings)
            with _MIL_LOCK:
                _seed_generators()
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

    These are OpenCV's of this thread and the C library's of the process; nothing else here uses either.
    """
    cv2.setRNGSeed(_SEED)
    ctypes.CDLL(None).srand(_SEED)
