"""Tiers E and docking: criteria on whole flights and on the seed paper's bench.

Accuracy of pairs in view, either no pose or a wide covariance for the others, losing and finding the drogue, processing
time, and the gain by tracker and filter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from datasets_manifest.recipe.recipe import FrameCounts, Recipe
from droguekit.scoring.poses.pose_errors import COMPONENTS
from droguekit.scoring.results.benchmark_result import BenchmarkResult
from droguekit.scoring.sequences.tracking_scores import REACQUISITION_LIMIT_FRAMES, has_found, reacquisition
from studies.acceptance.acceptance_table import (
    COMPARISON,
    GOAL,
    TWO_SIDED,
    AcceptanceRow,
    ValueWithLimit,
    at_most,
    between,
    block_mean_limit,
    block_percentile_limit,
    block_rms_limit,
    block_share_limit,
    mean_limit,
    not_measured,
    paired_ratio_limit,
    share_limit,
    worst,
)
from studies.acceptance.rendered.scored_frames import BEST
from studies.acceptance.rendered.sequence_pairs import FILTERED, ScoredPair, Scores

# The share without a fix that each family of `docking-conditions` may have.
CONDITIONS = {"sky": 0.01, "cloud": 0.01, "low-light": 0.03, "ground": 0.03}
_P99_MM = 3.0
# Poses in view with which one out of view is compared: those nearest in distance (our choice).
_NEIGHBOURS = 25
# A tenth of what the paper's Table 2 gives for its 7 markers: 40 mm, 40 mm, 1.03 % of Z.
_TABLE_2 = (("|X| error [mm]", 4.0), ("|Y| error [mm]", 4.0), ("|Z| error [% of Z]", 0.103))
_UNFIXED = 0.005
# Of fewer fixes a mean has no limit.
_FEWEST_FIXES = 2
# Beyond 5 m, and at 2 m within a tenth. [m], [ms]
_SPEEDS = ((5.0, np.inf, 30.0, "beyond 5 m"), (1.8, 2.2, 70.0, "at 2 m"))
# Of recipes without sequences, the bench's: ten sets at each of its nine stations.
_BENCH_PART = 90
Rows = Callable[[str, Scores, bool], list[AcceptanceRow]]
# What is aimed at, our choice: half a pair at 25 a second, and a loss in as long as a docking takes.
_LAG_S, _LOSSES_PER_MINUTE = 0.02, 1.0
_NEES = (0.85, 1.20)


@dataclass(frozen=True)
class FlightData:
    """One recipe that criteria are measured on.

    Attributes:
        recipe: name of a shipped one, or a file.
        parts: how many sequences, or parts of 90 pairs of a bench, a full measurement takes.
        rows: which criteria.
        follows: whether it has sequences, for tracker and filter.
        times: whether processing times are judged.
        compares: whether all methods are measured on the same pairs for comparison.
    """

    recipe: str
    parts: int
    rows: Rows
    follows: bool = True
    times: bool = False
    compares: bool = False


def part_length(recipe: Recipe) -> int:
    """How many pairs one sequence, or one part of a bench, has."""
    return _BENCH_PART if recipe.sequence is None else recipe.sequence.frames_per_sequence


def with_parts(recipe: Recipe, parts: int) -> Recipe:
    """The recipe with at least that many sequences; each added one has a scene of its own."""
    wanted = parts * part_length(recipe)
    if wanted <= recipe.frames.count:
        return recipe
    scenes = max(recipe.frames.scenes, parts)
    frames = FrameCounts.model_validate({**recipe.frames.model_dump(), "count": wanted, "scenes": scenes})
    return recipe.model_copy(update={"frames": frames})


def approach_rows(title: str, scores: Scores, is_comparison: bool) -> list[AcceptanceRow]:
    """Criteria 17 to 21 on every method; rows of all but our best method are for comparison.

    Args:
        title: of the data.
        scores: by method.
        is_comparison: whether all rows are.
    """
    rows = []
    for name, pairs in scores.items():
        compared_only = is_comparison or name != BEST
        rows += [
            *_accuracy_rows(f"{title}, {name}", pairs, compared_only),
            _overconfidence_row(f"{title}, {name}", pairs, compared_only),
        ]
    return rows


def condition_rows(title: str, scores: Scores, is_comparison: bool) -> list[AcceptanceRow]:
    """Criteria 22 and 23 by family, and for comparison the same of our best method by number of markers."""
    rows = []
    for name, pairs in scores.items():
        for family, bar in CONDITIONS.items():
            seen = [pair for pair in pairs if pair.pair.family == family and pair.pair.in_view]
            label, compared_only = f"{title}, {name}, {family}", is_comparison or name != BEST
            rows += [_unfixed_row(_bar("22", compared_only), label, seen, bar), _bound_row(label, seen, compared_only)]
    in_view = [pair for pair in scores.get(BEST, ()) if pair.pair.in_view]
    for count in sorted({pair.pair.truth.layout.count for pair in in_view}):
        alike, label = [p for p in in_view if p.pair.truth.layout.count == count], f"{title}, {BEST}, {count} markers"
        rows += [
            _unfixed_row(COMPARISON, label, alike, max(CONDITIONS.values())),
            _bound_row(label, alike, True),
        ]
    return rows


def lost_rows(title: str, scores: Scores, is_comparison: bool) -> list[AcceptanceRow]:
    """Criteria 24 and 25: poses of a hidden drogue, and how soon poses return; and 21 on partly seen or dazzled pairs.

    They judge filtered poses too: a filter may neither invent poses nor delay new ones.
    """
    rows = []
    for name, pairs in scores.items():
        label, compared_only = f"{title}, {name}", is_comparison or name not in (BEST, FILTERED)
        hidden = [pair for pair in pairs if pair.pair.visibility == "hidden"]
        found = reacquisition(
            ([pair.pair.visibility for pair in flight], [_has_found(pair) for pair in flight])
            for flight in _flights(pairs)
        )
        soon = f"{label}: re-appearances not re-acquired within {REACQUISITION_LIMIT_FRAMES} pairs"
        late = found.n - found.within_3
        rows += [
            _count_row(_bar("24", compared_only), soon, late, found.n),
            _count_row(
                _bar("25", compared_only),
                f"{label}: poses while hidden",
                sum(p.error is not None for p in hidden),
                len(hidden),
            ),
            _overconfidence_row(label, pairs, compared_only),
        ]
    return rows


def bench_rows(title: str, scores: Scores, is_comparison: bool) -> list[AcceptanceRow]:
    """Criterion 26: mean absolute errors at the worst station of a bench, and the share of pairs without a pose.

    Every station must have poses.
    """
    rows = []
    for name, pairs in scores.items():
        bar = COMPARISON if is_comparison or name != BEST else "26"
        fixed = [pair for pair in pairs if pair.error is not None]
        missing = len(pairs) - len(fixed)
        failed = f"; {missing} of {len(pairs)} pairs without a pose" if missing else ""
        stations = {z: [pair for pair in fixed if _station_m(pair) == z] for z in sorted(set(map(_station_m, pairs)))}
        bare = ", ".join(f"{z:g} m" for z, there in stations.items() if len(there) < _FEWEST_FIXES)
        for axis, (quantity, high) in enumerate(_TABLE_2):
            label = f"{title}, {name}: mean {quantity}, worst station"
            if bare or not stations:
                why = f"too few poses at {bare}" if bare else "there are no pairs"
                rows.append(not_measured(bar, label, high, why))
                continue
            means = [(f"{z:g} m", *_mean_error(there, axis)) for z, there in stations.items()]
            where, value, limit = worst(means)
            rows.append(at_most(bar, label, high, (value, limit), len(fixed), f"{where}{failed}"))
        share = f"{title}, {name}: share of pairs without a pose"
        rows.append(
            at_most(bar, share, _UNFIXED, share_limit(missing, len(pairs)), len(pairs))
            if pairs
            else not_measured(bar, share, _UNFIXED, "there are no pairs")
        )
    return rows


FLIGHT_TIERS: dict[str, tuple[FlightData, ...]] = {
    "e": (FlightData("pose-tier-e", 20, approach_rows),),
    "docking": (
        FlightData("docking-10m", 4, approach_rows, times=True, compares=True),
        FlightData("docking-conditions", 12, condition_rows),
        FlightData("drogue-lost", 6, lost_rows),
        FlightData("semi-physical-5", 10, bench_rows, follows=False),
        FlightData("semi-physical-7", 10, bench_rows, follows=False),
    ),
}


def processing_time_rows(title: str, pairs: Sequence[ScoredPair], is_comparison: bool) -> list[AcceptanceRow]:
    """Criterion 27: median processing time of a pair, by distance; pairs without a pose count."""
    rows = []
    for low_m, high_m, bar_ms, where in _SPEEDS:
        timed = [
            (1e3 * pair.work_s, pair.pair.sequence_id)
            for pair in pairs
            if pair.work_s is not None and low_m <= pair.pair.distance_m <= high_m
        ]
        bar, quantity = COMPARISON if is_comparison else "27", f"{title}: median time of a pair {where} [ms]"
        if not timed:
            rows.append(not_measured(bar, quantity, bar_ms, "no pair there tells its time"))
            continue
        took, flights = zip(*timed, strict=True)
        rows.append(at_most(bar, quantity, bar_ms, block_percentile_limit(took, flights, 50.0, quantity), len(took)))
    return rows


def tracking_filter_rows(title: str, scores: Scores, result: BenchmarkResult) -> list[AcceptanceRow]:
    """Goals of tracker and filter on one dataset; goals without a measurement are left out.

    Args:
        title: of the data.
        scores: by method, of pairs in view and out of it.
        result: of the benchmark of the same estimates.
    """
    sequences = result.sequences
    if sequences is None:
        return []
    rows = []
    for name, method in sequences.methods.items():
        label = f"{title}, {name}"
        if name == BEST and method.tracking is not None and method.tracking.both.losses is not None:
            losses = method.tracking.both.losses
            measured = losses.per_minute, losses.per_minute_interval[1]
            quantity = f"{label}: losses of the tracker per minute"
            rows.append(at_most(GOAL, quantity, _LOSSES_PER_MINUTE, measured, losses.count, TWO_SIDED))
        if name != FILTERED or method.filtering is None:
            continue
        filtering = method.filtering
        nees = None if filtering.nees is None else filtering.nees.motion
        if nees is not None and filtering.nees is not None:
            ends = filtering.nees.interval or (-np.inf, np.inf)
            quantity = f"{label}: NEES/dof of velocity and rate"
            rows.append(between(GOAL, quantity, _NEES, (nees.per_freedom, *ends), filtering.nees.n, TWO_SIDED))
        for component, lag in (filtering.lags or {}).items():
            if lag.lag_s is not None:
                high_s = max(map(abs, lag.interval or (np.inf,)))
                quantity = f"{label}: lag of {component} [s]"
                rows.append(at_most(GOAL, quantity, _LAG_S, (abs(lag.lag_s), high_s), sequences.count, TWO_SIDED))
    return [*rows, *_filter_gain_rows(title, scores)]


def bound_ratio(pairs: Iterable[ScoredPair]) -> tuple[str, ValueWithLimit, int] | None:
    """The component that is worst against its bound: name, root mean square ratio with its limit, number of poses."""
    known = [pair for pair in pairs if pair.over_bound is not None]
    if not known:
        return None
    ratios, blocks = np.array([pair.over_bound for pair in known]), [pair.pair.sequence_id for pair in known]
    limits = [block_rms_limit(column, blocks) for column in ratios.T]
    worst = max(range(len(limits)), key=lambda k: limits[k][1])
    return COMPONENTS[worst], limits[worst], len(known)


def _accuracy_rows(label: str, pairs: Sequence[ScoredPair], is_comparison: bool) -> list[AcceptanceRow]:
    seen = [pair for pair in pairs if pair.pair.in_view]
    fixed = [pair for pair in seen if pair.error is not None]
    mean, p99 = f"{label}: mean position error [mm]", f"{label}: 99th percentile of position error [mm]"
    angles = [f"{label}: 99th percentile of {angle} error [deg]" for angle in ("pitch", "yaw")]
    unfixed = _unfixed_row(_bar("20", is_comparison), label, seen, 0.005)
    if not fixed:
        why = "no pair in view has a pose"
        bars = [("17", mean, 0.6), ("18", p99, _P99_MM), *(("19", angle, 0.5) for angle in angles)]
        return [*(not_measured(_bar(bar, is_comparison), title, high, why) for bar, title, high in bars), unfixed]
    blocks = [pair.pair.sequence_id for pair in fixed]
    position_mm = [1e3 * pair.position_m for pair in fixed]
    note, n = _failures(seen), len(fixed)
    limit = block_percentile_limit(position_mm, blocks, 99.0, p99)
    rows = [
        at_most(_bar("17", is_comparison), mean, 0.6, block_mean_limit(position_mm, blocks), n, note),
        at_most(_bar("18", is_comparison), p99, _P99_MM, limit, n, note),
    ]
    for column, angle in ((3, angles[0]), (4, angles[1])):
        values = [float(pair.error[column]) for pair in fixed if pair.error is not None]
        rows.append(
            at_most(_bar("19", is_comparison), angle, 0.5, block_percentile_limit(values, blocks, 99.0, angle), n, note)
        )
    return [*rows, unfixed]


def _unfixed_row(bar: str, label: str, seen: Sequence[ScoredPair], high: float) -> AcceptanceRow:
    quantity = f"{label}: share of pairs in view without a pose"
    if not seen:
        return not_measured(bar, quantity, high, "no pair has four markers and the hub in view")
    missing = [pair.error is None for pair in seen]
    return at_most(bar, quantity, high, block_share_limit(missing, [pair.pair.sequence_id for pair in seen]), len(seen))


def _bound_row(label: str, seen: Sequence[ScoredPair], is_comparison: bool) -> AcceptanceRow:
    quantity, bar = f"{label}: error over its bound, worst component, RMS", _bar("23", is_comparison)
    ratio = bound_ratio(seen)
    if ratio is None:
        return not_measured(bar, quantity, 1.5, "no pose in view has a bound")
    component, measured, n = ratio
    note = "; ".join(part for part in (component, _failures(seen)) if part)
    return at_most(bar, quantity, 1.5, measured, n, note)


def _overconfidence_row(label: str, pairs: Sequence[ScoredPair], is_comparison: bool) -> AcceptanceRow:
    """Criterion 21: a pair out of view needs a reason for no pose, a wider covariance, or a pose as good as in view."""
    others = [pair for pair in pairs if not pair.pair.in_view]
    seen = [pair for pair in pairs if pair.pair.in_view and pair.sd_m is not None]
    bold, quantity = (
        sum(_is_overconfident(pair, seen) for pair in others),
        f"{label}: pairs out of view answered without care",
    )
    if not others:
        # Without such a pair there was no wrong estimate.
        return at_most(_bar("21", is_comparison), quantity, 0.0, (0.0, 0.0), 0, "all pairs are in view")
    return _count_row(_bar("21", is_comparison), quantity, bold, len(others))


def _is_overconfident(pair: ScoredPair, seen: Sequence[ScoredPair]) -> bool:
    """Whether an estimate out of view has neither a reason, nor a wider covariance, nor a small error."""
    if pair.error is None:
        return not pair.reason
    if 1e3 * pair.position_m <= _P99_MM and pair.pair.visibility != "hidden":
        return False
    if pair.sd_m is None or not seen:
        return True
    nearest = sorted(seen, key=lambda other: abs(other.pair.distance_m - pair.pair.distance_m))[:_NEIGHBOURS]
    return pair.sd_m <= float(np.median([other.sd_m for other in nearest]))


def _count_row(bar: str, quantity: str, count: int, n: int) -> AcceptanceRow:
    """A number of events that must be zero."""
    if n == 0:
        return not_measured(bar, quantity, 0.0, "there was no occasion")
    return at_most(bar, quantity, 0.0, (float(count), float(count)), n)


def _has_found(pair: ScoredPair) -> bool:
    return pair.error is not None and has_found(pair.error[:3], pair.pair.rim_radius_m)


def _flights(pairs: Sequence[ScoredPair]) -> list[list[ScoredPair]]:
    ordered = sorted(pairs, key=lambda pair: (pair.pair.sequence_id, pair.pair.frame_index))
    return [list(flight) for _, flight in groupby(ordered, key=lambda pair: pair.pair.sequence_id)]


def _bar(number: str, is_comparison: bool) -> str:
    return COMPARISON if is_comparison else number


def _failures(seen: Sequence[ScoredPair]) -> str:
    missing = sum(pair.error is None for pair in seen)
    return f"{missing} of {len(seen)} pairs without a pose" if missing else ""


def _station_m(pair: ScoredPair) -> float:
    return round(pair.pair.distance_m, 3)


def _mean_error(pairs: Sequence[ScoredPair], axis: int) -> ValueWithLimit:
    errors = []
    for pair in pairs:
        if pair.error is not None:
            scale = 100.0 / pair.pair.distance_m if axis == 2 else 1e3
            errors.append(scale * abs(float(pair.error[axis])))
    return mean_limit(errors)


def _filter_gain_rows(title: str, scores: Scores) -> list[AcceptanceRow]:
    """Mean position error of filtered poses over that of measured ones, on the same pairs in view."""
    if not {BEST, FILTERED} <= set(scores):
        return []
    both = [
        (raw, filtered)
        for raw, filtered in zip(scores[BEST], scores[FILTERED], strict=True)
        if raw.pair.in_view and raw.error is not None and filtered.error is not None
    ]
    flights = sorted({raw.pair.sequence_id for raw, _ in both})
    if len(flights) < 2:
        return []
    above, below = (
        [_sum_m([pair[column] for pair in both if pair[0].pair.sequence_id == flight]) for flight in flights]
        for column in (1, 0)
    )
    quantity = f"{title}: mean position error, {FILTERED} over {BEST}"
    return [at_most(GOAL, quantity, 1.0, paired_ratio_limit(above, below), len(both))]


def _sum_m(pairs: Sequence[ScoredPair]) -> float:
    return float(np.sum([pair.position_m for pair in pairs]))
