"""The single-channel picture for marker detection, bright on markers and dark elsewhere, and its bright regions."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.images import Pixels, StereoImages
from drogue_models.parameters import DrogueParameters
from geometry.se3 import Array
from geometry.stereo import Eye
from nav.matching.connected_regions import connected_regions

# A filled ellipse covers pi/4 = 0.785 of its box; squares of a few pixels cover all of it, a ring or a crescent half.
_LEAST_FILL = 0.55
_MOST_ELONGATED = 2.5


@dataclass(frozen=True, eq=False)
class Blobs:
    """Regions of one image.

    Attributes:
        centers_px: (M, 2) centres of mass.
        areas_px2: (M,) numbers of pixels.
    """

    centers_px: Array
    areas_px2: Array

    @property
    def radii_px(self) -> Array:
        """(M,) radii of the circles of the same area. [px]"""
        radii: Array = np.sqrt(self.areas_px2 / np.pi)
        return radii

    def __len__(self) -> int:
        return len(self.areas_px2)


def disc_like_blobs(mask: NDArray[np.uint8], least_area_px2: float, most: int) -> Blobs:
    """Regions that may be images of discs: compact, filled, clear of the picture's edge.

    Args:
        mask: (H, W), nonzero inside.
        least_area_px2: smaller ones are noise.
        most: number of the largest regions to keep; the time of the matching grows with its square.

    Returns:
        Blobs in descending order of area.
    """
    regions = connected_regions(mask)
    left, top, width, height = regions.boxes.T
    area, (rows, columns) = regions.areas_px2, mask.shape
    inside = (left > 0) & (top > 0) & (left + width < columns) & (top + height < rows)
    compact = (width <= _MOST_ELONGATED * height) & (height <= _MOST_ELONGATED * width)
    filled = area >= _LEAST_FILL * width * height
    keep = np.flatnonzero(inside & compact & filled & (area >= least_area_px2))
    keep = keep[np.argsort(-area[keep], kind="stable")][:most]
    return Blobs(regions.centers_px[keep], area[keep].astype(np.float64))


# Left, top, right, bottom of a part of an image, the last two exclusive. [px]
Window = tuple[int, int, int, int]
# A paint counts as coloured when its strongest component exceeds the others by this share of itself: 0.95 for the
# shipped red, 0 for white.
_SATURATED_FRACTION = 0.5

# Weight at which the other colours are subtracted. A low sun makes haze so warm that red exceeds the others there too,
# and a larger weight is needed: orange haze has a third more red than green, red paint twenty times as much.
PLAIN, AGAINST_WARM_SKY = 1.0, 1.4
OTHERS_WEIGHTS = (PLAIN, AGAINST_WARM_SKY)
# Range of the pixels beyond the rim: from where the lens no longer mixes them with the rim [px] to this many rim radii.
_CLEAR_OF_RIM_PX, _BEYOND_RIM = 2.5, 1.4
# Limits of the balancing weight, from blue skies to warm ones.
_WEIGHTS = (0.0, 1.6)

# Share of clipped pixels up to which a colour counts, and sites of each colour in a cell.
_HARDLY_CLIPPED, _MOSAIC_SITES = 0.02, (1.0, 2.0, 1.0)
# Where the first site of each colour lies in an RGGB cell; the mean of both greens lies between them. [px]
_SITE_OFFSET_PX = (0.0, 0.5, 1.0)
_RED, _GREEN = 0, 1


def marker_color(drogue: DrogueParameters) -> int | None:
    """Index of the markers' own colour (0 red, 1 green, 2 blue), or None for white and grey markers."""
    lit = drogue.marker_luminance_cd_m2 > 0
    rgb = drogue.marker_emission_rgb if lit else drogue.marker_reflectance_rgb
    strongest = int(np.argmax(rgb))
    others = max(value for index, value in enumerate(rgb) if index != strongest)
    return strongest if rgb[strongest] - others > _SATURATED_FRACTION * rgb[strongest] else None


