"""Copies of images, and COCO files as other people's readers take them."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.storage.reader import Dataset
from geometry.stereo import EYES
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export
from labelgen.export.frame_files import DISPLAY_REMARK
from labelgen.export.keypoints import view_of
from tests.support.display_encoding import shown
from tests.support.other_python import read_by
from tests.support.whole_dataset import write_whole_dataset

READ_BY_DATUMARO = """
import json, sys
import datumaro
read = datumaro.Dataset.import_from(sys.argv[1], "coco_person_keypoints")
print(json.dumps([
    {"subset": item.subset, "id": item.id, "shape": list(item.media.data.shape), "annotations": [
        {"type": one.type.name, "id": one.id, "label": read.categories()[datumaro.AnnotationType.label][one.label].name,
         "box": list(map(float, one.get_bbox())), "area": float(one.get_area()),
         "points": list(map(float, one.points)) if one.type.name == "points" else [],
         "flags": [int(flag) for flag in one.visibility] if one.type.name == "points" else []}
        for one in item.annotations]}
    for item in read]))
"""


@pytest.fixture(scope="module")
def with_images(mixed_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("coco") / "out"
    assert write_export("coco", mixed_dataset, out, ExportLog(), image_bits=8) == [out]
    return out


def annotations_of(path: Path) -> list[dict]:
    return json.loads(path.read_text())["annotations"]


def test_every_category_names_the_keypoints_of_its_annotations(with_images: Path) -> None:
    table = json.loads((with_images / "annotations" / "all.json").read_text())
    categories = {category["id"]: category for category in table["categories"]}
    assert [category["name"] for category in categories.values()] == ["drogue", "marker", "hub"]
    assert {annotation["category_id"] for annotation in table["annotations"]} == set(categories)
    for annotation in table["annotations"]:
        category = categories[annotation["category_id"]]
        assert len(annotation["keypoints"]) == 3 * len(category["keypoints"])
        assert all(1 <= end <= len(category["keypoints"]) for bone in category["skeleton"] for end in bone)
    ids = [annotation["id"] for annotation in table["annotations"]]
    assert len(ids) == len(set(ids)) and min(ids) > 0 and max(ids) < 2**31


def test_every_named_image_lies_in_the_moved_folder(with_images: Path, mixed_dataset: Path, tmp_path: Path) -> None:
    source = Dataset(mixed_dataset)
    moved = with_images.rename(tmp_path / "moved")
    files = sorted(path.name for path in (moved / "annotations").iterdir())
    assert files == ["all.json", *(f"person_keypoints_{split}.json" for split in ("test", "train", "val"))]
    for file in files:
        split = file.removesuffix(".json").rpartition("_")[2]
        folder = moved / "images" if split == "all" else moved / "images" / split
        table = json.loads((moved / "annotations" / file).read_text())
        assert table["images"]
        for image in table["images"]:
            own = image["droguekit"]
            pixels = cv2.imread(str(folder / image["file_name"]))
            stored = getattr(source.images(own["frame_index"]), own["view"])
            np.testing.assert_array_equal(pixels[:, :, ::-1], shown(stored, source, own["frame_index"]))
    moved.rename(with_images)


def test_images_for_screens_are_linked_and_linear_ones_keep_their_values_only_when_asked(
    dataset_by_preset: Callable[..., Path], tmp_path: Path
) -> None:
    log = ExportLog()
    for encoding, bits, is_same in (("gamma", 8, True), ("linear", 8, False), ("linear", 16, True)):
        dataset, out = dataset_by_preset("rgb-ideal", {"encoding": encoding}), tmp_path / f"{encoding}-{bits}"
        write_export("coco", dataset, out, log, image_bits=bits)
        copy = next((out / "images").rglob("000001_right.png")).read_bytes()
        assert (copy == (dataset / "frames" / "000001" / "right.png").read_bytes()) == is_same
    assert log.remarks == [DISPLAY_REMARK]


def test_deep_images_are_told_of_and_copied_with_eight_bits(
    dataset_by_preset: Callable[..., Path], tmp_path: Path
) -> None:
    dataset = dataset_by_preset("mono", {"output_bits": 12})
    log = ExportLog()
    write_export("coco", dataset, tmp_path / "without", log)
    assert log.losses["images of 12 bits in 16, nearly black to programs for 8: add --images for copies"] == 6
    log = ExportLog()
    write_export("coco", dataset, tmp_path / "with", log, image_bits=8)
    assert log.losses["images of 12 bits: written with 8, on the sRGB curve"] == 6
    source = Dataset(dataset)
    for image in json.loads((tmp_path / "with" / "annotations" / "all.json").read_text())["images"]:
        copy = cv2.imread(str(tmp_path / "with" / "images" / image["file_name"]), cv2.IMREAD_UNCHANGED)
        own = image["droguekit"]
        stored = getattr(source.images(own["frame_index"]), own["view"])
        np.testing.assert_array_equal(copy, shown(stored, source, own["frame_index"]))
        assert copy.dtype == np.uint8


def chunks(png: bytes) -> dict[bytes, bytes]:
    """The data of a PNG's chunks by type."""
    found, place = {}, 8
    while place < len(png):
        (length,) = struct.unpack_from(">I", png, place)
        found[png[place + 4 : place + 8]] = png[place + 8 : place + 8 + length]
        place += 12 + length
    return found


