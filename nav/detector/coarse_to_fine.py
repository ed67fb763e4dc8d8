"""Detection from coarse to fine: small candidates are looked at again, at twice the scale, in windows around them.

A drogue that is few cells of the network wide is rarely certain, and a wheel or an intake looks like one there. An
input of twice the size tells them apart, but takes four times as long, most of it for sky and land. The windows show
the same pixels where there is something to see. Near drogues need none: they are large enough in the first pass.

The idea is that of AutoFocus (Najibi, Singh, Davis 2019, doi:10.1109/ICCV.2019.00984), here without training for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geometry.boxes import intersection_area
from geometry.se3 import Array
from nav.detector.multiscale_inference import ScoredBoxes
from nav.detector.output_maps import decode_maps, non_maximum_suppression

FINE_SCALE = 2
"""Pixels of the fine image per pixel of the network's input, along each axis."""

WINDOW_PX = 192
"""Width and height of a window in the fine image: room for a small drogue, and a multiple of 32. [px]"""

LARGEST_SMALL_PX = WINDOW_PX // FINE_SCALE
"""Largest side in the input of what a window can show. [px]"""

LEAST_CANDIDATE = 0.1
"""Score from which a box of the first pass is looked at again."""

# A box of the first pass from this score on is certain enough, where the network's threshold is not higher still.
_CERTAIN = 0.7
# Largest number of windows for an image.
_MOST_WINDOWS = 2
# A window shows a box of the first pass whole where its sides, which are right to a few pixels, are this far from the
# window's edge. A box in the window counts where its middle is this far from the edge, which cuts too much off others.
# Neither holds at the image's own edge. [px of the fine image]
_WHOLE_FROM_PX, _COUNTS_FROM_PX = 4.0, 14.0
# A box in a window may be this much larger than what is looked at again: the first pass measures small boxes roughly.
_SIZE_FACTOR = 1.25
# A box this many times smaller than a certain one, of which more than a half lies in that, is a part of that drogue.
_PART_FACTOR, _MAX_INSIDE = 2.0, 0.5


@dataclass(frozen=True)
class SecondLook:
    """Which boxes of a first pass are looked at again.

    Attributes:
        fine_size_px: width and height of the images at `FINE_SCALE` times the size of the input. [px]
        small_below_px: a box of the first pass whose longer side is below this is small. [px]
        score_threshold: from which a large box is certain to be a drogue.
    """

    fine_size_px: tuple[int, int]
    small_below_px: float
    score_threshold: float

    @property
    def certain_from(self) -> float:
        """Score from which a small box is certain to be a drogue."""
        return max(_CERTAIN, self.score_threshold)


def detect_again(
    coarse: Sequence[ScoredBoxes],
    fine_images: Sequence[Callable[[], NDArray[np.uint8]]],
    run: Callable[[Sequence[NDArray[np.uint8]]], Sequence[NDArray[Any]]],
    look: SecondLook,
    least_score: float,
    max_boxes: int,
) -> list[ScoredBoxes]:
    """Replace the small boxes of a first pass by those that windows at twice the scale show in their places.

    Args:
        coarse: boxes and scores of each image from `LEAST_CANDIDATE` on, in corner coordinates of the network's input.
        fine_images: functions that return the same images at `FINE_SCALE` times the size of the input; called where
            there is something to look at.
        run: the network, from images of one size to output maps; see `nav.detector.output_maps`.
        look: which boxes are looked at again.
        least_score: boxes with a lower score are left out.
        max_boxes: largest number of boxes of an image.

    Returns:
        Boxes and scores of each image, the best first, in corner coordinates of the network's input.
    """
    corners = [window_corners(*found, look) for found in coarse]
    windows = [
        fine[top : top + WINDOW_PX, left : left + WINDOW_PX]
        for fine_image, some in zip(fine_images, corners, strict=True)
        if some
        for fine in (fine_image(),)
        for left, top in some
    ]
    seen = iter(decode_maps(run(windows), least_score) if windows else ())
    return [
        _first(_replaced(found, [(*next(seen), corner) for corner in some], look), least_score, max_boxes)
        for found, some in zip(coarse, corners, strict=True)
    ]


