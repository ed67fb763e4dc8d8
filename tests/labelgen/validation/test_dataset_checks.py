from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycocotools.mask
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.layout import frame_folder
from datasets_manifest.storage.manifest import build_manifest, read_manifest, with_build, write_manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.writer import canonical_json
from labelgen.validation.dataset_checks import validate_dataset
from tests.support.drawn_pairs import Pair


def folder_of(dataset: Path, pair: Pair) -> Path:
    return frame_folder(dataset, pair.frame.frame_index)


def faults_of(dataset: Path) -> list[str]:
    report = validate_dataset(dataset)
    assert not report.passed
    assert all("\n" not in fault for fault in report.faults)
    return report.faults


def edit_record(dataset: Path, pair: Pair, edit: Callable[..., Any]) -> None:
    """Change a record's JSON and describe the dataset anew, so that only its contents are wrong."""
    path = folder_of(dataset, pair) / "record.json"
    table = json.loads(path.read_text())
    edit(table)
    path.write_text(canonical_json(table) + "\n")
    manifest = read_manifest(dataset)
    splits = {entry.scene_id: entry.split for entry in manifest.frames}
    write_manifest(dataset, build_manifest(dataset, manifest.recipe, "1", splits))


def test_a_whole_dataset_passes(small_dataset: Path, pairs: list[Pair], capfd: pytest.CaptureFixture[str]) -> None:
    report = validate_dataset(small_dataset)
    assert report.faults == [] and report.passed and report.pairs == len(pairs)
    counts = {check.name: check.count for check in report.checks}
    assert counts["hashes"] == len(pairs) and counts["labels against part ids"] == 2 * len(pairs)
    assert "labels against part ids" in report.table()
    assert capfd.readouterr() == ("", "")


def test_no_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="there is no such dataset folder"):
        validate_dataset(tmp_path / "none")


def test_a_truncated_manifest_is_a_fault(small_dataset: Path) -> None:
    path = small_dataset / "manifest.json"
    path.write_text(path.read_text()[:500])
    (fault,) = faults_of(small_dataset)
    assert "manifest.json: is truncated" in fault


