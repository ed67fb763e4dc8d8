"""Bars on whole flights: the accuracy of what is in view, silence or modesty about the rest, and losing the drogue."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby

import numpy as np

from droguekit.benchmark.poses.pose_errors import COMPONENTS
from droguekit.benchmark.sequences.tracking_scores import SOON_FRAMES, reacquisition
from studies.acceptance.confidence import Limited
from studies.acceptance.rendered.block_limits import (
    block_mean_limit,
    block_percentile_limit,
    block_rms_limit,
    block_share_limit,
)
from studies.acceptance.rendered.scored_frames import BEST
from studies.acceptance.rendered.sequence_pairs import FILTERED, ScoredPair, Scores
from studies.acceptance.table import BESIDE, BarRow, at_most, not_measured

# The share without a fix that each family of `docking-conditions` may have.
CONDITIONS = {"sky": 0.01, "cloud": 0.01, "low-light": 0.03, "ground": 0.03}
_P99_MM = 3.0
# Poses in view with which one out of view is compared: those nearest in distance (our choice).
_NEIGHBOURS = 25
# A pose that is off by more of the distance has not found the drogue again (our choice).
_FOUND_FRACTION = 0.1


def approach_rows(title: str, scores: Scores, is_beside: bool) -> list[BarRow]:
    """Bars 17 to 21 on every method; those of all but our best one stand beside.

    Args:
        title: of the data.
        scores: by method.
        is_beside: whether all of it does.
    """
    rows = []
    for name, pairs in scores.items():
        beside = is_beside or name != BEST
        rows += [*_accuracy_rows(f"{title}, {name}", pairs, beside), _modesty_row(f"{title}, {name}", pairs, beside)]
    return rows


def condition_rows(title: str, scores: Scores, is_beside: bool) -> list[BarRow]:
    """Bars 22 and 23 by family, and beside them the same of our best method by number of markers."""
    rows = []
    for name, pairs in scores.items():
        for family, bar in CONDITIONS.items():
            seen = [pair for pair in pairs if pair.pair.family == family and pair.pair.in_view]
            label, beside = f"{title}, {name}, {family}", is_beside or name != BEST
            rows += [_unfixed_row(_bar("22", beside), label, seen, bar), _bound_row(label, seen, beside)]
    in_view = [pair for pair in scores.get(BEST, ()) if pair.pair.in_view]
    for count in sorted({pair.pair.truth.layout.count for pair in in_view}):
        alike, label = [p for p in in_view if p.pair.truth.layout.count == count], f"{title}, {BEST}, {count} markers"
        rows += [
            _unfixed_row(BESIDE, label, alike, max(CONDITIONS.values())),
            _bound_row(label, alike, True),
        ]
    return rows


def lost_rows(title: str, scores: Scores, is_beside: bool) -> list[BarRow]:
    """Bars 24 and 25: poses of what is not seen, and how soon they come back; and 21 on what is seen in part or glared.

    They judge filtered poses too: a filter may neither invent poses nor keep a receiver waiting for new ones.
    """
    rows = []
    for name, pairs in scores.items():
        label, beside = f"{title}, {name}", is_beside or name not in (BEST, FILTERED)
        hidden = [pair for pair in pairs if pair.pair.sight == "hidden"]
        found = reacquisition(
            ([pair.pair.sight for pair in flight], [_has_found(pair) for pair in flight]) for flight in _flights(pairs)
        )
        soon = f"{label}: re-appearances not re-acquired within {SOON_FRAMES} pairs"
        late = found.n - found.within_3
        rows += [
            _count_row(_bar("24", beside), soon, late, found.n),
            _count_row(
                _bar("25", beside),
                f"{label}: poses while hidden",
                sum(p.error is not None for p in hidden),
                len(hidden),
            ),
            _modesty_row(label, pairs, beside),
        ]
    return rows


def bound_ratio(pairs: Iterable[ScoredPair]) -> tuple[str, Limited, int] | None:
    """The component that is worst against its bound: name, root mean square ratio with its limit, number of poses."""
    known = [pair for pair in pairs if pair.over_bound is not None]
    if not known:
        return None
    ratios, blocks = np.array([pair.over_bound for pair in known]), [pair.pair.sequence_id for pair in known]
    limits = [block_rms_limit(column, blocks) for column in ratios.T]
    worst = max(range(len(limits)), key=lambda k: limits[k][1])
    return COMPONENTS[worst], limits[worst], len(known)


def _accuracy_rows(label: str, pairs: Sequence[ScoredPair], beside: bool) -> list[BarRow]:
    seen = [pair for pair in pairs if pair.pair.in_view]
    fixed = [pair for pair in seen if pair.error is not None]
    mean, p99 = f"{label}: mean position error [mm]", f"{label}: 99th percentile of position error [mm]"
    angles = [f"{label}: 99th percentile of {angle} error [deg]" for angle in ("pitch", "yaw")]
    unfixed = _unfixed_row(_bar("20", beside), label, seen, 0.005)
    if not fixed:
        why = "no pair in view has a pose"
        bars = [("17", mean, 0.6), ("18", p99, _P99_MM), *(("19", angle, 0.5) for angle in angles)]
        return [*(not_measured(_bar(bar, beside), title, high, why) for bar, title, high in bars), unfixed]
    blocks = [pair.pair.sequence_id for pair in fixed]
    position_mm = [1e3 * pair.position_m for pair in fixed]
    note, n = _failures(seen), len(fixed)
    limit = block_percentile_limit(position_mm, blocks, 99.0, p99)
    rows = [
        at_most(_bar("17", beside), mean, 0.6, block_mean_limit(position_mm, blocks), n, note),
        at_most(_bar("18", beside), p99, _P99_MM, limit, n, note),
    ]
    for column, angle in ((3, angles[0]), (4, angles[1])):
        values = [float(pair.error[column]) for pair in fixed if pair.error is not None]
        rows.append(
            at_most(_bar("19", beside), angle, 0.5, block_percentile_limit(values, blocks, 99.0, angle), n, note)
        )
    return [*rows, unfixed]


def _unfixed_row(bar: str, label: str, seen: Sequence[ScoredPair], high: float) -> BarRow:
    quantity = f"{label}: share of pairs in view without a pose"
    if not seen:
        return not_measured(bar, quantity, high, "no pair has four markers and the hub in view")
    missing = [pair.error is None for pair in seen]
    return at_most(bar, quantity, high, block_share_limit(missing, [pair.pair.sequence_id for pair in seen]), len(seen))


def _bound_row(label: str, seen: Sequence[ScoredPair], beside: bool) -> BarRow:
    quantity, bar = f"{label}: error over its bound, worst component, RMS", _bar("23", beside)
    ratio = bound_ratio(seen)
    if ratio is None:
        return not_measured(bar, quantity, 1.5, "no pose in view has a bound")
    component, measured, n = ratio
    note = "; ".join(part for part in (component, _failures(seen)) if part)
    return at_most(bar, quantity, 1.5, measured, n, note)


def _modesty_row(label: str, pairs: Sequence[ScoredPair], beside: bool) -> BarRow:
    """Bar 21: of what is not in view, either a reason, or a wider covariance, or a pose as good as in view."""
    others = [pair for pair in pairs if not pair.pair.in_view]
    seen = [pair for pair in pairs if pair.pair.in_view and pair.sd_m is not None]
    bold, quantity = sum(_is_bold(pair, seen) for pair in others), f"{label}: pairs out of view answered without care"
    if not others:
        # What never happened was never answered wrongly.
        return at_most(_bar("21", beside), quantity, 0.0, (0.0, 0.0), 0, "all pairs are in view")
    return _count_row(_bar("21", beside), quantity, bold, len(others))


def _is_bold(pair: ScoredPair, seen: Sequence[ScoredPair]) -> bool:
    """Whether an answer to a pair out of view is neither reasoned, nor modest, nor exact all the same."""
    if pair.error is None:
        return not pair.reason
    if 1e3 * pair.position_m <= _P99_MM and pair.pair.sight != "hidden":
        return False
    if pair.sd_m is None or not seen:
        return True
    nearest = sorted(seen, key=lambda other: abs(other.pair.distance_m - pair.pair.distance_m))[:_NEIGHBOURS]
    return pair.sd_m <= float(np.median([other.sd_m for other in nearest]))


def _count_row(bar: str, quantity: str, count: int, n: int) -> BarRow:
    """A number of events of which none may happen."""
    if n == 0:
        return not_measured(bar, quantity, 0.0, "there was no occasion")
    return at_most(bar, quantity, 0.0, (float(count), float(count)), n)


def _has_found(pair: ScoredPair) -> bool:
    return pair.error is not None and pair.position_m <= _FOUND_FRACTION * pair.pair.distance_m


def _flights(pairs: Sequence[ScoredPair]) -> list[list[ScoredPair]]:
    ordered = sorted(pairs, key=lambda pair: (pair.pair.sequence_id, pair.pair.frame_index))
    return [list(flight) for _, flight in groupby(ordered, key=lambda pair: pair.pair.sequence_id)]


def _bar(number: str, beside: bool) -> str:
    return BESIDE if beside else number


def _failures(seen: Sequence[ScoredPair]) -> str:
    missing = sum(pair.error is None for pair in seen)
    return f"{missing} of {len(seen)} pairs without a pose" if missing else ""
