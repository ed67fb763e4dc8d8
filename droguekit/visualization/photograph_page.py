"""Photographs with found and drawn boxes, as one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.importers.photographs import shown_photograph
from droguekit.assurance.photograph_check import PhotographCheck, PhotographResult, check_lines
from droguekit.scoring.report.html_page import page_template
from droguekit.scoring.report.label_drawing import draw_box, jpeg_uri, resized

_TILE_PX, _LINE_PX = 480, 2
# A strip that is narrower than a tile would be beyond what JPEG can hold.
_TALLEST_PX = 4000
_MOST_TILES = 200
HIT_RGB, FALSE_RGB, DRAWN_RGB, FOUND_RGB = (60, 200, 90), (235, 60, 50), (255, 205, 60), (70, 170, 255)
"""Colours of found boxes that are drogues, that are none, of drawn boxes, and of found ones that nobody judged."""


class _Tile(NamedTuple):
    uri: str
    width_px: int
    height_px: int
    name: str
    text: str


def write_photograph_page(found: PhotographCheck, folder: Path, out: Path) -> None:
    """Write the page; it is replaced as a whole, or not at all.

    Args:
        found: what was found.
        folder: of the photographs.
        out: file to write.

    Raises:
        ValueError: a photograph cannot be read any more.
        OSError: the page cannot be written.
    """
    groups = [(title, chosen) for title, chosen in _groups(found) if chosen]
    lines = list(check_lines(found))
    page = page_template("photograph_page.html.j2", __package__).render(
        title=f"{folder.resolve().name}: {len(found.photographs)} photographs",
        lines=lines,
        unreadable=found.unreadable,
        colors={name: f"rgb{rgb}" for name, rgb in _COLORS.items()},
        groups=[(title, len(chosen), [_tile(folder, one) for one in chosen[:_MOST_TILES]]) for title, chosen in groups],
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text_atomic(out, page)


_COLORS = {
    "drogue, found": HIT_RGB,
    "false alarm": FALSE_RGB,
    "drawn by hand": DRAWN_RGB,
    "found, not judged": FOUND_RGB,
}


def _groups(found: PhotographCheck) -> Iterator[tuple[str, list[PhotographResult]]]:
    """The photographs in groups: those with faults first."""
    judged = found.judged
    yield "Missed drogues", [one for one in judged if one.misses]
    yield "False alarms", [one for one in judged if one.false_alarms and not one.misses]
    rest = [one for one in judged if not one.misses and not one.false_alarms]
    yield "All drogues found", [one for one in rest if one.drawn]
    yield "Rightly nothing", [one for one in rest if not one.drawn]
    others = [one for one in found.photographs if one.drawn is None]
    best_first = sorted(others, key=lambda one: -max((box.score for box in one.found), default=0.0))
    yield "Found, not judged", [one for one in best_first if one.found]
    yield "Nothing found, not judged", [one for one in best_first if not one.found]


def _tile(folder: Path, one: PhotographResult) -> _Tile:
    picture = shown_photograph(folder / one.name)
    color = np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture
    height, width = color.shape[:2]
    tile, scale = resized(color, max(1, min(_TILE_PX, _TALLEST_PX * width // height)))
    for box in one.drawn or ():
        draw_box(tile, box, scale, color=DRAWN_RGB, line_px=_LINE_PX)
    for found in reversed(one.found):
        rgb = FOUND_RGB if found.is_true is None else HIT_RGB if found.is_true else FALSE_RGB
        draw_box(tile, found.box_xywh_px, scale, color=rgb, line_px=_LINE_PX)
    scores = ", ".join(f"{found.score:.2f}" for found in one.found)
    words = [f"{'score' if len(one.found) == 1 else 'scores'} {scores}" if scores else "no box"]
    if one.family is not None:
        words.append(f"like {one.family}" if one.difference is None else f"not covered: {one.difference}")
    return _Tile(jpeg_uri(tile), tile.shape[1], tile.shape[0], one.name, "; ".join(words))
