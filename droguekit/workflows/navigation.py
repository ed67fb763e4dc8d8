"""Estimate poses in a dataset without its truth, and measure latencies where pairs arrive in real time."""

from __future__ import annotations

import json
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from datasets_manifest.storage.pair_faults import PairFaults
from droguekit.workflows.estimate_file import EstimateFile

if TYPE_CHECKING:
    from datasets_manifest.storage.blind import BlindDataset
    from datasets_manifest.storage.storage import Location
    from droguekit.batch.progress import ProgressReport
    from nav.sequence_navigator import PairEstimates, SequenceSettings, SkippedPair


_SCHEMA = 1


@dataclass(frozen=True)
class LatencyPercentiles:
    """Percentiles of a time over all processed pairs. [ms]"""

    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float


@dataclass(frozen=True)
class LatencyReport:
    """Latencies of pairs that arrived in real time.

    Attributes:
        rate_hz: of arrival. [Hz]
        pairs: how many arrived.
        late: how many were skipped because newer ones had arrived.
        latency: from arrival to estimates; None where all were skipped.
        stages: time of each stage, in the order of processing.
        left_out: numbers of a camera's images that were not used, by their reason; None for a dataset.
    """

    rate_hz: float
    pairs: int
    late: int
    latency: LatencyPercentiles | None
    stages: dict[str, LatencyPercentiles]
    left_out: dict[str, int] | None = None

    def to_json(self) -> str:
        """The content of the latency file."""
        content = {key: value for key, value in asdict(self).items() if key != "left_out" or value is not None}
        return json.dumps({"schema": _SCHEMA, **content}, indent=1, allow_nan=False) + "\n"

    def lines(self) -> list[str]:
        """The report as a table."""
        rows = {"whole": self.latency, **self.stages} if self.latency is not None else {}
        head = [f"{self.pairs} pairs at {self.rate_hz:g} Hz, {self.late} late"]
        if self.left_out:
            head.append("left out: " + ", ".join(f"{count} {reason}" for reason, count in self.left_out.items()))
        if rows:
            head.append(f"{'ms':<12}{'median':>8}{'95 %':>8}{'99 %':>8}{'largest':>9}")
        return head + [
            f"{name:<12}{row.p50_ms:8.1f}{row.p95_ms:8.1f}{row.p99_ms:8.1f}{row.max_ms:9.1f}"
            for name, row in rows.items()
            if row is not None
        ]


class LatencyTally:
    """Collects latencies pair by pair.

    Attributes:
        pairs: how many arrived so far.
        late: how many of them were skipped.
    """

    def __init__(self, newest: int | None = None) -> None:
        """Start without pairs.

        Args:
            newest: of so many processed pairs the times are kept; of all when None.
        """
        self._latencies_s: deque[float] = deque(maxlen=newest)
        self._stages_s: dict[str, deque[float]] = {}
        self.pairs = self.late = 0

    def skipped(self) -> None:
        """Count a skipped pair."""
        self.pairs += 1
        self.late += 1

    def processed(self, latency_s: float, stage_s: dict[str, float]) -> None:
        """Add a processed pair's latency and the times of its stages. [s]"""
        # A stage that only some pairs need, such as the detector beside a tracker, takes no time for the others.
        for stage in [stage for stage in stage_s if stage not in self._stages_s]:
            self._stages_s[stage] = deque([0.0] * len(self._latencies_s), self._latencies_s.maxlen)
        self.pairs += 1
        self._latencies_s.append(latency_s)
        for stage, times_s in self._stages_s.items():
            times_s.append(stage_s.get(stage, 0.0))

    def report(self, rate_hz: float, left_out: dict[str, int] | None = None) -> LatencyReport:
        """The latencies so far.

        Args:
            rate_hz: of arrival. [Hz]
            left_out: see `LatencyReport`.
        """
        return LatencyReport(
            rate_hz=rate_hz,
            pairs=self.pairs,
            late=self.late,
            latency=_percentiles(self._latencies_s) if self._latencies_s else None,
            stages={stage: _percentiles(times_s) for stage, times_s in self._stages_s.items()},
            left_out=left_out,
        )


