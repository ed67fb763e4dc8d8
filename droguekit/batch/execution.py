"""Frames made by whoever a run was given: counted, written down in the events, and shown while it goes on."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from typing import Any, TextIO

from datasets_manifest.storage.manifest import Drop
from droguekit.batch.cluster import LostWorkersError, run_on_cluster
from droguekit.batch.failure_policy import ERRORS_OF_THE_PLACE, FIRST_FRAMES, reason_of
from droguekit.batch.frame_task import FrameReport, FrameTask
from droguekit.batch.machine import GIB_PER_WORKER, available_memory_gib
from droguekit.batch.planning.recipe_plan import frame_timeout_s
from droguekit.batch.progress import ProgressReport
from droguekit.batch.stop_request import StopRequest
from droguekit.batch.workers import MAX_ATTEMPTS, Attempt, Limits, is_accident, run_tasks


@dataclass(frozen=True)
class Spread:
    """By whom frames are made.

    Attributes:
        workers: processes of this machine; 0 works in this process, for debugging.
        timeout_s: for one frame; None reckons it from the recipe. [s]
        scheduler: address of a Dask scheduler whose workers make the frames instead, or None.
        pairs_per_tar: how many frames come into a tar file; None leaves that as it is, folders at first.
    """

    workers: int
    timeout_s: float | None = None
    scheduler: str | None = None
    pairs_per_tar: int | None = None


@dataclass
class Totals:
    """What the new frames of a run cost together.

    Attributes:
        made: their indices in the order in which they were finished.
        retries: attempts that came to nothing by an accident and were repeated.
        stage_s: CPU seconds by stage. [s]
        size_bytes: of their files without the records.
        peak_gib: the most memory that the workers were seen to hold together between their frames. [GiB]
    """

    made: list[int] = field(default_factory=list)
    retries: int = 0
    stage_s: Counter[str] = field(default_factory=Counter)
    size_bytes: int = 0
    peak_gib: float = 0.0

    def add(self, index: int, report: FrameReport) -> None:
        """One more frame is finished."""
        self.made.append(index)
        self.stage_s.update(report.stage_s)
        self.size_bytes += report.size_bytes

    def as_event(self) -> dict[str, Any]:
        """The numbers alone, for the last event of a run."""
        numbers = {"retries": self.retries, "size_bytes": self.size_bytes, "workers_peak_gib": round(self.peak_gib, 3)}
        return {"made": len(self.made), **numbers, "stage_s": dict(self.stage_s)}


class Events:
    """What happened when and where, a JSON object a line; not part of what a dataset is."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, event: str, **values: Any) -> None:
        """Append a line."""
        line = {"time_utc": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **values}
        self._stream.write(json.dumps(line) + "\n")
        self._stream.flush()


def make_frames(
    task: FrameTask, todo: Sequence[int], spread: Spread, report: ProgressReport, events: Events
) -> tuple[Totals, list[Drop]]:
    """Make frames; those that cannot be made are dropped with their reason, and the others go on.

    Args:
        task: makes a frame.
        todo: indices of the frames, without repetition, in the order in which they begin.
        spread: by whom.
        report: hears how it goes.
        events: are told of every attempt.

    Raises:
        ValueError: what went wrong would go wrong for other frames too.
        OSError: the same, such as a full disk.
        KeyboardInterrupt: it was told to stop, and the frames in hand are finished.
    """
    totals, drops = Totals(), list[Drop]()
    if not todo:
        return totals, drops
    report.begin("pairs", len(todo))
    try:
        with StopRequest(report.say) as stop, closing(_attempts(task, todo, spread, stop)) as attempts:
            for attempt in attempts:
                _take(attempt, totals, drops, len(todo), report, events)
    finally:
        report.end()
    if stop.is_requested:
        events.write("stop", left=len(todo) - len(totals.made), **totals.as_event())
        report.say(f"stopped after {len(totals.made)} of {len(todo)} pairs, all of which are whole")
        raise KeyboardInterrupt
    return totals, drops


def _take(
    attempt: Attempt[FrameReport],
    totals: Totals,
    drops: list[Drop],
    planned: int,
    report: ProgressReport,
    events: Events,
) -> None:
    """Count an attempt, and tell of it."""
    totals.peak_gib = max(totals.peak_gib, attempt.workers_gib)
    if attempt.value is not None:
        totals.add(attempt.index, attempt.value)
        cost = {**asdict(attempt.value), "workers_gib": round(attempt.workers_gib, 3)}
        events.write("frame", frame=attempt.index, attempt=attempt.number, **cost)
    else:
        reason = _reason(attempt, len(totals.made), len(drops), planned)
        events.write("drop" if attempt.final else "retry", frame=attempt.index, reason=reason)
        report.say(f"frame {attempt.index}: {reason}{'' if attempt.final else '; it is tried again'}")
        totals.retries += not attempt.final
        if attempt.final:
            drops.append(Drop(frame_index=attempt.index, reason=reason))
    report.note(_state(totals.retries, len(drops), attempt.workers_gib))
    if attempt.final:
        report.advance()


def _state(retries: int, drops: int, workers_gib: float) -> str:
    """What stands beside the count: failures and memory, as far as there are any."""
    parts = (
        f"{retries} repeated" if retries else "",
        f"{drops} left out" if drops else "",
        f"workers hold {workers_gib:.1f} GiB" if workers_gib else "",
    )
    return ", ".join(filter(None, parts))


def _attempts(
    task: FrameTask, todo: Sequence[int], spread: Spread, stop: StopRequest
) -> Generator[Attempt[FrameReport], None, None]:
    timeout_s = frame_timeout_s(task.recipe) if spread.timeout_s is None else spread.timeout_s
    if spread.scheduler is not None:
        return run_on_cluster(task, todo, spread.scheduler, timeout_s, stop)
    workers = min(spread.workers, len(todo))
    share_gib = available_memory_gib() / max(workers, 1)
    limits = Limits(timeout_s, process_gib=max(GIB_PER_WORKER, share_gib))
    return run_tasks(task, todo, workers, limits, stop, task.pack)


def _reason(attempt: Attempt[FrameReport], made: int, dropped: int, planned: int) -> str:
    """Why an attempt failed.

    Raises:
        BaseException: what went wrong, where it goes wrong for other frames too.
    """
    error = attempt.error
    if error is None:
        raise ValueError(f"frame {attempt.index}: its task returned nothing")
    if is_accident(error):
        return f"{error}, attempt {attempt.number} of {MAX_ATTEMPTS}"
    if not isinstance(error, LostWorkersError):
        is_common = made == 0 and dropped + 1 >= min(FIRST_FRAMES, planned)
        if is_common or isinstance(error, ERRORS_OF_THE_PLACE):
            raise error
    return reason_of(error)
