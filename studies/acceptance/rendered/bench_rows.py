"""Bars on the seed paper's bench and on time: what stands beside its Table 2, and how long a pair takes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from studies.acceptance.confidence import Limited, mean_limit, share_limit
from studies.acceptance.rendered.block_limits import block_percentile_limit
from studies.acceptance.rendered.scored_frames import BEST
from studies.acceptance.rendered.sequence_pairs import ScoredPair, Scores
from studies.acceptance.table import BESIDE, BarRow, at_most, not_measured, worst

# A tenth of what the paper's Table 2 gives for its 7 markers: 40 mm, 40 mm, 1.03 % of Z.
_TABLE_2 = (("|X| error [mm]", 4.0), ("|Y| error [mm]", 4.0), ("|Z| error [% of Z]", 0.103))
_UNFIXED = 0.005
# Of fewer fixes a mean has no limit.
_FEWEST_FIXES = 2
# Beyond 5 m, and at 2 m within a tenth. [m], [ms]
_SPEEDS = ((5.0, np.inf, 30.0, "beyond 5 m"), (1.8, 2.2, 70.0, "at 2 m"))


def bench_rows(title: str, scores: Scores, is_beside: bool) -> list[BarRow]:
    """Bar 26: mean absolute errors at the worst station of a bench, each of which must have poses, and their share."""
    rows = []
    for name, pairs in scores.items():
        bar = BESIDE if is_beside or name != BEST else "26"
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


def speed_rows(title: str, pairs: Sequence[ScoredPair], is_beside: bool) -> list[BarRow]:
    """Bar 27: median time of all stages of a pair, by distance; no pose takes its time too."""
    rows = []
    for low_m, high_m, bar_ms, where in _SPEEDS:
        told = [
            (1e3 * pair.work_s, pair.pair.sequence_id)
            for pair in pairs
            if pair.work_s is not None and low_m <= pair.pair.distance_m <= high_m
        ]
        bar, quantity = BESIDE if is_beside else "27", f"{title}: median time of a pair {where} [ms]"
        if not told:
            rows.append(not_measured(bar, quantity, bar_ms, "no pair there tells its time"))
            continue
        took, flights = zip(*told, strict=True)
        rows.append(at_most(bar, quantity, bar_ms, block_percentile_limit(took, flights, 50.0, quantity), len(took)))
    return rows


def _station_m(pair: ScoredPair) -> float:
    return round(pair.pair.distance_m, 3)


def _mean_error(pairs: Sequence[ScoredPair], axis: int) -> Limited:
    errors = []
    for pair in pairs:
        if pair.error is not None:
            scale = 100.0 / pair.pair.distance_m if axis == 2 else 1e3
            errors.append(scale * abs(float(pair.error[axis])))
    return mean_limit(errors)
