"""How two datasets differ, as one self-contained HTML page: a picture of each law, and pairs side by side."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
from jinja2 import Environment, StrictUndefined
from markupsafe import escape

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from droguekit.assurance.dataset_diff import DatasetDiff, LawDiff
from droguekit.scoring.report.label_drawing import display_picture, resized

_SHOWN_PAIRS, _TILE_PX, _JPEG_QUALITY = 4, 320, 80
_BAR_PX, _HEIGHT_PX = 8, 48
# Numbers have as many parts.
_MOST_BARS = 24

_TEMPLATE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
:root { color-scheme: light dark; --page: #fff; --ink: #1c2026; --soft: #5b6470; --line: #d5dae0;
  --a: #2f6fb3; --b: #d9822b; --mark: #f6c9c3; }
@media (prefers-color-scheme: dark) { :root { --page: #15181c; --ink: #e6e9ed; --soft: #9aa4b0; --line: #3a424c;
  --a: #6fa8e6; --b: #f0a457; --mark: #6b2d28; } }
body { margin: 0 auto; padding: 1.5rem; max-width: 72rem; background: var(--page); color: var(--ink);
  font: 16px/1.5 system-ui, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.6rem; margin: 0; }
h2 { font-size: 1.15rem; margin: 2rem 0 0.4rem; }
p { margin: 0.3rem 0; overflow-wrap: anywhere; }
.note, .ends { color: var(--soft); font-size: 0.9rem; }
.verdict { font-weight: 600; }
.a { color: var(--a); } .b { color: var(--b); }
.laws { display: grid; grid-template-columns: repeat(auto-fill, minmax(15rem, 1fr)); gap: 0.8rem; }
.law { border: 1px solid var(--line); border-radius: 6px; padding: 0.6rem 0.8rem; }
.law.differs { background: var(--mark); }
.law h3 { font-size: 1rem; margin: 0; overflow-wrap: anywhere; }
.law svg { width: 100%; height: auto; display: block; margin: 0.4rem 0 0; }
.ends { display: flex; justify-content: space-between; font-size: 0.78rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.85rem; }
th, td { text-align: left; padding: 0.2rem 0.8rem 0.2rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
td { overflow-wrap: anywhere; }
.pairs { display: grid; grid-template-columns: 1fr 1fr; gap: 0.6rem; max-width: 44rem; }
.pairs img { width: 100%; display: block; } figure { margin: 0; } figcaption { font-size: 0.85rem; }
</style>
</head>
<body>
<h1>{{ title }}</h1>
<p class="verdict">{{ found.verdict }}</p>
{% for letter, name, sha256, pairs in sides %}
<p><b class="{{ letter }}">{{ letter|upper }}</b> {{ name }}, {{ pairs }} pairs, {{ sha256[:12] }}</p>
{% endfor %}
<p class="note">A coloured law differs more than draws explain. All of them together do so by chance in
{{ chance }} of comparisons. {{ found.same_frames }} pairs show the same frame in both.</p>
{% for heading, laws in groups if laws %}
<h2>{{ heading }}</h2>
<div class="laws">
{% for law in laws %}
<div class="law{% if law.differs %} differs{% endif %}">
<h3>{{ law.name }}</h3>
<p class="note"><span class="a">{{ law.typical[0] }}</span> | <span class="b">{{ law.typical[1] }}</span>, distance
{{ "%.3f"|format(law.distance) }}, p {{ "%.2g"|format(law.p) }}, {{ law.counts[0] }} | {{ law.counts[1] }}
{{ law.units }}</p>
{{ law.picture|safe }}
<div class="ends"><span>{{ law.ends[0] }}</span><span>{{ law.ends[1] }}</span></div>
</div>
{% endfor %}
</div>
{% endfor %}
{% for heading, keys in tables if keys %}
<h2>{{ heading }}</h2>
<div class="scroll"><table>
<tr><th>key</th><th class="a">A</th><th class="b">B</th></tr>
{% for row in keys %}
<tr><td>{{ row.key }}</td><td>{{ row.a or "missing" }}</td><td>{{ row.b or "missing" }}</td></tr>
{% endfor %}
</table></div>
{% endfor %}
<h2>Pairs</h2>
<div class="pairs">
{% for shown in pictures %}
<figure><img src="data:image/jpeg;base64,{{ shown.data }}" alt="{{ shown.text }}">
<figcaption>{{ shown.text }}</figcaption></figure>
{% endfor %}
</div>
</body>
</html>
"""


class _ShownLaw(NamedTuple):
    name: str
    units: str
    counts: tuple[int, int]
    typical: tuple[str, str]
    distance: float
    p: float
    differs: bool
    picture: str
    ends: tuple[str, str]


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
    page = (
        Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
        .from_string(_TEMPLATE)
        .render(
            title=f"{found.names[0]} and {found.names[1]}",
            found=found,
            sides=list(zip("ab", found.names, found.sha256, found.pairs, strict=True)),
            chance=f"{100 * chance:g} %",
            groups=[("Labels", _shown(found.labels)), ("Pixels", _shown(found.pixels))],
            tables=[("Recipe", found.recipe), ("Software and engines", found.manifest)],
            pictures=list(_pictures(datasets)),
        )
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text_atomic(out, page)


def _shown(laws: tuple[LawDiff, ...]) -> list[_ShownLaw]:
    # What differs comes first.
    return [
        _ShownLaw(
            law.name, law.units, law.counts, law.typical, law.distance, law.p, law.differs, _drawn(law), _ends(law)
        )
        for law in sorted(laws, key=lambda law: not law.differs)
    ]


def _ends(law: LawDiff) -> tuple[str, str]:
    return (law.ends[0], law.ends[-1]) if law.ends else ("", "")


def _drawn(law: LawDiff) -> str:
    """Two rows of bars as an SVG: shares of A upwards, of B downwards."""
    parts = min(len(law.shares[0]), _MOST_BARS)
    most = max((*law.shares[0], *law.shares[1], 1e-9))
    bars = []
    for place in range(parts):
        label = law.ends[place] if len(law.ends) == len(law.shares[0]) else "of this part"
        for share, color, sign in ((law.shares[0][place], "a", -1), (law.shares[1][place], "b", 1)):
            length = share / most * _HEIGHT_PX / 2
            top = _HEIGHT_PX / 2 + (-length if sign < 0 else 0.0)
            bars.append(
                f'<rect x="{place * _BAR_PX}" y="{top:.2f}" width="{_BAR_PX - 1}" height="{length:.2f}"'
                f' fill="var(--{color})"><title>{escape(label)}: {100 * share:.0f} %</title></rect>'
            )
    width = _MOST_BARS * _BAR_PX
    return f'<svg viewBox="0 0 {width} {_HEIGHT_PX}" role="img" aria-label="shares">{"".join(bars)}</svg>'


def _pictures(datasets: tuple[Location, Location]) -> Iterator[_ShownPair]:
    sources = [Dataset(dataset) for dataset in datasets]
    for place in range(_SHOWN_PAIRS):
        for letter, source in zip("AB", sources, strict=True):
            indices = source.frame_indices
            if not indices:
                continue
            index = indices[place * len(indices) // _SHOWN_PAIRS]
            picture = cv2.cvtColor(resized(display_picture(source.images(index)), _TILE_PX)[0], cv2.COLOR_RGB2BGR)
            data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
            yield _ShownPair(base64.b64encode(data).decode(), f"{letter}, pair {index}")
