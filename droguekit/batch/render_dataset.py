"""Render a dataset from a recipe: keep what exists, make the rest in worker processes, and describe the whole."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import partial
from typing import Any, NamedTuple, TextIO

from datasets_manifest.recipe.recipe import Recipe, RecipeSource
from datasets_manifest.release.card import write_card, write_croissant
from datasets_manifest.storage.frame_store import list_frames
from datasets_manifest.storage.layout import ANNOTATIONS_FOLDER, RECIPE_FILE
from datasets_manifest.storage.manifest import Drop, Manifest, build_manifest, read_manifest, with_build, write_manifest
from datasets_manifest.storage.mesh_copies import write_mesh_copies
from datasets_manifest.storage.packing import read_packing
from datasets_manifest.storage.storage import Location, join, open_storage
from datasets_manifest.storage.writer import write_calibration
from droguekit.batch.cluster import LostWorkersError, run_on_cluster
from droguekit.batch.execution import GIB_PER_WORKER, ExecutionOptions, available_memory_gib
from droguekit.batch.frame_task import FATAL_ERRORS, FIRST_FRAMES, FrameReport, FrameTask, error_reason
from droguekit.batch.progress import ProgressReport
from droguekit.batch.recipe_plan import frame_timeout_s
from droguekit.batch.resume import check_frames, finish_frames, join_build, open_dataset, remove_damaged
from droguekit.batch.stop_request import StopRequest
from droguekit.batch.task_queue import TaskQueue
from droguekit.batch.worker_pool import (
    MAX_ATTEMPTS,
    TaskAttempt,
    WorkerDiedError,
    WorkerLimits,
    is_accident,
    run_tasks,
)
from labelgen.export.annotations.coco import write_annotations
from render.engine import crash_advice, engine_notice, has_compiled
from render.version import RENDER_VERSION
from scenes.sampler import scene_of_frame, split_of_scenes

# With so many pairs, a step of milliseconds a pair takes long enough to be announced.
_MANY_PAIRS = 1000
_OTHER_BUILD = "another build made the existing pairs, so new ones may differ in pixels or last digits"
_VANISHED = "it was there, and somebody deleted it during the run; run the same command to make it again"


@dataclass
class RunTotals:
    """Time and size of the new frames of a run.

    Attributes:
        made: their indices in the order in which they finished.
        retries: attempts that failed by an accident and were repeated.
        surprises: failed attempts at frames that no earlier run left out.
        stage_s: CPU seconds by stage. [s]
        size_bytes: of their files without the records.
        peak_gib: largest memory of all workers together, measured between frames. [GiB]
    """

    made: list[int] = field(default_factory=list)
    retries: int = 0
    surprises: int = 0
    stage_s: Counter[str] = field(default_factory=Counter)
    size_bytes: int = 0
    peak_gib: float = 0.0

    def add(self, index: int, report: FrameReport) -> None:
        """Add a finished frame."""
        self.made.append(index)
        self.stage_s.update(report.stage_s)
        self.size_bytes += report.size_bytes

    def as_event(self) -> dict[str, Any]:
        """The numbers for the last event of a run."""
        numbers = {"retries": self.retries, "size_bytes": self.size_bytes, "workers_peak_gib": round(self.peak_gib, 3)}
        return {"made": len(self.made), **numbers, "stage_s": dict(self.stage_s)}


class RunConditions(NamedTuple):
    """What decides whether an error ends a run.

    Attributes:
        is_first: whether the dataset has no frames yet.
        workers: processes that make the frames.
        crash_advice: what to do where native code ends workers.
        left_out: frames that an earlier run could not make; that they fail again says nothing about this machine.
    """

    is_first: bool
    workers: int
    crash_advice: str
    left_out: frozenset[int]


class EventLog:
    """The log of a run, one JSON object a line; not part of the dataset's hash."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, event: str, **values: Any) -> None:
        """Append a line."""
        line = {"time_utc": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **values}
        self._stream.write(json.dumps(line) + "\n")
        self._stream.flush()


