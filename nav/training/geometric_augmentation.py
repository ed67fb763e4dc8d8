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

MIN_VISIBLE_FRACTION = 0.3
"""A drogue of which a view shows less is painted over, for nobody would call what is left a drogue."""
# Longer side over the canvas's height: 13 px of 480, 9 px of 320. At 40 m the paper's camera sees 17.5 and 11 px.
_SMALLEST_BOX_FRACTION = 0.027
_LARGEST_BOX_FRACTION = 1.2  # longer side over the window's shorter one; larger boxes are mostly cut off
_SHIFT_FRACTION = 0.9  # of the range in which the crop can move while it contains the drogue's centre
TILES = 4
# Where the four windows meet, as fractions of width and height; nearer to an edge one would be a sliver.
_CROSSING_RANGE = (0.3, 0.7)


@dataclass(frozen=True)
class CanvasWindow:
    """A rectangle of the canvas that a view fills: low corner and size, in whole pixels. [px]"""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True)
class ViewRanges:
    """The ranges from which views are drawn.

    Attributes:
        scale: smallest and largest magnification, canvas pixels per image pixel.
        rotation_deg: largest rotation either way.
        flip_fraction: fraction of views that are mirrored left to right.
        smallest_box_px: no box is reduced to a longer side below this. [px]
    """

    scale: tuple[float, float]
    rotation_deg: float
    flip_fraction: float
    smallest_box_px: float = 0.0

    def on_canvas(self, source_wh: tuple[int, int], canvas_wh: tuple[int, int]) -> ViewRanges:
        """These ranges for a canvas: magnifications are relative to the one that just fits the image into it."""
        fit = min(canvas_wh[0] / source_wh[0], canvas_wh[1] / source_wh[1])
        scale = self.scale[0] * fit, self.scale[1] * fit
        return replace(self, scale=scale, smallest_box_px=_SMALLEST_BOX_FRACTION * canvas_wh[1])


@dataclass(frozen=True, eq=False)
class ImageView:
    """An affine map from an image to a window of the canvas: `canvas = linear @ source + shift`, counted from corners.

    Attributes:
        linear, shift: of the map.
        window: the part of the canvas that is painted.
        is_whole: the whole image fills the canvas, with the same pixels as the detector's input.
    """

    linear: NDArray[np.float64]
    shift: NDArray[np.float64]
    window: CanvasWindow
    is_whole: bool = False


def whole_view(source_wh: tuple[int, int], canvas_wh: tuple[int, int]) -> ImageView:
    """The view without augmentation: the whole image, centred on the canvas."""
    placement = letterbox(source_wh, canvas_wh)
    shift = np.array(placement.offset_px, dtype=np.float64)
    return ImageView(np.diag(placement.scale), shift, CanvasWindow(0, 0, *canvas_wh), is_whole=True)


def sample_view(
    rng: np.random.Generator, source_wh: tuple[int, int], boxes: Boxes, window: CanvasWindow, ranges: ViewRanges
) -> ImageView:
    """Draw a view whose crop contains the first box's centre; in an image without boxes it may lie anywhere.

    Args:
        rng: random stream.
        source_wh: width and height of the image. [px]
        boxes: of the image.
        window: the part of the canvas to fill.
        ranges: of scale, rotation and mirroring.
    """
    low_scale, high_scale = ranges.scale
    if len(boxes):
        longest_px = float(boxes[0, 2:].max())
        largest_px = _LARGEST_BOX_FRACTION * min(window.width, window.height)
        high_scale = max(min(high_scale, largest_px / longest_px), low_scale)
        low_scale = min(max(low_scale, ranges.smallest_box_px / longest_px), high_scale)
    scale = float(np.exp(rng.uniform(np.log(low_scale), np.log(high_scale))))
    rotation = np.radians(rng.uniform(-ranges.rotation_deg, ranges.rotation_deg))
    mirror = -1.0 if rng.random() < ranges.flip_fraction else 1.0
    cos, sin = np.cos(rotation), np.sin(rotation)
    linear = scale * np.array([[cos, -sin], [sin, cos]]) @ np.diag([mirror, 1.0])
    source, crop = np.array(source_wh, dtype=np.float64), np.array([window.width, window.height]) / scale
    low, high = np.minimum(crop / 2, source - crop / 2), np.maximum(crop / 2, source - crop / 2)
    if len(boxes):
        anchor = boxes[0, :2] + boxes[0, 2:] / 2
        reach = _SHIFT_FRACTION * crop / 2
        low, high = np.clip(anchor - reach, low, high), np.clip(anchor + reach, low, high)
    middle = np.array([window.x + window.width / 2, window.y + window.height / 2])
    return ImageView(linear, middle - linear @ rng.uniform(low, high), window)


def warp_view(canvas: Image, image: Image, view: ImageView) -> None:
    """Warp an image into the view's window of the canvas, grey outside the image."""
    window = view.window
    if view.is_whole:
        canvas[:] = letterbox_image(image, (window.width, window.height))[0]
        return
    source = image
    # Averaging first, because interpolation would alias a strong reduction.
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
    """Map boxes to the canvas; they may lie outside the window."""
    if not len(boxes):
        return boxes.reshape(0, 4)
    centers = (boxes[:, :2] + boxes[:, 2:] / 2) @ view.linear.T + view.shift
    # The map m takes an ellipse with half axes (a, b) along x and y to one reaching sqrt((m00 a)^2 + (m01 b)^2) in x.
    halves = np.sqrt((boxes[:, 2:] / 2) ** 2 @ (view.linear**2).T)
    return np.hstack([centers - halves, 2 * halves])


def clip_boxes(boxes: Boxes, window: CanvasWindow) -> tuple[Boxes, NDArray[np.float64]]:
    """Clip boxes to a window.

    Returns:
        (n, 4) clipped boxes, of zero width or height where nothing is left, and (n,) the fraction of each box's area
        that is left.
    """
    low_limit, high_limit = (
        np.array([window.x, window.y]),
        np.array([window.x + window.width, window.y + window.height]),
    )
    low = np.clip(boxes[:, :2], low_limit, high_limit)
    high = np.clip(boxes[:, :2] + boxes[:, 2:], low_limit, high_limit)
    areas = boxes[:, 2] * boxes[:, 3]
    fractions = np.prod(high - low, axis=1) / np.where(areas > 0, areas, 1)
    return np.hstack([low, high - low]), fractions


def paint_view(canvas: Image, image: Image, boxes: Boxes, view: ImageView) -> Boxes:
    """Paint a view on the canvas, and clip the image's boxes to it.

    Returns:
        (m, 4) visible parts of the drogues that are visible enough. The visible parts of other drogues are painted
        grey, so that no drogue on the canvas lacks a box.
    """
    warp_view(canvas, image, view)
    visible, fractions = clip_boxes(transform_boxes(boxes, view), view.window)
    kept = fractions >= MIN_VISIBLE_FRACTION
    for x, y, width, height in visible[~kept & (fractions > 0)]:
        canvas[int(y) : int(np.ceil(y + height)), int(x) : int(np.ceil(x + width))] = PADDING_DN
    return visible[kept]


def sample_mosaic_windows(rng: np.random.Generator, canvas_wh: tuple[int, int]) -> list[CanvasWindow]:
    """Draw four windows that fill a canvas and meet in one point."""
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
    """Draw a view of each of four images, one for each window of a mosaic."""
    windows = sample_mosaic_windows(rng, canvas_wh)
    return [
        sample_view(rng, source_wh, own, window, ranges)
        for source_wh, own, window in zip(source_whs, boxes, windows, strict=True)
    ]
