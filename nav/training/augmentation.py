"""Augmentation of images: geometric, then photometric.

Geometric: mirrored, scaled, rotated and cropped views of images, one alone or four in a mosaic. Boxes are (n, 4) x, y
of the low corner, width, height, counted from the corner of the image: the whole image is (0, 0, W, H). A drogue is
round, so the ellipse in its box is what rotates. Source of the mosaic: Bochkovskiy et al. 2020, arXiv:2004.10934,
section 3.3; the seed paper trains with it.

Photometric: colour jitter, blur, noise, sharpening and JPEG. Images are encoded by the sRGB curve whatever the
dataset's sensor (`nav.detector.input_image`), and gains multiply encoded values: half the value is about a fifth of
the light.
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
SMALLEST_LEARNED_FRACTION = 0.018
"""Longer side over the canvas's height: 9 px of 480.

Views are drawn for an image's first drogue; those beside it may become too small to tell them from anything else.
"""
# Of an image's first drogue: 13 px of 480, 9 px of 320. At 40 m the paper's camera sees 17.6 and 11 px.
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


def paint_view(canvas: Image, image: Image, boxes: Boxes, view: ImageView, smallest_px: float = 0.0) -> Boxes:
    """Paint a view on the canvas, and clip the image's boxes to it.

    Args:
        canvas: (H, W, 3), changed in place.
        image: (h, w, 3).
        boxes: (n, 4) of the drogues in the image.
        view: where the image comes on the canvas.
        smallest_px: longer side of the smallest box on the canvas that is large enough. [px]

    Returns:
        (m, 4) visible parts of the drogues that are visible and large enough. The visible parts of other drogues are
        painted grey, so that no drogue on the canvas lacks a box.
    """
    warp_view(canvas, image, view)
    visible, fractions = clip_boxes(transform_boxes(boxes, view), view.window)
    large_enough = visible[:, 2:].max(axis=1, initial=0.0) >= smallest_px
    kept: NDArray[np.bool_] = (fractions >= MIN_VISIBLE_FRACTION) & large_enough
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


# Fractions of the images that are changed, and the ranges from which the change is drawn.
_TONE_FRACTION, _EXPOSURE, _GAMMA, _BALANCE = 0.8, (0.55, 1.7), (0.7, 1.45), (0.85, 1.18)
_CAST_FRACTION, _CAST = 0.2, (0.6, 1.5)
_GREY_FRACTION = 0.08  # for mono cameras, and so that the network does not rely on colour alone
_SATURATION = (0.5, 1.4)
_LOW_LIGHT_FRACTION, _LOW_LIGHT = 0.12, (0.15, 0.5)
_MIN_MEAN_DN = 20.0  # no image is made darker, or invisible drogues would keep their boxes
_BLUR_FRACTION, _BLUR_SIGMA_PX = 0.15, (0.4, 1.6)
_MOTION_FRACTION, _MOTION_PX = 0.08, (3, 9)
_NOISE_FRACTION, _NOISE_DN = 0.35, (0.5, 6.0)
_LOW_LIGHT_NOISE_DN = (2.0, 8.0)
# What pictures from the web and from video went through after the camera.
_RESAMPLED_FRACTION, _RESAMPLED_SCALE = 0.12, (0.35, 0.8)
_SHARPENED_FRACTION, _SHARPENED_AMOUNT, _SHARPENED_SIGMA_PX = 0.12, (0.3, 1.5), 1.0
_COMPRESSED_FRACTION, _JPEG_QUALITY = 0.25, (20, 95)


def color_jitter(rng: np.random.Generator, image: Image) -> Image:
    """Randomly change tone, colour, sharpness, noise and coding, as other light and cameras do.

    (H, W, 3) -> (H, W, 3).
    """
    is_dark = rng.random() < _LOW_LIGHT_FRACTION
    image = cv2.LUT(_mix_colors(rng, image), _tone_curves(rng))
    if is_dark:
        image = _darken(rng, image)
    if rng.random() < _BLUR_FRACTION:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), _log_uniform(rng, _BLUR_SIGMA_PX).item()), dtype=np.uint8)
    if rng.random() < _MOTION_FRACTION:
        image = _motion_blur(rng, image)
    if is_dark or rng.random() < _NOISE_FRACTION:
        image = _add_noise(rng, image, _log_uniform(rng, _LOW_LIGHT_NOISE_DN if is_dark else _NOISE_DN).item())
    return _processed(rng, image)


def _processed(rng: np.random.Generator, image: Image) -> Image:
    """Resample, sharpen and compress some images."""
    if rng.random() < _RESAMPLED_FRACTION:
        scale, size = rng.uniform(*_RESAMPLED_SCALE), image.shape[1::-1]
        # With a factor in place of a size, OpenCV would not take the whole picture, and boxes would be off.
        small_size = [max(1, round(scale * side)) for side in size]
        small = cv2.resize(image, small_size, interpolation=cv2.INTER_AREA)
        image = np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
    if rng.random() < _SHARPENED_FRACTION:
        amount = rng.uniform(*_SHARPENED_AMOUNT)
        blurred = cv2.GaussianBlur(image, (0, 0), _SHARPENED_SIGMA_PX)
        image = np.asarray(cv2.addWeighted(image, 1 + amount, blurred, -amount, 0), dtype=np.uint8)
    if rng.random() < _COMPRESSED_FRACTION:
        quality = int(rng.integers(_JPEG_QUALITY[0], _JPEG_QUALITY[1] + 1))
        # OpenCV takes blue for the first channel, and codes blue more coarsely than red.
        _, coded = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
        image = np.asarray(cv2.cvtColor(cv2.imdecode(coded, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB), dtype=np.uint8)
    return image


def _log_uniform(rng: np.random.Generator, limits: tuple[float, float], count: int = 1) -> NDArray[np.float64]:
    values: NDArray[np.float64] = np.exp(rng.uniform(np.log(limits[0]), np.log(limits[1]), count))
    return values


def _mix_colors(rng: np.random.Generator, image: Image) -> Image:
    """Change the saturation; some images become grey."""
    saturation = 0.0 if rng.random() < _GREY_FRACTION else rng.uniform(*_SATURATION)
    return image if abs(saturation - 1) < 0.1 else saturate(image, saturation)


def saturate(image: Image, saturation: float) -> Image:
    """Move the colours of (H, W, 3) away from grey, or for a saturation below 1 towards it."""
    luminance = np.full((3, 3), (0.2126, 0.7152, 0.0722))  # Rec. 709
    mix = luminance + saturation * (np.eye(3) - luminance)
    return np.asarray(cv2.transform(image, mix), dtype=np.uint8)


def _tone_curves(rng: np.random.Generator) -> NDArray[np.uint8]:
    """(256, 1, 3) lookup table of exposure, gamma and white balance for the three channels."""
    gain, gamma, balance = np.ones(1), np.ones(1), np.ones(3)
    if rng.random() < _TONE_FRACTION:
        gain, gamma = _log_uniform(rng, _EXPOSURE), _log_uniform(rng, _GAMMA)
        balance = _log_uniform(rng, _BALANCE, 3)
    if rng.random() < _CAST_FRACTION:
        balance = balance * _log_uniform(rng, _CAST, 3)
    level = (np.arange(256) / 255)[:, None] ** gamma * gain * balance
    curves: NDArray[np.uint8] = np.rint(255 * np.clip(level, 0, 1)).astype(np.uint8)
    return curves[:, None, :]


def _darken(rng: np.random.Generator, image: Image) -> Image:
    """Scale the image down to low light."""
    gain = max(_log_uniform(rng, _LOW_LIGHT).item(), min(1.0, _MIN_MEAN_DN / max(float(image.mean()), 1.0)))
    return np.asarray(cv2.LUT(image, np.rint(gain * np.arange(256)).astype(np.uint8)), dtype=np.uint8)


def _motion_blur(rng: np.random.Generator, image: Image) -> Image:
    """Blur the image along a straight line, as motion does, without moving it."""
    length_px = int(rng.integers(_MOTION_PX[0], _MOTION_PX[1] + 1))
    reach, angle = length_px // 2, rng.uniform(0, np.pi)
    half_px, middle = (length_px - 1) / 2, reach
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    for t in np.linspace(-half_px, half_px, 4 * length_px):
        row, column = round(t * np.sin(angle)), round(t * np.cos(angle))
        kernel[middle + row, middle + column] = kernel[middle - row, middle - column] = 1
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), dtype=np.uint8)


def _add_noise(rng: np.random.Generator, image: Image, sigma_dn: float) -> Image:
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    noise *= np.float32(sigma_dn)
    noise += image
    np.rint(noise, out=noise)
    return np.clip(noise, 0, 255, out=noise).astype(np.uint8)
