"""`manifest.json`: what a dataset holds and how it was made, with hashes of all of it.

That is also the conventions of its numbers, and the software and processor with which they were made.
"""

from __future__ import annotations

import hashlib
import json
import platform
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.frame_store import FrameStore
from datasets_manifest.storage.layout import BLIND_FILE, MANIFEST_FILE, RECORD_FILE
from datasets_manifest.storage.mesh_copies import offer_mesh_copies
from datasets_manifest.storage.storage import Location, map_in_order, open_storage
from datasets_manifest.storage.writer import canonical_json
from drogue_models.frozen_model import FrozenModel
from drogue_models.presets import explain
from drogue_models.untrusted_files import parse_json

CONVENTIONS = {
    "transforms": "a_from_b takes coordinates in b to coordinates in a; 4x4, row-major",
    "camera_axes": "x right, y down, z forward",
    "drogue_axes": "origin at the centre of the rim circle, z from the mouth to the hose",
    "world_axes": "x east, y north, z up",
    "body_axes": "x forward, y right, z down",
    "units": "metres, seconds, cd/m2; angles in degrees where a name ends in _deg",
    "pixel_centre": "integer coordinates are pixel centres; the full frame is [-0.5, -0.5, width, height]",
    "coco_pixels": "COCO files add 0.5 to boxes and keypoints: their origin is the corner of the image",
    "quaternion_order": "x y z w, wherever an export writes quaternions",
    "attitude": "left_from_drogue rotation = Ry(yaw) Rx(pitch) Rz(roll)",
    "time": "of the middle of the exposure",
}

# Between the versions of a package that two builds used.
_AND = " and "
_CPU_INFO = Path("/proc/cpuinfo")
_SOFTWARE = ("droguekit", "numpy", "scipy", "opencv-python-headless", "pydantic", "trimesh", "mitsuba", "drjit", "bpy")


def software_versions() -> dict[str, str]:
    """Versions of Python and of the installed packages on which pixels and labels depend."""
    versions = {"python": platform.python_version()}
    for package in _SOFTWARE:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions


def cpu_features() -> list[str]:
    """Instruction sets that numpy found on this machine, and the processor's maker and model where the system tells.

    They decide the last bits of derived numbers: libraries and compilers choose their code by all of them, and two
    models of one maker with equal instruction sets render different pixels.
    """
    # numpy's stubs leave out the form with `mode`.
    report: dict[str, Any] = np.show_config(mode="dicts")  # type: ignore[call-arg, assignment, func-returns-value]
    extensions = report["SIMD Extensions"]
    return [*extensions.get("baseline", ()), *extensions.get("found", ()), *_processor(_CPU_INFO)]


def _processor(cpu_info: Path) -> list[str]:
    """Maker and model of a Linux machine's processor, such as `AuthenticAMD`, `family 25 model 17`, as far as known."""
    try:
        text = cpu_info.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    maker, family, model = (
        re.search(rf"^{key}\s*:\s*(\S+)", text, re.M) for key in ("vendor_id", "cpu family", "model")
    )
    found = [] if maker is None else [maker.group(1)]
    return found if family is None or model is None else [*found, f"family {family.group(1)} model {model.group(1)}"]


def differing_builds(
    other_software: Mapping[str, str],
    other_features: Collection[str],
    own_software: Mapping[str, str],
    own_features: Collection[str],
) -> list[str]:
    """Differences in software and processor from another build, a line each; equal builds make equal pixels."""
    found = [
        f"{name} {other_software.get(name, 'missing')} there, {own_software.get(name, 'missing')} here"
        for name in sorted({*other_software, *own_software})
        if other_software.get(name) != own_software.get(name)
    ]
    return found if set(other_features) == set(own_features) else [*found, "another set of processor features"]


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
        software, cpu_features: that made the frames; those of several builds are joined.
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


def with_another_build(manifest: Manifest, software: Mapping[str, str], cpu_features: Sequence[str]) -> Manifest:
    """The manifest of a dataset of two builds: both versions of a package, and the processor features of both."""
    versions = {
        name: {*manifest.software.get(name, "missing").split(_AND), software.get(name, "missing")}
        for name in sorted({*manifest.software, *software})
    }
    joined = {name: _AND.join(sorted(found)) for name, found in versions.items()}
    return with_build(manifest, joined, list(dict.fromkeys([*manifest.cpu_features, *cpu_features])))


def write_manifest(dataset: Location, manifest: Manifest) -> None:
    """Write `manifest.json`, whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    with open_storage(dataset).write_text(MANIFEST_FILE) as stream:
        stream.write(json.dumps(manifest.model_dump(mode="json"), indent=1, allow_nan=False) + "\n")


def read_manifest(dataset: Location) -> Manifest:
    """The manifest of a dataset, whose drogues find its copies of their meshes from then on.

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
                f"{dataset}: is a blind dataset, which has no truth; it came from another one, or was imported"
            ) from error
        raise ValueError(
            f"{path}: is missing; `render` with the same recipe makes its pairs again, `import` makes a dataset "
            "of other images"
        ) from error
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ValueError(f"{path}: is truncated or not JSON: {error}") from error
    try:
        manifest = Manifest.model_validate(table)
    except ValidationError as error:
        raise ValueError(f"{path}: {explain(error)}") from error
    offer_mesh_copies(storage, manifest.recipe)
    return manifest


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
