"""What all formats promise alike."""

from __future__ import annotations

import hashlib
import importlib
import json
import re
import shutil
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.image_codecs import encode_png
from datasets_manifest.storage.manifest import build_manifest, write_manifest
from datasets_manifest.storage.pair_faults import PairFaults
from datasets_manifest.storage.reader import Dataset
from droguekit.cli.main import WRONG_INPUT, run
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import FORMATS, write_export
from tests.support.changed_records import with_another_pose
from tests.support.drawn_pairs import Pair

NAMES = (
    "coco",
    "yolo",
    "yolo-image-order",
    "yolo-detect",
    "speed",
    "kitti",
    "webdataset",
    "huggingface",
    "parquet",
    "blind",
    "cvat",
    "label-studio",
    "fiftyone",
)
# Those that fill a folder of their own; the others replace single files.
FOLDERS = tuple(name for name in NAMES if name not in ("coco", "parquet"))


class Steps:
    """Records what a progress report is told."""

    def __init__(self) -> None:
        self.told: list[object] = []

    def begin(self, what: str, total: int) -> None:
        self.told.append((what, total))

    def advance(self) -> None:
        self.told.append(1)

    def end(self) -> None:
        self.told.append("end")


def tree(folder: Path) -> dict[str, str]:
    """Hashes of all files by their relative path."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_has_a_writer_and_a_line(name: str) -> None:
    module, function = FORMATS[name].writer.split(":")
    assert callable(getattr(importlib.import_module(module), function))
    assert FORMATS[name].description and "\n" not in FORMATS[name].description


@pytest.mark.parametrize("name", NAMES)
def test_the_same_dataset_gives_the_same_bytes_and_stays_as_it_is(
    name: str, mixed_dataset: Path, tmp_path: Path
) -> None:
    before = tree(mixed_dataset)
    for out in ("a", "b"):
        write_export(name, mixed_dataset, tmp_path / out, ExportLog())
    assert tree(tmp_path / "a") == tree(tmp_path / "b") and tree(tmp_path / "a")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]
    assert tree(mixed_dataset) == before


@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_dataset_leaves_nothing_half_written(name: str, mixed_dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(mixed_dataset, tmp_path / "copy")
    last = max((copy / "frames").iterdir())
    (last / "record.json").write_bytes((last / "record.json").read_bytes()[:-100])
    steps = Steps()
    with pytest.raises(ValueError, match=r"record\.json: is truncated"):
        write_export(name, copy, tmp_path / "out", ExportLog(steps))
    # A bar that is not taken down would hide the terminal's cursor.
    assert steps.told[-1] == "end"
    assert [path.name for path in tmp_path.rglob("*") if path.name.endswith(".part")] == []
    assert not (tmp_path / "out").exists() or tree(tmp_path / "out") == {}


@pytest.mark.parametrize("name", FOLDERS)
def test_nothing_is_overwritten(name: str, mixed_dataset: Path, tmp_path: Path) -> None:
    kept = tmp_path / "kept.txt"
    kept.write_text("mine")
    with pytest.raises(ValueError, match="is not empty; name a new folder"):
        write_export(name, mixed_dataset, tmp_path, ExportLog())
    assert list(tmp_path.iterdir()) == [kept]


@pytest.mark.parametrize("name", FOLDERS)
def test_images_behind_links_are_refused(name: str, mixed_dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(mixed_dataset, tmp_path / "copy")
    secret = tmp_path / "secret.png"
    image = min((copy / "frames").iterdir()) / "left.png"
    image.rename(secret)
    image.symlink_to(secret)
    with pytest.raises(ValueError, match=r"left\.png: leads outside the frame's folder"):
        write_export(name, copy, tmp_path / "out", ExportLog())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["coco", "speed", "webdataset", "huggingface", "parquet"])
def test_a_full_disk_is_one_line_and_leaves_nothing(
    name: str,
    dataset_by_preset: Callable[..., Any],
    tmp_path: Path,
    full_disk: Callable[[int], AbstractContextManager[None]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    # Images of 12 bits are written anew instead of linked.
    dataset = dataset_by_preset("mono", {"output_bits": 12})
    with full_disk(2000):
        code = run(["export", str(dataset), "--format", name, "--out", str(tmp_path / "out")])
    errors = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("pairs: ")]
    assert code == WRONG_INPUT and len(errors) == 1, errors
    assert "cannot be written" in errors[0] and "File too large" in errors[0]
    assert [path for path in tmp_path.rglob("*") if path.is_file() or path.name.endswith(".part")] == []


def test_unknown_formats_and_the_dataset_itself_are_refused(mixed_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no format named 'voc'; there are coco"):
        write_export("voc", mixed_dataset, tmp_path, ExportLog())
    for inside in (mixed_dataset / "frames" / "..", mixed_dataset / "annotations"):
        with pytest.raises(ValueError, match="--out: must lie outside the dataset's folder"):
            write_export("coco", mixed_dataset, inside, ExportLog())


def test_a_missing_package_is_named_with_its_extra(
    mixed_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # None in sys.modules makes an import fail as a package does that is not installed.
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "labelgen.export.packages.parquet", raising=False)
    with pytest.raises(ValueError, match=r"parquet: pyarrow is missing: pip install 'droguekit\[exports\]'"):
        write_export("parquet", mixed_dataset, tmp_path, ExportLog())


@pytest.mark.parametrize("name", NAMES)
def test_a_dataset_that_is_still_being_rendered_is_refused(name: str, small_recipe: Recipe, tmp_path: Path) -> None:
    dataset = tmp_path / "dataset"
    dataset.mkdir()
    write_manifest(
        dataset, build_manifest(dataset, small_recipe, "1", dict.fromkeys(range(small_recipe.frames.scenes), "train"))
    )
    with pytest.raises(ValueError, match="lists no pairs yet"):
        write_export(name, dataset, tmp_path / "out", ExportLog())


@pytest.mark.parametrize("name", NAMES)
def test_every_pair_is_counted(name: str, mixed_dataset: Path, tmp_path: Path) -> None:
    steps = Steps()
    write_export(name, mixed_dataset, tmp_path / "out", ExportLog(steps))
    assert steps.told == [("pairs", 9), *[1] * 9, "end"]


@pytest.mark.parametrize("name", ["coco", "yolo", "yolo-detect", "kitti"])
def test_what_is_cut_off_is_told(name: str, mixed_dataset: Path, tmp_path: Path) -> None:
    log = ExportLog()
    write_export(name, mixed_dataset, tmp_path / "out", log)
    # One drogue is outside both images, one is cut off by either.
    assert log.losses["views with a drogue of which no pixel is seen: without a label"] == 2
    assert log.losses["drogues that leave the image: their boxes end at its border"] == 2


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("opencv", "kalibr", "ros-camera-info")])
def test_a_damaged_pair_is_left_out_and_counted(name: str, mixed_dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(mixed_dataset, tmp_path / "copy")
    record = min((copy / "frames").iterdir()) / "record.json"
    whole = record.read_bytes()
    for damaged, fault in ((whole[:-100], "is truncated"), (with_another_pose(whole), "was changed")):
        record.write_bytes(damaged)
        faults = PairFaults()
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        write_export(name, copy, tmp_path / "out", ExportLog(faults=faults))
        assert faults.first is not None
        assert faults.count == 1 and faults.first[0] == int(record.parent.name)
        assert re.search(rf"record\.json: {fault}", faults.first[1])
        assert tree(tmp_path / "out")


def test_a_split_without_a_whole_pair_is_not_named(mixed_dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(mixed_dataset, tmp_path / "copy")
    for index, split in Dataset(copy).manifest.split_of_frame().items():
        if split == "val":
            (copy / "frames" / f"{index:06d}" / "record.json").write_text("{")
    for name in ("yolo", "huggingface"):
        write_export(name, copy, tmp_path / name, ExportLog(faults=PairFaults()))
    table = yaml.safe_load((tmp_path / "yolo" / "data.yaml").read_text())
    assert (table["train"], table["val"], table["test"]) == ("images/train", "images/train", "images/test")
    front = yaml.safe_load((tmp_path / "huggingface" / "README.md").read_text(encoding="utf-8").split("---\n", 2)[1])
    files = [entry["path"] for entry in front["configs"][0]["data_files"]]
    assert files == ["data/train-*.parquet", "data/test-*.parquet"]
    assert all(any((tmp_path / "huggingface").glob(path)) for path in files)
    assert [split["name"] for split in front["dataset_info"]["splits"]] == ["train", "test"]


def test_a_pair_with_a_changed_image_is_no_half_pair_in_an_export(mixed_dataset: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(mixed_dataset, tmp_path / "copy")
    last = max((copy / "frames").iterdir())
    (last / "right.png").write_bytes((last / "right.png").read_bytes()[:-100])
    faults = PairFaults()
    write_export("yolo", copy, tmp_path / "out", ExportLog(faults=faults))
    assert faults.count == 1
    assert not [path for path in (tmp_path / "out").rglob("*") if last.name in path.name]


def contradict(table: dict, what: str) -> None:
    """Change one value of a record so that it contradicts the others."""
    view = table["views"]["left"]
    if what == "markers":
        view["markers"] = view["markers"][1:]
    elif what == "hub":
        view["hub"] = None
    elif what == "box_visible_xywh_px":
        view["box_visible_xywh_px"][0] -= 1000.0
    elif what == "visible_drogue_px":
        view["visible_drogue_px"] = 160 * 120 + 1
    elif what == "angles":
        table["yaw_deg"] = None
    elif what == "box_full_xywh_px":
        view["box_full_xywh_px"] = None
    else:
        table["scene_id"] = 2**63


@pytest.mark.parametrize("name", NAMES)
def test_records_that_contradict_themselves_are_named(
    name: str, small_dataset: Path, full_pairs: list[Pair], tmp_path: Path
) -> None:
    path = small_dataset / "frames" / f"{full_pairs[0].frame.frame_index:06d}" / "record.json"
    whole = path.read_text()
    for what in (
        "markers",
        "hub",
        "box_visible_xywh_px",
        "visible_drogue_px",
        "angles",
        "box_full_xywh_px",
        "scene_id",
    ):
        table = json.loads(whole)
        contradict(table, what)
        path.write_text(json.dumps(table))
        with pytest.raises(ValueError, match=rf"record\.json: .*{what}"):
            write_export(name, small_dataset, tmp_path / "out", ExportLog())


def test_part_ids_that_show_no_drogue_are_named(small_dataset: Path, full_pairs: list[Pair], tmp_path: Path) -> None:
    path = small_dataset / "frames" / f"{full_pairs[0].frame.frame_index:06d}" / "left_parts.png"
    path.write_bytes(encode_png(np.zeros((120, 160), np.uint8)))
    with pytest.raises(ValueError, match=r"left_parts\.png: no pixel shows the drogue"):
        write_export("coco", small_dataset, tmp_path / "out", ExportLog())
