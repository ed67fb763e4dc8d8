"""How long answers took and how many pairs were late, when pairs came at a rate."""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import asdict, dataclass

import numpy as np

_SCHEMA = 1


@dataclass(frozen=True)
class Percentiles:
    """Of one time over all pairs that were worked on. [ms]"""

    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float


@dataclass(frozen=True)
class LatencyReport:
    """What became of pairs that came at a rate.

    Attributes:
        rate_hz: at which they came. [Hz]
        pairs: how many came.
        late: how many were not worked on because newer ones had come.
        latency: from a pair's moment to its answers; None where all were late.
        stages: by stage, in the order of the work.
    """

    rate_hz: float
    pairs: int
    late: int
    latency: Percentiles | None
    stages: dict[str, Percentiles]

    def to_json(self) -> str:
        """The content of a file."""
        return json.dumps({"schema": _SCHEMA, **asdict(self)}, indent=1) + "\n"

    def lines(self) -> list[str]:
        """As a table for people."""
        rows = {"whole": self.latency, **self.stages} if self.latency is not None else {}
        head = [f"{self.pairs} pairs at {self.rate_hz:g} Hz, {self.late} late"]
        if rows:
            head.append(f"{'ms':<12}{'median':>8}{'95 %':>8}{'99 %':>8}{'largest':>9}")
        return head + [
            f"{name:<12}{row.p50_ms:8.1f}{row.p95_ms:8.1f}{row.p99_ms:8.1f}{row.max_ms:9.1f}"
            for name, row in rows.items()
            if row is not None
        ]


class LatencyTally:
    """Counts pair after pair."""

    def __init__(self, rate_hz: float) -> None:
        """Begin before the first pair, of those that come at a rate. [Hz]"""
        self._rate_hz = rate_hz
        self._latencies_s: list[float] = []
        self._stages_s: defaultdict[str, list[float]] = defaultdict(list)
        self._late = 0

    def late(self) -> None:
        """Count a pair that was not worked on."""
        self._late += 1

    def worked_on(self, latency_s: float, stage_s: dict[str, float]) -> None:
        """Count a pair with its answers, and the stages that it went through. [s]"""
        self._latencies_s.append(latency_s)
        for stage, spent_s in stage_s.items():
            self._stages_s[stage].append(spent_s)

    def report(self) -> LatencyReport:
        """What was counted."""
        done = len(self._latencies_s)
        return LatencyReport(
            rate_hz=self._rate_hz,
            pairs=done + self._late,
            late=self._late,
            latency=_percentiles(self._latencies_s, done) if done else None,
            # A stage that only some pairs went through, such as the detector beside a tracker, took the others no time.
            stages={stage: _percentiles(spent_s, done) for stage, spent_s in self._stages_s.items()},
        )


def _percentiles(times_s: list[float], count: int) -> Percentiles:
    """Of times, and of zeros up to a count."""
    padded_ms = 1e3 * np.array(times_s + [0.0] * (count - len(times_s)))
    middle, high, highest, most = np.percentile(padded_ms, [50, 95, 99, 100]).tolist()
    return Percentiles(middle, high, highest, most)