def make_frames(
    task: FrameTask,
    todo: Sequence[int],
    options: ExecutionOptions,
    report: ProgressReport,
    events: EventLog,
    left_out: Collection[int] = (),
) -> tuple[RunTotals, list[Drop]]:
    """Make frames; those that cannot be made are dropped with a reason.

    Args:
        task: makes a frame.
        todo: indices of the frames, each once; those of a unit (`unit_of_frame`) are made in a row.
        options: who makes them.
        report: is told of the progress.
        events: gets every attempt.
        left_out: indices of frames that an earlier run could not make.

    Raises:
        ValueError: an error that other frames would meet too.
        OSError: likewise, such as a full disk.
        KeyboardInterrupt: the user asked to stop, and the running frames are finished.
    """
    totals, drops = RunTotals(), list[Drop]()
    if not todo:
        return totals, drops
    advice = crash_advice(task.recipe.render.engine)
    run = RunConditions(task.engine_version is None, options.worker_count(), advice, frozenset(left_out))
    report.begin("pairs", len(todo))
    try:
        with StopRequest(report.say) as stop, closing(_attempts(task, todo, options, stop)) as attempts:
            for attempt in attempts:
                _record_attempt(attempt, totals, drops, run, report, events)
    finally:
        report.end()
    if stop.is_requested:
        events.write("stop", left=len(todo) - len(totals.made), **totals.as_event())
        report.say(f"stopped after {len(totals.made)} of {len(todo)} pairs, all of them complete")
        raise KeyboardInterrupt
    return totals, drops


def _record_attempt(
    attempt: TaskAttempt[FrameReport],
    totals: RunTotals,
    drops: list[Drop],
    run: RunConditions,
    report: ProgressReport,
    events: EventLog,
) -> None:
    """Count, log and report an attempt.

    Raises:
        BaseException: the error of the attempt, where other frames would meet it too.
    """
    totals.peak_gib = max(totals.peak_gib, attempt.workers_gib)
    if attempt.value is not None:
        totals.add(attempt.index, attempt.value)
        cost = {**asdict(attempt.value), "workers_gib": round(attempt.workers_gib, 3)}
        events.write("frame", frame=attempt.index, attempt=attempt.number, **cost)
    else:
        reason = _failure_reason(attempt, totals, len(drops), run)
        events.write("drop" if attempt.final else "retry", frame=attempt.index, reason=reason)
        report.say(f"frame {attempt.index}: {reason}{'' if attempt.final else '; it is tried again'}")
        totals.retries += not attempt.final
        totals.surprises += attempt.index not in run.left_out
        if attempt.final:
            drops.append(Drop(frame_index=attempt.index, reason=reason))
    if attempt.output:
        events.write("output", frame=attempt.index, attempt=attempt.number, text=attempt.output)
    report.note(_progress_note(totals.retries, len(drops), attempt.workers_gib))
    if attempt.final:
        report.advance()


def _progress_note(retries: int, drops: int, workers_gib: float) -> str:
    """Failures and memory, as far as there are any."""
    parts = (
        f"{retries} repeated" if retries else "",
        f"{drops} left out" if drops else "",
        f"workers hold {workers_gib:.1f} GiB" if workers_gib else "",
    )
    return ", ".join(filter(None, parts))


def _attempts(
    task: FrameTask, todo: Sequence[int], options: ExecutionOptions, stop: StopRequest
) -> Generator[TaskAttempt[FrameReport], None, None]:
    timeout_s = frame_timeout_s(task.recipe) if options.timeout_s is None else options.timeout_s
    unit_of = partial(unit_of_frame, task.recipe)
    if options.scheduler is not None:
        return run_on_cluster(task, TaskQueue(todo, unit_of).in_rows(), options.scheduler, timeout_s, stop)
    workers = min(options.worker_count(), len(todo))
    share_gib = available_memory_gib() / max(workers, 1)
    is_cold = not has_compiled(task.recipe.render.engine, options.device)
    limits = WorkerLimits(timeout_s, process_gib=max(GIB_PER_WORKER, share_gib), is_first_alone=is_cold)
    return run_tasks(task, todo, workers, limits, stop, task.pack, unit_of)


