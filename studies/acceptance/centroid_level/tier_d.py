"""Tier D: some markers measured wrongly, at the level of centroids."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from droguekit.batch.progress import ProgressReport
from studies.acceptance.centroid_level.cell_store import run_cells
from studies.acceptance.centroid_level.corruption import CLEAN, Corruption
from studies.acceptance.centroid_level.monte_carlo import Cell, CellResult
from studies.acceptance.centroid_level.tier_c import Results
from studies.acceptance.confidence import Limited, paired_ratio_limit
from studies.acceptance.protocol import (
    DOCKING_RANGE_M,
    MARKER_COUNTS,
    ORDER_DRAWS,
    ROBUST_ORDER_DRAWS,
    SIGMAS_PX,
    SINGLE_DRAWS,
)
from studies.acceptance.table import BarRow, at_most, worst

CellMaker = Callable[[str, int, float, Corruption], Cell]

# Centroid noise at which robust methods are compared with themselves on clean markers.
_SIGMA_PX = 0.1
# The seed paper's order of 5, 7 and 8 markers shows from this noise on.
_ORDER_SIGMAS_PX = tuple(sigma for sigma in SIGMAS_PX if sigma >= 0.1)
_ONE_EYE = Corruption(1, "one eye")
_BAD = {
    count: (Corruption(count, "one eye"), Corruption(count, "both eyes"), Corruption(count, "u only"))
    for count in (1, 2)
}


def bars_tier_d(out: Path, seed: int, draws: int | None, report: ProgressReport) -> list[BarRow]:
    """Run what is not there yet, and compare it with bars 11 and 12.

    Arguments and errors as `tier_c.bars_tier_c`.
    """

    def robust(method: str, markers: int, sigma_px: float, corruption: Corruption) -> Cell:
        return Cell(method, markers, DOCKING_RANGE_M, sigma_px, draws or SINGLE_DRAWS, seed, corruption)

    def ordered(method: str, markers: int, sigma_px: float, corruption: Corruption) -> Cell:
        many = ROBUST_ORDER_DRAWS if method == "joint-robust" else ORDER_DRAWS
        return replace(robust(method, markers, sigma_px, corruption), draws=draws or many)

    planned = [
        robust("joint-robust", markers, _SIGMA_PX, corruption)
        for markers in MARKER_COUNTS
        for corruption in (CLEAN, *_BAD[1], *(_BAD[2] if markers > 5 else ()))
    ]
    planned += [ordered("paper", markers, sigma, _ONE_EYE) for sigma in _ORDER_SIGMAS_PX for markers in MARKER_COUNTS]
    planned += [ordered("joint-robust", markers, sigma, _ONE_EYE) for sigma in SIGMAS_PX for markers in MARKER_COUNTS]
    planned += [ordered("paper-literal", 8, sigma, _ONE_EYE) for sigma in _ORDER_SIGMAS_PX]
    results = run_cells(planned, out, report)
    return [
        _against_clean((7, 8), 1, 1.25, robust, results),
        _against_clean((7, 8), 2, 1.5, robust, results),
        _against_clean((5,), 1, 1.5, robust, results),
        _order("paper", _ORDER_SIGMAS_PX, ordered, results),
        _order("joint-robust", SIGMAS_PX, ordered, results),
        _literal(ordered, results),
    ]


def _against_clean(counts: tuple[int, ...], bad: int, bar: float, cell: CellMaker, results: Results) -> BarRow:
    """Mean position error of the robust method with bad markers over that with good ones, worst case."""
    rows = []
    for markers in counts:
        clean = results[cell("joint-robust", markers, _SIGMA_PX, CLEAN)]
        for corruption in _BAD[bad]:
            bad_result = results[cell("joint-robust", markers, _SIGMA_PX, corruption)]
            rows.append((f"{markers} markers, {corruption}", *mean_ratio(bad_result, clean)))
    where, ratio, limit = worst(rows)
    names = " or ".join(map(str, counts))
    quantity = f"joint-robust, {names} markers, {bad} bad: mean position error / clean"
    return at_most("11", quantity, bar, (ratio, limit), _n(results), where)


def _order(method: str, sigmas_px: tuple[float, ...], cell: CellMaker, results: Results) -> BarRow:
    """Eight markers better than seven, seven better than five, with one bad marker."""
    rows = []
    for sigma in sigmas_px:
        few, some, many = (results[cell(method, markers, sigma, _ONE_EYE)] for markers in MARKER_COUNTS)
        rows.append((f"8 against 7, {sigma:g} px", *mean_ratio(many, some)))
        rows.append((f"7 against 5, {sigma:g} px", *mean_ratio(some, few)))
    where, ratio, limit = worst(rows)
    quantity = f"{method}, 1 bad in one eye: mean position error, more markers / fewer"
    return at_most("12", quantity, 1.0, (ratio, limit), few.n, where)


def _literal(cell: CellMaker, results: Results) -> BarRow:
    """The baseline over the literal reading: below 1 when the literal one brings nothing."""
    rows = [
        (
            f"{sigma:g} px",
            *mean_ratio(results[cell("paper", 8, sigma, _ONE_EYE)], results[cell("paper-literal", 8, sigma, _ONE_EYE)]),
        )
        for sigma in _ORDER_SIGMAS_PX
    ]
    where, ratio, limit = worst(rows)
    quantity = "paper / paper-literal, 8 markers, 1 bad in one eye: mean position error"
    return at_most("12", quantity, 1.0, (ratio, limit), _n(results), where)


def mean_ratio(above: CellResult, below: CellResult) -> Limited:
    """Ratio of mean position errors in the same poses, with its upper limit."""
    return paired_ratio_limit(above.position_sums_m, below.position_sums_m)


def _n(results: Results) -> int:
    return min(result.n for result in results.values())
