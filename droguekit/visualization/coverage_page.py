"""What a dataset covers, as one self-contained HTML page: a table of cells for each crossing."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from datasets_manifest.atomic import write_text_atomic
from droguekit.assurance.coverage import Coverage, CrossingCoverage, DomainCell, Share
from droguekit.assurance.design_domain import DesignDomain
from droguekit.scoring.report.html_page import page_template
from droguekit.scoring.report.number_text import percent


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
    page = page_template("coverage_page.html.j2", __package__).render(
        title=f"What {coverage.dataset} covers of {coverage.domain}",
        domain=domain,
        verdict=f"{coverage.pairs} pairs; "
        + (f"{lacking} cells have too few" if lacking else "every cell has the pairs that it needs"),
        scored=coverage.scored,
        position_percent=f"{100 * domain.most_position_error_fraction:g}",
        outside=coverage.outside,
        crossings=[_shown(crossing, domain) for crossing in coverage.crossings],
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
    return f"{percent(share.hits / share.count)} ({share.interval_text})"