def _percentiles(times_s: Iterable[float]) -> LatencyPercentiles:
    middle, high, highest, most = np.percentile(1e3 * np.array(list(times_s)), [50, 95, 99, 100]).tolist()
    return LatencyPercentiles(middle, high, highest, most)


@dataclass(frozen=True)
class NavigationOptions:
    """How to navigate.

    Attributes:
        centroids: how centres are measured: `own`, `binary` or `edge`.
        detector: see `detector_factory`; the default one when None.
        tracker: name; the detector runs on every pair when None.
        redetect_every: pairs between two checks of the tracker by the detector; the default number when None.
        filtered, smoothed: whether to add filtered and smoothed estimates.
        capture_radius_m: of the docking quantities; from the drogue's opening when None. [m]
        is_live: whether pairs come from a running camera instead of a dataset.
        rate_hz: pairs of a dataset arrive at this rate, as fast as they are processed when None; a camera is asked for
            it. [Hz]
        latency_out: file for the latencies as JSON, or None.
    """

    centroids: str = "own"
    detector: str | None = None
    tracker: str | None = None
    redetect_every: int | None = None
    filtered: bool = False
    smoothed: bool = False
    capture_radius_m: float | None = None
    is_live: bool = False
    rate_hz: float | None = None
    latency_out: Path | None = None

    def __post_init__(self) -> None:
        if self.redetect_every is not None and self.tracker is None:
            raise ValueError("--redetect-every: needs --tracker; without one the detector runs on every pair")
        if self.redetect_every is not None and self.redetect_every < 1:
            raise ValueError(f"--redetect-every: must be at least 1, got {self.redetect_every}")
        if self.capture_radius_m is not None:
            if not (self.filtered or self.smoothed):
                raise ValueError(
                    "--capture-radius: needs --filter or --smooth, whose estimates have docking quantities"
                )
            if not 0 < self.capture_radius_m < float("inf"):
                raise ValueError(f"--capture-radius: must be above 0 m, got {self.capture_radius_m:g}")
        if self.rate_hz is not None and not 1e-3 <= self.rate_hz <= 1e4:
            raise ValueError(f"--rate: must be from 0.001 to 10000 Hz, got {self.rate_hz:g}")
        if self.latency_out is not None and self.rate_hz is None and not self.is_live:
            raise ValueError("--latency: needs --rate or --live; without one there is no time of arrival")


@dataclass(frozen=True)
class FixCount:
    """Number of poses that a method found, and number of pairs."""

    method: str
    fixes: int
    pairs: int


@dataclass(frozen=True)
class NavigationSummary:
    """What navigation did.

    Attributes:
        fixes: of every method.
        latency: None where pairs did not arrive in real time.
        fault: what ended a camera's run too early, or pairs without an estimate, as one line; None for nothing.
        faults: the pairs whose work ended by a fault.
    """

    fixes: list[FixCount]
    latency: LatencyReport | None
    fault: str | None = None
    faults: PairFaults = field(default_factory=PairFaults)

    def lines(self) -> list[str]:
        """The summary for the user."""
        width = max(16, *(len(fixes.method) for fixes in self.fixes))
        lines = [f"{fixes.method:<{width}} {fixes.fixes} fixes in {fixes.pairs} pairs" for fixes in self.fixes]
        if self.faults.count:
            lines.append(f"{'faults':<{width}} in {self.faults.count} of {self.fixes[0].pairs} pairs")
        return lines + ([] if self.latency is None else self.latency.lines())


