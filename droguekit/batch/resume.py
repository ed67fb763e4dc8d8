"""What of a dataset is already there: whether it belongs to the recipe, and which frames can stay."""

from __future__ import annotations

import fcntl
import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from pydantic import ValidationError

from datasets_manifest import layout
from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.manifest import Manifest, build_manifest, read_manifest, write_manifest
from datasets_manifest.recipe import Recipe
from datasets_manifest.records import PairRecord
from datasets_manifest.writer import remove_frame, remove_leftovers
from render.version import RENDER_VERSION
from scenes.sampler import split_of_scene

_OURS = {
    layout.RECIPE_FILE,
    layout.MANIFEST_FILE,
    layout.EVENTS_FILE,
    layout.CARD_FILE,
    layout.CROISSANT_FILE,
    layout.FRAMES_FOLDER,
    layout.ANNOTATIONS_FOLDER,
    layout.CALIBRATION_FOLDER,
}


@contextmanager
def open_dataset(out: Path, recipe: Recipe, recipe_text: str) -> Iterator[TextIO]:
    """A dataset's folder, new or to be completed, that nobody else writes into meanwhile.

    Frames that a manifest does not vouch for are removed, and so is what killed runs left half-written. A folder that
    was new is removed again when the block ends with an error before it has a frame.

    Yields:
        The stream to which events are appended.

    Raises:
        ValueError: the folder holds something else, another recipe, or another run at work.
        OSError: it cannot be made or written.
    """
    is_new = not out.exists()
    if not is_new and not out.is_dir():
        raise ValueError(f"{out}: is a file; give a folder for the dataset")
    foreign = [] if is_new else sorted(entry.name for entry in out.iterdir() if not _is_ours(entry.name))
    if foreign and not (out / layout.MANIFEST_FILE).exists():
        raise ValueError(f"{out}: holds other things ({foreign[0]}); give a new or empty folder for the dataset")
    out.mkdir(parents=True, exist_ok=True)
    try:
        with (out / layout.EVENTS_FILE).open("a", encoding="utf-8") as events:
            _lock(events, out)
            remove_leftovers(out)
            _start(out, recipe, recipe_text)
            yield events
    except BaseException:
        if is_new and not layout.frame_indices(out):
            shutil.rmtree(out, ignore_errors=True)
        raise


def _is_ours(name: str) -> bool:
    return name in _OURS or name.startswith(".")


def _lock(events: TextIO, out: Path) -> None:
    """The kernel frees this lock when the process ends, however it ends."""
    try:
        fcntl.flock(events, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise ValueError(f"{out}: another run is writing into it; wait for its end, or give another folder") from error


def _start(out: Path, recipe: Recipe, recipe_text: str) -> None:
    """See that the folder belongs to the recipe; a new one gets its manifest before its first frame."""
    if (out / layout.MANIFEST_FILE).exists():
        manifest = read_manifest(out)
        differing = differing_keys(manifest.recipe.model_dump(mode="json"), recipe.model_dump(mode="json"))
        if differing:
            shown = ", ".join(differing[:8]) + (f" and {len(differing) - 8} more" if len(differing) > 8 else "")
            raise ValueError(f"{out}: was made from another recipe, which differs in {shown}; give another folder")
        if manifest.render_version != RENDER_VERSION:
            raise ValueError(
                f"{out}: was made by render version {manifest.render_version}, but this is {RENDER_VERSION}, whose "
                "pixels differ; render into a new folder"
            )
        return
    for frame_index in layout.frame_indices(out):
        remove_frame(out, frame_index)
    write_text_atomic(out / layout.RECIPE_FILE, recipe_text)
    write_manifest(out, build_manifest(out, recipe, RENDER_VERSION, lambda scene_id: split_of_scene(recipe, scene_id)))


def differing_keys(first: Any, second: Any, where: str = "") -> list[str]:
    """Dotted keys at which two JSON values differ, in order."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        keys = [*first, *(key for key in second if key not in first)]
        missing = object()
        return [
            key_path
            for key in keys
            for key_path in differing_keys(
                first.get(key, missing), second.get(key, missing), f"{where}.{key}" if where else str(key)
            )
        ]
    return [] if first == second else [where]


@dataclass(frozen=True)
class Found:
    """The frames that a folder holds.

    Attributes:
        whole: indices of those that are as they were written.
        damaged: indices of the others, ascending.
        engine_version: that made the whole ones; None when there are none.
    """

    whole: frozenset[int]
    damaged: tuple[int, ...]
    engine_version: str | None


def sort_frames(dataset: Path, manifest: Manifest) -> Found:
    """Tell the frames that are there as they were written from the damaged ones.

    Raises:
        ValueError: whole frames were made by different engine versions.
    """
    vouched = {entry.frame_index: entry.record_sha256 for entry in manifest.frames}
    whole: list[int] = []
    damaged: list[int] = []
    versions: dict[str, int] = {}
    for frame_index in layout.frame_indices(dataset):
        record = _read_whole(layout.frame_folder(dataset, frame_index), vouched.get(frame_index))
        if record is None or record.frame_index != frame_index:
            damaged.append(frame_index)
        else:
            whole.append(frame_index)
            versions.setdefault(record.engine_version, frame_index)
    if len(versions) > 1:
        shown = ", ".join(f"frame {index} by {version}" for version, index in versions.items())
        raise ValueError(f"{dataset}: its frames were made by different engines: {shown}; delete those of one")
    return Found(frozenset(whole), tuple(damaged), next(iter(versions), None))


def _read_whole(folder: Path, record_sha256: str | None) -> PairRecord | None:
    """The record of a frame, or None where it or a file of the frame is not what was written."""
    try:
        data = (folder / layout.RECORD_FILE).read_bytes()
        if record_sha256 not in (None, hashlib.sha256(data).hexdigest()):
            return None
        record = PairRecord.model_validate(json.loads(data))
        for name, sha256 in record.file_sha256.items():
            if hashlib.sha256((folder / name).read_bytes()).hexdigest() != sha256:
                return None
    except (OSError, ValueError, ValidationError, RecursionError):
        return None
    return record
