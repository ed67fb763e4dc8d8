"""Plain shapes painted on training images: occluders before the drogue, and round or red things that are none."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from nav.training.image_views import Boxes, Image

_OCCLUDED_FRACTION = 0.12  # share of the drogues
_MOST_HIDDEN = 0.45  # of a drogue's ellipse; an occluder with which more of any is hidden is not painted
_DISTRACTED_FRACTION = 0.3  # share of the canvases
_MOST_DISTRACTORS = 3
_DISTRACTOR_SIZE = (0.02, 0.25)  # of the canvas's height
# Red and orange (paint, lamps), white, dark: the colours of drogues, markers, pods and probes.
_COLORS = ((200, 30, 30), (225, 95, 35), (150, 20, 30), (235, 235, 235), (35, 35, 38), (120, 122, 125))
_COLOR_SPREAD = 20


def occlude(rng: np.random.Generator, image: Image, boxes: Boxes) -> Boxes:
    """Paint a bar or a polygon before some of the drogues.

    Args:
        rng: the stream.
        image: (H, W, 3), changed in place.
        boxes: (n, 4) of the drogues on it.

    Returns:
        (n, 4) the boxes of what remains visible.
    """
    remaining = boxes.copy()
    hidden = np.zeros(image.shape[:2], dtype=np.uint8)
    for box in boxes:
        # All draws are made for every box, so that what follows does not depend on what is painted.
        wanted, corners, color = rng.random() < _OCCLUDED_FRACTION, _sample_occluder(rng, box), _sample_color(rng)
        if not wanted:
            continue
        with_it = hidden.copy()
        cv2.fillConvexPoly(with_it, corners, 1)
        # It may stand before the others too, together with those painted before.
        left = [_visible_box(with_it, each) for each in boxes]
        visible = [each for each in left if each is not None]
        if len(visible) == len(boxes):
            image[with_it > hidden] = color
            hidden, remaining = with_it, np.array(visible)
    return remaining


def _sample_occluder(rng: np.random.Generator, box: NDArray[np.float64]) -> NDArray[np.int32]:
    """(4, 2) corners of a bar across the box, or of a shorter piece."""
    center, size = box[:2] + box[2:] * rng.uniform(0, 1, 2), float(box[2:].max())
    angle, width, length = rng.uniform(0, np.pi), size * rng.uniform(0.08, 0.5), size * rng.uniform(0.4, 3)
    along = np.array([np.cos(angle), np.sin(angle)]) * length / 2
    across = np.array([-np.sin(angle), np.cos(angle)]) * width / 2
    corners = [along + across, along - across, -along - across, -along + across]
    rounded: NDArray[np.int32] = np.rint(center + np.array(corners)).astype(np.int32)
    return rounded


def _sample_color(rng: np.random.Generator) -> NDArray[np.uint8]:
    color = np.array(_COLORS[rng.integers(len(_COLORS))]) * rng.uniform(0.4, 1.1)
    return np.clip(color + rng.uniform(-_COLOR_SPREAD, _COLOR_SPREAD, 3), 0, 255).astype(np.uint8)


def _visible_box(hidden: NDArray[np.uint8], box: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The box of what occluders leave of the ellipse in a box; None where that is too little."""
    low = np.floor(box[:2]).astype(int)
    high = np.minimum(np.ceil(box[:2] + box[2:]).astype(int), hidden.shape[::-1])
    y, x = np.mgrid[low[1] : high[1], low[0] : high[0]] + 0.5
    center, halves = box[:2] + box[2:] / 2, box[2:] / 2
    ellipse = ((x - center[0]) / halves[0]) ** 2 + ((y - center[1]) / halves[1]) ** 2 <= 1
    visible = ellipse & (hidden[low[1] : high[1], low[0] : high[0]] == 0)
    if visible.sum() < (1 - _MOST_HIDDEN) * ellipse.sum() or not visible.any():
        return None
    # What is hidden of rows and columns moves an edge; what is not leaves it where it was, between the pixels.
    edges = []
    for axis in (0, 1):
        before, after = np.flatnonzero(ellipse.any(axis=axis)), np.flatnonzero(visible.any(axis=axis))
        low_edge, high_edge = box[axis], box[axis] + box[2 + axis]
        edges.append(
            (
                low_edge if after[0] == before[0] else float(low[axis] + after[0]),
                high_edge if after[-1] == before[-1] else float(low[axis] + after[-1] + 1),
            )
        )
    (x_low, x_high), (y_low, y_high) = edges
    return np.array([x_low, y_low, x_high - x_low, y_high - y_low])


def distract(rng: np.random.Generator, image: Image, boxes: Boxes) -> None:
    """Paint discs, rings and bars beside the drogues, in their colours; they get no boxes."""
    if rng.random() >= _DISTRACTED_FRACTION:
        return
    height, width = image.shape[:2]
    for _ in range(int(rng.integers(1, _MOST_DISTRACTORS + 1))):
        size = float(np.exp(rng.uniform(*np.log(_DISTRACTOR_SIZE)))) * height
        center, axes = rng.uniform(0, (width, height)), size / 2 * rng.uniform(0.5, 1, 2)
        turn_deg, kind, color = rng.uniform(0, 180), rng.integers(3), _sample_color(rng).tolist()
        if _meets(center, size, boxes):
            continue
        at, halves = (round(center[0]), round(center[1])), (max(round(axes[0]), 1), max(round(axes[1]), 1))
        if kind == 0:
            cv2.ellipse(image, at, halves, turn_deg, 0, 360, color, -1, cv2.LINE_AA)
        elif kind == 1:
            cv2.ellipse(image, at, halves, turn_deg, 0, 360, color, max(round(size / 10), 1), cv2.LINE_AA)
        else:
            corners = cv2.boxPoints((center.tolist(), (2 * axes[0], axes[1] / 2), turn_deg))
            cv2.fillConvexPoly(image, np.rint(corners).astype(np.int32), color, cv2.LINE_AA)


def _meets(center: NDArray[np.float64], size: float, boxes: Boxes) -> bool:
    """Whether a shape would stand before, or touch, a drogue."""
    low, high = boxes[:, :2] - size, boxes[:, :2] + boxes[:, 2:] + size
    return bool(((center > low) & (center < high)).all(axis=1).any())
