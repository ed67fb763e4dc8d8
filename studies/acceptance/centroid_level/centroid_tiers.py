"""Tiers C and D: noise, flips, covariances, tolerances and bad markers at the level of centroids."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import norm

from drogue_models.presets import RING_RADIUS_M
from droguekit.batch.progress import ProgressReport
from droguekit.scoring.confidence_intervals import CONFIDENCE, rms_upper_limit
from droguekit.scoring.poses.cramer_rao import FacingRing
from geometry.stereo import paper_rig
from studies.acceptance.acceptance_table import AcceptanceRow, at_most, between, worst
from studies.acceptance.centroid_level.drawn_frames import (
    AS_BUILT,
    CLEAN,
    RING_ONLY,
    TOLERANCED,
    Corruption,
    Tolerances,
    stated_tolerances,
)
from studies.acceptance.centroid_level.monte_carlo import (
    BATCHED_DRAWS,
    DOCKING_RANGE_M,
    FLIP_DRAWS,
    MARKER_COUNTS,
    ORDER_DRAWS,
    ROBUST_ORDER_DRAWS,
    SIGMAS_PX,
    SINGLE_DRAWS,
    STATIONS_M,
    Cell,
    CellResult,
    run_cells,
)
from studies.acceptance.confidence_limits import ValueWithLimit, nees_limits, paired_ratio_limit, paired_rms_ratio_limit

# Where the ring's radius outweighs all else, knowing of it or not changes nothing: the ratio is 1, and its limit above.
_NEVER_WORSE = 1.01

Results = Mapping[Cell, CellResult]


def measure_tier_c(out: Path, seed: int, draws: int | None, report: ProgressReport) -> list[AcceptanceRow]:
    """Tier C, criteria 5, 6, 7, 9 and 10: noise, flips, covariances and tolerances.

    Cells that are finished already are not run again.

    Args:
        out: keeps finished cells.
        seed: of the draws.
        draws: frames a cell, the protocol's when None.
        report: of progress.

    Raises:
        ValueError: a seed or number out of range, or a folder with other content.
        OSError: the folder cannot be written.
    """
    count = draws or BATCHED_DRAWS
    ring, hub = as_built_cells("joint", seed, draws or FLIP_DRAWS), as_built_cells("joint-hub", seed, count)
    every, ring_only = (toleranced_cells(tolerances, seed, count) for tolerances in (TOLERANCED, RING_ONLY))
    results = run_cells([*ring, *hub, *every, *ring_only], out, report)
    return [
        *_nrms_rows("5", "X, Y, Z NRMS, hub, as built", slice(0, 3), (1.08, 1.20), {c: results[c] for c in hub}),
        *_nrms_rows("6", "pitch, yaw NRMS, hub, as built", slice(3, 5), (1.10, 1.25), {c: results[c] for c in hub}),
        *_without_hub_rows({c: results[c] for c in ring}),
        _nees_row("NEES/dof, joint-hub, as built, all cells", [results[c] for c in hub]),
        _nees_row("NEES/dof, joint-hub, all tolerances", [results[c] for c in every]),
        _predicted_row("Z RMSE / prediction, all tolerances, worst cell", {c: results[c] for c in every}),
        _predicted_row("Z RMSE / prediction, ring radius only, worst cell", {c: results[c] for c in ring_only}),
        _never_worse_row({c: results[c] for c in every}),
    ]


def as_built_cells(method: str, seed: int, draws: int) -> list[Cell]:
    """All stations, noises and numbers of markers."""
    return [
        Cell(method, markers, (station, station), sigma, draws, seed, tolerances=AS_BUILT)
        for markers in MARKER_COUNTS
        for sigma in SIGMAS_PX
        for station in STATIONS_M
    ]


def toleranced_cells(tolerances: Tolerances, seed: int, draws: int) -> list[Cell]:
    """Eight markers at all stations and noises; the tolerances are stated to the method."""
    stated = stated_tolerances(tolerances, paper_rig())
    return [
        Cell("joint-hub", 8, (station, station), sigma, draws, seed, tolerances=tolerances, stated=stated)
        for sigma in SIGMAS_PX
        for station in STATIONS_M
    ]


def _nrms_rows(
    bar: str, quantity: str, part: slice, bars: tuple[float, float], results: Results
) -> list[AcceptanceRow]:
    """The worst component, pooled over all cells and in the worst cell."""
    values = np.array([result.nrms[part] for result in results.values()])
    counts = np.array([result.n for result in results.values()])
    pooled = float(np.sqrt(counts @ values**2 / counts.sum()).max())
    n = int(counts.sum())
    cells = [
        (_name(cell), value, rms_upper_limit(value, result.n))
        for cell, result in results.items()
        for value in np.array(result.nrms)[part].tolist()
    ]
    where, value, limit = worst(cells)
    return [
        at_most(bar, f"{quantity}, pooled", bars[0], (pooled, rms_upper_limit(pooled, n)), n),
        at_most(bar, f"{quantity}, worst cell", bars[1], (value, limit), int(counts.min()), where),
    ]


def _without_hub_rows(results: Results) -> list[AcceptanceRow]:
    """Attitude where the tilt is clear, and how often it is mirrored elsewhere."""
    clear = [(cell, r) for cell, r in results.items() if r.clear_nrms is not None and r.clear_n]
    rows = []
    if clear:
        counts = np.array([r.clear_n for _, r in clear])
        values = np.array([r.clear_nrms for _, r in clear])
        pooled, n = float(np.sqrt((counts @ values**2) / counts.sum()).max()), int(counts.sum())
        quantity = "pitch, yaw NRMS, no hub, tilt > 3 s0, pooled"
        rows.append(at_most("7", quantity, 1.20, (pooled, rms_upper_limit(pooled, n)), n))
    flips = [(_name(cell), *_flip_gap(result)) for cell, result in results.items()]
    where, gap, limit = worst(flips)
    fewest = min(result.n for result in results.values())
    rows.append(at_most("7", "|flip rate - Q(T/s0)|, worst cell", 0.02, (gap, limit), fewest, where))
    return rows


def _flip_gap(result: CellResult) -> ValueWithLimit:
    """Distance of the flip rate from the law; its limit counts the binomial error of the rate under the law."""
    gap = abs(result.flips / result.n - result.flip_law)
    error = np.sqrt(result.flip_law * (1 - result.flip_law) / result.n)
    return gap, gap + float(norm.ppf(CONFIDENCE) * error)


def _nees_row(quantity: str, results: list[CellResult]) -> AcceptanceRow:
    counts = np.array([result.nees_n for result in results])
    values = np.array([result.nees or 0.0 for result in results])
    freedom = 5 * int(counts.sum())
    return between(
        "9", quantity, (0.85, 1.20), nees_limits(5 * float(counts @ values) / freedom, freedom), freedom // 5
    )


def _predicted_row(quantity: str, results: Results) -> AcceptanceRow:
    rig = paper_rig()
    rows = []
    for cell, result in results.items():
        ring = FacingRing(rig.camera.fx_px, rig.baseline_m, RING_RADIUS_M, cell.markers, cell.distance_m[0])
        stated = cell.stated
        scale = stated.ring_radius_m / RING_RADIUS_M
        predicted = ring.toleranced_depth_m(cell.sigma_px, scale, stated.disparity_px, stated.placement_m)
        ratio = result.z_rms_m / predicted
        rows.append((_name(cell), ratio, rms_upper_limit(ratio, result.n)))
    where, ratio, limit = worst(rows)
    return at_most("10", quantity, 1.20, (ratio, limit), next(iter(results.values())).n, where)


def _never_worse_row(results: Results) -> AcceptanceRow:
    """Z errors of the method with stated tolerances over the better of stereo alone and itself without them."""
    rows = []
    for cell, result in results.items():
        assert result.untold is not None
        best = min(result.stereo, result.untold, key=lambda rival: rival.z_rms_m)
        limited = paired_rms_ratio_limit(result.z_rms_m, best.z_rms_m, best.correlation, result.n)
        rows.append((_name(cell), *limited))
    where, ratio, limit = worst(rows)
    quantity = "Z RMSE / the better of stereo mean and fixed ring, all tolerances, worst cell"
    return at_most("10", quantity, _NEVER_WORSE, (ratio, limit), next(iter(results.values())).n, where)


def _name(cell: Cell) -> str:
    low, high = cell.distance_m
    place = f"{low:g} m" if low == high else f"{low:g} to {high:g} m"
    return f"{cell.markers} markers, {cell.sigma_px:g} px, {place}"


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


def measure_tier_d(out: Path, seed: int, draws: int | None, report: ProgressReport) -> list[AcceptanceRow]:
    """Tier D, criteria 11 and 12: some markers measured wrongly.

    Arguments and errors as `measure_tier_c`.
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


