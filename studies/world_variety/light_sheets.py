"""Sheets of drogues and tankers at four distances in four lights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from datasets_manifest.atomic import write_bytes_atomic
from droguekit.api.recipe_rendering import load_recipe, render_dataset
from droguekit.api.stereo_dataset import StereoPair
from droguekit.scoring.report.label_drawing import Picture, display_picture, resized

LIGHTS_RECIPE = Path(__file__).with_name("lights.toml")
_TILE_PX = 240
_GAP_PX = 4
_CAPTION_PX = 26
_PAPER = 24
_TEXT_RGB = (255, 255, 255)
# A drogue is shown with its surroundings, but never enlarged by more than twice.
_VIEW_PER_BOX = 1.8
_LEAST_VIEW_PX = 120


def sheet_rows(
    out: Path, subjects: Mapping[str, Mapping[str, Any]], workers: int | None, whole_image: bool
) -> dict[str, Picture]:
    """A row of 16 tiles for each subject: four lights at 1.5 m, then at 4, 10 and 30 m.

    Args:
        out: folder of the datasets; pairs that exist there are kept.
        subjects: changes of the recipe by name, which must be fit for a folder.
        workers: processes that render.
        whole_image: show whole images, instead of the drogue with its surroundings.

    Raises:
        ValueError: a change that the recipe does not take; names the key.
        OSError: the folder cannot be written.
    """
    rows = {}
    for name, changes in subjects.items():
        dataset = render_dataset(load_recipe(str(LIGHTS_RECIPE), **changes), out / name, workers=workers)
        rows[name] = _row(name, [_image_tile(pair) if whole_image else _drogue_tile(pair) for pair in dataset])
    return rows


def write_sheet(rows: Sequence[Picture], path: Path) -> None:
    """Write rows one below the other as a PNG or JPEG file.

    Raises:
        OSError: it cannot be written.
    """
    sheet = np.concatenate(list(rows))
    _, data = cv2.imencode(path.suffix, cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    write_bytes_atomic(path, data.tobytes())


def _row(name: str, tiles: list[Picture]) -> Picture:
    height_px, width_px = tiles[0].shape[:2]
    length_px = len(tiles) * (width_px + _GAP_PX)
    row = np.full((_CAPTION_PX + height_px + _GAP_PX, length_px, 3), _PAPER, dtype=np.uint8)
    cv2.putText(row, name, (4, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.55, _TEXT_RGB, 1, cv2.LINE_AA)
    for place, tile in enumerate(tiles):
        left = place * (width_px + _GAP_PX)
        row[_CAPTION_PX : _CAPTION_PX + height_px, left : left + width_px] = tile
    return row


def _image_tile(pair: StereoPair) -> Picture:
    return _captioned(resized(display_picture(pair.images), _TILE_PX * 4 // 3)[0], pair)


def _drogue_tile(pair: StereoPair) -> Picture:
    picture = display_picture(pair.images)
    box = pair.record.views.left.box_full_xywh_px
    assert box is not None  # every frame of the recipe has a drogue
    x, y, width, height = box
    side = max(_VIEW_PER_BOX * max(width, height), _LEAST_VIEW_PX)
    scale = _TILE_PX / side
    place = np.array(
        [
            [scale, 0.0, _TILE_PX / 2 - scale * (x + width / 2)],
            [0.0, scale, _TILE_PX / 2 - scale * (y + height / 2)],
        ]
    )
    if scale < 1:
        picture = cv2.GaussianBlur(picture, (0, 0), 0.4 / scale)
    paper = (_PAPER,) * 3
    tile = cv2.warpAffine(picture, place, (_TILE_PX, _TILE_PX), flags=cv2.INTER_LINEAR, borderValue=paper)
    return _captioned(np.asarray(tile, dtype=np.uint8), pair)


def _captioned(tile: Picture, pair: StereoPair) -> Picture:
    conditions = pair.record.conditions
    text = f"{conditions.distance_m:g} m, {conditions.family}"
    for color, thickness in (((0, 0, 0), 3), (_TEXT_RGB, 1)):
        foot = (6, tile.shape[0] - 7)
        cv2.putText(tile, text, foot, cv2.FONT_HERSHEY_SIMPLEX, 0.42, color, thickness, cv2.LINE_AA)
    return tile
