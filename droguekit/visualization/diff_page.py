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
from droguekit.scoring.report.number_text import percent

_SHOWN_PAIRS, _TILE_PX, _JPEG_QUALITY = 4, 320, 80
_WIDTH_PX, _HEIGHT_PX = 192, 48
# More words of a law are folded.
_OPEN_WORDS = 6
_BAR = Markup(
    '<rect x="{:.2f}" y="{:.2f}" width="{:.2f}" height="{:.2f}" fill="var(--{})"><title>of this part: {}</title></rect>'
)


class _Word(NamedTuple):
    """A word of a law: its shares as text, and the lengths of their bars. [%]"""

    name: str
    shares: tuple[str, str]
    lengths: tuple[float, float]


class _ShownLaw(NamedTuple):
    """A law of numbers with a picture, or one of words with its words, the commonest first."""

    law: LawDiff
    bars: Markup
    words: list[_Word]


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
        open_words=_OPEN_WORDS,
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text_atomic(out, page)


def _shown(laws: tuple[LawDiff, ...]) -> list[_ShownLaw]:
    """Laws in pictures; what differs comes first."""
    shown = []
    for law in sorted(laws, key=lambda law: not law.differs):
        # Of numbers only the two ends of their range have names.
        are_words = len(law.ends) == len(law.shares[0])
        shown.append(_ShownLaw(law, *((Markup(), _words(law)) if are_words else (_bars(law), []))))
    return shown


def _key_table(title: str, anchor: str, keys: tuple[KeyDiff, ...]) -> Table:
    rows = [[key.key, key.a or "missing", key.b or "missing"] for key in keys]
    return Table(
        anchor, title, ["A", "B"], [RowGroup("", rows)], first=None, second="key", text_columns=frozenset(("A", "B"))
    )


def _bars(law: LawDiff) -> Markup:
    """Two rows of bars as an SVG: shares of A upwards, of B downwards."""
    most, step = max((*law.shares[0], *law.shares[1], 1e-9)), _WIDTH_PX / len(law.shares[0])
    bars = []
    for place, pair in enumerate(zip(*law.shares, strict=True)):
        for share, color in zip(pair, "ab", strict=True):
            length = share / most * _HEIGHT_PX / 2
            top = _HEIGHT_PX / 2 - (length if color == "a" else 0.0)
            bars.append(_BAR.format(place * step, top, step - 1, length, color, percent(share)))
    frame = Markup('<svg viewBox="0 0 {} {}" role="img" aria-label="shares of A upwards, of B downwards">{}</svg>')
    return frame.format(_WIDTH_PX, _HEIGHT_PX, Markup("").join(bars))


def _words(law: LawDiff) -> list[_Word]:
    words = zip(law.ends, *law.shares, strict=True)
    return [
        _Word(name, (percent(a), percent(b)), (100 * a, 100 * b))
        for name, a, b in sorted(words, key=lambda word: -max(word[1:]))
    ]


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
