"""A dataset from a recipe: what is there stays, the rest is made by worker processes, and the whole is described."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

from datasets_manifest import layout
from datasets_manifest.calibration import write_calibration
from datasets_manifest.card import write_card
from datasets_manifest.croissant import write_croissant
from datasets_manifest.manifest import Drop, Manifest, build_manifest, made_with, read_manifest, write_manifest
from datasets_manifest.recipe import Recipe
from droguekit.batch.cluster import run_on_cluster
from droguekit.batch.frame_task import FrameReport, FrameTask, OtherBuildError
from droguekit.batch.machine import GIB_PER_WORKER, available_memory_gib
from droguekit.batch.plan import frame_timeout_s
from droguekit.batch.progress import ProgressReport
from droguekit.batch.resume import open_dataset, sort_frames
from droguekit.batch.stop import StopRequest
from droguekit.batch.workers import MAX_ATTEMPTS, Attempt, Limits, is_accident, run_tasks
from labelgen.export.coco import write_annotations
from render.engine import EngineUnavailableError
from render.version import RENDER_VERSION
from scenes.sampler import split_of_scene

# Errors that other frames would meet too; so does whatever the first frames of a run all fail by.
_ERRORS_OF_THE_PLACE = (OSError, EngineUnavailableError, OtherBuildError)
_FIRST_FRAMES = 3


@dataclass(frozen=True)
class Spread:
    """By whom frames are made.

    Attributes:
        workers: processes of this machine; 0 works in this process, for debugging.
        timeout_s: for one frame; None reckons it from the recipe. [s]
        scheduler: address of a Dask scheduler whose workers make the frames instead, or None.
    """

    workers: int
    timeout_s: float | None = None
    scheduler: str | None = None


@dataclass
class Totals:
    """What the new frames of a run cost together.

    Attributes:
        made: their indices in the order in which they were finished.
        retries: attempts that came to nothing by an accident and were repeated.
        stage_s: CPU seconds by stage. [s]
        size_bytes: of their files without the records.
    """

    made: list[int] = field(default_factory=list)
    retries: int = 0
    stage_s: Counter[str] = field(default_factory=Counter)
    size_bytes: int = 0

    def add(self, index: int, report: FrameReport) -> None:
        """One more frame is finished."""
        self.made.append(index)
        self.stage_s.update(report.stage_s)
        self.size_bytes += report.size_bytes


@dataclass(frozen=True)
class RunSummary:
    """What a run did.

    Attributes:
        totals: of the frames that it made.
        kept: frames that were there already.
        drops: frames that were given up, and why.
        pairs: in the dataset now; `planned` by the recipe.
        dataset_sha256: of the dataset as it stands now.
    """

    totals: Totals
    kept: int
    drops: tuple[Drop, ...]
    pairs: int
    planned: int
    dataset_sha256: str


def render_dataset(
    recipe: Recipe, recipe_text: str, out: Path, frames: Sequence[int], spread: int | Spread, report: ProgressReport
) -> RunSummary:
    """Make the frames of a recipe that are not there yet, then describe the whole dataset.

    The result does not depend on the order of `frames`, on who makes them, or on how often a run was stopped and
    started again. A dataset of part of the frames is a valid one, which a later run completes.

    Args:
        recipe: what to make.
        recipe_text: the recipe as given, kept in the dataset.
        out: the dataset's folder.
        frames: indices of the frames to make, in that order.
        spread: by whom; a number is that many worker processes of this machine.
        report: hears how it goes.

    Raises:
        ValueError: wrong frames, a folder of another recipe, or an engine that cannot be used.
        OSError: the folder cannot be written or the disk is full; finished frames stay.
        KeyboardInterrupt: it was told to stop; finished frames stay, and what describes the dataset is as before.
    """
    if len(set(frames)) != len(frames) or any(not 0 <= index < recipe.frames.count for index in frames):
        raise ValueError(f"frames: must be different indices from 0 to {recipe.frames.count - 1}")
    spread = Spread(spread) if isinstance(spread, int) else spread
    with open_dataset(out, recipe, recipe_text) as stream:
        events = Events(stream)
        manifest = read_manifest(out)
        there = sort_frames(out, manifest)
        kept = sum(index in there.whole for index in frames)
        if kept:
            report.say(f"{kept} of {len(frames)} pairs are there already and whole")
        if there.damaged:
            report.say(f"{len(there.damaged)} pairs are damaged and made again: {_few(there.damaged)}")
        events.write("start", frames=len(frames), kept=kept, damaged=there.damaged, **asdict(spread))
        task = FrameTask(recipe, out, there.engine_version)
        todo = list(dict.fromkeys([*(index for index in frames if index not in there.whole), *there.damaged]))
        totals, dropped = _make(task, todo, spread, report, events)
        drops = still_missing([*manifest.drops, *dropped], out)
        manifest = describe_dataset(recipe, out, drops)
        events.write("end", pairs=manifest.counts.pairs, dataset_sha256=manifest.dataset_sha256)
    return RunSummary(totals, kept, drops, manifest.counts.pairs, recipe.frames.count, manifest.dataset_sha256)


def describe_dataset(recipe: Recipe, out: Path, drops: Sequence[Drop], made_by: Manifest | None = None) -> Manifest:
    """Write all that a dataset holds besides its frames: manifest, annotations, calibration, card, Croissant.

    Args:
        recipe: that it was made from.
        out: its folder.
        drops: frames that were given up.
        made_by: names the versions and processor features by which the frames were made; those of here if None.

    Raises:
        OSError: they cannot be written.
    """
    manifest = build_manifest(
        out, recipe, RENDER_VERSION, lambda scene_id: split_of_scene(recipe, scene_id), tuple(drops)
    )
    if made_by is not None:
        manifest = made_with(manifest, made_by.software, made_by.cpu_features)
    write_manifest(out, manifest)
    write_calibration(out, recipe.rig)
    write_annotations(out, out / layout.ANNOTATIONS_FOLDER)
    write_card(out, manifest)
    write_croissant(out, manifest)
    return manifest


class Events:
    """What happened when and where, a JSON object a line; not part of what a dataset is."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, event: str, **values: Any) -> None:
        """Append a line."""
        line = {"time_utc": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **values}
        self._stream.write(json.dumps(line) + "\n")
        self._stream.flush()


