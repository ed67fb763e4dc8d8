"""What tracker and filter do over sequences, beside the bars: losses, motion, lag, and what filtering is worth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from droguekit.benchmark.results.benchmark_result import BenchmarkResult
from studies.acceptance.confidence import paired_ratio_limit
from studies.acceptance.rendered.scored_frames import BEST
from studies.acceptance.rendered.sequence_pairs import FILTERED, ScoredPair, Scores
from studies.acceptance.table import GOAL, BarRow, at_most, between

# What is aimed at, our choice: half a pair at 25 a second, and a loss in as long as a docking takes.
_LAG_S, _LOSSES_PER_MINUTE = 0.02, 1.0
_NEES = (0.85, 1.20)


def following_rows(title: str, scores: Scores, result: BenchmarkResult) -> list[BarRow]:
    """Goals of tracker and filter on one dataset; those that nothing was measured for are left out.

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
            rows.append(
                at_most(GOAL, f"{label}: losses of the tracker per minute", _LOSSES_PER_MINUTE, measured, losses.count)
            )
        if name != FILTERED or method.filtering is None:
            continue
        filtering = method.filtering
        nees = None if filtering.nees is None else filtering.nees.motion
        if nees is not None and filtering.nees is not None:
            ends = filtering.nees.interval or (nees.per_freedom, nees.per_freedom)
            quantity = f"{label}: NEES/dof of velocity and rate"
            rows.append(between(GOAL, quantity, _NEES, (nees.per_freedom, *ends), filtering.nees.n))
        for component, lag in (filtering.lags or {}).items():
            if lag.lag_s is not None:
                high_s = max(abs(end) for end in lag.interval or (lag.lag_s,))
                quantity = f"{label}: lag of {component} [s]"
                rows.append(at_most(GOAL, quantity, _LAG_S, (abs(lag.lag_s), high_s), sequences.count))
    return [*rows, *_worth_rows(title, scores)]


def _worth_rows(title: str, scores: Scores) -> list[BarRow]:
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
