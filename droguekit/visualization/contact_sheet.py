"""Contact sheets: left images side by side with their labels."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

from datasets_manifest.atomic import write_bytes_atomic
from datasets_manifest.storage.blind import BlindDataset, BlindPair
from datasets_manifest.storage.layout import BLIND_FILE
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location, open_storage
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import PairRecord
from droguekit.scoring.report.label_drawing import Picture, display_picture, draw_box, draw_crosses, resized
from droguekit.visualization.video_file import evenly

_HUB_RGB = (255, 120, 220)
_TEXT_RGB = (255, 255, 255)
_PAPER = 24
_GAP_PX = 4
_CAPTION_PX = 22
# A sheet takes three bytes a pixel while it is drawn.
_MOST_PX = 2**28
# libjpeg's JPEG_MAX_DIMENSION
_MOST_JPEG_SIDE_PX = 65_500


def write_contact_sheet(
    dataset: Location, out: Path, count: int, columns: int, tile_width_px: int, by_family: bool
) -> tuple[int, int]:
    """Draw pairs of a dataset, spread evenly, and write the sheet as PNG or JPEG.

    Args:
        dataset: with its truth or without.
        out: ends in .png or .jpg.
        count: pairs at most.
        columns: tiles in a row, or families side by side.
        tile_width_px: width of a tile.
        by_family: a row for each family of conditions, without labels.

    Returns:
        How many pairs it shows, and how many there are.

    Raises:
        ValueError: a number out of its range, another ending, no pairs, one that cannot be read, or a sheet that is
            too large.
        OSError: it cannot be written.
    """
    _check_arguments(out, count, columns, tile_width_px)
    sheet, shown, pairs = _draw_sheet(dataset, out, count, columns, tile_width_px, by_family)
    _, data = cv2.imencode(out.suffix.lower(), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    write_bytes_atomic(out, data.tobytes())
    return shown, pairs


def _check_arguments(out: Path, count: int, columns: int, tile_width: int) -> None:
    for name, value, low, high in (
        ("count", count, 1, 400),
        ("columns", columns, 1, 40),
        ("tile-width", tile_width, 64, 4096),
    ):
        if not low <= value <= high:
            raise ValueError(f"--{name}: must be from {low} to {high}, got {value}")
    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise ValueError(f"--out: must end in .png or .jpg, got {out}")


def _draw_sheet(
    dataset: Location, out: Path, count: int, columns: int, tile_width: int, by_family: bool
) -> tuple[Picture, int, int]:
    """The sheet, the number of pairs that it shows, and of all pairs."""
    is_blind = open_storage(dataset).exists(BLIND_FILE)
    if is_blind and by_family:
        raise ValueError(f"--by-family: {dataset} has no truth, and so no families")
    source = BlindDataset(dataset) if is_blind else Dataset(dataset)
    pairs = len(source.frame_indices)
    if not pairs:
        raise ValueError(f"{dataset}: holds no pairs yet")
    if by_family and isinstance(source, Dataset):
        sheet, shown = _family_sheet(source, out, count, columns, tile_width)
        return sheet, shown, pairs
    frames = evenly(source.frame_indices, count)
    tiles = (
        _draw_blind_tile(source.pair(index), tile_width)
        if isinstance(source, BlindDataset)
        else _draw_tile(source.images(index), source.record(index), tile_width)
        for index in frames
    )
    columns = min(columns, len(frames))
    return _grid(tiles, (math.ceil(len(frames) / columns), columns), out), len(frames), pairs


def _grid(tiles: Iterable[Picture], shape: tuple[int, int], out: Path, down: bool = False) -> Picture:
    """Equal tiles in rows, or in columns, on a sheet that a file can hold.

    Args:
        tiles: in reading order; only the first is drawn where the sheet is too large.
        shape: rows and columns.
        out: file of the sheet.
        down: whether they are read from top to bottom first.

    Returns:
        (H, W, 3) in the order red, green, blue.

    Raises:
        ValueError: the sheet is too large for its file.
    """
    sheet: Picture | None = None
    for place, tile in enumerate(tiles):
        height_px, width_px = tile.shape[0] + _GAP_PX, tile.shape[1] + _GAP_PX
        if sheet is None:
            size_px = shape[0] * height_px + _GAP_PX, shape[1] * width_px + _GAP_PX
            _check_size(out, *size_px)
            sheet = np.full((*size_px, 3), _PAPER, dtype=np.uint8)
        row, column = divmod(place, shape[0])[::-1] if down else divmod(place, shape[1])
        top, left = _GAP_PX + row * height_px, _GAP_PX + column * width_px
        sheet[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
    assert sheet is not None
    return sheet


def _check_size(out: Path, height_px: int, width_px: int) -> None:
    suffix, size = out.suffix.lower(), f"the sheet would be {width_px} x {height_px} px"
    if height_px * width_px > _MOST_PX:
        raise ValueError(f"--out: {size}, and {_MOST_PX} px in all are the most; lower --count or --tile-width")
    if suffix != ".png" and max(height_px, width_px) > _MOST_JPEG_SIDE_PX:
        raise ValueError(
            f"--out: {size}, and a side of a {suffix} file has at most {_MOST_JPEG_SIDE_PX}; write a .png, or change "
            "--columns"
        )


def _family_sheet(dataset: Dataset, out: Path, count: int, columns: int, tile_width_px: int) -> tuple[Picture, int]:
    """Left images without labels, a row for each family of conditions, with the distance of the drogue in a corner.

    Args:
        dataset: of the pairs.
        out: file of the sheet.
        count: tiles at most; every family gets the same number, as long as it has pairs, spread evenly over them.
        columns: families side by side.
        tile_width_px: width of a tile; its height follows the images.

    Returns:
        (H, W, 3) in the order red, green, blue, and how many pairs it shows.

    Raises:
        ValueError: an image or a record cannot be read, or there are more families than tiles.
    """
    families: dict[str, list[int]] = {}
    for index in dataset.frame_indices:
        families.setdefault(dataset.record(index).conditions.family, []).append(index)
    if count < len(families):
        raise ValueError(f"--count: must be at least {len(families)}, a pair for each family, got {count}")
    length = min(count // len(families), max(map(len, families.values())))
    shown = {name: evenly(indices, length) for name, indices in families.items()}
    rows = math.ceil(len(shown) / min(columns, len(shown)))
    blocks = (_family_row(dataset, name, indices, length, tile_width_px) for name, indices in shown.items())
    sheet = _grid(blocks, (rows, math.ceil(len(shown) / rows)), out, down=True)
    return sheet, sum(map(len, shown.values()))


def _family_row(dataset: Dataset, name: str, frames: Sequence[int], length: int, width_px: int) -> Picture:
    """A caption with the family's name over its tiles, from left to right."""
    tiles = [_plain_tile(dataset.images(index), dataset.record(index), width_px) for index in frames]
    height_px = tiles[0].shape[0]
    row = np.full((_CAPTION_PX + height_px, length * (width_px + _GAP_PX) - _GAP_PX, 3), _PAPER, dtype=np.uint8)
    cv2.putText(row, name, (4, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT_RGB, 1, cv2.LINE_AA)
    for place, tile in enumerate(tiles):
        left = place * (width_px + _GAP_PX)
        row[_CAPTION_PX:, left : left + width_px] = tile
    return row


def _plain_tile(images: StereoImages, record: PairRecord, width_px: int) -> Picture:
    picture, _ = resized(display_picture(images), width_px)
    distance_m = record.conditions.distance_m
    text = "no drogue" if distance_m is None else f"{distance_m:.1f} m"
    foot = (6, picture.shape[0] - 7)
    for color, thickness in (((0, 0, 0), 3), (_TEXT_RGB, 1)):
        cv2.putText(picture, text, foot, cv2.FONT_HERSHEY_SIMPLEX, 0.42, color, thickness, cv2.LINE_AA)
    return picture


def _draw_tile(images: StereoImages, record: PairRecord, width_px: int) -> Picture:
    picture, scale = resized(display_picture(images), width_px)
    view = record.views.left
    if view.box_full_xywh_px is not None:
        draw_box(picture, view.box_full_xywh_px, scale)
    for other in view.neighbours:
        draw_box(picture, other.box_full_xywh_px, scale)
    draw_crosses(picture, [marker.center_ellipse_px for marker in view.markers], scale)
    if view.hub is not None and view.hub.visible_fraction > 0:
        draw_crosses(picture, [view.hub.center_ellipse_px], scale, color=_HUB_RGB)
    distance_m = record.conditions.distance_m
    what = "no drogue" if distance_m is None else f"{distance_m:.2f} m"
    return _with_caption(picture, f"{record.frame_index}: {what}")


def _draw_blind_tile(pair: BlindPair, width_px: int) -> Picture:
    picture, _ = resized(display_picture(pair.images), width_px)
    return _with_caption(picture, f"{pair.frame_index}: {pair.images.time_s:.2f} s")


def _with_caption(picture: Picture, text: str) -> Picture:
    caption = np.zeros((_CAPTION_PX, picture.shape[1], 3), dtype=np.uint8)
    cv2.putText(caption, text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT_RGB, 1, cv2.LINE_AA)
    tile: Picture = np.concatenate([picture, caption])
    return tile