def _against_clean(counts: tuple[int, ...], bad: int, bar: float, cell: CellMaker, results: Results) -> AcceptanceRow:
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


def _order(method: str, sigmas_px: tuple[float, ...], cell: CellMaker, results: Results) -> AcceptanceRow:
    """Eight markers better than seven, seven better than five, with one bad marker."""
    rows = []
    for sigma in sigmas_px:
        few, some, many = (results[cell(method, markers, sigma, _ONE_EYE)] for markers in MARKER_COUNTS)
        rows.append((f"8 against 7, {sigma:g} px", *mean_ratio(many, some)))
        rows.append((f"7 against 5, {sigma:g} px", *mean_ratio(some, few)))
    where, ratio, limit = worst(rows)
    quantity = f"{method}, 1 bad in one eye: mean position error, more markers / fewer"
    return at_most("12", quantity, 1.0, (ratio, limit), few.n, where)


def _literal(cell: CellMaker, results: Results) -> AcceptanceRow:
    """Mean error of `paper` over that of `paper-literal`: below 1 where the literal reading is no better."""
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


def mean_ratio(above: CellResult, below: CellResult) -> ValueWithLimit:
    """Ratio of mean position errors in the same poses, with its upper limit."""
    return paired_ratio_limit(above.position_sums_m, below.position_sums_m)


def _n(results: Results) -> int:
    return min(result.n for result in results.values())
