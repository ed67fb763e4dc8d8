"""`manifest.json`: what a dataset holds and how it was made, with hashes of all of it."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.frame_store import FrameStore
from datasets_manifest.storage.layout import BLIND_FILE, MANIFEST_FILE, RECORD_FILE
from datasets_manifest.storage.provenance import CONVENTIONS, cpu_features, software_versions
from datasets_manifest.storage.storage import Location, map_in_order, open_storage
from datasets_manifest.storage.writer import canonical_json
from drogue_models.frozen_model import FrozenModel
from drogue_models.presets import explain
from drogue_models.untrusted_files import parse_json

SplitName = Literal["train", "val", "test"]

DATA_LICENCE = "CC-BY-4.0"


class FrameEntry(FrozenModel):
    """One stereo pair of the dataset.

    Attributes:
        empty: whether it has no drogue.
        record_sha256: of its `record.json`, which holds the hashes of the frame's other files.
    """

    frame_index: int = Field(ge=0)
    scene_id: int = Field(ge=0)
    split: SplitName
    empty: bool
    record_sha256: str = Field(pattern="^[0-9a-f]{64}$")


class Drop(FrozenModel):
    """A frame of the recipe that was not made, with the reason."""

    frame_index: int = Field(ge=0)
    reason: str = Field(min_length=1)


class Counts(FrozenModel):
    """Numbers of pairs; `by_scene` is keyed by the scene's id."""

    pairs: int
    empty: int
    by_split: dict[SplitName, int]
    by_scene: dict[int, int]


class Manifest(FrozenModel):
    """A dataset's description.

    Attributes:
        recipe: with every reference replaced by its contents.
        conventions: axes, units, pixels, quaternions.
        software, cpu_features: of the machine that wrote this file.
        engines: pairs by engine and version.
        render_version: changes whenever the same recipe gives different pixels.
        drops: frames of the recipe that were not made.
        data_licence: SPDX name, of the data.
        dataset_sha256: hash of the sorted record hashes and the recipe.
        manifest_sha256: hash of everything else in this file.
    """

    schema_version: Literal[1] = 1
    name: str
    recipe: Recipe
    conventions: dict[str, str]
    software: dict[str, str]
    cpu_features: tuple[str, ...]
    engines: dict[str, int]
    render_version: str
    counts: Counts
    drops: tuple[Drop, ...]
    data_licence: str
    dataset_sha256: str
    manifest_sha256: str
    frames: tuple[FrameEntry, ...]

    @model_validator(mode="after")
    def _unchanged(self) -> Self:
        hashes = (entry.record_sha256 for entry in self.frames)
        if self.dataset_sha256 != dataset_sha256(self.recipe, hashes):
            raise ValueError("dataset_sha256: does not belong to these frames and this recipe; the file was edited")
        if self.manifest_sha256 != _content_sha256(self.model_dump(mode="json")):
            raise ValueError("manifest_sha256: does not belong to the rest of the file, which was edited")
        return self

    def split_of_frame(self) -> dict[int, SplitName]:
        """The split of every frame by its index."""
        return {entry.frame_index: entry.split for entry in self.frames}


def dataset_sha256(recipe: Recipe, record_hashes: Iterable[str]) -> str:
    """Hash of a dataset: of the resolved recipe and its records' hashes, regardless of their order.

    It does not depend on machine, time, path or number of workers.
    """
    content = {"recipe": recipe.model_dump(mode="json"), "records": sorted(record_hashes)}
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()


