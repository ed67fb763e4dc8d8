"""Shapes painted on images of a training: occluders over drogues, and distractors beside them.

Boxes are (n, 4) x, y of the low corner, width, height, counted from the corner of the image. [px]
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from nav.training.augmentation import Boxes, Image

_OCCLUDED_FRACTION = 0.12  # of the drogues
_MAX_HIDDEN_FRACTION = 0.45  # of a drogue's ellipse; an occluder that would hide more of any drogue is not painted
_DISTRACTED_FRACTION = 0.3  # of the canvases
_MAX_DISTRACTORS = 3
# Discs within each other, seen along or beside their axis: wheels, roundels, nozzles and intakes of engines.
_NESTED_DISCS, _NESTED_SCALE, _NESTED_SHIFT = (2, 4), (0.35, 0.85), 0.5
_DISTRACTOR_SIZE = (0.02, 0.6)  # over the canvas's height
_RING_TUBE_FRACTION = (0.08, 0.3)  # radius of a ring's tube over the radius of the ring
_MIN_TUBE_PX = 0.5
_RING_AMBIENT_FRACTION = (0.2, 0.9)  # brightness of the side that faces away from the lamp, over that which faces it
# Red and orange (paint, lamps), white, dark: the colours of drogues, markers, pods and probes.
_COLORS = ((200, 30, 30), (225, 95, 35), (150, 20, 30), (235, 235, 235), (35, 35, 38), (120, 122, 125))
_COLOR_SPREAD = 20


def paint_occluders(rng: np.random.Generator, image: Image, boxes: Boxes) -> Boxes:
    """Paint a bar over some of the drogues, as an occluder.

    Args:
        rng: random stream.
        image: (H, W, 3), changed in place.
        boxes: (n, 4) of the drogues in it.

    Returns:
        (n, 4) boxes of the parts that remain visible.
    """
    remaining = boxes.copy()
    hidden = np.zeros(image.shape[:2], dtype=np.uint8)
    for box in boxes:
        # All draws are made for every box, so that later draws do not depend on what is painted.
        is_occluded, corners, color = rng.random() < _OCCLUDED_FRACTION, _sample_occluder(rng, box), _sample_color(rng)
        if not is_occluded:
            continue
        hidden_with = hidden.copy()
        cv2.fillConvexPoly(hidden_with, corners, 1)
        # It may also hide other drogues, together with the occluders painted so far.
        left = [_visible_box(hidden_with, each) for each in boxes]
        visible = [each for each in left if each is not None]
        if len(visible) == len(boxes):
            image[hidden_with > hidden] = color
            hidden, remaining = hidden_with, np.array(visible)
    return remaining


def _sample_occluder(rng: np.random.Generator, box: NDArray[np.float64]) -> NDArray[np.int32]:
    """(4, 2) corners of a bar over the box; a short one hides a part of its width only."""
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
    """The box of the part of a box's ellipse that occluders leave visible; None where too little is left."""
    low = np.floor(box[:2]).astype(int)
    high = np.minimum(np.ceil(box[:2] + box[2:]).astype(int), hidden.shape[::-1])
    y, x = np.mgrid[low[1] : high[1], low[0] : high[0]] + 0.5
    center, halves = box[:2] + box[2:] / 2, box[2:] / 2
    ellipse = ((x - center[0]) / halves[0]) ** 2 + ((y - center[1]) / halves[1]) ** 2 <= 1
    visible = ellipse & (hidden[low[1] : high[1], low[0] : high[0]] == 0)
    if visible.sum() < (1 - _MAX_HIDDEN_FRACTION) * ellipse.sum() or not visible.any():
        return None
    # An edge moves where its outermost rows or columns are hidden; otherwise it keeps its sub-pixel position.
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


def paint_distractors(rng: np.random.Generator, image: Image, boxes: Boxes) -> None:
    """Paint discs, rings, bars and nested discs beside the drogues, in a drogue's colours; they get no boxes."""
    if rng.random() >= _DISTRACTED_FRACTION:
        return
    height, width = image.shape[:2]
    for _ in range(int(rng.integers(1, _MAX_DISTRACTORS + 1))):
        size = float(np.exp(rng.uniform(*np.log(_DISTRACTOR_SIZE)))) * height
        center, axes = rng.uniform(0, (width, height)), size / 2 * rng.uniform(0.5, 1, 2)
        turn_deg, kind, color = rng.uniform(0, 180), rng.integers(4), _sample_color(rng).tolist()
        tube, ambient, toward_lamp = _sample_ring(rng)
        nested = _sample_nested_discs(rng, center, axes)
        if _touches_drogue(center, size, boxes):
            continue
        at, halves = (round(center[0]), round(center[1])), (max(round(axes[0]), 1), max(round(axes[1]), 1))
        if kind == 0:
            cv2.ellipse(image, at, halves, turn_deg, 0, 360, color, -1, cv2.LINE_AA)
        elif kind == 1:
            ring = axes / (1 + tube)
            tube_px = max(tube * float(ring.max()), _MIN_TUBE_PX)
            paint_ring(image, center, ring, turn_deg, tube_px, color, ambient, toward_lamp)
        elif kind == 2:
            corners = cv2.boxPoints((center.tolist(), (2 * axes[0], axes[1] / 2), turn_deg))
            cv2.fillConvexPoly(image, np.rint(corners).astype(np.int32), color, cv2.LINE_AA)
        else:
            for disc in nested:
                cv2.ellipse(image, (disc.center_px, 2 * disc.half_axes_px, turn_deg), disc.color, -1, cv2.LINE_AA)


