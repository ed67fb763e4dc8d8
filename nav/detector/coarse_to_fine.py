"""Detection from coarse to fine: small candidates are looked at again, at twice the scale, in windows around them.

A drogue that is few cells of the network wide is rarely certain, and a wheel or an intake looks like one there. An
input of twice the size tells them apart, but takes four times as long, most of it for sky and land. The windows show
the same pixels where there is something to see. Near drogues need none: they are large enough in the first pass.

The idea is that of AutoFocus (Najibi, Singh, Davis 2019, doi:10.1109/ICCV.2019.00984), here without training for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
# Shares of a window's side: a box of the first pass is replaced where its middle is this far from the window's edge,
# and a box in the window counts where its middle is this far from it, since of others the edge cuts off too much.
_REPLACED_FROM, _COUNTS_FROM = 0.15, 0.075
# A box in a window may be this much larger than what is looked at again: the first pass measures small boxes roughly.
_SIZE_FACTOR = 1.25
# A box this many times smaller than a certain one, of which more than a half lies in that, is a part of that drogue.
_PART_FACTOR, _MAX_INSIDE = 2.0, 0.5


def detect_again(
    coarse: Sequence[ScoredBoxes],
    fine_images: Sequence[Callable[[], NDArray[np.uint8]]],
    fine_size_px: tuple[int, int],
    run: Callable[[Sequence[NDArray[np.uint8]]], Sequence[NDArray[Any]]],
    small_below_px: float,
    score_threshold: float,
    least_score: float,
    max_boxes: int,
) -> list[ScoredBoxes]:
    """Replace the small boxes of a first pass by those that windows at twice the scale show in their places.

    Args:
        coarse: boxes and scores of each image from `LEAST_CANDIDATE` on, in corner coordinates of the network's input.
        fine_images: functions that return the same images at `FINE_SCALE` times the size of the input; called where
            there is something to look at.
        fine_size_px: width and height of those. [px]
        run: the network, from images of one size to output maps; see `nav.detector.output_maps`.
        small_below_px: a box of the first pass whose longer side is below this is small. [px]
        score_threshold: from which a large box is certain to be a drogue.
        least_score: boxes with a lower score are left out.
        max_boxes: largest number of boxes of an image.

    Returns:
        Boxes and scores of each image, the best first, in corner coordinates of the network's input.
    """
    corners = [window_corners(*found, fine_size_px, small_below_px, score_threshold) for found in coarse]
    windows = [
        fine[top : top + WINDOW_PX, left : left + WINDOW_PX]
        for fine_image, some in zip(fine_images, corners, strict=True)
        if some
        for fine in (fine_image(),)
        for left, top in some
    ]
    seen = iter(decode_maps(run(windows), least_score) if windows else ())
    return [
        _merged(
            found, [(*next(seen), corner) for corner in some], small_below_px, score_threshold, least_score, max_boxes
        )
        for found, some in zip(coarse, corners, strict=True)
    ]


def window_corners(
    boxes: Array, scores: Array, fine_size_px: tuple[int, int], small_below_px: float, score_threshold: float
) -> list[tuple[int, int]]:
    """Left and top sides of the windows in the fine image, around the best small boxes of a first pass. [px]

    Args:
        boxes: (n, 4) in corner coordinates of the network's input, the best first. [px]
        scores: (n,).
        fine_size_px: width and height of the fine image. [px]
        small_below_px: a box whose longer side is below this is small. [px]
        score_threshold: from which a large box is certain to be a drogue.
    """
    width, height = fine_size_px
    if min(width, height) < WINDOW_PX:
        return []
    stays = _are_certain(boxes, scores, small_below_px, score_threshold)
    wanted = (scores >= LEAST_CANDIDATE) & (scores < max(_CERTAIN, score_threshold)) & (_sizes(boxes) < small_below_px)
    wanted &= ~_are_parts(boxes, boxes[stays])
    corners: list[tuple[int, int]] = []
    for x, y, box_width, box_height in boxes[wanted]:
        left, top = (
            int(np.clip(round(FINE_SCALE * middle - WINDOW_PX / 2), 0, size - WINDOW_PX))
            for middle, size in ((x + box_width / 2, width), (y + box_height / 2, height))
        )
        # A window that shows the box in its middle half will do for it too.
        if all(max(abs(left - one), abs(top - other)) >= WINDOW_PX / 4 for one, other in corners):
            corners.append((left, top))
        if len(corners) == _MOST_WINDOWS:
            break
    return corners


def _merged(
    coarse: ScoredBoxes,
    windows: Sequence[tuple[Array, Array, tuple[int, int]]],
    small_below_px: float,
    score_threshold: float,
    least_score: float,
    max_boxes: int,
) -> ScoredBoxes:
    """Boxes of windows, and those of the first pass that no window replaces, after non-maximum suppression."""
    boxes, scores = coarse
    certain = boxes[_are_certain(boxes, scores, small_below_px, score_threshold)]
    is_uncertain = (_sizes(boxes) < small_below_px) & (scores < max(_CERTAIN, score_threshold))
    replaced = np.zeros(len(boxes), dtype=bool)
    found: list[ScoredBoxes] = []
    for window_boxes, window_scores, corner in windows:
        replaced |= is_uncertain & _are_within(boxes, corner, _REPLACED_FROM)
        moved = (window_boxes + np.array([*corner, 0, 0])) / FINE_SCALE
        kept = (_sizes(moved) < _SIZE_FACTOR * small_below_px) & _are_within(moved, corner, _COUNTS_FROM)
        kept &= ~_are_parts(moved, certain)
        found.append((moved[kept], window_scores[kept]))
    stays = ~replaced & (scores >= least_score)
    every = [*found, (boxes[stays], scores[stays])]
    merged, merged_scores = (np.concatenate(parts) for parts in zip(*every, strict=True))
    order = np.argsort(-merged_scores, kind="stable")
    merged, merged_scores = merged[order], merged_scores[order]
    best = non_maximum_suppression(merged, max_boxes)
    return merged[best], merged_scores[best]


def _sizes(boxes: Array) -> Array:
    """(n,) longer sides. [px]"""
    sizes: Array = boxes[:, 2:].max(axis=1, initial=0)
    return sizes


def _are_within(boxes: Array, corner: tuple[int, int], margin: float) -> NDArray[np.bool_]:
    """(n,) whether the middles of boxes lie in a window, farther from its edge than a share of its side."""
    from_corner = FINE_SCALE * (boxes[:, :2] + boxes[:, 2:] / 2) - corner
    within: NDArray[np.bool_] = (np.abs(from_corner - WINDOW_PX / 2) < (0.5 - margin) * WINDOW_PX).all(axis=1)
    return within


def _are_certain(boxes: Array, scores: Array, small_below_px: float, score_threshold: float) -> NDArray[np.bool_]:
    """(n,) whether boxes of the first pass are drogues that no window is needed for."""
    is_large = _sizes(boxes) >= small_below_px
    is_sure = scores >= max(_CERTAIN, score_threshold)
    certain: NDArray[np.bool_] = is_sure | (is_large & (scores >= score_threshold))
    return certain


def _are_parts(boxes: Array, certain: Array) -> NDArray[np.bool_]:
    """(n,) whether boxes lie mostly within a certain and much larger one, as a hub or a marker lies in its drogue."""
    parts = np.zeros(len(boxes), dtype=bool)
    for whole in certain:
        inside = intersection_area(whole, boxes) > _MAX_INSIDE * boxes[:, 2:].prod(axis=1)
        parts |= inside & (_PART_FACTOR * _sizes(boxes) <= whole[2:].max())
    return parts