@pytest.mark.parametrize("name", ["left.png", "right_parts.png"])
def test_truncated_images_are_faults(
    small_dataset: Path, full_pairs: list[Pair], name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = folder_of(small_dataset, full_pairs[0]) / name
    path.write_bytes(path.read_bytes()[:-20])
    faults = faults_of(small_dataset)
    assert all(str(path) in fault for fault in faults) and len(faults) == 2
    # The decoder must not be let loose on it: libpng writes to standard error.
    assert capfd.readouterr() == ("", "")


def test_a_changed_pixel_is_a_fault(small_dataset: Path, full_pairs: list[Pair]) -> None:
    one, other = (folder_of(small_dataset, pair) / "left.png" for pair in full_pairs[:2])
    shutil.copy(other, one)
    (fault,) = faults_of(small_dataset)
    assert fault == f"{one}: was changed: its hash differs from the recorded one"


@pytest.mark.parametrize("damage", [lambda text: text[: len(text) // 2], lambda text: "[]", lambda text: "[" * 100_000])
def test_a_damaged_record_is_a_fault(small_dataset: Path, full_pairs: list[Pair], damage: Callable[..., Any]) -> None:
    path = folder_of(small_dataset, full_pairs[0]) / "record.json"
    path.write_text(damage(path.read_text()))
    (fault,) = faults_of(small_dataset)
    assert fault.startswith(f"{path}: ")


def test_missing_and_stray_files_are_faults(small_dataset: Path, full_pairs: list[Pair]) -> None:
    shutil.rmtree(folder_of(small_dataset, full_pairs[0]))
    missing = folder_of(small_dataset, full_pairs[1]) / "right.png"
    missing.unlink()
    stray = folder_of(small_dataset, full_pairs[1]) / "notes.txt"
    stray.write_text("")
    leftover = small_dataset / "frames" / ".000001-abc.part"
    leftover.mkdir()
    shutil.copytree(folder_of(small_dataset, full_pairs[1]), small_dataset / "frames" / "000099")
    faults = faults_of(small_dataset)
    for wanted in (
        f"{folder_of(small_dataset, full_pairs[0]) / 'record.json'}: is missing",
        f"{missing}: is missing",
        f"{stray}: is not on record",
        f"{leftover}: was left by a run that was killed",
        f"{small_dataset / 'frames' / '000099'}: is not in the manifest",
    ):
        assert wanted in faults


def test_shifted_labels_are_faults(small_dataset: Path, full_pairs: list[Pair]) -> None:
    def shift(table: dict[str, Any]) -> None:
        # As a renderer with its origin at the pixel corner would have it.
        for view in table["views"].values():
            for marker in view["markers"]:
                marker["center_proj_px"] = [value + 0.5 for value in marker["center_proj_px"]]
                marker["center_ellipse_px"] = [value + 0.5 for value in marker["center_ellipse_px"]]

    edit_record(small_dataset, full_pairs[0], shift)
    faults = faults_of(small_dataset)
    assert sum("off the pose's image" in fault for fault in faults) == 16
    assert sum("from the centroid of part" in fault for fault in faults) == 16
    assert sum("keypoints: differ" in fault for fault in faults) == 2


def test_rows_that_differ_between_the_eyes_are_a_fault(small_dataset: Path, full_pairs: list[Pair]) -> None:
    def lower(table: dict[str, Any]) -> None:
        table["views"]["right"]["markers"][0]["center_proj_px"][1] += 1e-7

    edit_record(small_dataset, full_pairs[0], lower)
    assert any("rows of left and right differ by 1e-07 px" in fault for fault in faults_of(small_dataset))


def test_a_wrong_box_is_a_fault(small_dataset: Path, full_pairs: list[Pair]) -> None:
    def widen(table: dict[str, Any]) -> None:
        table["views"]["left"]["box_visible_xywh_px"][2] += 1

    edit_record(small_dataset, full_pairs[0], widen)
    faults = faults_of(small_dataset)
    assert any("left_parts.png: box_visible_xywh_px" in fault for fault in faults)
    assert any("bbox: is" in fault for fault in faults)


def test_a_scene_in_two_splits_is_a_fault(small_dataset: Path, small_recipe: Recipe) -> None:
    manifest = read_manifest(small_dataset)
    first = manifest.frames[0]
    moved = first.model_copy(update={"split": "val" if first.split == "train" else "train"})
    leaky = manifest.model_copy(update={"frames": (moved, *manifest.frames[1:])})
    # With the hash that belongs to it.
    write_manifest(small_dataset, with_build(leaky, manifest.software, manifest.cpu_features))
    assert any("is in more than one split" in fault for fault in faults_of(small_dataset))


def test_annotations_that_disagree_are_faults(small_dataset: Path) -> None:
    annotations = small_dataset / "annotations"
    table = json.loads((annotations / "all.json").read_text())
    table["annotations"][0]["area"] += 1
    table["annotations"][1]["segmentation"] = table["annotations"][0]["segmentation"]
    del table["annotations"][2]["bbox"]
    del table["images"][-1]
    (annotations / "all.json").write_text(json.dumps(table))
    parts = sorted(path for path in annotations.iterdir() if path.name != "all.json")
    parts[0].write_text("{")
    parts[1].unlink()
    faults = faults_of(small_dataset)
    for wanted in (
        "area: is",
        "segmentation: differs",
        "annotation is invalid: KeyError",
        "all.json: has 11 images",
    ):
        assert any(wanted in fault for fault in faults), wanted
    assert any(fault.startswith(f"{parts[0]}: is truncated") for fault in faults)
    assert f"{parts[1]}: is missing" in faults


def test_a_coco_file_without_annotations_is_a_fault(small_dataset: Path) -> None:
    path = small_dataset / "annotations" / "all.json"
    table = json.loads(path.read_text())
    del table["annotations"]
    path.write_text(json.dumps(table))
    assert f"{path}: is truncated or not a COCO file: has no 'annotations'" in faults_of(small_dataset)


@pytest.mark.parametrize("is_zero", [True, False])
def test_annotation_ids_that_are_not_unique_and_positive_are_a_fault(small_dataset: Path, is_zero: bool) -> None:
    def edit(table: dict[str, Any]) -> None:
        first, second, *_ = table["annotations"]
        first["id"] = 0 if is_zero else second["id"]

    edit_coco(small_dataset, edit)
    path = small_dataset / "annotations" / "all.json"
    assert f"{path}: annotation ids must be unique and above 0" in faults_of(small_dataset)


def test_a_path_out_of_the_frame_is_a_fault(small_dataset: Path, full_pairs: list[Pair]) -> None:
    edit_record(
        small_dataset, full_pairs[0], lambda table: table["file_sha256"].update({"../../recipe.toml": "0" * 64})
    )
    (fault,) = faults_of(small_dataset)
    assert "must name files of the frame's own folder" in fault
    with pytest.raises(ValueError, match="own folder"):
        Dataset(small_dataset).record(full_pairs[0].frame.frame_index)


def edit_coco(dataset: Path, edit: Callable[..., Any]) -> None:
    path = dataset / "annotations" / "all.json"
    table = json.loads(path.read_text())
    edit(table)
    path.write_text(json.dumps(table))


HUGE = 2**31 - 1


@pytest.mark.parametrize(
    "segmentation",
    [
        {"size": [HUGE, HUGE], "counts": "0" * 100},
        {"size": [-1, -1], "counts": "0"},
        {"size": [HUGE, 1], "counts": [HUGE]},
        {"size": None, "counts": "0" * 1000},
        {"counts": [0, 1]},
        {"size": "as it was", "counts": [HUGE, HUGE, HUGE]},
        {"size": "as it was", "counts": [-5, 5]},
        {"size": "as it was", "counts": "~" * 1000},
        {"size": "as it was", "counts": None},
        [[0, 0, 1e9, 0, 1e9, 1e9]],
        [[]],
        None,
        "\ud800",
    ],
)
def test_hostile_segmentations_are_faults_beside_others(
    small_dataset: Path, pairs: list[Pair], segmentation: Any
) -> None:
    def edit(table: dict[str, Any]) -> None:
        before = table["annotations"][0]["segmentation"]
        if isinstance(segmentation, dict) and segmentation.get("size") == "as it was":
            segmentation["size"] = before["size"]
        table["annotations"][0]["segmentation"] = segmentation

    edit_coco(small_dataset, edit)
    report = validate_dataset(small_dataset)
    assert any("all.json: image" in fault and "segmentation" in fault for fault in report.faults)
    assert report.pairs == len(pairs)


def test_uncompressed_run_lengths_are_read(small_dataset: Path) -> None:
    def edit(table: dict[str, Any]) -> None:
        for annotation in table["annotations"]:
            mask = pycocotools.mask.decode(annotation["segmentation"]).ravel(order="F")
            ends = np.flatnonzero(np.diff(mask)) + 1
            runs = np.diff([0, *ends, mask.size]).tolist()
            annotation["segmentation"]["counts"] = runs if mask[0] == 0 else [0, *runs]

    edit_coco(small_dataset, edit)
    assert not any("segmentation" in fault for fault in faults_of(small_dataset))


@pytest.mark.parametrize("categories", [None, [], [{"id": 2, "name": "drogue"}], [{"id": 1}], [7]])
def test_annotations_without_the_drogues_category_are_a_fault(small_dataset: Path, categories: Any) -> None:
    edit_coco(small_dataset, lambda table: table.pop("categories") and table.update(categories=categories))
    if categories is None:
        edit_coco(small_dataset, lambda table: table.pop("categories"))
    assert any("all.json" in fault and ("categories" in fault or "COCO" in fault) for fault in faults_of(small_dataset))


def test_more_markers_than_a_drogue_can_have_are_a_fault(small_dataset: Path, pairs: list[Pair]) -> None:
    def edit(record: dict[str, Any]) -> None:
        for eye in ("left", "right"):
            record["views"][eye]["markers"] = record["views"][eye]["markers"][:1] * 300

    edit_record(small_dataset, pairs[0], edit)
    assert any("record.json: views.left.markers" in fault for fault in faults_of(small_dataset))


@pytest.mark.parametrize("time_s", [1e300, -1e300, 2.0**31])
def test_times_that_no_export_can_write_are_a_fault(small_dataset: Path, pairs: list[Pair], time_s: float) -> None:
    edit_record(small_dataset, pairs[0], lambda record: record.update(time_s=time_s))
    assert any("record.json: time_s" in fault for fault in faults_of(small_dataset))


@pytest.mark.parametrize("text", ["NaN", "-Infinity", "1e999"])
def test_numbers_that_are_none_are_a_fault(small_dataset: Path, pairs: list[Pair], text: str) -> None:
    path = folder_of(small_dataset, pairs[0]) / "record.json"
    table = json.loads(path.read_text())
    table["views"]["left"]["markers"][0]["center_proj_px"][0] = "HERE"
    path.write_text(json.dumps(table).replace('"HERE"', text))
    assert any("record.json" in fault for fault in faults_of(small_dataset))


def test_many_faults_of_a_kind_are_counted(small_dataset: Path) -> None:
    for number in range(500):
        (small_dataset / f".left-{number}.part").touch()
    report = validate_dataset(small_dataset)
    lines = report.fault_lines()
    assert len(report.faults) == 500
    assert len(lines) == 101 and lines[-1] == "leftovers: 400 more faults"
