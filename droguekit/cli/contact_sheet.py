"""A contact sheet: left images side by side with their labels drawn in."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.images import Pixels, StereoImages
from datasets_manifest.reader import Dataset
from datasets_manifest.records import PairRecord, PixelBox, PixelPoint

Picture = NDArray[np.uint8]

_BOX_RGB = (255, 220, 0)
_MARKER_RGB = (0, 255, 120)
_HUB_RGB = (80, 200, 255)
_TEXT_RGB = (255, 255, 255)
_GAP_PX = 4
_CAPTION_PX = 22


def draw_contact_sheet(dataset: Dataset, frames: Sequence[int], columns: int, tile_width_px: int) -> Picture:
    """Tiles of left images with box, marker and hub centres, and a caption with index and distance.

    Args:
        dataset: where they come from.
        frames: indices, in reading order; at least one.
        columns: tiles in a row.
        tile_width_px: width of a tile; its height follows the images.

    Returns:
        (H, W, 3) in the order red, green, blue.

    Raises:
        ValueError: an image or a record cannot be read.
    """
    tiles = [_draw_tile(dataset.images(index), dataset.record(index), tile_width_px) for index in frames]
    height_px, width_px = tiles[0].shape[:2]
    rows = math.ceil(len(tiles) / columns)
    shape = (rows * (height_px + _GAP_PX) + _GAP_PX, columns * (width_px + _GAP_PX) + _GAP_PX, 3)
    sheet = np.full(shape, 24, dtype=np.uint8)
    for place, tile in enumerate(tiles):
        row, column = divmod(place, columns)
        top, left = _GAP_PX + row * (height_px + _GAP_PX), _GAP_PX + column * (width_px + _GAP_PX)
        sheet[top : top + height_px, left : left + width_px] = tile
    return sheet


def _draw_tile(images: StereoImages, record: PairRecord, width_px: int) -> Picture:
    scale = width_px / images.left.shape[1]
    height_px = round(images.left.shape[0] * scale)
    picture = cv2.resize(_as_rgb8(images.left, images), (width_px, height_px), interpolation=cv2.INTER_AREA)
    view = record.views.left
    if view.box_full_xywh_px is not None:
        _draw_box(picture, view.box_full_xywh_px, scale)
    for marker in view.markers:
        _draw_cross(picture, marker.center_ellipse_px, scale, _MARKER_RGB)
    if view.hub is not None and view.hub.visible_fraction > 0:
        _draw_cross(picture, view.hub.center_ellipse_px, scale, _HUB_RGB)
    distance_m = record.conditions.distance_m
    what = "no drogue" if distance_m is None else f"{distance_m:.2f} m"
    caption = np.zeros((_CAPTION_PX, width_px, 3), dtype=np.uint8)
    text = f"{record.frame_index}: {what}"
    cv2.putText(caption, text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT_RGB, 1, cv2.LINE_AA)
    tile: Picture = np.concatenate([picture, caption])
    return tile


def _as_rgb8(pixels: Pixels, images: StereoImages) -> Picture:
    """An image for the eye: 8 bits, three channels, and the sRGB curve where the numbers are linear."""
    top = 2**images.bits - 1
    values = np.clip((pixels.astype(np.float32) - images.black_level_dn) / (top - images.black_level_dn), 0, 1)
    if images.encoding == "linear":
        # IEC 61966-2-1.
        values = np.where(values <= 0.0031308, 12.92 * values, 1.055 * np.power(values, 1 / 2.4) - 0.055)
    picture: Picture = np.rint(255 * values).astype(np.uint8)
    return picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)


def _to_tile(point_px: PixelPoint, scale: float) -> tuple[float, float]:
    """A point of the image in the scaled tile; both count from the centre of their first pixel."""
    return (point_px[0] + 0.5) * scale - 0.5, (point_px[1] + 0.5) * scale - 0.5


def _draw_box(picture: Picture, box_px: PixelBox, scale: float) -> None:
    x, y, width, height = box_px
    low, high = _to_tile((x, y), scale), _to_tile((x + width, y + height), scale)
    corners = [(round(point[0]), round(point[1])) for point in (low, high)]
    cv2.rectangle(picture, corners[0], corners[1], _BOX_RGB, 1, cv2.LINE_AA)


def _draw_cross(picture: Picture, center_px: PixelPoint, scale: float, color: tuple[int, int, int]) -> None:
    x, y = _to_tile(center_px, scale)
    if 0 <= x < picture.shape[1] and 0 <= y < picture.shape[0]:
        cv2.drawMarker(picture, (round(x), round(y)), color, cv2.MARKER_CROSS, 5, 1, cv2.LINE_AA)
