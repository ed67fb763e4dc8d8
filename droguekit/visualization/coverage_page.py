"""What a dataset covers, as one self-contained HTML page: a table of cells for each crossing."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment, StrictUndefined

from datasets_manifest.atomic import write_text_atomic
from droguekit.assurance.coverage import Coverage, CrossingCoverage, DomainCell, Share
from droguekit.assurance.design_domain import DesignDomain

_TEMPLATE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
:root { color-scheme: light dark; --page: #fff; --ink: #1c2026; --soft: #5b6470; --line: #d5dae0;
  --lacks: #f6c9c3; --enough: #d3e8d5; --free: #eef1f4; }
@media (prefers-color-scheme: dark) { :root { --page: #15181c; --ink: #e6e9ed; --soft: #9aa4b0; --line: #3a424c;
  --lacks: #6b2d28; --enough: #24482b; --free: #22272d; } }
body { margin: 0 auto; padding: 1.5rem; max-width: 72rem; background: var(--page); color: var(--ink);
  font: 16px/1.5 system-ui, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.6rem; margin: 0; }
h2 { font-size: 1.15rem; margin: 2rem 0 0.4rem; }
p { margin: 0.3rem 0; }
.note { color: var(--soft); font-size: 0.9rem; }
.verdict { font-weight: 600; }
.scroll { overflow-x: auto; }
table { border-collapse: separate; border-spacing: 3px; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: var(--soft); padding: 0.3rem 0; }
th { font-weight: 500; text-align: left; color: var(--soft); padding: 0.2rem 0.5rem; white-space: nowrap; }
td { text-align: right; padding: 0.35rem 0.6rem; border-radius: 4px; background: var(--free); vertical-align: top; }
td.lacks { background: var(--lacks); }
td.enough { background: var(--enough); }
td b { display: block; font-size: 1rem; }
td span { display: block; font-size: 0.78rem; white-space: nowrap; }
</style>
</head>
<body>
<h1>{{ title }}</h1>
<p>{{ domain.description }}</p>
<p class="verdict">{{ verdict }}</p>
<p class="note">Large numbers are pairs. {% if scored %}Below them: the share of solved cases with its 95 % interval, of
{{ scored|join(", ") }}. A pose is solved where its position is wrong by at most {{ position_percent }} % of the
distance, a box where it overlaps the drogue's by half.{% endif %}</p>
{% for crossing in crossings %}
<h2>{{ crossing.title }}</h2>
<p class="note">{{ crossing.note }}</p>
<div class="scroll">
{% for table in crossing.tables %}
<table>
{% if table.caption %}<caption>{{ table.caption }}</caption>{% endif %}
<tr><th>{{ table.corner }}</th>{% for name in table.columns %}<th scope="col">{{ name }}</th>{% endfor %}</tr>
{% for row in table.rows %}
<tr><th scope="row">{{ row.name }}</th>
{% for cell in row.cells %}
<td class="{{ cell.kind }}"><b>{{ cell.pairs }}</b>{% for line in cell.lines %}<span>{{ line }}</span>{% endfor %}</td>
{% endfor %}
</tr>
{% endfor %}
</table>
{% endfor %}
</div>
{% endfor %}
<h2>Where the ends of the cells come from</h2>
<ul>
{% for name, quantity in domain.quantities.items() if quantity.source or outside[name] %}
<li>{{ name }}{% if quantity.source %}: {{ quantity.source }}{% endif %}
{%- if outside[name] %} ({{ outside[name] }} pairs lie outside of the bins){% endif %}</li>
{% endfor %}
</ul>
</body>
</html>
"""


class _ShownCell(NamedTuple):
    pairs: int
    kind: str
    lines: list[str]


class _Row(NamedTuple):
    name: str
    cells: list[_ShownCell]


class _Table(NamedTuple):
    caption: str
    corner: str
    columns: tuple[str, ...]
    rows: list[_Row]


class _ShownCrossing(NamedTuple):
    title: str
    note: str
    tables: list[_Table]


def write_coverage_page(coverage: Coverage, domain: DesignDomain, out: Path) -> None:
    """Write the page; it is replaced as a whole, or not at all.

    Args:
        coverage: of a dataset.
        domain: that it was measured against.
        out: file to write.

    Raises:
        OSError: it cannot be written.
    """
    lacking = sum(len(crossing.lacking) for crossing in coverage.crossings)
    page = (
        Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
        .from_string(_TEMPLATE)
        .render(
            title=f"What {coverage.dataset} covers of {coverage.domain}",
            domain=domain,
            verdict=f"{coverage.pairs} pairs; "
            + (f"{lacking} cells have too few" if lacking else "every cell has the pairs that it needs"),
            scored=coverage.scored,
            position_percent=f"{100 * domain.most_position_error_fraction:g}",
            outside=coverage.outside,
            crossings=[_shown(crossing, domain) for crossing in coverage.crossings],
        )
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text_atomic(out, page)


def _shown(crossing: CrossingCoverage, domain: DesignDomain) -> _ShownCrossing:
    need = f"Each cell is to have {crossing.fewest_pairs} pairs." if crossing.fewest_pairs else "Counted only."
    outside = f" {crossing.outside} pairs lie outside." if crossing.outside else ""
    return _ShownCrossing(" × ".join(crossing.of), need + outside, list(_tables(crossing, domain)))


def _tables(crossing: CrossingCoverage, domain: DesignDomain) -> Iterator[_Table]:
    """One table, or with three quantities one for each bin of the first; with a single quantity one row."""
    columns = domain.quantities[crossing.of[-1]].bins
    lines = [crossing.cells[first : first + len(columns)] for first in range(0, len(crossing.cells), len(columns))]
    rows = [(cells[0].bins, _Row("", [_cell(cell, crossing) for cell in cells])) for cells in lines]
    if len(crossing.of) == 1:
        yield _Table("", crossing.of[0], columns, [row._replace(name="pairs") for _, row in rows])
        return
    height = len(domain.quantities[crossing.of[-2]].bins)
    for first in range(0, len(rows), height):
        part = rows[first : first + height]
        caption = f"{crossing.of[0]} {part[0][0][0]}" if len(crossing.of) == 3 else ""
        yield _Table(
            caption, " \\ ".join(crossing.of[-2:]), columns, [row._replace(name=bins[-2]) for bins, row in part]
        )


def _cell(cell: DomainCell, crossing: CrossingCoverage) -> _ShownCell:
    kind = "free" if not crossing.fewest_pairs else "lacks" if cell.pairs < crossing.fewest_pairs else "enough"
    several = len({name for other in crossing.cells for name in other.scores}) > 1
    lines = [(f"{name}: " if several else "") + _share_text(share) for name, share in cell.scores.items()]
    return _ShownCell(cell.pairs, kind, lines)


def _share_text(share: Share) -> str:
    low, high = (round(100 * end) for end in share.interval)
    return f"{100 * share.hits / share.count:.0f} % ({low} to {high})"
