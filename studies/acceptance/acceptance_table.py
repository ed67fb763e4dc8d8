"""Criteria and measured values as a table, for people (bars.md, terminal) and programs (bars.json)."""

from __future__ import annotations

import json
from collections.abc import Sequence

from pydantic import BaseModel, ConfigDict

GOAL, COMPARISON = "goal", "beside"


class AcceptanceRow(BaseModel):
    """One criterion.

    Attributes:
        bar: its number in docs/explanation/acceptance.md, `goal` for an aim that is not required, or `beside` for a
            figure given for comparison.
        quantity: what is measured, with its unit.
        low, high: required range; None means no lower end.
        measured: None where nothing could be measured.
        limit_low, limit_high: one-sided 95 % limits of what is measured.
        n: sample size.
        met: whether the limits lie within `low` and `high`; False where nothing could be measured.
        note: a remark for the reader, may be empty.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    bar: str
    quantity: str
    low: float | None = None
    high: float
    measured: float | None
    limit_low: float | None = None
    limit_high: float | None = None
    n: int
    met: bool
    note: str = ""


class AcceptanceTable(BaseModel):
    """All criteria of one tier.

    Attributes:
        tier: its name.
        seed: of everything drawn.
        code_version: of this package.
        rows: the criteria.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    tier: str
    seed: int
    code_version: str
    rows: tuple[AcceptanceRow, ...]

    @property
    def missed(self) -> int:
        """How many numbered criteria are not met."""
        return sum(not row.met for row in self.rows if row.bar not in _WITHOUT_NUMBER)

    def to_json(self) -> str:
        """The text of bars.json."""
        return json.dumps(self.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"

    def to_markdown(self) -> str:
        """The text of bars.md."""
        head = f"# Bars of tier {self.tier}, seed {self.seed}, droguekit {self.code_version}\n\n"
        numbered = sum(row.bar not in _WITHOUT_NUMBER for row in self.rows)
        count = f"{numbered - self.missed} of {numbered} bars are met. Limits are one-sided, 95 %.\n\n"
        lines = ["| " + " | ".join(cells) + " |" for cells in (_HEADINGS, ["---"] * len(_HEADINGS), *self._cells())]
        return head + count + "\n".join(lines) + "\n"

    def to_lines(self) -> list[str]:
        """The table for a terminal, a line a row."""
        rows = [_HEADINGS, *self._cells()]
        widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADINGS))]
        return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]

    def _cells(self) -> list[list[str]]:
        return [_row_cells(row) for row in self.rows]


_WITHOUT_NUMBER = (GOAL, COMPARISON)
_HEADINGS = ["bar", "quantity", "must be", "measured", "95 % limit", "n", "met", "note"]


def at_most(
    bar: str, quantity: str, high: float, measured: tuple[float, float], n: int, note: str = ""
) -> AcceptanceRow:
    """A quantity that must not exceed `high`; `measured` is its value and upper limit."""
    value, limit = measured
    return AcceptanceRow(
        bar=bar, quantity=quantity, high=high, measured=value, limit_high=limit, n=n, met=limit <= high, note=note
    )


def between(
    bar: str, quantity: str, wanted: tuple[float, float], measured: tuple[float, float, float], n: int
) -> AcceptanceRow:
    """A quantity with a required range; `measured` is its value, lower and upper limit."""
    (low, high), (value, limit_low, limit_high) = wanted, measured
    return AcceptanceRow(
        bar=bar,
        quantity=quantity,
        low=low,
        high=high,
        measured=value,
        limit_low=limit_low,
        limit_high=limit_high,
        n=n,
        met=low <= limit_low and limit_high <= high,
    )


def not_measured(bar: str, quantity: str, high: float, note: str) -> AcceptanceRow:
    """A criterion that could not be measured, and why; it counts as missed."""
    return AcceptanceRow(bar=bar, quantity=quantity, high=high, measured=None, n=0, met=False, note=note)


def _row_cells(row: AcceptanceRow) -> list[str]:
    wanted = f"<= {row.high:.4g}" if row.low is None else f"{row.low:.4g} to {row.high:.4g}"
    measured = "-" if row.measured is None else f"{row.measured:.4g}"
    limits = [f"{limit:.4g}" for limit in (row.limit_low, row.limit_high) if limit is not None]
    met = "yes" if row.met else "NO" if row.bar not in _WITHOUT_NUMBER else "no"
    return [row.bar, row.quantity, wanted, measured, " to ".join(limits) or "-", str(row.n), met, row.note]


def worst(rows: Sequence[tuple[str, float, float]]) -> tuple[str, float, float]:
    """Of (name, value, limit) the one with the largest limit."""
    return max(rows, key=lambda row: row[2])