def unit_of_frame(recipe: Recipe, frame_index: int) -> int:
    """Number of the sequence of a frame, or of the scene of a single one.

    What its frames share is made once for all that a process makes in a row: flight, sky, ground and objects.
    """
    if recipe.sequence is not None:
        return frame_index // recipe.sequence.frames_per_sequence
    return scene_of_frame(recipe, frame_index)


def _failure_reason(attempt: TaskAttempt[FrameReport], totals: RunTotals, dropped: int, run: RunConditions) -> str:
    """Why an attempt failed.

    Raises:
        BaseException: the error itself, if other frames would meet it too.
    """
    error = attempt.error
    if error is None:
        raise ValueError(f"frame {attempt.index}: its task returned nothing")
    advice = run.crash_advice if isinstance(error, WorkerDiedError) and error.is_of_native_code else ""
    if is_accident(error):
        # Every worker has had a second one by then, so that none was only unlucky.
        accidents = totals.surprises + 1
        is_shared = accidents >= max(MAX_ATTEMPTS * FIRST_FRAMES, 2 * run.workers)
        if is_shared and not totals.made and attempt.index not in run.left_out:
            raise OSError(f"no frame can be made: {accidents} attempts failed, the last: {error}{advice}") from error
        return f"{error}, attempt {attempt.number} of {MAX_ATTEMPTS}{advice}"
    if not isinstance(error, LostWorkersError):
        if isinstance(error, FATAL_ERRORS):
            raise error
        if run.is_first and not totals.made and dropped + 1 >= FIRST_FRAMES:
            if not isinstance(error, ValueError):
                raise error
            reason = f"{error_reason(error)}; the first {FIRST_FRAMES} pairs all fail"
            raise ValueError(f"frame {attempt.index}: {reason}") from error
    return error_reason(error)


@dataclass(frozen=True)
class RunSummary:
    """What a run did.

    Attributes:
        totals: of the frames that it made.
        kept: frames that existed before.
        drops: frames that cannot be made, and why.
        pairs: in the dataset now.
        planned: pairs of the recipe.
        dataset_sha256: of the dataset now.
    """

    totals: RunTotals
    kept: int
    drops: tuple[Drop, ...]
    pairs: int
    planned: int
    dataset_sha256: str


