"""Small pictures of a dataset's pairs with their labels drawn in, as data URIs."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.images import StereoImages
from datasets_manifest.reader import Dataset
from datasets_manifest.records import PairRecord, PixelBox, PixelPoint, ViewRecord

Picture = NDArray[np.uint8]

_TILE_WIDTH_PX = 400
_JPEG_QUALITY = 82
_BOX_RGB = (255, 221, 51)
_CENTER_RGB = (51, 238, 255)

# A drogue smaller than this share of the picture's width is shown once more, enlarged, in a corner.
_ENLARGE_BELOW = 0.3
_INSET_SHARE = 0.38
_INSET_MARGIN = 1.25

# Pairs looked at for their distance: enough to spread a dozen over any range of distances.
_MOST_LOOKED_AT = 240

# Coordinates are handed to OpenCV in 1/16 px, so that lines stand where the labels say.
_SHIFT = 4


@dataclass(frozen=True)
class Tile:
    """One picture.

    Attributes:
        frame_index: of the pair.
        distance_m: Z of the rim's centre in the left camera. [m]
        data_uri: JPEG of the left image.
        width_px, height_px: its size.
    """

    frame_index: int
    distance_m: float
    data_uri: str
    width_px: int
    height_px: int


def contact_tiles(dataset: Dataset, count: int = 12) -> list[Tile]:
    """Up to `count` pairs spread over the distances, nearest first; empty if no pair shows a drogue."""
    indices = dataset.frame_indices
    looked_at = [indices[k] for k in _spread(len(indices), _MOST_LOOKED_AT)]
    records = [record for record in map(dataset.record, looked_at) if record.left_from_drogue is not None]
    records.sort(key=lambda record: (_distance_m(record), record.frame_index))
    tiles = []
    for record in (records[k] for k in _spread(len(records), count)):
        picture = label_picture(display_picture(dataset.images(record.frame_index)), record.views.left)
        tiles.append(
            Tile(record.frame_index, _distance_m(record), jpeg_uri(picture), picture.shape[1], picture.shape[0])
        )
    return tiles


def display_picture(images: StereoImages) -> Picture:
    """(H, W, 3) left image in sRGB, as a screen wants it."""
    span = 2**images.bits - 1 - images.black_level_dn
    level = np.clip((images.left.astype(np.float32) - images.black_level_dn) / span, 0, 1)
    if images.encoding == "linear":
        # IEC 61966-2-1, the sRGB curve.
        level = np.where(level <= 0.0031308, 12.92 * level, 1.055 * level ** (1 / 2.4) - 0.055)
    picture = np.rint(255 * level).astype(np.uint8)
    return np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture


def label_picture(picture: Picture, view: ViewRecord) -> Picture:
    """A small copy of an image with the visible box and the marker centres; a far drogue also enlarged in a corner."""
    height, width = picture.shape[:2]
    scale = _TILE_WIDTH_PX / width
    size = (_TILE_WIDTH_PX, round(height * scale))
    tile = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    box = view.box_visible_xywh_px
    if box is None:
        return np.asarray(tile, dtype=np.uint8)
    _draw_box(tile, box, scale, (-0.5, -0.5))
    centers = [marker.center_ellipse_px for marker in view.markers if marker.visible_fraction > 0]
    if box[2] >= _ENLARGE_BELOW * width:
        _draw_centers(tile, centers, scale, (-0.5, -0.5))
    else:
        _put_inset(tile, picture, box, centers)
    return np.asarray(tile, dtype=np.uint8)


def jpeg_uri(picture: Picture) -> str:
    """An RGB picture as a JPEG data URI."""
    _, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def _put_inset(tile: Picture, picture: Picture, box: PixelBox, centers: Sequence[PixelPoint]) -> None:
    """Enlarge the surroundings of the box into the corner that is farthest from it."""
    side = round(_INSET_SHARE * tile.shape[0])
    middle = (box[0] + box[2] / 2, box[1] + box[3] / 2)
    reach = _INSET_MARGIN * max(box[2], box[3])
    scale = side / reach
    corner = (middle[0] - reach / 2, middle[1] - reach / 2)
    # Pixel (i, j) of the inset shows the image at corner + (i + 1/2) / scale, in pixel-centre coordinates.
    start = [low + 0.5 / scale for low in corner]
    warp = np.array([[1 / scale, 0, start[0]], [0, 1 / scale, start[1]]])
    inset = cv2.warpAffine(
        picture, warp, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
    )
    _draw_centers(inset, centers, scale, corner)
    cv2.rectangle(inset, (0, 0), (side - 1, side - 1), _BOX_RGB, 1)
    x = 0 if middle[0] > picture.shape[1] / 2 else tile.shape[1] - side
    y = 0 if middle[1] > picture.shape[0] / 2 else tile.shape[0] - side
    tile[y : y + side, x : x + side] = inset


def _draw_box(tile: Picture, box: PixelBox, scale: float, corner: PixelPoint) -> None:
    ends = [(box[0], box[1]), (box[0] + box[2], box[1] + box[3])]
    low, high = (_fixed_point(end, scale, corner) for end in ends)
    cv2.rectangle(tile, low, high, _BOX_RGB, 1, cv2.LINE_AA, _SHIFT)


def _draw_centers(tile: Picture, centers: Sequence[PixelPoint], scale: float, corner: PixelPoint) -> None:
    for center in centers:
        x, y = _fixed_point(center, scale, corner)
        arm = 4 << _SHIFT
        cv2.line(tile, (x - arm, y), (x + arm, y), _CENTER_RGB, 1, cv2.LINE_AA, _SHIFT)
        cv2.line(tile, (x, y - arm), (x, y + arm), _CENTER_RGB, 1, cv2.LINE_AA, _SHIFT)


def _fixed_point(point: PixelPoint, scale: float, corner: PixelPoint) -> tuple[int, int]:
    """Where an image point lies in an enlarged cut-out, whose low corner is given, in OpenCV's fixed point."""
    x, y = ((value - low) * scale - 0.5 for value, low in zip(point, corner, strict=True))
    return round(x * 2**_SHIFT), round(y * 2**_SHIFT)


def _spread(length: int, count: int) -> list[int]:
    """Up to `count` places spread over a list, both ends among them."""
    return sorted({round(place) for place in np.linspace(0, length - 1, min(count, length))}) if length else []


def _distance_m(record: PairRecord) -> float:
    return float(record.left_from_drogue.translation_m[2]) if record.left_from_drogue is not None else 0.0
