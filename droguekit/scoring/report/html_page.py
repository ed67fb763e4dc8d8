"""What all HTML reports share: tables, parts with panels, and templates."""

from __future__ import annotations

from dataclasses import dataclass, field

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

MOST_OPEN_ROWS = 24
"""A table with more lines is folded: some hundred lines of numbers hide what comes after them."""


@dataclass(frozen=True)
class RowGroup:
    """Rows that belong together.

    Attributes:
        label: what they have in common, empty where a table has no groups.
        rows: cells as text, the row's name first.
        is_published: the rows are published results, which the page sets apart from measured ones.
    """

    label: str
    rows: list[list[str]]
    is_published: bool = False


@dataclass(frozen=True)
class Table:
    """A table of a page; the macro `number_table` of `report_blocks.html.j2` draws it.

    Attributes:
        anchor: id on the page.
        title: caption; empty for none.
        columns: headings of all columns behind the row's name.
        groups: the rows.
        first: heading of the groups' labels, which are cells at the left; None where labels are above their rows.
        second: heading of the rows' names.
        text_columns: headings of columns of words instead of numbers.
        notes: sentences below.
    """

    anchor: str
    title: str
    columns: list[str]
    groups: list[RowGroup]
    first: str | None = "distance"
    second: str = "method"
    text_columns: frozenset[str] = frozenset()
    notes: list[str] = field(default_factory=list)

    @property
    def row_count(self) -> int:
        """Lines of all groups together."""
        return sum(len(group.rows) for group in self.groups)

    @property
    def is_long(self) -> bool:
        """Whether it would fill a screen, and is folded under its title."""
        return self.row_count > MOST_OPEN_ROWS

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.columns) + (1 if self.first is None else 2)


@dataclass(frozen=True)
class ReportPart:
    """Panels, tables and notes that belong together.

    Attributes:
        legend: names and their keys in the panels.
    """

    anchor: str
    title: str
    legend: list[tuple[str, Markup]]
    panels: list[Markup]
    tables: list[Table]
    notes: list[str]


def page_template(name: str, *packages: str) -> Template:
    """A template of this package; a variable that the caller does not give is an error.

    Args:
        name: of the template.
        packages: others whose templates come first.
    """
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package) for package in (*packages, __package__)]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)