def window_corners(boxes: Array, scores: Array, look: SecondLook) -> list[tuple[int, int]]:
    """Left and top sides of the windows in the fine image, around the best small boxes of a first pass. [px]

    Args:
        boxes: (n, 4) in corner coordinates of the network's input, the best first. [px]
        scores: (n,).
        look: which boxes are looked at again.
    """
    width, height = look.fine_size_px
    if min(width, height) < WINDOW_PX:
        return []
    stays = _are_certain(boxes, scores, look)
    wanted = (scores >= LEAST_CANDIDATE) & (scores < look.certain_from) & (_sizes(boxes) < look.small_below_px)
    wanted &= ~_are_parts(boxes, boxes[stays])
    corners: list[tuple[int, int]] = []
    for x, y, box_width, box_height in boxes[wanted]:
        left, top = (
            int(np.clip(round(FINE_SCALE * middle - WINDOW_PX / 2), 0, size - WINDOW_PX))
            for middle, size in ((x + box_width / 2, width), (y + box_height / 2, height))
        )
        box = np.array([[x, y, box_width, box_height]])
        if not any(_are_whole(box, corner, look.fine_size_px).all() for corner in corners):
            corners.append((left, top))
        if len(corners) == _MOST_WINDOWS:
            break
    return corners


def _replaced(
    coarse: ScoredBoxes,
    windows: Sequence[tuple[Array, Array, tuple[int, int]]],
    look: SecondLook,
) -> ScoredBoxes:
    """Boxes of windows, and those of the first pass that no window shows whole, in no order."""
    boxes, scores = coarse
    certain = boxes[_are_certain(boxes, scores, look)]
    is_uncertain = (_sizes(boxes) < look.small_below_px) & (scores < look.certain_from)
    stays = np.ones(len(boxes), dtype=bool)
    found: list[ScoredBoxes] = []
    for window_boxes, window_scores, corner in windows:
        stays &= ~(is_uncertain & _are_whole(boxes, corner, look.fine_size_px))
        moved = (window_boxes + np.array([*corner, 0, 0])) / FINE_SCALE
        low_px, high_px = _limits_px(corner, look.fine_size_px, _COUNTS_FROM_PX)
        middles_px = FINE_SCALE * (moved[:, :2] + moved[:, 2:] / 2)
        kept = ((middles_px > low_px) & (middles_px < high_px)).all(axis=1) & ~_are_parts(moved, certain)
        kept &= _sizes(moved) < _SIZE_FACTOR * look.small_below_px
        found.append((moved[kept], window_scores[kept]))
    every = [*found, (boxes[stays], scores[stays])]
    all_boxes, all_scores = (np.concatenate(parts) for parts in zip(*every, strict=True))
    return all_boxes, all_scores


def _first(found: ScoredBoxes, least_score: float, max_boxes: int) -> ScoredBoxes:
    """The best boxes after non-maximum suppression."""
    boxes, scores = found
    order = np.argsort(-scores, kind="stable")
    order = order[scores[order] >= least_score]
    best = order[non_maximum_suppression(boxes[order], max_boxes)]
    return boxes[best], scores[best]


def _sizes(boxes: Array) -> Array:
    """(n,) longer sides. [px]"""
    sizes: Array = boxes[:, 2:].max(axis=1, initial=0)
    return sizes


def _limits_px(corner: tuple[int, int], fine_size_px: tuple[int, int], margin_px: float) -> tuple[Array, Array]:
    """(2,) low and high limits of a window in the fine image, less a margin, and none at the image's own edge. [px]"""
    low = [side + margin_px if side > 0 else -np.inf for side in corner]
    high = [
        side + WINDOW_PX - margin_px if side + WINDOW_PX < size else np.inf
        for side, size in zip(corner, fine_size_px, strict=True)
    ]
    return np.array(low), np.array(high)


def _are_whole(boxes: Array, corner: tuple[int, int], fine_size_px: tuple[int, int]) -> NDArray[np.bool_]:
    """(n,) whether a window shows boxes whole, as far as the image does."""
    low_px, high_px = _limits_px(corner, fine_size_px, _WHOLE_FROM_PX)
    low, high = FINE_SCALE * boxes[:, :2], FINE_SCALE * (boxes[:, :2] + boxes[:, 2:])
    whole: NDArray[np.bool_] = ((low >= low_px) & (high <= high_px)).all(axis=1)
    return whole


def _are_certain(boxes: Array, scores: Array, look: SecondLook) -> NDArray[np.bool_]:
    """(n,) whether boxes of the first pass are drogues that no window is needed for."""
    is_large = _sizes(boxes) >= look.small_below_px
    certain: NDArray[np.bool_] = (scores >= look.certain_from) | (is_large & (scores >= look.score_threshold))
    return certain


def _are_parts(boxes: Array, certain: Array) -> NDArray[np.bool_]:
    """(n,) whether boxes lie mostly within a certain and much larger one, as a hub or a marker lies in its drogue."""
    parts = np.zeros(len(boxes), dtype=bool)
    for whole in certain:
        inside = intersection_area(whole, boxes) > _MAX_INSIDE * boxes[:, 2:].prod(axis=1)
        parts |= inside & (_PART_FACTOR * _sizes(boxes) <= whole[2:].max())
    return parts