class _Disc(NamedTuple):
    center_px: NDArray[np.float64]
    half_axes_px: NDArray[np.float64]
    color: list[int]


def _sample_nested_discs(
    rng: np.random.Generator, center_px: NDArray[np.float64], half_axes_px: NDArray[np.float64]
) -> list[_Disc]:
    """Discs of one shape, each within the one before, outermost first; their centres lie on a line."""
    bearing = rng.uniform(0, 2 * np.pi)
    toward, shift = np.array([np.cos(bearing), np.sin(bearing)]), rng.uniform(0, _NESTED_SHIFT)
    discs = []
    for _ in range(int(rng.integers(_NESTED_DISCS[0], _NESTED_DISCS[1] + 1))):
        discs.append(_Disc(center_px, half_axes_px, _sample_color(rng).tolist()))
        scale = rng.uniform(*_NESTED_SCALE)
        # The smaller disc stays within the other for any direction, as it does within its shorter half axis.
        center_px = center_px + toward * shift * (1 - scale) * half_axes_px.min()
        half_axes_px = scale * half_axes_px
    return discs


def _sample_ring(rng: np.random.Generator) -> tuple[float, float, NDArray[np.float64]]:
    """Radius of the tube over that of the ring, fraction of ambient light, direction to the lamp."""
    tube, ambient = float(rng.uniform(*_RING_TUBE_FRACTION)), float(rng.uniform(*_RING_AMBIENT_FRACTION))
    toward_lamp = rng.standard_normal(3)
    toward_lamp[2] = abs(toward_lamp[2])
    return tube, ambient, toward_lamp / np.linalg.norm(toward_lamp)


def _touches_drogue(center: NDArray[np.float64], size: float, boxes: Boxes) -> bool:
    """Whether a shape would cover or touch a drogue."""
    low, high = boxes[:, :2] - size, boxes[:, :2] + boxes[:, 2:] + size
    return bool(((center > low) & (center < high)).all(axis=1).any())


def paint_ring(
    image: Image,
    center_px: NDArray[np.float64],
    half_axes_px: NDArray[np.float64],
    turn_deg: float,
    tube_px: float,
    color: Sequence[int],
    ambient_fraction: float,
    toward_lamp: NDArray[np.float64],
) -> None:
    """Paint a matt torus seen from a distance: of all plain shapes a ring looks most like a drogue.

    The tube has the same width all around: a tilted ring is flatter, its tube is not. Distances to the ellipse are a
    first-order approximation, accurate near it (Sampson 1982, doi:10.1016/0146-664X(82)90101-0).

    Args:
        image: (H, W, 3), changed in place.
        center_px: (2,) x, y.
        half_axes_px: (2,) of the ellipse along the middle of the tube, above 0.
        turn_deg: angle from the image's x axis to the first half axis, towards y.
        tube_px: radius of the tube.
        color: red, green, blue of the side that faces the lamp.
        ambient_fraction: relative brightness of the side that faces away from it, 0 to 1.
        toward_lamp: (3,) unit vector to the lamp: x, y of the image, and towards the camera.
    """
    height, width = image.shape[:2]
    reach = float(half_axes_px.max()) + tube_px + 1
    low = np.maximum(np.floor(center_px - reach).astype(int), 0)
    high = np.minimum(np.ceil(center_px + reach).astype(int), (width, height))
    if (low >= high).any():
        return
    y, x = np.mgrid[low[1] : high[1], low[0] : high[0]].astype(np.float32) + 0.5
    turn = np.radians(turn_deg)
    along = (x - center_px[0]) * np.cos(turn) + (y - center_px[1]) * np.sin(turn)
    across = (y - center_px[1]) * np.cos(turn) - (x - center_px[0]) * np.sin(turn)
    radius = np.maximum(np.hypot(along / half_axes_px[0], across / half_axes_px[1]), 1e-6)
    slope_along, slope_across = along / half_axes_px[0] ** 2 / radius, across / half_axes_px[1] ** 2 / radius
    slope = np.maximum(np.hypot(slope_along, slope_across), 1e-6)
    distance_px = (radius - 1) / slope
    cover = np.clip(tube_px + 0.5 - np.abs(distance_px), 0, 1)[..., None]
    outwards = np.clip(distance_px / tube_px, -1, 1)
    normal_x = (slope_along * np.cos(turn) - slope_across * np.sin(turn)) / slope * outwards
    normal_y = (slope_along * np.sin(turn) + slope_across * np.cos(turn)) / slope * outwards
    facing = normal_x * toward_lamp[0] + normal_y * toward_lamp[1] + np.sqrt(1 - outwards**2) * toward_lamp[2]
    brightness = ambient_fraction + (1 - ambient_fraction) * np.clip(facing, 0, 1)
    painted = np.array(color) * brightness[..., None]
    patch = image[low[1] : high[1], low[0] : high[0]]
    patch[:] = np.rint(patch * (1 - cover) + painted * cover)
