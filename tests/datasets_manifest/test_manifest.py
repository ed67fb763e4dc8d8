from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from datasets_manifest.storage import manifest
from datasets_manifest.storage.layout import frame_folder
from datasets_manifest.storage.manifest import (
    Drop,
    build_manifest,
    cpu_features,
    dataset_sha256,
    read_manifest,
    software_versions,
    write_manifest,
)

SPLIT_OF_SCENE = {scene_id: ("train", "test")[scene_id % 2] for scene_id in range(4)}


def test_counts_splits_and_engines(tiny: Path) -> None:
    manifest = read_manifest(tiny)
    assert (manifest.counts.pairs, manifest.counts.empty) == (3, 1)
    assert manifest.counts.by_split == {"train": 1, "val": 0, "test": 2}
    assert manifest.counts.by_scene == {0: 1, 1: 2}
    assert manifest.split_of_frame() == {0: "train", 1: "test", 3: "test"}
    assert manifest.engines == {"mitsuba 3": 3}
    assert "numpy" in manifest.software and manifest.cpu_features
    assert {"camera_axes", "units", "pixel_centre", "quaternion_order", "coco_pixels"} <= set(manifest.conventions)


def test_reading_gives_what_was_written(tiny: Path, tmp_path: Path) -> None:
    manifest = read_manifest(tiny)
    write_manifest(tmp_path, manifest)
    assert (tmp_path / "manifest.json").read_bytes() == (tiny / "manifest.json").read_bytes()
    assert read_manifest(tmp_path).dataset_sha256 == manifest.dataset_sha256


def test_the_dataset_hash_ignores_order_and_place(maker: tuple[Callable[..., Any], ...], tmp_path: Path) -> None:
    make_recipe, _, _, _, add_frame = maker
    recipe = make_recipe()
    digests = set()
    for name, order in (("a", [0, 1, 2, 3]), ("b", [3, 1, 0, 2])):
        for index in order:
            add_frame(tmp_path / name, recipe, index)
        digests.add(build_manifest(tmp_path / name, recipe, "1", SPLIT_OF_SCENE).dataset_sha256)
    hashes = [entry.record_sha256 for entry in build_manifest(tmp_path / "a", recipe, "1", SPLIT_OF_SCENE).frames]
    random.Random(1).shuffle(hashes)
    digests.add(dataset_sha256(recipe, hashes))
    assert len(digests) == 1


def test_the_dataset_hash_follows_records_and_recipe(tiny: Path) -> None:
    manifest = read_manifest(tiny)
    hashes = [entry.record_sha256 for entry in manifest.frames]
    other = manifest.recipe.model_copy(update={"seed": 5})
    digests = {
        manifest.dataset_sha256,
        dataset_sha256(manifest.recipe, hashes[:-1]),
        dataset_sha256(manifest.recipe, [*hashes[:-1], "0" * 64]),
        dataset_sha256(other, hashes),
    }
    assert len(digests) == 4


def test_drops_are_kept_with_their_reasons(tiny: Path, maker: tuple[Callable[..., Any], ...]) -> None:
    make_recipe, *_ = maker
    drops = [Drop(frame_index=2, reason="the engine stopped"), Drop(frame_index=1, reason="no room")]
    write_manifest(tiny, build_manifest(tiny, make_recipe(), "1", SPLIT_OF_SCENE, drops))
    assert [drop.frame_index for drop in read_manifest(tiny).drops] == [1, 2]


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda table: table.update(data_licence="other"), "manifest_sha256"),
        (lambda table: table["frames"][0].update(split="val"), "manifest_sha256"),
        (lambda table: table["frames"][0].update(record_sha256="0" * 64), "dataset_sha256"),
        (lambda table: table["frames"].pop(), "dataset_sha256"),
        (lambda table: table["recipe"].update(seed=9), "dataset_sha256"),
        (lambda table: table["recipe"].update(seeed=9), "recipe.seeed"),
        (lambda table: table.update(schema_version=2), "schema_version"),
        (lambda table: table.pop("engines"), "engines"),
    ],
)
def test_edited_manifests_are_refused(tiny: Path, edit: Callable[..., Any], message: str) -> None:
    path = tiny / "manifest.json"
    table = json.loads(path.read_text())
    edit(table)
    path.write_text(json.dumps(table))
    with pytest.raises(ValueError, match=message) as caught:
        read_manifest(tiny)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_missing_and_truncated_manifests_are_refused(tiny: Path, tmp_path: Path) -> None:
    path = tiny / "manifest.json"
    text = path.read_text()
    for damaged in ("", text[:300], "[]", "null"):
        path.write_text(damaged)
        with pytest.raises(ValueError, match=r"manifest\.json: ") as caught:
            read_manifest(tiny)
        assert "\n" not in str(caught.value)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match=r"manifest\.json: is truncated or not JSON"):
        read_manifest(tiny)
    path.unlink()
    with pytest.raises(ValueError, match=r"manifest\.json: is missing"):
        read_manifest(tiny)
    with pytest.raises(ValueError, match="there is no such dataset folder"):
        read_manifest(tmp_path / "none")


@pytest.mark.parametrize("contents", ["{", "{}", "[]", '{"frame_index": 1}'])
def test_a_damaged_record_cannot_be_described(tiny: Path, maker: tuple[Callable[..., Any], ...], contents: str) -> None:
    make_recipe, *_ = maker
    path = frame_folder(tiny, 1) / "record.json"
    path.write_text(contents)
    with pytest.raises(ValueError, match=r"000001/record\.json: is not a complete record"):
        build_manifest(tiny, make_recipe(), "1", SPLIT_OF_SCENE)


def test_a_record_in_the_wrong_folder_cannot_be_described(tiny: Path, maker: tuple[Callable[..., Any], ...]) -> None:
    make_recipe, *_ = maker
    frame_folder(tiny, 1).rename(frame_folder(tiny, 2))
    with pytest.raises(ValueError, match=r"000002/record\.json: belongs to frame 1"):
        build_manifest(tiny, make_recipe(), "1", SPLIT_OF_SCENE)


def test_processors_of_two_makers_are_two(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = set()
    for maker in ("GenuineIntel", "AuthenticAMD"):
        (tmp_path / maker).write_text(f"processor\t: 0\nvendor_id\t: {maker}\nmodel name\t: any\n")
        monkeypatch.setattr(manifest, "_CPU_INFO", tmp_path / maker)
        told.add(frozenset(cpu_features()))
    monkeypatch.setattr(manifest, "_CPU_INFO", tmp_path / "missing")
    nobody = frozenset(cpu_features())
    assert len(told | {nobody}) == 3 and frozenset.intersection(*told) == nobody


def test_two_models_of_one_maker_are_two_processors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = set()
    for family, model in ((25, 17), (26, 17), (25, 1)):
        text = f"vendor_id\t: AuthenticAMD\ncpu family\t: {family}\nmodel\t\t: {model}\nmodel name\t: AMD EPYC\n"
        (tmp_path / "cpuinfo").write_text(text)
        monkeypatch.setattr(manifest, "_CPU_INFO", tmp_path / "cpuinfo")
        features = cpu_features()
        assert f"family {family} model {model}" in features
        found.add(frozenset(features))
    assert len(found) == 3


def test_machine_description() -> None:
    features = cpu_features()
    assert features and all(isinstance(feature, str) for feature in features)
    assert {"python", "numpy", "scipy", "opencv-python-headless"} <= set(software_versions())
