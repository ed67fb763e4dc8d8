"""Exports for CVAT, Label Studio and FiftyOne, as these tools' own readers take them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from scipy import ndimage

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.records import PairRecord, ViewRecord
from drogue_models.parts import FIRST_MARKER_ID, Part
from geometry.stereo import EYES, Eye
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export
from labelgen.export.keypoints import view_of
from labelgen.part_pixels import drogue_mask
from tests.support.display_encoding import shown
from tests.support.other_python import read_by

NAMES = ("cvat", "label-studio", "fiftyone")
SIZE_PX = (160, 120)

READ_CVAT_BY_DATUMARO = """
import json, sys
import datumaro
read = datumaro.Dataset.import_from(sys.argv[1], "cvat")
labels = read.categories()[datumaro.AnnotationType.label]
told = {}
for item in read:
    found = []
    for one in item.annotations:
        entry = {"type": one.type.name, "label": labels[one.label].name, "group": one.group,
                 "index": one.attributes.get("index")}
        if one.type.name == "mask":
            rows, columns = one.image.nonzero()
            entry["pixels"] = [rows.tolist(), columns.tolist()]
        else:
            entry["numbers"] = list(map(float, one.get_bbox() if one.type.name == "bbox" else one.points))
        found.append(entry)
    told[item.id] = {"shape": list(item.media.data.shape), "found": found}
print(json.dumps(told))
"""

READ_BY_LABEL_STUDIO = """
import json, os, sys
from label_studio_sdk.converter import Converter
from label_studio_sdk.label_interface import LabelInterface
folder = sys.argv[1]
config = open(os.path.join(folder, "label_config.xml")).read()
tasks = json.load(open(os.path.join(folder, "tasks.json")))
interface = LabelInterface(config)
faults = []
for task in tasks:
    interface.validate_task({"id": task["id"], "data": task["data"]})
    faults += [task["id"] for annotation in task["annotations"] if not interface.validate_annotation(annotation)]
for task in tasks:
    task["data"]["image"] = os.path.join(folder, task["data"]["image"].partition("?d=")[2])
json.dump(tasks, open("tasks.json", "w"))
Converter(config, folder, download_resources=False).convert_to_coco("tasks.json", "coco", is_dir=False)
print(json.dumps({"faults": faults, "coco": json.load(open("coco/result.json"))}))
"""

READ_BY_FIFTYONE = """
import json, os, sys
try:
    import mongomock
except ModuleNotFoundError:
    mongomock = None
if mongomock is not None:
    # FiftyOne's database in memory.
    import mongoengine, pymongo
    os.environ["FIFTYONE_DATABASE_URI"] = "mongodb://localhost:27017"
    about = {"version": "7.0.2", "versionArray": [7, 0, 2, 0], "ok": 1.0}
    mongomock.MongoClient.server_info = lambda self, *a, **k: about
    client, connect = mongomock.MongoClient("mongodb://localhost:27017"), mongoengine.connect
    client.__dict__["_closed"] = False
    pymongo.MongoClient = lambda *a, **k: client
    mongoengine.connect = lambda name, **k: connect(
        name, mongo_client_class=lambda *a, **k: client, host="mongodb://localhost:27017")
os.environ["FIFTYONE_DO_NOT_TRACK"] = "true"
import fiftyone
read = fiftyone.Dataset.from_dir(sys.argv[1], dataset_type=fiftyone.types.FiftyOneDataset)
told = {"media_type": read.media_type, "slices": read.group_media_types, "samples": []}
for name in read.group_slices:
    read.group_slice = name
    for sample in read:
        objects = sample["objects"].detections if sample["objects"] else []
        keypoints = sample["keypoints"].keypoints if sample["keypoints"] else []
        told["samples"].append({
            "group": str(sample["group"].id), "slice": name, "file": sample.filepath, "tags": sample.tags,
            "is_file": os.path.isfile(sample.filepath), "frame_index": sample["frame_index"],
            "objects": [{"label": one.label, "box": one.bounding_box, "index": one["marker_index"],
                         "mask": one.mask.astype(int).tolist()} for one in objects],
            "keypoints": [{"points": one.points, "index": one["marker_index"], "flag": one["flag"]}
                          for one in keypoints],
        })