@pytest.mark.parametrize(("preset", "channels"), [("mono", 1), ("rgb-ideal", 3)])
def test_copies_of_sixteen_bits_lose_nothing_and_say_how_many_bits_count(
    preset: str, channels: int, dataset_by_preset: Callable[..., Path], tmp_path: Path
) -> None:
    dataset = dataset_by_preset(preset, {"output_bits": 12})
    log = ExportLog()
    write_export("coco", dataset, tmp_path / "out", log, image_bits=16)
    assert not any("bits" in what for what in log.losses)
    source = Dataset(dataset)
    for image in json.loads((tmp_path / "out" / "annotations" / "all.json").read_text())["images"]:
        path = tmp_path / "out" / "images" / image["file_name"]
        found = chunks(path.read_bytes())
        assert list(found)[:2] == [b"IHDR", b"sBIT"] and found[b"sBIT"] == bytes([12] * channels)
        copy = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        stored = getattr(source.images(image["droguekit"]["frame_index"]), image["droguekit"]["view"])
        np.testing.assert_array_equal((copy if channels == 1 else copy[:, :, ::-1]) >> 4, stored)
        # A reader of 8 bits sees the upper ones.
        np.testing.assert_array_equal(cv2.imread(str(path))[:, :, 0], (copy if channels == 1 else copy[:, :, 0]) >> 8)


def test_other_formats_refuse_the_option(mixed_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="--images: is for coco; kitti has images without it"):
        write_export("kitti", mixed_dataset, tmp_path / "out", ExportLog(), image_bits=8)
    assert not (tmp_path / "out").exists()


def test_datumaro_reads_every_annotation(with_images: Path, mixed_dataset: Path, tmp_path: Path) -> None:
    told = read_by("datumaro", READ_BY_DATUMARO, with_images, folder=tmp_path)
    assert len(told) == 18 and {item["subset"] for item in told} == {"train", "val", "test"}
    assert all(item["shape"] == [120, 160, 3] for item in told)
    read = {(one["id"], one["type"]): one for item in told for one in item["annotations"]}
    wanted = annotations_of(with_images / "annotations" / "all.json")
    names = {1: "drogue", 2: "marker", 3: "hub"}
    # A box, a mask and the keypoints of each.
    assert len(read) == sum(len(item["annotations"]) for item in told) == 3 * len(wanted)
    for annotation in wanted:
        box, mask, points = (read[annotation["id"], kind] for kind in ("bbox", "mask", "points"))
        assert {one["label"] for one in (box, mask, points)} == {names[annotation["category_id"]]}
        np.testing.assert_allclose(box["box"], annotation["bbox"])
        assert mask["area"] == annotation["area"]
        keypoints = np.array(annotation["keypoints"]).reshape(-1, 3)
        # datumaro rounds points to hundredths of a pixel.
        np.testing.assert_allclose(np.reshape(points["points"], (-1, 2)), keypoints[:, :2], atol=0.0051)
        assert points["flags"] == keypoints[:, 2].tolist()


def test_the_views_of_the_datasets_own_images_are_named_without_copies(mixed_dataset: Path, tmp_path: Path) -> None:
    (whole, *_) = write_export("coco", mixed_dataset, tmp_path / "out", ExportLog())
    source = Dataset(mixed_dataset)
    named = [image["file_name"] for image in json.loads(whole.read_text())["images"]]
    assert named == [f"frames/{index:06d}/{eye}.png" for index in source.frame_indices for eye in EYES]
    assert all((mixed_dataset / name).is_file() for name in named)
    assert len(annotations_of(whole)) > sum(
        view_of(source.record(index), eye).box_visible_xywh_px is not None
        for index in source.frame_indices
        for eye in EYES
    )


def test_files_of_an_older_exports_splits_do_not_stay(tmp_path: Path) -> None:
    dataset, out = tmp_path / "dataset", tmp_path / "out"
    write_whole_dataset(dataset)
    out.mkdir()
    first, log = write_export("coco", dataset, out, ExportLog()), ExportLog()
    assert {path.name for path in first} == {"all.json", "train.json", "test.json"}
    shutil.copy(out / "train.json", out / "val.json")
    assert write_export("coco", dataset, out, log) == first
    assert {path.name for path in out.iterdir()} == {path.name for path in first}
    assert log.remarks[-1].startswith("val.json of an older export is removed")
    # Somebody else's file of that name stays.
    (out / "val.json").write_text('{"info":{"contributor":"me"}}')
    write_export("coco", dataset, out, ExportLog())
    assert (out / "val.json").exists()