def navigate_dataset(
    dataset: Location,
    methods: Sequence[str],
    out: Path,
    report: ProgressReport,
    options: NavigationOptions | None = None,
) -> NavigationSummary:
    """Estimate poses in every pair without the truth, and write each when it exists; all methods when none is named.

    A pair that cannot be read, or in which our own code fails, gets no fix with that reason, and the summary counts it.

    Raises:
        ValueError: no such dataset, method, detector, tracker or way to measure centres, or an output that is a folder.
        OSError: the estimates cannot be written; those before are kept.
    """
    from datasets_manifest.atomic import write_text_atomic
    from datasets_manifest.storage.blind import BlindDataset
    from droguekit.numerical_threads import one_thread
    from nav.runner import add_smoothed

    options = NavigationOptions() if options is None else options
    settings = sequence_settings(methods, options)
    check_places(out, options.latency_out)
    blind = BlindDataset(dataset)
    if not blind.frame_indices:
        raise ValueError(f"{dataset}: has no pairs")
    tally = None if options.rate_hz is None else LatencyTally()
    fixes, faults = Counter[str](), PairFaults()
    opened = _estimate_pairs(blind, settings, options)
    # Closing ends the threads of real-time processing, whatever stops the writing.
    with one_thread(), closing(opened) as answers:
        if options.latency_out is not None:
            options.latency_out.parent.mkdir(parents=True, exist_ok=True)
        report.begin("pairs", len(blind.frame_indices))
        try:
            with EstimateFile(out) as file:
                for estimate in add_smoothed(tallied(answers, tally, faults, report.advance), settings):
                    file.write(estimate)
                    fixes[estimate.method] += estimate.status == "fix"
        finally:
            report.end()
    latency = None if tally is None or options.rate_hz is None else tally.report(options.rate_hz)
    if latency is not None and options.latency_out is not None:
        write_text_atomic(options.latency_out, latency.to_json())
    counts = [FixCount(name, fixes[name], len(blind.frame_indices)) for name in settings.names]
    return NavigationSummary(counts, latency, faults.line(), faults)


def check_places(out: Path, latency_out: Path | None) -> None:
    """Check the output files before the work.

    Raises:
        ValueError: one is a folder.
    """
    for option, file in (("--out", out), ("--latency", latency_out)):
        if file is not None and file.is_dir():
            raise ValueError(f"{option}: must be a file, got the folder {file}")


def sequence_settings(methods: Sequence[str], options: NavigationOptions) -> SequenceSettings:
    """What navigation measures; all methods when `methods` is empty.

    Raises:
        ValueError: no such way to measure centres.
    """
    from nav.runner import CENTROID_CHOICES, method_names
    from nav.sequence_navigator import SequenceSettings
    from nav.tracking.tracker import REDETECT_EVERY

    choice = next((name for name in CENTROID_CHOICES if name == options.centroids), None)
    if choice is None:
        raise ValueError(f"--centroids: must be one of {', '.join(CENTROID_CHOICES)}, got {options.centroids!r}")
    return SequenceSettings(
        methods=tuple(dict.fromkeys(methods)) or method_names(),
        centroids=choice,
        tracker=options.tracker,
        redetect_every=REDETECT_EVERY if options.redetect_every is None else options.redetect_every,
        filtered=options.filtered,
        smoothed=options.smoothed,
        capture_radius_m=options.capture_radius_m,
    )


def _estimate_pairs(
    blind: BlindDataset, settings: SequenceSettings, options: NavigationOptions
) -> Generator[PairEstimates | SkippedPair]:
    """Estimates of all pairs, as fast as possible or in real time."""
    from nav.realtime import MonotonicClock, replay
    from nav.runner import open_navigator, process_dataset

    navigator = open_navigator(settings, options.detector)
    if options.rate_hz is None:
        return process_dataset(blind, navigator)
    return replay(blind, navigator, options.rate_hz, MonotonicClock())


def tallied(
    answers: Iterable[PairEstimates | SkippedPair],
    tally: LatencyTally | None,
    faults: PairFaults,
    advance: Callable[[], None],
) -> Iterator[PairEstimates | SkippedPair]:
    """Pass on the estimates, and collect latencies and faults; time until the next request counts as output.

    Args:
        answers: of the pairs.
        tally: that collects latencies, or None.
        faults: that collects faults.
        advance: called after each pair.
    """
    from nav.sequence_navigator import SkippedPair

    for each in answers:
        if each.fault is not None:
            faults.note(each.frame_index, each.fault)
        start = perf_counter()
        yield each
        if isinstance(each, SkippedPair):
            if tally is not None and each.fault is None:
                tally.skipped()
        elif tally is not None and each.latency_s is not None:
            tally.processed(each.latency_s, {**each.stage_s, "output": perf_counter() - start})
        advance()
