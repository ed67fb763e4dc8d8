"""A dataset from a recipe: what is there stays, the rest is made by worker processes, and the whole is described."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

from datasets_manifest.calibration.calibration import write_calibration
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.release.card import write_card
from datasets_manifest.release.croissant import write_croissant
from datasets_manifest.storage.frame_store import frames_there
from datasets_manifest.storage.layout import ANNOTATIONS_FOLDER
from datasets_manifest.storage.manifest import Drop, Manifest, build_manifest, made_with, read_manifest, write_manifest
from datasets_manifest.storage.packing import packing_of
from datasets_manifest.storage.storage import Location, join
from droguekit.batch.execution import Events, Spread, Totals, make_frames
from droguekit.batch.frame_task import FrameTask
from droguekit.batch.progress import ProgressReport
from droguekit.batch.resume import finish_frames, open_dataset, sort_frames
from labelgen.export.coco import write_annotations
from render.version import RENDER_VERSION
from scenes.sampler import split_of_scenes

# For so many, a step that takes milliseconds a pair is long enough to be announced.
_MANY_PAIRS = 1000


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
    recipe: Recipe, recipe_text: str, out: Location, frames: Sequence[int], spread: int | Spread, report: ProgressReport
) -> RunSummary:
    """Make the frames of a recipe that are not there yet, then describe the whole dataset.

    The result does not depend on the order of `frames`, on who makes them, or on how often a run was stopped and
    started again. A dataset of part of the frames is a valid one, which a later run completes.

    Args:
        recipe: what to make.
        recipe_text: the recipe as given, kept in the dataset.
        out: where the dataset lies: a folder, or a URL that all who make frames can reach.
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
    with open_dataset(out, recipe, recipe_text, spread.pairs_per_tar) as stream:
        events = Events(stream)
        manifest = read_manifest(out)
        present = len(frames_there(out))
        if present >= _MANY_PAIRS:
            report.say(f"looking whether {present} pairs are as they were written")
        there = sort_frames(out, manifest)
        kept = sum(index in there.whole for index in frames)
        if kept:
            report.say(f"{kept} of {len(frames)} pairs are there already and whole")
        if there.damaged:
            report.say(f"{len(there.damaged)} pairs are damaged and made again: {_few(there.damaged)}")
        events.write("start", frames=len(frames), kept=kept, damaged=there.damaged, **asdict(spread))
        packing = packing_of(out, frames if isinstance(frames, range) else range(recipe.frames.count))
        task = FrameTask(recipe, out, there.engine_version, packing)
        todo = list(dict.fromkeys([*(index for index in frames if index not in there.whole), *there.damaged]))
        totals, dropped = make_frames(task, todo, spread, report, events)
        drops = still_missing([*manifest.drops, *dropped], out)
        if kept + len(totals.made) >= _MANY_PAIRS:
            report.say(f"writing manifest and annotations of {kept + len(totals.made)} pairs")
        manifest = describe_dataset(recipe, out, drops)
        cost = {**totals.as_event(), "drops": len(drops)}
        events.write("end", pairs=manifest.counts.pairs, dataset_sha256=manifest.dataset_sha256, **cost)
    return RunSummary(totals, kept, drops, manifest.counts.pairs, recipe.frames.count, manifest.dataset_sha256)


def describe_dataset(recipe: Recipe, out: Location, drops: Sequence[Drop], made_by: Manifest | None = None) -> Manifest:
    """Write all that a dataset holds besides its frames: manifest, annotations, calibration, card, Croissant.

    Args:
        recipe: that it was made from.
        out: where it lies; nobody may be making frames there any more.
        drops: frames that were given up.
        made_by: names the versions and processor features by which the frames were made; those of here if None.

    Raises:
        OSError: they cannot be written.
    """
    finish_frames(out)
    manifest = build_manifest(out, recipe, RENDER_VERSION, split_of_scenes(recipe), tuple(drops))
    if made_by is not None:
        manifest = made_with(manifest, made_by.software, made_by.cpu_features)
    write_manifest(out, manifest)
    write_calibration(out, recipe.rig)
    write_annotations(out, join(out, ANNOTATIONS_FOLDER))
    write_card(out, manifest)
    write_croissant(out, manifest)
    return manifest


def still_missing(drops: Iterable[Drop], out: Location) -> tuple[Drop, ...]:
    """The last reason for each dropped frame that has not been made since."""
    there = set(frames_there(out))
    latest = {drop.frame_index: drop for drop in drops if drop.frame_index not in there}
    return tuple(latest.values())


def _few(indices: Sequence[int]) -> str:
    shown = ", ".join(map(str, indices[:20]))
    return shown if len(indices) <= 20 else f"{shown} and {len(indices) - 20} more"
