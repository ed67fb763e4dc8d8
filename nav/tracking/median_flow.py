"""Follows the drogue by optical flow of points in its box: the median of their moves, and of their spreading.

Forward-backward errors sort the points (Kalal et al., "Forward-backward error", doi:10.1109/ICPR.2010.675); the flow is
OpenCV's pyramid of Lucas and Kanade.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.detector.detector import Detection
from nav.tracking.appearance_model import ALIKE, Likeness
from nav.tracking.box_motion import BoxMotion
from nav.tracking.region import Box, EyeImage, box_center, box_size, grown, image_region, moved

# The box is looked at with so many pixels across it, not enlarged.
_GRID = 96
_MOST_POINTS = 80
_LEAST_POINTS = 6
_CORNER_QUALITY, _CORNER_GAP = 0.01, 3
_WINDOW, _LEVELS = (15, 15), 3
# How far the drogue may move from one image to the next, beyond what its motion lets expect. [px]
_REACH_PX = 64.0
# Points that come back farther from where they began, on the region's grid, were lost on the way.
_MOST_BACK = 1.0
_LARGEST_LOG_SCALE = 0.25


class MedianFlowEyeTracker:
    """One eye of the tracker `flow`."""

    _image: EyeImage
    _box: Box
    _motion: BoxMotion
    _likeness: Likeness

    def __init__(self, image: EyeImage, box: Box) -> None:
        self._restart(image, box)

    def look(self, image: EyeImage, predicted: Box | None, sd_px: float | None) -> Detection | None:
        """See `EyeTracker`. The flow is from the last image with the drogue, and has its own reach."""
        expected = self._motion.expect(image.time_s).box if predicted is None else predicted
        box = self._flowed(image, expected)
        if box is None:
            return None
        likeness = self._likeness.of(image, box)
        return None if likeness < ALIKE else Detection(box, min(likeness, 1.0))

    def learn(self, image: EyeImage, found: Detection | None) -> None:
        """See `EyeTracker`."""
        if found is not None:
            self._go_on(image, found.box_xywh_px)

    def correct(self, image: EyeImage, box: Box) -> None:
        """See `EyeTracker`."""
        if self._likeness.of(image, box) < ALIKE:
            self._restart(image, box)
        else:
            self._go_on(image, box)

    def _go_on(self, image: EyeImage, box: Box) -> None:
        self._image, self._box = image, box
        self._motion.update(box, image.time_s)
        self._likeness.learn(image, box)

    def _restart(self, image: EyeImage, box: Box) -> None:
        self._image, self._box = image, box
        self._motion = BoxMotion(box, image.time_s)
        self._likeness = Likeness(image, box)

    def _flowed(self, image: EyeImage, expected: Box) -> Box | None:
        """The last box, moved and scaled as its points moved; None where too few of them can be followed."""
        step_px = max(1.0, box_size(self._box) / _GRID)
        middle, shift = box_center(self._box), box_center(expected) - box_center(self._box)
        window = grown(self._box, _REACH_PX, _REACH_PX)
        before = image_region(self._image, window, step_px)
        now = image_region(image, moved(window, middle + shift, 1.0), step_px)
        if before is None or now is None or min(*before.size, *now.size) < _WINDOW[0]:
            return None
        start = _corners(before.grey(), before.grid(np.array([self._box[:2], np.add(self._box[:2], self._box[2:])])))
        if len(start) < _LEAST_POINTS:
            return None
        guess = now.grid(before.image(start) + shift)
        # Where the image's edge cuts one window and not the other they are not of one size.
        size = (max(before.size[0], now.size[0]), max(before.size[1], now.size[1]))
        first, second = _padded(before.grey(), size), _padded(now.grey(), size)
        end, kept = _flow(first, second, start, guess)
        if len(end) < _LEAST_POINTS:
            return None
        return _carried(self._box, before.image(start[kept]), now.image(end))


def _corners(grey: NDArray[np.uint8], corners: Array) -> Array:
    """(P, 2) places inside the box (low corner, high corner) that flow can follow."""
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
    """(K, 2) where points came to, and (P,) which of them could be followed there and back."""
    there, back = (guess.astype(np.float32)[:, None], start.astype(np.float32)[:, None])
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    end, seen, _ = cv2.calcOpticalFlowPyrLK(
        first, second, back, there.copy(), winSize=_WINDOW, maxLevel=_LEVELS, flags=flags
    )
    again, seen_again, _ = cv2.calcOpticalFlowPyrLK(
        second, first, end, back.copy(), winSize=_WINDOW, maxLevel=_LEVELS, flags=flags
    )
    error = np.linalg.norm(again - back, axis=2).ravel()
    followed = (seen.ravel() > 0) & (seen_again.ravel() > 0)
    limit = min(_MOST_BACK, float(np.median(error[followed]))) if followed.any() else 0.0
    kept = followed & (error <= limit)
    return end[kept, 0].astype(np.float64), kept


def _carried(box: Box, start: Array, end: Array) -> Box:
    """The box moved by the median move of its points and scaled by the median change of their distances."""
    rows, columns = np.triu_indices(len(start), 1)
    before = np.linalg.norm(start[rows] - start[columns], axis=1)
    after = np.linalg.norm(end[rows] - end[columns], axis=1)
    log_scale = float(np.median(np.log(np.maximum(after, 1e-3) / np.maximum(before, 1e-3))))
    scale = float(np.exp(np.clip(log_scale, -_LARGEST_LOG_SCALE, _LARGEST_LOG_SCALE)))
    # Growth moves points away from the box's middle, not only the box.
    middle = box_center(box)
    center = middle + np.median(end - (middle + scale * (start - middle)), axis=0)
    return moved(box, center, scale)


def _padded(grey: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    below, beside = size[1] - grey.shape[0], size[0] - grey.shape[1]
    return np.asarray(cv2.copyMakeBorder(grey, 0, below, 0, beside, cv2.BORDER_REPLICATE), dtype=np.uint8)
