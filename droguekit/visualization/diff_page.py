"""How two datasets differ, as one self-contained HTML page: a picture of each law, and pairs side by side."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
from markupsafe import Markup

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from droguekit.assurance.dataset_diff import DatasetDiff, KeyDiff
from droguekit.assurance.law_comparison import LawDiff
from droguekit.scoring.report.html_page import RowGroup, Table, page_template
from droguekit.scoring.report.label_drawing import display_picture, resized

_SHOWN_PAIRS, _TILE_PX, _JPEG_QUALITY = 4, 320, 80
_BAR_PX, _HEIGHT_PX = 8, 48
# Numbers have as many parts.
_MOST_BARS = 24
_BAR = Markup('<rect x="{}" y="{:.2f}" width="{}" height="{:.2f}" fill="var(--{})"><title>{}: {:.0f} %</title></rect>')


class _ShownPair(NamedTuple):
    data: str
    text: str


def write_diff_page(found: DatasetDiff, datasets: tuple[Location, Location], out: Path, chance: float) -> None:
    """Write the page; it is replaced as a whole, or not at all.

    Args:
        found: how the datasets differ.
        datasets: where they are, for some pictures.
        out: file to write.
        chance: of a difference in any row without a cause.

    Raises:
        ValueError: an image cannot be read.
        OSError: the page cannot be written.
    """
    tables = (("Recipe", "recipe", found.recipe), ("Software and engines", "manifest", found.manifest))
    page = page_template("diff_page.html.j2", __package__).render(
        title=f"{found.names[0]} and {found.names[1]}",
        found=found,
        sides=list(zip("ab", found.names, found.sha256, found.pairs, strict=True)),
        chance=f"{100 * chance:g} %",
        groups=[("Labels", _shown(found.labels)), ("Pixels", _shown(found.pixels))],
        tables=[_key_table(title, anchor, keys) for title, anchor, keys in tables if keys],
        pictures=list(_pictures(datasets)),
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text_atomic(out, page)


def _shown(laws: tuple[LawDiff, ...]) -> list[tuple[LawDiff, Markup]]:
    """Laws and their pictures; what differs comes first."""
    return [(law, _bars(law)) for law in sorted(laws, key=lambda law: not law.differs)]


def _key_table(title: str, anchor: str, keys: tuple[KeyDiff, ...]) -> Table:
    rows = [[key.key, key.a or "missing", key.b or "missing"] for key in keys]
    return Table(
        anchor, title, ["A", "B"], [RowGroup("", rows)], first=None, second="key", text_columns=frozenset(("A", "B"))
    )


def _bars(law: LawDiff) -> Markup:
    """Two rows of bars as an SVG: shares of A upwards, of B downwards."""
    most = max((*law.shares[0], *law.shares[1], 1e-9))
    are_words = len(law.ends) == len(law.shares[0])
    bars = []
    for place, pair in enumerate(zip(*law.shares, strict=True)):
        if place == _MOST_BARS:
            break
        label = law.ends[place] if are_words else "of this part"
        for share, color in zip(pair, "ab", strict=True):
            length = share / most * _HEIGHT_PX / 2
            top = _HEIGHT_PX / 2 - (length if color == "a" else 0.0)
            bars.append(_BAR.format(place * _BAR_PX, top, _BAR_PX - 1, length, color, label, 100 * share))
    frame = Markup('<svg viewBox="0 0 {} {}" role="img" aria-label="shares">{}</svg>')
    return frame.format(_MOST_BARS * _BAR_PX, _HEIGHT_PX, Markup("").join(bars))


def _pictures(datasets: tuple[Location, Location]) -> Iterator[_ShownPair]:
    sources = [Dataset(dataset) for dataset in datasets]
    for place in range(_SHOWN_PAIRS):
        for letter, source in zip("AB", sources, strict=True):
            indices = source.frame_indices
            if place >= len(indices):
                continue
            index = indices[place * len(indices) // min(_SHOWN_PAIRS, len(indices))]
            picture = cv2.cvtColor(resized(display_picture(source.images(index)), _TILE_PX)[0], cv2.COLOR_RGB2BGR)
            data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
            yield _ShownPair(base64.b64encode(data).decode(), f"{letter}, pair {index}")
