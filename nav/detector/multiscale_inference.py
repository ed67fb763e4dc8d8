"""Inference at several scales: large drogues from passes at half the size, all others from the pass at full size.

A drogue that is nearer than in most training images is larger than the network has learned to detect. At half the size
it is as large as those that the network detects best. In an image that is larger than those of the training, the
largest drogues come from a quarter of the size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.detector.input_image import Letterbox, letterbox_image
from nav.detector.output_maps import SIZE_STEP_PX, decode_maps, non_maximum_suppression

ScoredBoxes = tuple[Array, Array]
"""(n, 4) boxes x, y, width, height in corner coordinates of the input [px], and (n,) scores, the best first."""

# Near the limit the boxes of both passes count, so that no drogue is lost between them.
_SHARED_FACTOR = 1.25
_ALL_BOXES = 10_000  # of a smaller pass, before it is merged
# A box of which more than this lies in a large drogue's box is a part of that drogue, such as a marker.
_MAX_INSIDE = 0.5


def half_size_px(input_size_px: tuple[int, int]) -> tuple[int, int]:
    """Half of a width and height, rounded up to a size that networks accept."""
    width, height = (-(-side // (2 * SIZE_STEP_PX)) * SIZE_STEP_PX for side in input_size_px)
    return width, height


def pass_sizes(input_size_px: tuple[int, int], trained_size_px: tuple[int, int]) -> tuple[tuple[int, int], ...]:
    """Widths and heights of all passes: half of each other, down to half the size of the training or just below.

    Args:
        input_size_px: width and height of the first pass.
        trained_size_px: of the images that the network has learned from.
    """
    sizes = [input_size_px]
    while len(sizes) == 1 or max(sizes[-1]) > max(trained_size_px) / 2 + SIZE_STEP_PX:
        sizes.append(half_size_px(sizes[-1]))
    return tuple(sizes)


def detect_multiscale(
    images: Sequence[NDArray[np.uint8]],
    run: Callable[[Sequence[NDArray[np.uint8]]], Sequence[NDArray[Any]]],
    large_from_px: float,
    least_score: float,
    max_boxes: int,
    passes: int = 2,
) -> list[ScoredBoxes]:
    """Detect drogues in images of one size, with passes at half the size where they are asked for.

    Args:
        images: (H, W, 3) each, from `nav.detector.input_image`.
        run: the network, from images of one size to output maps; see `nav.detector.output_maps`.
        large_from_px: see `merge_scales`; 0 for a single pass.
        least_score: boxes with a lower score are left out.
        max_boxes: largest number of boxes of an image.
        passes: number of passes, each at half the size of the one before.
    """
    full = decode_maps(run(images), least_score)
    if large_from_px == 0 or passes == 1:
        return [(boxes[:max_boxes], scores[:max_boxes]) for boxes, scores in full]
    height, width = images[0].shape[:2]
    halves, placements = zip(*(letterbox_image(each, half_size_px((width, height))) for each in images), strict=True)
    smaller = detect_multiscale(halves, run, large_from_px, least_score, _ALL_BOXES, passes - 1)
    half = map(to_full_size, smaller, placements)
    return [merge_scales(*both, large_from_px, max_boxes) for both in zip(full, half, strict=True)]


def to_full_size(found: ScoredBoxes, placement: Letterbox) -> ScoredBoxes:
    """Map boxes found in a reduced image to corner coordinates of the full-size one."""
    boxes, scores = found
    # From pixel-centre to corner coordinates.
    return placement.to_image(boxes) + np.array([0.5, 0.5, 0.0, 0.0]), scores


def merge_scales(full: ScoredBoxes, half: ScoredBoxes, large_from_px: float, max_boxes: int) -> ScoredBoxes:
    """Merge the boxes of both passes: large ones from the half-size pass, others from the full-size pass, after NMS.

    Args:
        full, half: boxes of the two passes, both in coordinates of the full size.
        large_from_px: a box whose longer side is at least this is large.
        max_boxes: largest number of boxes.
    """
    small = full[0][:, 2:].max(axis=1, initial=0) < large_from_px * _SHARED_FACTOR
    large = half[0][:, 2:].max(axis=1, initial=0) >= large_from_px / _SHARED_FACTOR
    boxes = np.concatenate([half[0][large], full[0][small]])
    scores = np.concatenate([half[1][large], full[1][small]])
    is_large = np.arange(len(boxes)) < large.sum()
    order = np.argsort(-scores, kind="stable")
    boxes, scores, is_large = boxes[order], scores[order], is_large[order]
    whole = ~_is_part(boxes, is_large)
    boxes, scores = boxes[whole], scores[whole]
    kept = non_maximum_suppression(boxes, max_boxes)
    return boxes[kept], scores[kept]


def _is_part(boxes: Array, is_large: Array) -> Array:
    """(n,) whether each box, best first, lies mostly within a large box with a better score."""
    low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
    sides = np.maximum(np.minimum(high[:, None], high) - np.maximum(low[:, None], low), 0)
    inside = sides.prod(axis=2) > _MAX_INSIDE * boxes[:, 2:].prod(axis=1)[:, None]
    is_part: Array = np.tril(inside & is_large, k=-1).any(axis=1)
    return is_part