def render_dataset(
    source: RecipeSource,
    out: Location,
    frames: Sequence[int],
    options: int | ExecutionOptions,
    report: ProgressReport,
) -> RunSummary:
    """Make the missing frames of a recipe, then describe the whole dataset.

    The result does not depend on the order of `frames`, on who makes them, or on how often a run was stopped and
    started again. A dataset with only a part of the frames is valid; a later run completes it.

    Args:
        source: the recipe; its text is kept in the dataset.
        out: place of the dataset: a folder, or a URL that all workers can reach.
        frames: indices of the frames to make.
        options: who makes them; a number means that many worker processes of this machine.
        report: is told of the progress.

    Raises:
        ValueError: wrong frames, a folder of another recipe, or an engine or device that cannot be used.
        OSError: the folder cannot be written or the disk is full; finished frames stay.
        KeyboardInterrupt: the user asked to stop; finished frames stay, and manifest and annotations are as before.
    """
    recipe = source.recipe
    if len(set(frames)) != len(frames) or any(not 0 <= index < recipe.frames.count for index in frames):
        raise ValueError(f"frames: must be different indices from 0 to {recipe.frames.count - 1}")
    options = (ExecutionOptions(options) if isinstance(options, int) else options).with_workers()
    notice = engine_notice(recipe.render.engine, options.device)
    if notice is not None:
        report.say(notice)
    with open_dataset(out, source, options.pairs_per_tar, report.say) as stream:
        events = EventLog(stream)
        manifest = read_manifest(out)
        present = len(list_frames(out))
        if present >= _MANY_PAIRS:
            report.say(f"checking {present} existing pairs")
        there = check_frames(out, manifest)
        kept = sum(index in there.whole for index in frames)
        if kept:
            report.say(f"{kept} of {len(frames)} pairs exist already")
        if there.damaged:
            report.say(f"{len(there.damaged)} pairs are damaged and will be made again: {_shortened(there.damaged)}")
        events.write("start", frames=len(frames), kept=kept, damaged=there.damaged, **asdict(options))
        packing = read_packing(out, frames if isinstance(frames, range) else range(recipe.frames.count))
        task = FrameTask(recipe, out, there.engine_version, packing, options.device)
        todo = list(dict.fromkeys([*(index for index in frames if index not in there.whole), *there.damaged]))
        made_by = manifest if there.whole else None
        if there.whole and todo:
            made_by, differences = join_build(out, manifest)
            if differences:
                report.say(f"{_OTHER_BUILD}: {'; '.join(differences)}")
        left_out = {drop.frame_index for drop in manifest.drops if drop.reason != _VANISHED}
        totals, dropped = make_frames(task, todo, options, report, events, left_out)
        lost = sorted({*there.damaged} - {*totals.made})
        if lost:
            report.say(f"{len(lost)} damaged pairs could not be made again and are removed: {_shortened(lost)}")
            remove_damaged(out, manifest, lost)
        # Somebody else may have deleted frames, or the whole folder, meanwhile.
        if not open_storage(out).exists(RECIPE_FILE):
            open_storage(out).write(RECIPE_FILE, source.text.encode())
        vanished = sorted({*there.whole, *totals.made} - {*list_frames(out)})
        dropped += [Drop(frame_index=index, reason=_VANISHED) for index in vanished]
        drops = still_missing([*manifest.drops, *dropped], out)
        if kept + len(totals.made) >= _MANY_PAIRS:
            report.say(f"writing manifest and annotations of {kept + len(totals.made)} pairs")
        manifest = describe_dataset(recipe, out, drops, made_by)
        cost = {**totals.as_event(), "drops": len(drops)}
        events.write("end", pairs=manifest.counts.pairs, dataset_sha256=manifest.dataset_sha256, **cost)
    return RunSummary(totals, kept, drops, manifest.counts.pairs, recipe.frames.count, manifest.dataset_sha256)


def describe_dataset(recipe: Recipe, out: Location, drops: Sequence[Drop], made_by: Manifest | None = None) -> Manifest:
    """Write everything besides the frames: manifest, meshes, annotations, calibration, card, Croissant.

    Args:
        recipe: of the dataset.
        out: its place; no frames may be in the making there.
        drops: frames that cannot be made.
        made_by: manifest with the versions and processor features that made the frames; None means this process.

    Raises:
        ValueError: a user's mesh that is missing or was changed.
        OSError: they cannot be written.
    """
    finish_frames(out)
    write_mesh_copies(out, recipe)
    manifest = build_manifest(out, recipe, RENDER_VERSION, split_of_scenes(recipe), tuple(drops))
    if made_by is not None:
        manifest = with_build(manifest, made_by.software, made_by.cpu_features)
    write_manifest(out, manifest)
    write_calibration(out, recipe.rig)
    write_annotations(out, join(out, ANNOTATIONS_FOLDER))
    write_card(out, manifest)
    write_croissant(out, manifest)
    return manifest


def still_missing(drops: Iterable[Drop], out: Location) -> tuple[Drop, ...]:
    """The latest drop of each frame that has not been made since."""
    there = set(list_frames(out))
    latest = {drop.frame_index: drop for drop in drops if drop.frame_index not in there}
    return tuple(latest.values())


def _shortened(indices: Sequence[int]) -> str:
    shown = ", ".join(map(str, indices[:20]))
    return shown if len(indices) <= 20 else f"{shown} and {len(indices) - 20} more"
