"""Open an existing dataset to continue it: check that it belongs to the recipe, and which frames can stay."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from datasets_manifest.atomic import try_lock
from datasets_manifest.recipe.recipe import RecipeSource
from datasets_manifest.storage import layout
from datasets_manifest.storage.frame_store import FrameStore, list_frames, shard_numbers
from datasets_manifest.storage.manifest import (
    Manifest,
    build_manifest,
    cpu_features,
    differing_builds,
    read_manifest,
    software_versions,
    with_another_build,
    write_manifest,
)
from datasets_manifest.storage.packing import (
    check_pairs_per_tar,
    configure_packing,
    pack_all,
    remove_packed,
    repair_shards,
)
from datasets_manifest.storage.storage import Location, Storage, map_in_order, open_storage
from datasets_manifest.storage.writer import remove_frame, remove_leftovers
from datasets_manifest.types.records import PairRecord
from drogue_models.untrusted_files import parse_json
from geometry.se3 import RigidTransform
from render.version import RENDER_VERSION
from scenes.sampler import sample_frame, split_of_scenes

_OWN_NAMES = {
    layout.RECIPE_FILE,
    layout.MANIFEST_FILE,
    layout.EVENTS_FILE,
    layout.CARD_FILE,
    layout.CROISSANT_FILE,
    layout.FRAMES_FOLDER,
    layout.SHARDS_FOLDER,
    layout.ANNOTATIONS_FOLDER,
    layout.CALIBRATION_FOLDER,
    layout.MESHES_FOLDER,
}
_FRAME_FOLDERS = {layout.FRAMES_FOLDER, layout.SHARDS_FOLDER}
# Machines differ in the last digits of what they draw; two draws differ by far more.
_SAME_POSE = 1e-6


@contextmanager
def open_dataset(
    out: Location, source: RecipeSource, pairs_per_tar: int | None = None, say: Callable[[str], None] | None = None
) -> Iterator[TextIO]:
    """Open a new dataset, or one to be completed, and keep other runs out of it.

    Pairs of the same recipe that no manifest vouches for are removed, and so are half-written files of killed runs. A
    new folder is removed again when the block ends with an error before it has a frame.

    An object store has no lock: two runs in one place would damage each other's frames. Give each its own place and
    merge.

    Args:
        out: its place.
        source: its recipe.
        pairs_per_tar: frames in a tar file; None keeps what the dataset has.
        say: is told of pairs that are removed.

    Yields:
        The stream to which events are appended.

    Raises:
        ValueError: the place holds other things or a dataset of another recipe, or another run is writing into it.
        OSError: it cannot be made or written.
    """
    check_pairs_per_tar(pairs_per_tar)
    folder = open_storage(out).path("")
    _refuse_foreign(folder or out, source)
    with _open_place(out) if folder is None else _open_folder(folder) as events:
        remove_leftovers(out)
        _check_or_create(out, source, say)
        configure_packing(out, pairs_per_tar)
        repair_shards(out)
        yield events


def finish_frames(out: Location) -> None:
    """Finish after the last frame: pack frames, and remove incomplete files of lost workers.

    Raises:
        ValueError: the index of a tar file is missing or damaged.
        OSError: a place that cannot be read or written.
    """
    remove_leftovers(out)
    pack_all(out)


@contextmanager
def _open_folder(out: Path) -> Iterator[TextIO]:
    is_new = not out.exists()
    if not is_new and not out.is_dir():
        raise ValueError(f"{out}: is a file; give a folder for the dataset")
    out.mkdir(parents=True, exist_ok=True)
    try:
        with (out / layout.EVENTS_FILE).open("a", encoding="utf-8") as events:
            _lock(events, out)
            yield events
    except BaseException:
        if is_new and not layout.frame_indices(out) and not shard_numbers(open_storage(out)):
            shutil.rmtree(out, ignore_errors=True)
        raise


@contextmanager
def _open_place(out: Location) -> Iterator[TextIO]:
    """The same on an object store, where files cannot be appended to: events go to a temporary file until the end."""
    storage = open_storage(out)
    before = storage.read(layout.EVENTS_FILE) if storage.exists(layout.EVENTS_FILE) else b""
    storage.write(layout.EVENTS_FILE, before)  # lets remote workers check that they see the same place
    with storage.spool("") as events:
        try:
            yield events
        finally:
            events.seek(0)
            with storage.write_text(layout.EVENTS_FILE) as stream:
                stream.write(before.decode())
                shutil.copyfileobj(events, stream)


def _refuse_foreign(out: Location, source: RecipeSource) -> None:
    """Refuse a place without a manifest unless it holds what a killed start leaves, or pairs of the same recipe.

    Raises:
        ValueError: it holds something else.
    """
    storage = open_storage(out)
    names = [name for name in storage.names("") if not name.startswith(".")]
    if not names or layout.MANIFEST_FILE in names:
        return
    has_pairs = bool(FrameStore(out).staged or shard_numbers(storage))
    if has_pairs:
        _refuse_other_pairs(out, source)
    # Everything else is written after the manifest, so that where no pairs are it is somebody else's.
    left = _OWN_NAMES if has_pairs else {layout.EVENTS_FILE, layout.RECIPE_FILE}
    hold = {name for name in _FRAME_FOLDERS if any(not inside.startswith(".") for inside in storage.names(name))}
    foreign = [name for name in names if name not in left and (name not in _FRAME_FOLDERS or name in hold)]
    if layout.RECIPE_FILE in names and not _is_same_text(storage, source):
        foreign.append(layout.RECIPE_FILE)
    if foreign:
        raise ValueError(f"{out}: holds other files ({foreign[0]}); give a new or empty folder for the dataset")


def _is_same_text(storage: Storage, source: RecipeSource) -> bool:
    return storage.exists(layout.RECIPE_FILE) and storage.read(layout.RECIPE_FILE) == source.text.encode()


def _refuse_other_pairs(out: Location, source: RecipeSource) -> None:
    """Refuse pairs without a manifest of another recipe: by its text, and by the first record that can be read.

    The text alone does not tell of another seed, and is the same for all recipes from Python; it decides where no
    record can be read, since such pairs are of no use.

    Raises:
        ValueError: they are of another recipe, or the index of a tar file is damaged.
        OSError: the connection to an object store fails.
    """
    store, is_same = FrameStore(out), _is_same_text(open_storage(out), source)
    damaged: str | None = None
    for frame_index in store.indices():
        try:
            found = PairRecord.model_validate(parse_json(store.read(frame_index, layout.RECORD_FILE)))
        except ValueError as error:
            _raise_lost_connection(store, error)
            damaged = damaged or store.where(frame_index, layout.RECORD_FILE)
        else:
            is_same, damaged = is_same and _is_drawn_from(source, frame_index, found), None
            break
    if not is_same:
        unread = "" if damaged is None else f" ({damaged} cannot be read)"
        raise ValueError(
            f"{out}: holds pairs without {layout.MANIFEST_FILE}, not of this recipe and seed{unread}; give another "
            "folder"
        )


def _is_drawn_from(source: RecipeSource, frame_index: int, record: PairRecord) -> bool:
    found = record.frame
    try:
        drawn = sample_frame(source.recipe, frame_index)
    except ValueError:
        return False
    is_same = (found.seed, found.scene_id, found.drogue) == (drawn.seed, drawn.scene_id, drawn.drogue)
    return is_same and _is_same_pose(found.left_from_drogue, drawn.left_from_drogue)


def _is_same_pose(first: RigidTransform | None, second: RigidTransform | None) -> bool:
    if first is None or second is None:
        return first is second
    return bool(np.allclose(first.as_matrix(), second.as_matrix(), rtol=0, atol=_SAME_POSE))


def _lock(events: TextIO, out: Path) -> None:
    if not try_lock(events):
        raise ValueError(f"{out}: another run is writing into it; wait for its end, or give another folder")


def _check_or_create(out: Location, source: RecipeSource, say: Callable[[str], None] | None) -> None:
    """Check that the place belongs to the recipe; a new one gets its manifest before its first frame."""
    storage, recipe = open_storage(out), source.recipe
    if storage.exists(layout.MANIFEST_FILE):
        manifest = read_manifest(out)
        differing = differing_keys(manifest.recipe.model_dump(mode="json"), recipe.model_dump(mode="json"))
        if differing:
            shown = ", ".join(differing[:8]) + (f" and {len(differing) - 8} more" if len(differing) > 8 else "")
            raise ValueError(f"{out}: was made from another recipe: they differ in {shown}; give another folder")
        if manifest.render_version != RENDER_VERSION:
            raise ValueError(
                f"{out}: was made by render version {manifest.render_version}, but this is {RENDER_VERSION}, whose "
                "pixels differ; render into a new folder"
            )
        return
    pairs = len(list_frames(out))
    if pairs and say is not None:
        say(f"{out}: its {layout.MANIFEST_FILE} is missing, so that its {pairs} pairs are discarded")
    for name in storage.folders_with(layout.FRAMES_FOLDER, layout.RECORD_FILE):
        storage.delete_folder(f"{layout.FRAMES_FOLDER}/{name}", layout.RECORD_FILE)
    for number in shard_numbers(storage):
        storage.delete(layout.shard_index_file(number))
        storage.delete(layout.shard_file(number))
    storage.write(layout.RECIPE_FILE, source.text.encode())
    write_manifest(out, build_manifest(out, recipe, RENDER_VERSION, split_of_scenes(recipe)))


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
class ExistingFrames:
    """The frames in a folder.

    Attributes:
        whole: indices of the undamaged frames.
        damaged: indices of the others, ascending.
        engine_version: that made the undamaged frames; None when there are none.
    """

    whole: frozenset[int]
    damaged: tuple[int, ...]
    engine_version: str | None


def check_frames(dataset: Location, manifest: Manifest) -> ExistingFrames:
    """Check every frame of a dataset against its hashes.

    Raises:
        ValueError: frames were made by different engine versions, or the index of a tar file is damaged.
        OSError: the connection to an object store fails, which is no damage of the frames.
    """
    record_hashes = _record_hashes(manifest)
    whole: list[int] = []
    damaged: list[int] = []
    versions: dict[str, int] = {}
    store = FrameStore(dataset)
    indices = store.indices()
    records = map_in_order(lambda index: _read_whole(store, index, record_hashes.get(index)), indices, store.storage)
    for frame_index, record in zip(indices, records, strict=True):
        if record is None or record.frame_index != frame_index:
            damaged.append(frame_index)
        else:
            whole.append(frame_index)
            versions.setdefault(record.engine_version, frame_index)
    if len(versions) > 1:
        shown = ", ".join(f"frame {index} by {version}" for version, index in versions.items())
        raise ValueError(f"{dataset}: its frames were made by different engines: {shown}; delete those of one")
    return ExistingFrames(frozenset(whole), tuple(damaged), next(iter(versions), None))


def join_build(dataset: Location, manifest: Manifest) -> tuple[Manifest, list[str]]:
    """Note this build in the manifest of a dataset whose frames another one made.

    The manifest is written before the first frame, so that also a run that is killed leaves it.

    Returns:
        The manifest, and the differences from this build, a line each; none for the same build.

    Raises:
        OSError: it cannot be written.
    """
    software, features = software_versions(), cpu_features()
    differences = differing_builds(manifest.software, manifest.cpu_features, software, features)
    if not differences:
        return manifest, differences
    joined = with_another_build(manifest, software, features)
    write_manifest(dataset, joined)
    return joined, differences


def remove_damaged(dataset: Location, manifest: Manifest, frame_indices: Collection[int]) -> None:
    """Remove damaged frames that were not made again; where a tar file has an older whole copy, that counts again.

    Args:
        dataset: its place; no frames may be in the making there.
        manifest: from before the frames were damaged.
        frame_indices: of these frames.

    Raises:
        ValueError: the index of a tar file is damaged.
        OSError: something cannot be removed, or the connection to an object store fails.
    """
    for frame_index in frame_indices:
        remove_frame(dataset, frame_index)
    store, record_hashes = FrameStore(dataset), _record_hashes(manifest)
    packed = set(store.indices()).intersection(frame_indices)
    remove_packed(dataset, [index for index in packed if _read_whole(store, index, record_hashes.get(index)) is None])


def _record_hashes(manifest: Manifest) -> dict[int, str]:
    return {entry.frame_index: entry.record_sha256 for entry in manifest.frames}


def _read_whole(store: FrameStore, frame_index: int, record_sha256: str | None) -> PairRecord | None:
    """The record of a frame, or None where the record or a file of the frame is damaged.

    Raises:
        OSError: the connection to an object store fails.
    """
    try:
        data = store.read(frame_index, layout.RECORD_FILE)
        if record_sha256 not in (None, hashlib.sha256(data).hexdigest()):
            return None
        record = PairRecord.model_validate(parse_json(data))
        for name, sha256 in record.file_sha256.items():
            if hashlib.sha256(store.read(frame_index, name)).hexdigest() != sha256:
                return None
    except ValueError as error:
        _raise_lost_connection(store, error)
        return None
    return record


def _raise_lost_connection(store: FrameStore, error: ValueError) -> None:
    """Raise the cause of an error of reading where that is no damage of the frame."""
    cause = error.__cause__
    if store.storage.is_remote and isinstance(cause, OSError) and not isinstance(cause, FileNotFoundError):
        raise cause from None
