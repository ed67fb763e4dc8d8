"""Images as a screen wants them, with boxes and centres drawn where the labels say."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import PixelBox, PixelPoint

Picture = NDArray[np.uint8]
Rgb = tuple[int, int, int]

BOX_RGB: Rgb = (255, 221, 51)
MARKER_RGB: Rgb = (51, 238, 255)

# Low corner of an image in pixel-centre coordinates.
_IMAGE_CORNER = (-0.5, -0.5)

# Coordinates are handed to OpenCV in 1/16 px, so that lines stand where the labels say.
_SHIFT = 4


def display_picture(images: StereoImages) -> Picture:
    """(H, W, 3) left image in sRGB, as a screen wants it."""
    span = 2**images.bits - 1 - images.black_level_dn
    level = np.clip((images.left.astype(np.float32) - images.black_level_dn) / span, 0, 1)
    if images.encoding == "linear":
        # IEC 61966-2-1, the sRGB curve.
        level = np.where(level <= 0.0031308, 12.92 * level, 1.055 * level ** (1 / 2.4) - 0.055)
    picture = np.rint(255 * level).astype(np.uint8)
    return np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture


def resized(picture: Picture, width_px: int) -> tuple[Picture, float]:
    """A copy of that width, and how much larger it is than the picture."""
    scale = width_px / picture.shape[1]
    size = (width_px, round(picture.shape[0] * scale))
    copy = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    return np.asarray(copy, dtype=np.uint8), scale


def draw_box(
    tile: Picture, box_px: PixelBox, scale: float, corner_px: PixelPoint = _IMAGE_CORNER, color: Rgb = BOX_RGB
) -> None:
    """Draw a box of an image into a resized copy of it, or an enlarged cut-out.

    Args:
        tile: (H, W, 3) the copy.
        box_px: x, y, width, height in the image.
        scale: size of the copy over that of what it shows.
        corner_px: low corner of what it shows.
        color: red, green, blue.
    """
    x, y, width, height = box_px
    low, high = (_fixed_point(end, scale, corner_px) for end in ((x, y), (x + width, y + height)))
    cv2.rectangle(tile, low, high, color, 1, cv2.LINE_AA, _SHIFT)


def draw_crosses(
    tile: Picture,
    centers_px: Sequence[PixelPoint],
    scale: float,
    corner_px: PixelPoint = _IMAGE_CORNER,
    color: Rgb = MARKER_RGB,
) -> None:
    """Draw points of an image as small crosses into an enlarged cut-out of it, or a copy of the whole.

    Args:
        tile: (H, W, 3) the cut-out.
        centers_px: points of the image.
        scale: size of the cut-out over that of what it shows.
        corner_px: low corner of the cut-out in the image.
        color: red, green, blue.
    """
    for center in centers_px:
        x, y = _fixed_point(center, scale, corner_px)
        arm = 4 << _SHIFT
        cv2.line(tile, (x - arm, y), (x + arm, y), color, 1, cv2.LINE_AA, _SHIFT)
        cv2.line(tile, (x, y - arm), (x, y + arm), color, 1, cv2.LINE_AA, _SHIFT)


def _fixed_point(point: PixelPoint, scale: float, corner: PixelPoint) -> tuple[int, int]:
    """Where an image point lies in a cut-out, in OpenCV's fixed point."""
    x, y = ((value - low) * scale - 0.5 for value, low in zip(point, corner, strict=True))
    return round(x * 2**_SHIFT), round(y * 2**_SHIFT)