def _make(
    task: FrameTask, todo: Sequence[int], spread: Spread, report: ProgressReport, events: Events
) -> tuple[Totals, list[Drop]]:
    """Make the frames; those that cannot be made are dropped with their reason, and the others go on."""
    totals, drops = Totals(), list[Drop]()
    if not todo:
        return totals, drops
    report.begin("pairs", len(todo))
    try:
        with StopRequest(report.say) as stop, closing(_attempts(task, todo, spread, stop)) as attempts:
            for attempt in attempts:
                if attempt.value is not None:
                    totals.add(attempt.index, attempt.value)
                    events.write("frame", frame=attempt.index, attempt=attempt.number, **asdict(attempt.value))
                else:
                    reason = _reason(attempt, len(totals.made), len(drops), len(todo))
                    events.write("drop" if attempt.final else "retry", frame=attempt.index, reason=reason)
                    report.say(f"frame {attempt.index}: {reason}{'' if attempt.final else '; it is tried again'}")
                    totals.retries += not attempt.final
                    if attempt.final:
                        drops.append(Drop(frame_index=attempt.index, reason=reason))
                if attempt.final:
                    report.advance()
    finally:
        report.end()
    if stop.is_requested:
        events.write("stop", made=len(totals.made), left=len(todo) - len(totals.made))
        report.say(f"stopped after {len(totals.made)} of {len(todo)} pairs, all of which are whole")
        raise KeyboardInterrupt
    return totals, drops


def _attempts(
    task: FrameTask, todo: Sequence[int], spread: Spread, stop: StopRequest
) -> Generator[Attempt[FrameReport], None, None]:
    timeout_s = frame_timeout_s(task.recipe) if spread.timeout_s is None else spread.timeout_s
    if spread.scheduler is not None:
        return run_on_cluster(task, todo, spread.scheduler, timeout_s, stop)
    workers = min(spread.workers, len(todo))
    share_gib = available_memory_gib() / max(workers, 1)
    return run_tasks(task, todo, workers, Limits(timeout_s, process_gib=max(GIB_PER_WORKER, share_gib)), stop)


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
    if isinstance(error, _ERRORS_OF_THE_PLACE) or (made == 0 and dropped + 1 >= min(_FIRST_FRAMES, planned)):
        raise error
    return " ".join(str(error).split()) or type(error).__name__


def still_missing(drops: Iterable[Drop], out: Path) -> tuple[Drop, ...]:
    """The last reason for each dropped frame that has not been made since."""
    there = set(layout.frame_indices(out))
    latest = {drop.frame_index: drop for drop in drops if drop.frame_index not in there}
    return tuple(latest.values())


def _few(indices: Sequence[int]) -> str:
    shown = ", ".join(map(str, indices[:20]))
    return shown if len(indices) <= 20 else f"{shown} and {len(indices) - 20} more"
