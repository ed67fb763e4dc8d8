"""Images for screens with boxes and marker centres drawn in, and thumbnails of pairs as data URIs."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.storage.pair_faults import PairFaults, read_or_note
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.images import StereoImages, display_table
from datasets_manifest.types.records import PairRecord, PixelBox, PixelPoint

Picture = NDArray[np.uint8]
Rgb = tuple[int, int, int]

BOX_RGB: Rgb = (255, 221, 51)
MARKER_RGB: Rgb = (51, 238, 255)

# Low corner of an image in pixel-centre coordinates.
_IMAGE_CORNER = (-0.5, -0.5)

# OpenCV gets coordinates in 1/16 px, so that lines lie where the labels say.
_SHIFT = 4

# OpenCV has integers of 32 bits.
_FARTHEST_PX = 1e6


def display_picture(images: StereoImages) -> Picture:
    """(H, W, 3) left image in sRGB, for a screen."""
    table = display_table(images.encoding, images.bits, images.black_level_dn)
    picture = np.take(table, images.left, mode="clip").astype(np.uint8)
    return np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture


def resized(picture: Picture, width_px: int) -> tuple[Picture, float]:
    """A copy of that width, and how much larger it is than the picture."""
    scale = width_px / picture.shape[1]
    size = (width_px, max(1, round(picture.shape[0] * scale)))
    copy = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    return np.asarray(copy, dtype=np.uint8), scale


def draw_box(
    tile: Picture,
    box_px: PixelBox,
    scale: float,
    corner_px: PixelPoint = _IMAGE_CORNER,
    color: Rgb = BOX_RGB,
    line_px: int = 1,
) -> None:
    """Draw a box of an image into a resized copy of it, or an enlarged cut-out.

    Args:
        tile: (H, W, 3) the copy.
        box_px: x, y, width, height in the image.
        scale: size of the copy over that of what it shows.
        corner_px: low corner of what it shows.
        color: red, green, blue.
        line_px: width of the lines.
    """
    x, y, width, height = box_px
    low, high = (_fixed_point(end, scale, corner_px) for end in ((x, y), (x + width, y + height)))
    cv2.rectangle(tile, low, high, color, line_px, cv2.LINE_AA, _SHIFT)


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
    """Where an image point lies in a cut-out, in OpenCV's fixed point; points far outside stay outside."""
    x, y = ((value - low) * scale - 0.5 for value, low in zip(point, corner, strict=True))
    x, y = (min(max(place, -_FARTHEST_PX), _FARTHEST_PX) for place in (x, y))
    return round(x * 2**_SHIFT), round(y * 2**_SHIFT)


TILE_WIDTH_PX = 400
_JPEG_QUALITY = 82

# A drogue smaller than this share of the picture's width is shown once more, enlarged, in a corner.
ENLARGE_BELOW = 0.3
_INSET_SHARE = 0.38
_INSET_MARGIN = 1.25

# Records read for their distance: enough to spread a dozen pairs over any range of distances.
_MOST_CANDIDATES = 240


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


def contact_tiles(dataset: Dataset, count: int = 12, faults: PairFaults | None = None) -> list[Tile]:
    """Up to `count` pairs spread over the distances, nearest first; empty if no pair shows a drogue.

    Args:
        dataset: of the pairs.
        count: how many.
        faults: count damaged pairs, which are left out; without, such a pair is an error.
    """
    indices = dataset.frame_indices
    candidates = [indices[k] for k in evenly_spaced(len(indices), _MOST_CANDIDATES)]
    read = (read_or_note(index, dataset.record, faults) for index in candidates)
    records = [record for record in read if record is not None and record.left_from_drogue is not None]
    records.sort(key=lambda record: (_distance_m(record), record.frame_index))
    tiles = []
    for record in (records[k] for k in evenly_spaced(len(records), count)):
        images = read_or_note(record.frame_index, dataset.images, faults)
        if images is None:
            continue
        view = record.views.left
        centers = [marker.center_ellipse_px for marker in view.markers if marker.visible_fraction > 0]
        picture = label_picture(display_picture(images), view.box_visible_xywh_px, centers)
        tiles.append(tile_of(record.frame_index, _distance_m(record), picture))
    return tiles


def tile_of(frame_index: int, distance_m: float, picture: Picture) -> Tile:
    """A picture as a thumbnail."""
    return Tile(frame_index, distance_m, jpeg_uri(picture), picture.shape[1], picture.shape[0])


def label_picture(picture: Picture, box: PixelBox | None, centers: Sequence[PixelPoint]) -> Picture:
    """A small copy of an image with a box and the marker centres; a far drogue also enlarged in a corner.

    Args:
        picture: (H, W, 3) the image.
        box: around the drogue, or None where it is not seen; nothing is drawn then.
        centers: of the visible markers. [px]
    """
    width = picture.shape[1]
    tile, scale = resized(picture, TILE_WIDTH_PX)
    if box is None:
        return tile
    draw_box(tile, box, scale)
    if box[2] >= ENLARGE_BELOW * width:
        draw_crosses(tile, centers, scale)
    else:
        _put_inset(tile, picture, box, centers)
    return tile


def jpeg_uri(picture: Picture) -> str:
    """An RGB picture as a JPEG data URI."""
    _, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def _put_inset(tile: Picture, picture: Picture, box: PixelBox, centers: Sequence[PixelPoint]) -> None:
    """Enlarge the surroundings of the box into the corner that is farthest from it."""
    inset, scale, corner = enlarged_surroundings(picture, box, tile.shape[0])
    draw_crosses(inset, centers, scale, corner)
    put_in_far_corner(tile, inset, (box[0] + box[2] / 2) / picture.shape[1], (box[1] + box[3] / 2) / picture.shape[0])


def enlarged_surroundings(picture: Picture, box: PixelBox, tile_height: int) -> tuple[Picture, float, PixelPoint]:
    """A square around a box, as large as an inset of a tile of that height.

    Returns:
        The inset, its size over that of what it shows, and the low corner of what it shows. [px]
    """
    side = round(_INSET_SHARE * tile_height)
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
    return np.asarray(inset, dtype=np.uint8), scale, corner


def put_in_far_corner(tile: Picture, inset: Picture, x_share: float, y_share: float) -> None:
    """Frame an inset and put it into the corner that is farthest from a place, given as shares of the tile's size."""
    side = inset.shape[0]
    cv2.rectangle(inset, (0, 0), (side - 1, side - 1), BOX_RGB, 1)
    x = 0 if x_share > 0.5 else tile.shape[1] - side
    y = 0 if y_share > 0.5 else tile.shape[0] - side
    tile[y : y + side, x : x + side] = inset


def evenly_spaced(length: int, count: int) -> list[int]:
    """Up to `count` places spread over a list, both ends among them."""
    return sorted({round(place) for place in np.linspace(0, length - 1, min(count, length))}) if length else []


def _distance_m(record: PairRecord) -> float:
    return float(record.left_from_drogue.translation_m[2]) if record.left_from_drogue is not None else 0.0
