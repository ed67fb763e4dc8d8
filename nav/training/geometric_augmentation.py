"""Geometric augmentation: mirrored, scaled, rotated and cropped views of images, one alone or four in a mosaic.

Boxes are (n, 4) x, y of the low corner, width, height, counted from the corner of the image: the whole image is
(0, 0, W, H). A drogue is round, so the ellipse in its box is what rotates.

Source of the mosaic: Bochkovskiy et al. 2020, arXiv:2004.10934, section 3.3; the seed paper trains with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from nav.detector.input_image import PADDING_DN, letterbox, letterbox_image

Boxes = NDArray[np.float64]
Image = NDArray[np.uint8]

LEAST_VISIBLE_FRACTION = 0.3
"""A drogue of which a view shows less is painted over, for nobody would call what is left a drogue."""
# Longer side against the canvas's height: 13 px of 480, 9 px of 320. At 40 m the paper's camera sees 17.5 and 11 px.
_SMALLEST_BOX_SHARE = 0.027
_LARGEST_BOX_SHARE = 1.2  # longer side against the window's shorter one; more is mostly cut off
_SHIFT_SHARE = 0.9  # how much of the freedom to move the crop is used while the drogue stays in it


@dataclass(frozen=True)
class CanvasWindow:
    """A rectangle of the canvas that a view fills: low corner and size, in whole pixels. [px]"""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True)
class ViewRanges:
    """What views are drawn from.

    Attributes:
        scale: smallest and largest magnification; 1 shows a pixel of the image as one of the canvas.
        turn_deg: largest rotation either way.
        flip_fraction: share of views that are mirrored left to right.
        smallest_box_px: longer side to which a box is reduced at most. [px]
    """

    scale: tuple[float, float]
    turn_deg: float
    flip_fraction: float
    smallest_box_px: float = 0.0

    def on_canvas(self, source_wh: tuple[int, int], canvas_wh: tuple[int, int]) -> ViewRanges:
        """The same, but magnifications count from the one that just fits the image in; the smallest box is set."""
        fit = min(canvas_wh[0] / source_wh[0], canvas_wh[1] / source_wh[1])
        scale = self.scale[0] * fit, self.scale[1] * fit
        return replace(self, scale=scale, smallest_box_px=_SMALLEST_BOX_SHARE * canvas_wh[1])


@dataclass(frozen=True, eq=False)
class ImageView:
    """Where an image's points go: `canvas = linear @ source + shift`, both counted from corners, shown in `window`.

    Attributes:
        linear, shift: of that map.
        window: of the canvas.
        is_whole: all of the image on all of the canvas, with the very pixels that the detector sees in use.
    """

    linear: NDArray[np.float64]
    shift: NDArray[np.float64]
    window: CanvasWindow
    is_whole: bool = False


def whole_view(source_wh: tuple[int, int], canvas_wh: tuple[int, int]) -> ImageView:
    """The whole image in the middle of the canvas: what is not augmented."""
    place = letterbox(source_wh, canvas_wh)
    shift = np.array(place.offset_px, dtype=np.float64)
    return ImageView(np.diag(place.scale), shift, CanvasWindow(0, 0, *canvas_wh), is_whole=True)


def sample_view(
    rng: np.random.Generator, source_wh: tuple[int, int], boxes: Boxes, window: CanvasWindow, ranges: ViewRanges
) -> ImageView:
    """A view whose crop shows the first box's centre, and is anywhere in an image without boxes.

    Args:
        rng: the stream.
        source_wh: of the image. [px]
        boxes: of the image.
        window: to fill.
        ranges: of the draws.
    """
    low_scale, high_scale = ranges.scale
    if len(boxes):
        longest_px = float(boxes[0, 2:].max())
        largest_px = _LARGEST_BOX_SHARE * min(window.width, window.height)
        high_scale = max(min(high_scale, largest_px / longest_px), low_scale)
        low_scale = min(max(low_scale, ranges.smallest_box_px / longest_px), high_scale)
    scale = float(np.exp(rng.uniform(np.log(low_scale), np.log(high_scale))))
    turn = np.radians(rng.uniform(-ranges.turn_deg, ranges.turn_deg))
    mirror = -1.0 if rng.random() < ranges.flip_fraction else 1.0
    linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ np.diag([mirror, 1.0])
    source, crop = np.array(source_wh, dtype=np.float64), np.array([window.width, window.height]) / scale
    low, high = np.minimum(crop / 2, source - crop / 2), np.maximum(crop / 2, source - crop / 2)
    if len(boxes):
        anchor = boxes[0, :2] + boxes[0, 2:] / 2
        reach = _SHIFT_SHARE * crop / 2
        low, high = np.clip(anchor - reach, low, high), np.clip(anchor + reach, low, high)
    middle = np.array([window.x + window.width / 2, window.y + window.height / 2])
    return ImageView(linear, middle - linear @ rng.uniform(low, high), window)


def warp_view(canvas: Image, image: Image, view: ImageView) -> None:
    """Paint the view into its window of the canvas, grey where the image ends."""
    window = view.window
    if view.is_whole:
        canvas[:] = letterbox_image(image, (window.width, window.height))[0]
        return
    source = image
    # Averaging before a strong reduction, which interpolation would alias.
    reduction = int(1 / np.sqrt(abs(np.linalg.det(view.linear))))
    if reduction >= 2:
        small_wh = (max(image.shape[1] // reduction, 1), max(image.shape[0] // reduction, 1))
        source = np.asarray(cv2.resize(image, small_wh, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    ratio = np.array([image.shape[1] / source.shape[1], image.shape[0] / source.shape[0]])
    linear = view.linear * ratio
    # OpenCV counts from pixel centres.
    shift = view.shift - (window.x, window.y) + linear @ (0.5, 0.5) - 0.5
    canvas[window.y : window.y + window.height, window.x : window.x + window.width] = cv2.warpAffine(
        source,
        np.column_stack([linear, shift]),
        (window.width, window.height),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(PADDING_DN, PADDING_DN, PADDING_DN),
    )


def transform_boxes(boxes: Boxes, view: ImageView) -> Boxes:
    """Where the boxes lie on the canvas, also outside the window."""
    if not len(boxes):
        return boxes.reshape(0, 4)
    centers = (boxes[:, :2] + boxes[:, 2:] / 2) @ view.linear.T + view.shift
    # An ellipse with the half axes (a, b) along x and y reaches sqrt((m00 a)^2 + (m01 b)^2) in x after the map m.
    halves = np.sqrt((boxes[:, 2:] / 2) ** 2 @ (view.linear**2).T)
    return np.hstack([centers - halves, 2 * halves])


def clip_boxes(boxes: Boxes, window: CanvasWindow) -> tuple[Boxes, NDArray[np.float64]]:
    """The parts of boxes in a window, and the share of each box's area that they are.

    Returns:
        (n, 4) boxes, of no width or height where nothing is left, and (n,) shares.
    """
    low_limit, high_limit = (
        np.array([window.x, window.y]),
        np.array([window.x + window.width, window.y + window.height]),
    )
    low = np.clip(boxes[:, :2], low_limit, high_limit)
    high = np.clip(boxes[:, :2] + boxes[:, 2:], low_limit, high_limit)
    areas = boxes[:, 2] * boxes[:, 3]
    shares = np.prod(high - low, axis=1) / np.where(areas > 0, areas, 1)
    return np.hstack([low, high - low]), shares


def paint_view(canvas: Image, image: Image, boxes: Boxes, view: ImageView) -> Boxes:
    """Paint a view and tell which boxes it shows.

    Returns:
        (m, 4) visible parts of the drogues that are visible enough. Of the others, what is visible is painted grey, so
        that no drogue stands on the canvas without a box.
    """
    warp_view(canvas, image, view)
    visible, shares = clip_boxes(transform_boxes(boxes, view), view.window)
    kept = shares >= LEAST_VISIBLE_FRACTION
    for x, y, width, height in visible[~kept & (shares > 0)]:
        canvas[int(y) : int(np.ceil(y + height)), int(x) : int(np.ceil(x + width))] = PADDING_DN
    return visible[kept]


TILES = 4
_CROSSING_RANGE = (0.3, 0.7)  # where the four meet, as shares of width and height; nearer to an edge one is a sliver


def sample_mosaic_windows(rng: np.random.Generator, canvas_wh: tuple[int, int]) -> list[CanvasWindow]:
    """Four rectangles that fill a canvas and meet in one point."""
    x, y = (round(rng.uniform(*_CROSSING_RANGE) * side) for side in canvas_wh)
    width, height = canvas_wh
    return [
        CanvasWindow(0, 0, x, y),
        CanvasWindow(x, 0, width - x, y),
        CanvasWindow(0, y, x, height - y),
        CanvasWindow(x, y, width - x, height - y),
    ]


def sample_mosaic(
    rng: np.random.Generator,
    source_whs: Sequence[tuple[int, int]],
    boxes: Sequence[Boxes],
    canvas_wh: tuple[int, int],
    ranges: ViewRanges,
) -> list[ImageView]:
    """A view of each of four images, one for each rectangle."""
    windows = sample_mosaic_windows(rng, canvas_wh)
    return [
        sample_view(rng, source_wh, own, window, ranges)
        for source_wh, own, window in zip(source_whs, boxes, windows, strict=True)
    ]
