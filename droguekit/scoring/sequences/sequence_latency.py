"""Latency of estimates over sequences, and the number of pairs that were skipped because newer ones had arrived."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from datasets_manifest.types.estimates import Estimate, NoFix
from droguekit.scoring.results.sequence_result import Latency, LatencyBin, TimePercentiles
from droguekit.scoring.sequences.filter_errors import SequenceData

LATE = "late:"
"""Beginning of the reason of a pair that was skipped because newer ones had arrived."""
# Stages in which a pair waits or is handed over, and is not processed.
_WAITING = frozenset({"read", "wait", "handover"})


def processing_time_s(stage_s: Mapping[str, float]) -> float | None:
    """Processing time of a pair without waiting; None where no such stage is reported. [s]

    Args:
        stage_s: seconds by stage, of an estimate.
    """
    work = [seconds for stage, seconds in stage_s.items() if stage not in _WAITING]
    return sum(work) if work else None


def latency(data: SequenceData, estimates: Mapping[int, Estimate]) -> Latency | None:
    """Latency of a method; None where no estimate reports one and no pair was late.

    Args:
        data: the truth.
        estimates: of the method, by frame.
    """
    frames = [state.frame_index for sequence in data.sequences for state in sequence.states]
    answered = {index: estimates[index] for index in sorted(frames) if index in estimates}
    in_time = {index: estimate for index, estimate in answered.items() if not _is_late(estimate)}
    late = len(answered) - len(in_time)
    took_ms = {index: 1e3 * a.latency_s for index, a in in_time.items() if a.latency_s is not None}
    if not took_ms and not late:
        return None
    stages: dict[str, list[float]] = {}
    for estimate in in_time.values():
        for stage, seconds in estimate.stage_s.items():
            stages.setdefault(stage, []).append(1e3 * seconds)
    bins = []
    for k, place in enumerate(data.groups.bins):
        inside = [ms for index, ms in took_ms.items() if data.groups.bin_of_frame.get(index) == k]
        if inside:
            bins.append(LatencyBin(**dict(time_percentiles(inside)), low_m=place.low_m, high_m=place.high_m))
    return Latency(
        overall=time_percentiles(list(took_ms.values())) if took_ms else None,
        bins=tuple(bins),
        stages={stage: time_percentiles(times) for stage, times in stages.items()},
        answers=len(answered),
        late=late,
        late_fraction=late / len(answered),
    )


def _is_late(estimate: Estimate) -> bool:
    return isinstance(estimate, NoFix) and estimate.reason.startswith(LATE)


def time_percentiles(times_ms: Sequence[float]) -> TimePercentiles:
    """Of at least one time. [ms]"""
    p50, p95, p99 = np.percentile(times_ms, (50, 95, 99)).tolist()
    return TimePercentiles(n=len(times_ms), p50_ms=p50, p95_ms=p95, p99_ms=p99, max_ms=max(times_ms))