def build_manifest(
    dataset: Location,
    recipe: Recipe,
    render_version: str,
    split_of_scene: Mapping[int, SplitName],
    drops: Sequence[Drop] = (),
) -> Manifest:
    """The manifest of the frames that are stored in a dataset.

    Args:
        dataset: its location.
        recipe: from which it was made.
        render_version: `render.version.RENDER_VERSION`.
        split_of_scene: the split of every scene, by its id.
        drops: frames that were not made.

    Raises:
        ValueError: a record that cannot be read; names the file.
    """
    entries, engines = [], Counter[str]()
    store = FrameStore(dataset)
    found = map_in_order(lambda index: _read_entry(store, index, split_of_scene), store.indices(), store.storage)
    for entry, engine in found:
        entries.append(entry)
        engines[engine] += 1
    content: dict[str, Any] = {
        "schema_version": 1,
        "name": recipe.name,
        "recipe": recipe.model_dump(mode="json"),
        "conventions": CONVENTIONS,
        "software": software_versions(),
        "cpu_features": cpu_features(),
        "engines": dict(engines),
        "render_version": render_version,
        "counts": count_pairs(entries).model_dump(mode="json"),
        "drops": [drop.model_dump(mode="json") for drop in sorted(drops, key=lambda drop: drop.frame_index)],
        "data_licence": DATA_LICENCE,
        "dataset_sha256": dataset_sha256(recipe, (entry.record_sha256 for entry in entries)),
        "frames": [entry.model_dump(mode="json") for entry in entries],
    }
    return Manifest.model_validate({**content, "manifest_sha256": _content_sha256(content)})


def with_build(manifest: Manifest, software: Mapping[str, str], cpu_features: Sequence[str]) -> Manifest:
    """The manifest with other software versions and processor features: those of the machines that made the frames."""
    content = manifest.model_dump(mode="json", exclude={"manifest_sha256"})
    content.update(software=dict(software), cpu_features=list(cpu_features))
    return Manifest.model_validate({**content, "manifest_sha256": _content_sha256(content)})


def write_manifest(dataset: Location, manifest: Manifest) -> None:
    """Write `manifest.json`, whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    with open_storage(dataset).write_text(MANIFEST_FILE) as stream:
        stream.write(json.dumps(manifest.model_dump(mode="json"), indent=1, allow_nan=False) + "\n")


def read_manifest(dataset: Location) -> Manifest:
    """The manifest of a dataset.

    Raises:
        ValueError: missing, truncated or edited; one line that names the file.
    """
    storage = open_storage(dataset)
    path = storage.where(MANIFEST_FILE)
    if not storage.root_exists():
        raise ValueError(f"{dataset}: there is no such dataset folder")
    try:
        table = parse_json(storage.read(MANIFEST_FILE))
    except FileNotFoundError as error:
        if storage.exists(BLIND_FILE):
            raise ValueError(
                f"{dataset}: is a blind dataset, which has no truth; take the one that it came from"
            ) from error
        raise ValueError(f"{path}: is missing; render the recipe again into this folder to complete it") from error
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ValueError(f"{path}: is truncated or not JSON: {error}") from error
    try:
        return Manifest.model_validate(table)
    except ValidationError as error:
        raise ValueError(f"{path}: {explain(error)}") from error


def count_pairs(entries: Sequence[FrameEntry]) -> Counts:
    """Numbers of pairs in total, empty, by split and by scene."""
    splits = Counter(entry.split for entry in entries)
    return Counts(
        pairs=len(entries),
        empty=sum(entry.empty for entry in entries),
        by_split={"train": splits["train"], "val": splits["val"], "test": splits["test"]},
        by_scene=dict(sorted(Counter(entry.scene_id for entry in entries).items())),
    )


def _content_sha256(table: dict[str, Any]) -> str:
    content = {key: value for key, value in table.items() if key != "manifest_sha256"}
    return hashlib.sha256(canonical_json(content).encode()).hexdigest()


def _read_entry(store: FrameStore, frame_index: int, split_of_scene: Mapping[int, SplitName]) -> tuple[FrameEntry, str]:
    """The manifest's entry of one record, and its engine; the record's other contents are not checked here."""
    path = store.where(frame_index, RECORD_FILE)
    try:
        data = store.read(frame_index, RECORD_FILE)
        table = parse_json(data)
        entry = FrameEntry(
            frame_index=table["frame_index"],
            scene_id=table["scene_id"],
            split=split_of_scene[table["scene_id"]],
            empty=table["left_from_drogue"] is None,
            record_sha256=hashlib.sha256(data).hexdigest(),
        )
        engine = str(table["engine_version"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: is not a complete record; delete the frame's folder and render it again") from error
    if entry.frame_index != frame_index:
        raise ValueError(f"{path}: belongs to frame {entry.frame_index}")
    return entry, engine