def marker_channel(
    images: StereoImages, eye: Eye, color: int | None, others_weight: float = PLAIN, window: Window | None = None
) -> Pixels:
    """The marker channel of one eye, linear in light.

    With a colour it is `max(c - max(the other two), 0)`, the paper's subtraction of channels; sites of that colour in a
    raw mosaic are preferred to a demosaiced image. Without a colour, or from a mono sensor, it is the brightness: the
    smallest of the three channels, which keeps white paint and dims a blue sky.

    Args:
        images: the pair.
        eye: which of the two.
        color: see `marker_color`.
        others_weight: weight at which the stronger of the other two colours is subtracted.
        window: left, top, right, bottom (the last two exclusive) of the part to compute; the whole image when None.

    Returns:
        (H, W) of unsigned integers on the image's own grid, proportional to light above the black level.
    """
    image, mosaic = (images.left, images.left_mosaic) if eye == "left" else (images.right, images.right_mosaic)
    left, top, right, bottom = window or (0, 0, *images.size_px)
    if color is not None and mosaic is not None:
        # Whole cells, and one more on each side, so that the interpolation equals that of the whole mosaic.
        low_x, low_y = max(0, left // 2 * 2 - 2), max(0, top // 2 * 2 - 2)
        cells = mosaic[low_y : bottom // 2 * 2 + 4, low_x : right // 2 * 2 + 4]
        channel = _from_mosaic(cells, color, others_weight, round(images.black_level_dn))
        return np.asarray(channel[top - low_y : bottom - low_y, left - low_x : right - low_x])
    linear = _linear(image[top:bottom, left:right], images)
    if linear.ndim == 2:
        return linear
    planes = cv2.split(linear)
    if color is None:
        return np.asarray(cv2.min(cv2.min(planes[0], planes[1]), planes[2]))
    first, second = (planes[index] for index in range(3) if index != color)
    return _color_excess(planes[color], cv2.max(first, second), others_weight)


def color_difference(images: StereoImages, eye: Eye, color: int, others_weight: float = PLAIN) -> NDArray[np.float32]:
    """As `marker_channel` of a colour image, but negative where another colour is stronger.

    Light of a blue sky that the lens spreads over a marker's edge reduces the difference there. Clipping at zero would
    move the edge and leave no trace beside it.

    Returns:
        (H, W)
    """
    image = images.left if eye == "left" else images.right
    # The black level is not subtracted beforehand, which would clip the noise below it.
    linear, black = (image, images.black_level_dn) if images.encoding == "linear" else (_linear(image, images), 0.0)
    planes = cv2.split(linear)
    first, second = (planes[index] for index in range(3) if index != color)
    others = cv2.max(first, second)
    offset = black * (others_weight - 1)
    return np.asarray(cv2.addWeighted(planes[color], 1.0, others, -others_weight, offset, dtype=cv2.CV_32F))


def balancing_weight(images: StereoImages, color: int, middles_px: Array, rim_px: float, usual: float = PLAIN) -> float:
    """Weight of the other colours at which the background beyond the rim is as dark in the channel as the face.

    This removes the step of light at the rim from the channel, and with it the light that the lens spreads from the sky
    over a small marker's edge: a blue sky would subtract from the edge, a warm one would add to it.

    Args:
        images: the pair, in colour.
        color: of the markers.
        middles_px: (2, 2) the drogue's middle in the left and the right image.
        rim_px: radius of its rim.
        usual: returned where the images show nothing beyond the rim.
    """
    beyond = []
    for image, (u, v) in zip((images.left, images.right), middles_px, strict=True):
        reach_px = _BEYOND_RIM * rim_px + _CLEAR_OF_RIM_PX
        left, top = (int(max(np.floor(place - reach_px), 0)) for place in (u, v))
        part = image[top : int(np.ceil(v + reach_px)) + 1, left : int(np.ceil(u + reach_px)) + 1]
        rows, columns = np.ogrid[top : top + part.shape[0], left : left + part.shape[1]]
        away_px = np.hypot(columns - u, rows - v)
        beyond.append(_linear(part, images)[(away_px > rim_px + _CLEAR_OF_RIM_PX) & (away_px < reach_px)])
    light = np.median(np.concatenate(beyond), axis=0) if sum(map(len, beyond)) else np.zeros(3)
    own, others = float(light[color]), float(np.delete(light, color).max())
    return float(np.clip(own / others, *_WEIGHTS)) if others > 0 else usual


def _color_excess(own: Pixels, others: Pixels, others_weight: float, black_dn: int = 0) -> Pixels:
    """`max(own - weight others, 0)` in the integers of the image, of the light above a black level in both."""
    if others_weight == PLAIN:
        return np.asarray(cv2.subtract(own, others))
    light = np.maximum(others, black_dn) - black_dn
    weighted = np.minimum(light * np.float32(others_weight) + black_dn, np.iinfo(own.dtype).max)
    return np.asarray(cv2.subtract(own, weighted.astype(own.dtype)))


def linear_light(images: StereoImages, eye: Eye, window: Window) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Light of a part of an image where the sensor measured it, and what it clips.

    Args:
        images: the pair.
        eye: which of the two.
        window: left, top, right, bottom (the last two exclusive) of the part.

    Returns:
        (H, W, 3) or (H, W), proportional to light above the black level, negative where noise is below it; of a Bayer
        sensor the raw mosaic. And (H, W, 3) or (H, W) whether the number is the sensor's highest.
    """
    image, mosaic = (images.left, images.left_mosaic) if eye == "left" else (images.right, images.right_mosaic)
    left, top, right, bottom = window
    part = (image if mosaic is None else mosaic)[top:bottom, left:right]
    if mosaic is None and images.encoding == "gamma":
        return _linear(part, images).astype(np.float32), part >= 2**images.bits - 1
    return part.astype(np.float32) - np.float32(images.black_level_dn), part >= 2**images.bits - 1


def brightness(images: StereoImages, eye: Eye, window: Window) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Light of all colours in a part of an image, green twice as in a mosaic; of green alone where another is clipped.

    Args:
        images: the pair.
        eye: which of the two.
        window: left, top, right, bottom (the last two exclusive) of the part.

    Returns:
        (H, W) proportional to light above the black level, and (H, W) whether one of these colours is clipped.
    """
    left, top, right, bottom = window
    part = (images.left if eye == "left" else images.right)[top:bottom, left:right]
    if images.encoding == "gamma":
        light = _linear(part, images).astype(np.float32)
    else:
        light = part.astype(np.float32) - np.float32(images.black_level_dn)
    clipped = part >= 2**images.bits - 1
    if part.ndim == 2:
        return light, clipped
    shares = clipped.mean(axis=(0, 1))
    chosen = shares <= max(_HARDLY_CLIPPED, float(shares.min()))
    if not chosen.all() and chosen[_GREEN]:
        chosen = np.arange(3) == _GREEN
    weights = np.where(chosen, _MOSAIC_SITES, 0).astype(np.float32)
    return light @ (weights / weights.sum()), clipped[..., chosen].any(axis=2)


def _linear(image: Pixels, images: StereoImages) -> Pixels:
    """The image proportional to light, black level removed."""
    if images.encoding == "linear":
        black = round(images.black_level_dn)
        # OpenCV's subtraction clips at zero.
        return image if black == 0 or image.size == 0 else np.asarray(cv2.subtract(image, (black, black, black, 0)))
    codes = np.arange(2**images.bits) / (2**images.bits - 1)
    black = images.black_level_dn / (2**images.bits - 1)
    light = np.maximum(_srgb_to_linear(codes) - _srgb_to_linear(np.array(black)), 0)
    levels: Pixels = np.round(65535 * light).astype(np.uint16)[image]
    return levels


def _srgb_to_linear(
    code: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Light of an sRGB value, both in 0..1 (IEC 61966-2-1)."""
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def _from_mosaic(mosaic: Pixels, color: int, others_weight: float, black_dn: int) -> Pixels:
    """Colour difference within each RGGB cell, interpolated bilinearly from the colour's sites to the full grid.

    It is zero at a red or blue site that does not exceed the other colours' sites around it as well. Before a bright
    sky the rim would otherwise show larger differences than the markers, where the colour's site is the brighter one.
    """
    height, width = mosaic.shape
    even = mosaic[: height // 2 * 2, : width // 2 * 2]
    first_green, second_green = np.ascontiguousarray(even[0::2, 1::2]), np.ascontiguousarray(even[1::2, 0::2])
    green = cv2.addWeighted(first_green, 0.5, second_green, 0.5, 0)
    planes = (np.ascontiguousarray(even[0::2, 0::2]), green, np.ascontiguousarray(even[1::2, 1::2]))
    first, second = (planes[index] for index in range(3) if index != color)
    difference = _color_excess(planes[color], cv2.max(first, second), others_weight, black_dn)
    if color != _GREEN:
        beside = _brightest_beside((planes[0], first_green, second_green, planes[2]), color)
        exceeds = _color_excess(planes[color], beside, others_weight, black_dn) > 0
        difference = np.where(exceeds, difference, difference.dtype.type(0))
    shift = -_SITE_OFFSET_PX[color] / 2
    full_to_site = np.array([[0.5, 0.0, shift], [0.0, 0.5, shift]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    upsampled = cv2.warpAffine(difference, full_to_site, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(upsampled)


def _brightest_beside(planes: tuple[Pixels, Pixels, Pixels, Pixels], color: int) -> Pixels:
    """The brightest other colour in the four squares of 2 x 2 sites around each red or blue site.

    One of the squares lies on the brighter side of any edge.

    Args:
        planes: red, green beside red, green beside blue, and blue sites, of all cells.
        color: 0 red, 2 blue.
    """
    red, in_reds_row, in_blues_row, blue = planes
    across, left_right, up_down = (
        (blue, in_reds_row, in_blues_row) if color == _RED else (red, in_blues_row, in_reds_row)
    )
    # A red site's other neighbours lie in the cells before it, a blue one's in those behind.
    anchor = 1 if color == _RED else 0
    row, column, square = (np.ones(shape, np.uint8) for shape in ((1, 2), (2, 1), (2, 2)))
    green = cv2.addWeighted(
        cv2.dilate(left_right, row, anchor=(anchor, 0)), 0.5, cv2.dilate(up_down, column, anchor=(0, anchor)), 0.5, 0
    )
    return np.asarray(cv2.max(green, cv2.dilate(across, square, anchor=(anchor, anchor))))
