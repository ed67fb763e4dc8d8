"""A dataset from a recipe, made by worker processes of this machine; goes on where an earlier run stopped."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

from pebble import ProcessExpired

from datasets_manifest import layout
from datasets_manifest.calibration import write_calibration
from datasets_manifest.manifest import Drop, Manifest, build_manifest, read_manifest, write_manifest
from datasets_manifest.recipe import Recipe
from droguekit.batch.frame_task import FrameFaultError, FrameReport, FrameTask
from droguekit.batch.progress import ProgressReport
from droguekit.batch.resume import open_dataset, sort_frames
from droguekit.batch.workers import MAX_ATTEMPTS, Attempt, run_tasks
from labelgen.export.coco import write_coco
from render.version import RENDER_VERSION
from scenes.sampler import split_of_scene


@dataclass(frozen=True)
class RunSummary:
    """What a run did.

    Attributes:
        made: what each new frame cost, by its index.
        kept: frames that were there already.
        drops: frames that were given up, and why.
        pairs: in the dataset now; `planned` by the recipe.
        dataset_sha256: of the dataset as it stands now.
    """

    made: dict[int, FrameReport]
    kept: int
    drops: tuple[Drop, ...]
    pairs: int
    planned: int
    dataset_sha256: str


def render_dataset(
    recipe: Recipe, recipe_text: str, out: Path, frames: Sequence[int], workers: int, report: ProgressReport
) -> RunSummary:
    """Make the frames of a recipe that are not there yet, then describe the whole dataset.

    The result does not depend on the order of `frames`, on the number of workers, or on how often a run was stopped
    and started again. A dataset of part of the frames is a valid one, which a later run completes.

    Args:
        recipe: what to make.
        recipe_text: the recipe as given, kept in the dataset.
        out: the dataset's folder.
        frames: indices of the frames to make, in that order.
        workers: number of processes; 0 works in this process, for debugging.
        report: hears how it goes.

    Raises:
        ValueError: wrong frames, a folder of another recipe, or an engine that cannot be used.
        OSError: the folder cannot be written or the disk is full; finished frames stay.
    """
    if len(set(frames)) != len(frames) or any(not 0 <= index < recipe.frames.count for index in frames):
        raise ValueError(f"frames: must be different indices from 0 to {recipe.frames.count - 1}")
    with open_dataset(out, recipe, recipe_text) as stream:
        events = _Events(stream)
        manifest = read_manifest(out)
        whole, damaged = sort_frames(out, manifest)
        kept = sum(index in whole for index in frames)
        if kept:
            report.say(f"{kept} of {len(frames)} pairs are there already and whole")
        if damaged:
            report.say(f"{len(damaged)} pairs are damaged and made again: {', '.join(map(str, damaged))}")
        events.write("start", frames=len(frames), kept=kept, damaged=damaged, workers=workers)
        task = FrameTask(recipe, out, next((record.engine_version for record in whole.values()), None))
        todo = list(dict.fromkeys([*(index for index in frames if index not in whole), *damaged]))
        made, dropped = _make(task, todo, workers, report, events)
        drops = _still_missing([*manifest.drops, *dropped], out)
        manifest = describe_dataset(recipe, out, drops)
        events.write("end", pairs=manifest.counts.pairs, dataset_sha256=manifest.dataset_sha256)
    return RunSummary(made, kept, drops, manifest.counts.pairs, recipe.frames.count, manifest.dataset_sha256)


def describe_dataset(recipe: Recipe, out: Path, drops: Sequence[Drop]) -> Manifest:
    """Write all that a dataset holds besides its frames: manifest, annotations, calibration.

    Raises:
        OSError: they cannot be written.
    """
    manifest = build_manifest(
        out, recipe, RENDER_VERSION, lambda scene_id: split_of_scene(recipe, scene_id), tuple(drops)
    )
    write_manifest(out, manifest)
    write_calibration(out, recipe.rig)
    write_coco(out, out / layout.ANNOTATIONS_FOLDER)
    return manifest


class _Events:
    """What happened when and where, a JSON object a line; not part of what a dataset is."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, event: str, **values: Any) -> None:
        line = {"time_utc": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **values}
        self._stream.write(json.dumps(line) + "\n")
        self._stream.flush()


def _make(
    task: FrameTask, todo: Sequence[int], workers: int, report: ProgressReport, events: _Events
) -> tuple[dict[int, FrameReport], list[Drop]]:
    """Make the frames; those that cannot be made are dropped with their reason, and the others go on."""
    made: dict[int, FrameReport] = {}
    drops: list[Drop] = []
    if not todo:
        return made, drops
    report.begin("pairs", len(todo))
    try:
        with closing(run_tasks(task, todo, min(workers, len(todo)))) as attempts:
            for attempt in attempts:
                if attempt.value is not None:
                    made[attempt.index] = attempt.value
                    events.write("frame", frame=attempt.index, attempt=attempt.number, **asdict(attempt.value))
                else:
                    reason = _reason(attempt)
                    events.write("drop" if attempt.final else "retry", frame=attempt.index, reason=reason)
                    report.say(f"frame {attempt.index}: {reason}{'' if attempt.final else '; it is tried again'}")
                    if attempt.final:
                        drops.append(Drop(frame_index=attempt.index, reason=reason))
                if attempt.final:
                    report.advance()
    finally:
        report.end()
    return made, drops


def _reason(attempt: Attempt[FrameReport]) -> str:
    """Why an attempt failed.

    Raises:
        Exception: what went wrong, where it would go wrong for other frames too.
    """
    error = attempt.error
    if isinstance(error, ProcessExpired):
        return f"its worker process died (exit code {error.exitcode}) in attempt {attempt.number} of {MAX_ATTEMPTS}"
    if isinstance(error, FrameFaultError):
        return str(error)
    if error is None:
        raise ValueError(f"frame {attempt.index}: its task returned nothing")
    raise error


def _still_missing(drops: Sequence[Drop], out: Path) -> tuple[Drop, ...]:
    """The last reason for each dropped frame that has not been made since."""
    there = set(layout.frame_indices(out))
    latest = {drop.frame_index: drop for drop in drops if drop.frame_index not in there}
    return tuple(latest.values())
