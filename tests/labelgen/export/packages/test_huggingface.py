"""Folders for the Hub: their Parquet files read by pyarrow, and the whole folder by Hugging Face's `datasets`."""

from __future__ import annotations

import base64
import hashlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

from datasets_manifest.storage.image_codecs import decode_exr
from datasets_manifest.storage.reader import Dataset
from drogue_models.marker_layout import marker_layout
from geometry.stereo import EYES
from labelgen.export.annotations.coco import DROGUE, HUB, MARKER
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export
from labelgen.export.keypoints import view_of
from labelgen.export.packages.huggingface import write_huggingface
from tests.support.display_encoding import shown
from tests.support.other_python import read_by
from tests.support.small_datasets import docking_recipe, rendered
from tests.support.whole_dataset import write_whole_dataset

CATEGORY_IDS = {0: DROGUE, 1: MARKER, 2: HUB}
HUB_SPLITS = {"train": "train", "val": "validation", "test": "test"}

READ_BY_DATASETS = """
import base64, hashlib, json, os, sys
os.environ["HF_HUB_OFFLINE"] = "1"
import datasets
import numpy as np
datasets.disable_progress_bars()
read = datasets.load_dataset(sys.argv[1])
told = {"features": {name: str(one) for name, one in next(iter(read.values())).features.items()}, "rows": {}}
for split, table in read.items():
    files = table.cast_column("left_image", datasets.Image(decode=False))["left_image"]
    depth = table.cast_column("left_depth_m", datasets.Image()) if "left_depth_m" in table.column_names else None
    told["rows"][split] = []
    for number, row in enumerate(table):
        for name in [name for name in row if name.endswith(("_image", "_parts", "_mosaic"))]:
            pixels = np.asarray(row[name])
            row[name] = [row[name].mode, pixels.dtype.name, pixels.shape, hashlib.sha256(pixels.tobytes()).hexdigest()]
        row["file"] = base64.b64encode(files[number]["bytes"]).decode()
        for name in ("left_depth_m", "right_depth_m"):
            row.pop(name, None)
        if depth is not None:
            row["depth"] = base64.b64encode(np.asarray(depth[number]["left_depth_m"]).tobytes()).decode()
        told["rows"][split].append(row)
print(json.dumps(told))
"""


def exported(dataset: Path, out: Path, log: ExportLog | None = None) -> list[dict[str, Any]]:
    """The rows of an exported dataset by pyarrow, in the order of the pairs."""
    assert write_export("huggingface", dataset, out, log or ExportLog()) == [out]
    rows = [row for path in sorted((out / "data").iterdir()) for row in pq.read_table(path).to_pylist()]
    return sorted(rows, key=lambda row: row["frame_index"])


def front_matter(out: Path) -> dict[str, Any]:
    table = yaml.safe_load((out / "README.md").read_text(encoding="utf-8").split("---\n", 2)[1])
    assert isinstance(table, dict)
    return table


def told_of(image: np.ndarray, mode: str) -> list[Any]:
    """What the script above tells of an image with these pixels."""
    return [mode, image.dtype.name, list(image.shape), hashlib.sha256(image.tobytes()).hexdigest()]


