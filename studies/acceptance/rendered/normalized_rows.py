"""Bars on poses over their bound, flips and covariances, from the benchmark's result of one dataset."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from droguekit.benchmark.poses.pose_errors import COMPONENTS
from droguekit.benchmark.results.benchmark_result import BenchmarkResult, BinRow
from droguekit.benchmark.statistics import rms_upper_limit
from studies.acceptance.confidence import nees_limits, share_limit
from studies.acceptance.rendered.scored_frames import BEST
from studies.acceptance.table import BarRow, at_most, between, not_measured, worst

_POSITION, _ATTITUDE = COMPONENTS[:3], COMPONENTS[3:]
# Stations lie in bins of their own; a bin counts as within a distance when its upper end does, by this leeway.
_LEEWAY = 1.02


def tier_a_rows(name: str, result: BenchmarkResult) -> list[BarRow]:
    """Bars 5, 6 and 9."""
    bins = result.methods[BEST].bins
    flips = [(row.sight_flips.flips, row.sight_flips.n) for row in bins]
    hits, n = sum(f for f, _ in flips), sum(n for _, n in flips)
    flip_title = f"{name}: flips, {BEST}, all distances"
    rows = [
        *_pooled_and_worst("5", f"{name}: X, Y, Z NRMS", _POSITION, (1.08, 1.20), bins),
        *_pooled_and_worst("6", f"{name}: pitch, yaw NRMS, hub", _ATTITUDE, (1.10, 1.25), bins),
    ]
    if n:
        # The bar is no flip at all among these; the limit says what rate that excludes.
        shown = at_most("6", flip_title, 0.0, (float(hits), float(hits)), n)
        rows.append(shown.model_copy(update={"note": f"rate below {share_limit(hits, n)[1]:.2g} (95 %)"}))
    else:
        rows.append(not_measured("6", flip_title, 0.0, "no tilt was clear"))
    nees = result.methods[BEST].overall.nees
    title = f"{name}: NEES/dof, {BEST}"
    if nees is None or nees.pose is None:
        return [*rows, not_measured("9", title, 1.20, "no covariance was reported")]
    limits = nees_limits(nees.pose.per_freedom, nees.n * nees.pose.freedom)
    return [*rows, between("9", title, (0.85, 1.20), limits, nees.n)]


def tier_b_rows(name: str, result: BenchmarkResult) -> list[BarRow]:
    """Bar 8."""
    bins = [row for row in result.methods[BEST].bins if row.high_m <= _LEEWAY * 20.0]
    return [_pooled("8", f"{name}: pose NRMS, 1.7 to 20 m, pooled", COMPONENTS, 1.30, bins)]


def _pooled_and_worst(
    bar: str, quantity: str, names: Sequence[str], bars: tuple[float, float], bins: Sequence[BinRow]
) -> list[BarRow]:
    cells = [
        (
            f"{row.low_m:g} to {row.high_m:g} m, {name}",
            getattr(row.normalized.nrms, name),
            getattr(row.normalized.upper, name),
        )
        for row in bins
        if row.normalized is not None
        for name in names
    ]
    pooled = _pooled(bar, f"{quantity}, pooled", names, bars[0], bins)
    title = f"{quantity}, worst distance"
    if not cells:
        return [pooled, not_measured(bar, title, bars[1], "no pose has a bound")]
    where, value, limit = worst(cells)
    fewest = min(row.normalized.n for row in bins if row.normalized is not None)
    return [pooled, at_most(bar, title, bars[1], (value, limit), fewest, where)]


def _pooled(bar: str, quantity: str, names: Sequence[str], high: float, bins: Sequence[BinRow]) -> BarRow:
    """The worst component over all bins together."""
    known = [row.normalized for row in bins if row.normalized is not None]
    if not known:
        return not_measured(bar, quantity, high, "no pose has a bound")
    counts = np.array([row.n for row in known])
    squares = np.array([[getattr(row.nrms, name) ** 2 for name in names] for row in known])
    means = np.sqrt(counts @ squares / counts.sum())
    value, n = float(means.max()), int(counts.sum())
    return at_most(bar, quantity, high, (value, rms_upper_limit(value, n)), n, names[int(means.argmax())])