print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def exports(mixed_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("tools")
    for name in NAMES:
        assert write_export(name, mixed_dataset, folder / name, ExportLog()) == [folder / name]
    return {name: folder / name for name in NAMES}


Masks = dict[tuple[str, int | None], NDArray[np.bool_]]


def views(dataset: Path) -> Iterator[tuple[PairRecord, Eye, ViewRecord, Masks]]:
    """All views with the masks of what they show, from the part ids."""
    source = Dataset(dataset)
    for index in source.frame_indices:
        record = source.record(index)
        for eye in EYES:
            view, part_id = view_of(record, eye), source.part_ids(index, eye)
            masks: Masks = {}
            if view.box_visible_xywh_px is not None:
                masks["drogue", None] = drogue_mask(part_id, len(view.markers))
                masks["hub", None] = part_id == Part.HUB
                masks |= {("marker", i): part_id == FIRST_MARKER_ID + i for i in range(len(view.markers))}
            yield record, eye, view, {key: mask for key, mask in masks.items() if mask.any()}


def box_of(mask: NDArray[np.bool_]) -> list[float]:
    """x, y, width, height from the image's corner."""
    rows, columns = np.nonzero(mask)
    return [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]


def file_of(dataset: Path, record: PairRecord, eye: Eye) -> str:
    split = Dataset(dataset).manifest.split_of_frame()[record.frame_index]
    return f"{split}/{record.frame_index:06d}_{eye}"


def centers_of(view: ViewRecord) -> NDArray[np.float64]:
    return np.array([marker.center_proj_px for marker in view.markers]) + 0.5


def test_datumaro_reads_every_shape_of_cvat(exports: dict[str, Path], mixed_dataset: Path, tmp_path: Path) -> None:
    told = read_by("datumaro", READ_CVAT_BY_DATUMARO, exports["cvat"], folder=tmp_path)
    assert len(told) == 18
    for record, eye, view, masks in views(mixed_dataset):
        item = told[file_of(mixed_dataset, record, eye)]
        assert item["shape"] == [SIZE_PX[1], SIZE_PX[0], 3]
        found = {(one["type"], one["label"], one["index"]): one for one in item["found"]}
        # A box of the drogue, a mask of everything, and the centres of hub and markers.
        assert len(found) == len(item["found"]) == (2 * len(masks) if masks else 0)
        assert len({one["group"] for one in item["found"]}) == len(masks)
        for (label, index), mask in masks.items():
            rows, columns = found["mask", label, index]["pixels"]
            np.testing.assert_array_equal(np.argwhere(mask), np.stack([rows, columns], axis=1))
            if label == "drogue":
                np.testing.assert_allclose(found["bbox", label, None]["numbers"], box_of(mask))
            if label == "marker":
                center = found["points", label, index]["numbers"]
                # datumaro rounds points to hundredths of a pixel.
                np.testing.assert_allclose(center, centers_of(view)[index], atol=0.0051)


def test_label_studio_takes_every_task_and_converts_it(
    exports: dict[str, Path], mixed_dataset: Path, tmp_path: Path
) -> None:
    told = read_by("label_studio", READ_BY_LABEL_STUDIO, exports["label-studio"], folder=tmp_path)
    assert told["faults"] == []
    coco = told["coco"]
    names = {category["id"]: category["name"] for category in coco["categories"]}
    images = {Path(image["file_name"]).name: image["id"] for image in coco["images"]}
    for record, eye, _, masks in views(mixed_dataset):
        image = images[f"{record.frame_index:06d}_{eye}.png"]
        found = [one for one in coco["annotations"] if one["image_id"] == image]
        drogues = [one for one in found if names[one["category_id"]] == "drogue"]
        boxes = [one["bbox"] for one in drogues if not one["segmentation"]]
        want = [box_of(mask) for (label, _), mask in masks.items() if label == "drogue"]
        np.testing.assert_allclose(np.reshape(boxes, (-1, 4)), np.reshape(want, (-1, 4)), atol=1e-9)
        for label in {label for label, _ in masks}:
            pieces = [mask for (other, _), mask in masks.items() if other == label]
            # Which pixels' centres lie within the polygons.
            got = np.zeros(pieces[0].shape, dtype=bool)
            for one in found:
                if one.get("segmentation") and names[one["category_id"]] == label:
                    outline = shapely.Polygon(np.reshape(one["segmentation"][0], (-1, 2)))
                    got |= shapely.contains_xy(outline, *(np.indices(got.shape)[::-1] + 0.5))
            # Outlines are thinned out by at most half a pixel, which moves them over no pixel's centre.
            np.testing.assert_array_equal(got, np.any([filled_holes(mask) for mask in pieces], axis=0))


def filled_holes(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Each piece of a mask without its holes; pieces that touch at a corner are two."""
    pieces, count = ndimage.label(mask)
    filled = [ndimage.binary_fill_holes(pieces == number) for number in range(1, count + 1)]
    return np.any(filled, axis=0)


def test_label_studio_keypoints_are_per_cents_of_the_image(exports: dict[str, Path], mixed_dataset: Path) -> None:
    tasks = json.loads((exports["label-studio"] / "tasks.json").read_text())
    assert [task["id"] for task in tasks] == list(range(1, 19))
    by_view: dict[tuple[int, str], dict[str, Any]] = {
        (task["data"]["frame_index"], task["data"]["view"]): task for task in tasks
    }
    for record, eye, view, masks in views(mixed_dataset):
        task = by_view[record.frame_index, eye]
        assert (exports["label-studio"] / task["data"]["image"].partition("?d=")[2]).is_file()
        results = task["annotations"][0]["result"]
        assert len({result["id"] for result in results}) == len(results)
        got = {
            result["value"]["keypointlabels"][0]: [result["value"]["x"], result["value"]["y"]]
            for result in results
            if result["type"] == "keypointlabels"
        }
        centers = centers_of(view) if masks else np.zeros((0, 2))
        shown = {
            f"marker_{index}": (100 * center / SIZE_PX).tolist()
            for index, center in enumerate(centers)
            if (center >= 0).all() and (center <= SIZE_PX).all()
        }
        assert got.keys() == shown.keys()
        for name, place in shown.items():
            np.testing.assert_allclose(got[name], place, atol=1e-12)


def test_fiftyone_reads_stereo_groups_with_boxes_masks_and_keypoints(
    exports: dict[str, Path], mixed_dataset: Path, tmp_path: Path
) -> None:
    told = read_by("fiftyone", READ_BY_FIFTYONE, exports["fiftyone"], folder=tmp_path)
    assert told["media_type"] == "group" and told["slices"] == {"left": "image", "right": "image"}
    samples = {(sample["frame_index"], sample["slice"]): sample for sample in told["samples"]}
    assert len(samples) == len(told["samples"]) == 18
    assert len({sample["group"] for sample in told["samples"]}) == 9
    for record, eye, view, masks in views(mixed_dataset):
        sample = samples[record.frame_index, eye]
        assert sample["is_file"] and sample["file"].endswith(file_of(mixed_dataset, record, eye) + ".png")
        assert sample["group"] == samples[record.frame_index, "left"]["group"]
        found = {(one["label"], one["index"]): one for one in sample["objects"]}
        assert found.keys() == masks.keys() and len(sample["objects"]) == len(masks)
        for key, mask in masks.items():
            x, y, width, height = (round(number) for number in box_of(mask))
            np.testing.assert_allclose(np.reshape(found[key]["box"], (2, 2)) * SIZE_PX, [[x, y], [width, height]])
            np.testing.assert_array_equal(found[key]["mask"], mask[y : y + height, x : x + width])
        assert len(sample["keypoints"]) == (1 if masks else 0)
        for one in sample["keypoints"]:
            np.testing.assert_allclose(
                np.reshape(one["points"], (-1, 2)) * SIZE_PX, centers_of(view)[one["index"]].reshape(-1, 2), atol=1e-9
            )
            assert len(one["flag"]) == len(one["index"]) and set(one["flag"]) <= {1, 2}


@pytest.mark.parametrize("name", NAMES)
def test_images_are_copies_of_eight_bits(name: str, dataset_by_preset: Any, tmp_path: Path) -> None:
    dataset = dataset_by_preset("mono", {"output_bits": 12})
    log = ExportLog()
    write_export(name, dataset, tmp_path / "out", log)
    assert log.losses["images of 12 bits: written with 8, on the sRGB curve"] == 6
    source = Dataset(dataset)
    for index in source.frame_indices:
        for eye in EYES:
            (copy,) = (tmp_path / "out").rglob(f"{index:06d}_{eye}.png")
            stored = getattr(source.images(index), eye)
            np.testing.assert_array_equal(cv2.imread(str(copy), cv2.IMREAD_UNCHANGED), shown(stored, source, index))


@pytest.mark.parametrize("name", NAMES)
def test_without_part_ids_there_are_boxes_alone(name: str, small_dataset: Path, tmp_path: Path) -> None:
    for path in small_dataset.glob("frames/*/record.json"):
        table = json.loads(path.read_text())
        for eye in EYES:
            del table["file_sha256"][f"{eye}_parts.png"]
        path.write_text(json.dumps(table))
    source, log = Dataset(small_dataset), ExportLog()
    records = [source.record(index) for index in source.frame_indices]
    seen = sum(view_of(record, eye).box_visible_xywh_px is not None for record in records for eye in EYES)
    assert seen > 0
    write_export(name, small_dataset, tmp_path / "out", log)
    assert log.losses["views without masks, markers and hub: the dataset has no part ids of them"] == seen
    text = "".join(path.read_text() for path in (tmp_path / "out").iterdir() if path.suffix in (".xml", ".json"))
    shape = {"cvat": "<box", "label-studio": '"type":"rectanglelabels"', "fiftyone": '"_cls":"Detection"'}[name]
    mask = {"cvat": "<mask", "label-studio": '"type":"polygonlabels"', "fiftyone": "$binary"}[name]
    assert text.count(shape) == seen and mask not in text