@pytest.fixture(scope="module")
def mixed_export(mixed_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("hub") / "mixed"
    write_export("huggingface", mixed_dataset, out, ExportLog())
    return out


def test_the_files_name_their_columns_as_datasets_does(mixed_export: Path) -> None:
    for path in (mixed_export / "data").iterdir():
        schema = pq.read_schema(path)
        features = json.loads(schema.metadata[b"huggingface"])["info"]["features"]
        assert list(features) == schema.names
        for eye in EYES:
            assert features[f"{eye}_image"] == {"_type": "Image"}
            assert str(schema.field(f"{eye}_image").type) == "struct<bytes: binary, path: string>"
            assert features[f"{eye}_objects"]["category"]["feature"]["names"] == ["drogue", "marker", "hub"]
        assert features["left_from_drogue"]["quaternion_xyzw"]["feature"] == {"dtype": "float64", "_type": "Value"}


def test_the_card_lists_files_splits_and_columns(mixed_export: Path, mixed_dataset: Path) -> None:
    front, manifest = front_matter(mixed_export), Dataset(mixed_dataset).manifest
    assert front["license"] == "cc-by-4.0" and front["size_categories"] == ["n<1K"] and "viewer" not in front
    (config,) = front["configs"]
    assert [entry["split"] for entry in config["data_files"]] == ["train", "validation", "test"]
    about = front["dataset_info"]
    counts = {HUB_SPLITS[split]: count for split, count in manifest.counts.by_split.items()}
    assert {entry["name"]: entry["num_examples"] for entry in about["splits"]} == counts
    for entry in config["data_files"]:
        (path,) = mixed_export.glob(entry["path"])
        assert path.name == f"{entry['split']}-00000-of-00001.parquet"
        assert pq.read_metadata(path).num_rows == counts[entry["split"]]
        assert [feature["name"] for feature in about["features"]] == pq.read_schema(path).names
    assert about["download_size"] == sum(path.stat().st_size for path in (mixed_export / "data").iterdir())
    text = (mixed_export / "README.md").read_text(encoding="utf-8")
    assert all(f"| `{feature['name']}` |" in text for feature in about["features"])
    assert manifest.dataset_sha256 in text and "croissant.json" not in text


def test_manifest_and_calibration_stand_beside_the_table(mixed_export: Path, mixed_dataset: Path) -> None:
    assert (mixed_export / "manifest.json").read_bytes() == (mixed_dataset / "manifest.json").read_bytes()
    for path in (mixed_dataset / "calibration").iterdir():
        assert (mixed_export / "calibration" / path.name).read_bytes() == path.read_bytes()


def test_rows_hold_the_images_and_records_of_all_pairs(mixed_dataset: Path, tmp_path: Path) -> None:
    source = Dataset(mixed_dataset)
    rows = exported(mixed_dataset, tmp_path / "out")
    assert [row["frame_index"] for row in rows] == list(source.frame_indices)
    splits = source.manifest.split_of_frame()
    for row in rows:
        folder = mixed_dataset / "frames" / f"{row['frame_index']:06d}"
        assert json.loads(row["record"]) == json.loads((folder / "record.json").read_text())
        assert row["split"] == splits[row["frame_index"]]
        for eye in EYES:
            seen = cv2.imdecode(np.frombuffer(row[f"{eye}_image"]["bytes"], np.uint8), cv2.IMREAD_COLOR)
            stored = cv2.imread(str(folder / f"{eye}.png"))
            np.testing.assert_array_equal(seen, shown(stored, source, row["frame_index"]))
            assert row[f"{eye}_image"]["path"] == f"{row['frame_index']:06d}_{eye}.png"
            assert row[f"{eye}_parts"]["bytes"] == (folder / f"{eye}_parts.png").read_bytes()


def test_objects_are_those_of_coco(mixed_dataset: Path, tmp_path: Path) -> None:
    (whole, *_) = write_export("coco", mixed_dataset, tmp_path / "coco", ExportLog())
    wanted: dict[tuple[int, str], dict[int, Any]] = {}
    table = json.loads(whole.read_text())
    places = {image["id"]: (image["droguekit"]["frame_index"], image["droguekit"]["view"]) for image in table["images"]}
    for one in table["annotations"]:
        wanted.setdefault(places[one["image_id"]], {})[one["id"]] = one
    for row in exported(mixed_dataset, tmp_path / "out"):
        for eye in EYES:
            objects, expected = row[f"{eye}_objects"], wanted.get((row["frame_index"], eye), {})
            assert sorted(objects["id"]) == sorted(expected)
            for number, id_ in enumerate(objects["id"]):
                one = expected[id_]
                assert CATEGORY_IDS[objects["category"][number]] == one["category_id"]
                assert objects["bbox"][number] == one["bbox"] and objects["area"][number] == one["area"]
                assert objects["marker_index"][number] == one["droguekit"].get("marker_index")


def test_pairs_without_a_drogue_have_no_pose_and_no_objects(mixed_dataset: Path, tmp_path: Path) -> None:
    source = Dataset(mixed_dataset)
    rows = exported(mixed_dataset, tmp_path / "out")
    empty = [row for row in rows if source.record(row["frame_index"]).frame.drogue is None]
    assert 0 < len(empty) < len(rows)
    for row in empty:
        assert row["left_from_drogue"] is None and row["distance_m"] is None and row["drogue"] is None
        for eye in EYES:
            for lists in (row[f"{eye}_objects"], row[f"{eye}_keypoints"]):
                assert all(values == [] for values in lists.values())


@pytest.mark.parametrize("preset", ["rgb-ideal", "paper-real"])
def test_opencv_projects_the_markers_onto_the_keypoints(
    preset: str, dataset_by_preset: Callable[..., Path], tmp_path: Path
) -> None:
    dataset = dataset_by_preset(preset)
    checked = 0
    for row in exported(dataset, tmp_path / "out"):
        record, pose = Dataset(dataset).record(row["frame_index"]), row["left_from_drogue"]
        if pose is None:
            continue
        assert record.frame.drogue is not None
        rotation = Rotation.from_quat(pose["quaternion_xyzw"]).as_matrix()
        left_m = marker_layout(record.frame.drogue).centers_m @ rotation.T + pose["translation_m"]
        for eye in EYES:
            camera, keypoints = row[f"{eye}_camera"], row[f"{eye}_keypoints"]
            place = camera["camera_from_left"]
            turn = Rotation.from_quat(place["quaternion_xyzw"]).as_rotvec()
            matrix, distortion = np.array(camera["matrix"]), np.array(camera["distortion"])
            image, _ = cv2.projectPoints(left_m, turn, np.array(place["translation_m"]), matrix, distortion)
            shown = np.array(keypoints["visibility"]) > 0
            # Quaternions and OpenCV's own arithmetic round at 1e-13 of a thousand pixels.
            np.testing.assert_allclose(np.array(keypoints["point"])[shown] - 0.5, image[shown, 0], atol=1e-8)
            assert keypoints["id"] == list(range(record.frame.drogue.marker_count))
            assert keypoints["visible_fraction"] == [one.visible_fraction for one in view_of(record, eye).markers]
            checked += int(shown.sum())
    assert checked > 0


@pytest.mark.parametrize("preset", ["mono", "rgb-ideal", "paper-colour"])
def test_all_bits_of_deep_images_are_in_the_files(
    preset: str, dataset_by_preset: Callable[..., Path], tmp_path: Path
) -> None:
    dataset, log = dataset_by_preset(preset, {"output_bits": 12}), ExportLog()
    source = Dataset(dataset)
    for row in exported(dataset, tmp_path / "out", log):
        images = source.images(row["frame_index"])
        wanted = {"left_image": images.left, "right_image": images.right}
        if preset == "paper-colour":
            assert images.left_mosaic is not None and images.right_mosaic is not None
            wanted |= {"left_mosaic": images.left_mosaic, "right_mosaic": images.right_mosaic}
        for name, pixels in wanted.items():
            seen = cv2.imdecode(np.frombuffer(row[name]["bytes"], np.uint8), cv2.IMREAD_UNCHANGED)
            assert seen.dtype == np.uint16 and seen.max() > 4095
            seen = seen[..., ::-1] if seen.ndim == 3 else seen
            if name.endswith("_mosaic"):
                np.testing.assert_array_equal(seen >> 4, pixels)
                continue
            np.testing.assert_array_equal(seen, shown(pixels, source, row["frame_index"], levels=65535))
            # Values above the black level of 64 stay apart.
            light = pixels[pixels >= 64]
            assert len(np.unique(seen[pixels >= 64])) == len(np.unique(light))
        assert row["image_black_level_dn"] == 0.0
    notes = (tmp_path / "out" / "README.md").read_text(encoding="utf-8")
    assert "The sensor is linear. Images are encoded for screens, in 16 bits" in notes
    assert ("Mosaics have 12 bits at the top of 16: shift values right by 4" in notes) == (preset == "paper-colour")
    assert ("decode=False" in notes) == (preset != "mono") == any("upper 8 bits" in line for line in log.remarks)


def test_depth_is_exact(tmp_path: Path) -> None:
    write_whole_dataset(tmp_path / "dataset")
    for row in exported(tmp_path / "dataset", tmp_path / "out"):
        for eye in EYES:
            passes = (tmp_path / "dataset" / "frames" / f"{row['frame_index']:06d}" / f"{eye}.exr").read_bytes()
            with Image.open(io.BytesIO(row[f"{eye}_depth_m"])) as picture:
                depth_m = np.asarray(picture)
            assert depth_m.dtype == np.float32 and np.isinf(depth_m).any()
            np.testing.assert_array_equal(depth_m, decode_exr(passes)["depth.Z"])


def test_files_end_at_the_limit(mixed_dataset: Path, tmp_path: Path) -> None:
    limit = 150_000
    write_huggingface(mixed_dataset, tmp_path / "out", ExportLog(), limit)
    source, found = Dataset(mixed_dataset), []
    for split, name in HUB_SPLITS.items():
        paths = sorted((tmp_path / "out" / "data").glob(f"{name}-*"))
        assert [path.name for path in paths] == [
            f"{name}-{number:05d}-of-{len(paths):05d}.parquet" for number in range(len(paths))
        ]
        indices = [index for path in paths for index in pq.read_table(path)["frame_index"].to_pylist()]
        assert indices == [index for index, one in sorted(source.manifest.split_of_frame().items()) if one == split]
        assert all(path.stat().st_size < limit + 30_000 or pq.read_metadata(path).num_rows == 1 for path in paths)
        found += paths
    assert len(found) > 3
    about = front_matter(tmp_path / "out")["dataset_info"]
    assert about["download_size"] == sum(path.stat().st_size for path in found)


def test_datasets_reads_everything(mixed_export: Path, mixed_dataset: Path, tmp_path: Path) -> None:
    told = read_by("datasets", READ_BY_DATASETS, mixed_export, folder=tmp_path)
    assert told["features"]["left_image"] == "Image(mode=None, decode=True)"
    assert "ClassLabel(names=['drogue', 'marker', 'hub'])" in told["features"]["left_objects"]
    source = Dataset(mixed_dataset)
    splits, seen = source.manifest.split_of_frame(), []
    by_pyarrow = {
        row["frame_index"]: row for path in (mixed_export / "data").iterdir() for row in pq.read_table(path).to_pylist()
    }
    for split, rows in told["rows"].items():
        for row in rows:
            index = row["frame_index"]
            assert HUB_SPLITS[splits[index]] == split
            images = source.images(index)
            for eye, pixels in (("left", images.left), ("right", images.right)):
                assert row[f"{eye}_image"] == told_of(shown(pixels, source, index), "RGB")
                assert row[f"{eye}_parts"] == told_of(source.part_ids(index, eye), "L")
            plain = [name for name in row if not name.endswith(("_image", "_parts")) and name != "file"]
            assert {name: row[name] for name in plain} == {name: by_pyarrow[index][name] for name in plain}
            seen.append(index)
    assert sorted(seen) == list(source.frame_indices)


@pytest.mark.parametrize("preset", ["mono", "rgb-ideal"])
def test_datasets_gives_all_bits_of_deep_images(
    preset: str, dataset_by_preset: Callable[..., Path], tmp_path: Path
) -> None:
    dataset = dataset_by_preset(preset, {"output_bits": 12})
    write_export("huggingface", dataset, tmp_path / "out", ExportLog())
    told, source = read_by("datasets", READ_BY_DATASETS, tmp_path / "out", folder=tmp_path), Dataset(dataset)
    for row in (row for rows in told["rows"].values() for row in rows):
        pixels = source.images(row["frame_index"]).left
        whole = shown(pixels, source, row["frame_index"], levels=65535)
        # Pillow has no colour images of 16 bits.
        wanted = told_of(whole, "I;16") if preset == "mono" else told_of((whole >> 8).astype(np.uint8), "RGB")
        assert row["left_image"] == wanted
        seen = cv2.imdecode(np.frombuffer(base64.b64decode(row["file"]), np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(seen[..., ::-1] if seen.ndim == 3 else seen, whole)


def test_datasets_reads_depth(tmp_path: Path) -> None:
    write_whole_dataset(tmp_path / "dataset")
    write_export("huggingface", tmp_path / "dataset", tmp_path / "out", ExportLog())
    told = read_by("datasets", READ_BY_DATASETS, tmp_path / "out", folder=tmp_path)
    rows = [row for rows in told["rows"].values() for row in rows]
    assert len(rows) == 3
    for row in rows:
        passes = (tmp_path / "dataset" / "frames" / f"{row['frame_index']:06d}" / "left.exr").read_bytes()
        depth_m = np.frombuffer(base64.b64decode(row["depth"]), np.float32)
        np.testing.assert_array_equal(depth_m, decode_exr(passes)["depth.Z"].ravel())


def test_datasets_reads_sequences(tmp_path: Path) -> None:
    dataset = rendered(docking_recipe(2), tmp_path / "dataset")
    write_export("huggingface", dataset, tmp_path / "out", ExportLog())
    told, source = read_by("datasets", READ_BY_DATASETS, tmp_path / "out", folder=tmp_path), Dataset(dataset)
    rows = [row for rows in told["rows"].values() for row in rows]
    assert {row["sequence_id"] for row in rows} == {0, 1}
    for row in rows:
        record = source.record(row["frame_index"])
        assert (row["sequence_id"], row["time_s"]) == (record.sequence_id, record.time_s)
