"""Exports for ultralytics, read by hand and by ultralytics itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.records import PairRecord
from drogue_models.parameters import even_ring
from drogue_models.parts import FIRST_MARKER_ID, Part
from drogue_models.presets import PRESETS, load_drogue
from geometry.stereo import EYES
from labelgen.export.annotations.yolo import flip_indices
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export
from labelgen.export.keypoints import view_of
from tests.support.display_encoding import shown
from tests.support.other_python import read_by

NAMES = ("yolo", "yolo-image-order", "yolo-detect")

# Runs in the other environment, which has nothing of ours.
READ_BY_ULTRALYTICS = """
import json, sys
from ultralytics.data.dataset import YOLODataset
from ultralytics.data.utils import check_det_dataset, img2label_paths
from ultralytics.data.dataset import get_hash, load_dataset_cache_file
from pathlib import Path
data = check_det_dataset(sys.argv[1], autodownload=False)
task = "pose" if "kpt_shape" in data else "detect"
told = {}
for split in ("train", "val", "test"):
    if not data.get(split):
        continue
    read = YOLODataset(img_path=data[split], data=data, task=task, augment=False, imgsz=160)
    cache = load_dataset_cache_file(Path(read.label_files[0]).parent.with_suffix(".cache"))
    found, missing, empty, corrupt = cache["results"][:4]
    told[split] = {
        "missing": missing, "found": found, "empty": empty, "corrupt": corrupt,
        "boxes": {Path(l["im_file"]).name: l["bboxes"].tolist() for l in read.labels},
        "keypoints": {Path(l["im_file"]).name: l["keypoints"].tolist() for l in read.labels if task == "pose"},
        "shape": list(read[0]["img"].shape),
    }
print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def exports(mixed_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("yolo")
    for name in NAMES:
        write_export(name, mixed_dataset, folder / name, ExportLog())
    return {name: folder / name for name in NAMES}


def label_rows(folder: Path, record: PairRecord, eye: str) -> np.ndarray:
    """Numbers of one label file, whatever its split."""
    (path,) = folder.glob(f"labels/*/{record.frame_index:06d}_{eye}.txt")
    rows = [list(map(float, line.split())) for line in path.read_text().splitlines()]
    return np.array(rows) if rows else np.zeros((0, 5))


def views(dataset: Path) -> Iterator[Any]:
    source = Dataset(dataset)
    for index in source.frame_indices:
        record = source.record(index)
        for eye in EYES:
            yield record, eye, view_of(record, eye), source.part_ids(index, eye)


def in_pixels(shares: np.ndarray) -> np.ndarray:
    """Corner-based pixels of the small rig."""
    return shares * [160, 120]


@pytest.mark.parametrize("name", NAMES)
def test_images_and_labels_go_together(name: str, exports: dict[str, Path], mixed_dataset: Path) -> None:
    splits = Dataset(mixed_dataset).manifest.split_of_frame()
    for record, eye, _, _ in views(mixed_dataset):
        place = f"{splits[record.frame_index]}/{record.frame_index:06d}_{eye}"
        image = exports[name] / "images" / f"{place}.png"
        stored = cv2.imread(str(mixed_dataset / f"frames/{record.frame_index:06d}/{eye}.png"))
        np.testing.assert_array_equal(cv2.imread(str(image)), shown(stored, Dataset(mixed_dataset), record.frame_index))
        assert (exports[name] / "labels" / f"{place}.txt").is_file()
    assert len(list(exports[name].rglob("*.txt"))) == len(list(exports[name].rglob("*.png"))) == 18


def test_poses_are_the_records_in_the_drogues_order(exports: dict[str, Path], mixed_dataset: Path) -> None:
    for record, eye, view, _ in views(mixed_dataset):
        rows = label_rows(exports["yolo"], record, eye)
        if view.box_visible_xywh_px is None:
            assert rows.size == 0
            continue
        (row,) = rows
        x, y, width, height = np.array(view.box_visible_xywh_px)
        # Shares of the image are rounded in the last bit.
        np.testing.assert_allclose(in_pixels(row[1:3]), [x + 0.5 + width / 2, y + 0.5 + height / 2], atol=1e-9)
        np.testing.assert_allclose(in_pixels(row[3:5]), [width, height], atol=1e-9)
        points = row[5:].reshape(8, 3)
        shown = points[:, 2] > 0
        assert not points[~shown].any() and not shown[len(view.markers) :].any()
        centers = np.array([marker.center_proj_px for marker in view.markers])
        inside = ((centers > -0.5) & (centers < [159.5, 119.5])).all(axis=1)
        assert shown[: len(centers)].tolist() == inside.tolist()
        np.testing.assert_allclose(in_pixels(points[shown, :2]), centers[inside] + 0.5, atol=1e-9)


def test_the_image_order_survives_a_mirror(exports: dict[str, Path], mixed_dataset: Path) -> None:
    flip = yaml.safe_load((exports["yolo-image-order"] / "data.yaml").read_text())["flip_idx"]
    assert flip == [0, 7, 6, 5, 4, 3, 2, 1]
    seen = 0
    for record, eye, view, _ in views(mixed_dataset):
        rows = label_rows(exports["yolo-image-order"], record, eye)
        if len(view.markers) != 8 or rows.size == 0 or not (rows[0, 7::3] > 0).all():
            continue
        places = in_pixels(rows[0, 5:].reshape(8, 3)[:, :2])
        mirrored = (places * [-1, 1] + [160, 0])[flip]
        for ring in (places, mirrored):
            around = ring - ring.mean(axis=0)
            turn = np.unwrap(np.arctan2(around[:, 0], -around[:, 1]))
            # It begins within half a step of the top and goes clockwise, once around.
            assert abs(turn[0]) <= np.pi / 8 + 0.1 and (np.diff(turn) > 0).all()
        seen += 1
    assert seen


def test_boxes_of_all_classes_are_the_part_ids(exports: dict[str, Path], mixed_dataset: Path) -> None:
    for record, eye, view, part_id in views(mixed_dataset):
        rows = label_rows(exports["yolo-detect"], record, eye)
        wanted = [] if view.box_visible_xywh_px is None else [(0, view.box_visible_xywh_px)]
        for part in (int(Part.HUB), *range(FIRST_MARKER_ID, FIRST_MARKER_ID + 32)):
            ys, xs = np.nonzero(part_id == part)
            if xs.size:
                box = (xs.min() - 0.5, ys.min() - 0.5, np.ptp(xs) + 1, np.ptp(ys) + 1)
                wanted.append((2 if part == Part.HUB else 1, box))
        assert rows.shape[0] == len(wanted)
        for row, (number, box) in zip(rows, wanted, strict=True):
            assert row[0] == number
            middle = np.array(box[:2]) + 0.5 + np.array(box[2:]) / 2
            np.testing.assert_allclose(in_pixels(row[1:].reshape(2, 2)), [middle, box[2:]], atol=1e-9)


EIGHT = even_ring(8, 0.27)


@pytest.mark.parametrize(
    "positions_m",
    [
        EIGHT,
        EIGHT[::-1],
        tuple(EIGHT[index] for index in (0, 4, 1, 5, 2, 6, 3, 7)),
        even_ring(7, 0.27)[1:],
        tuple((round(x, 3), round(y, 3)) for x, y in even_ring(7, 0.27)),
        load_drogue("basket-strut-markers").marker_positions_m,
    ],
    ids=["clockwise", "anticlockwise", "across", "gap", "rounded", "two-rings"],
)
def test_a_mirrored_drogue_with_flipped_keypoints_is_a_drogue_after_a_turn(positions_m: tuple) -> None:
    drogue = load_drogue("basket-strut-markers" if len(positions_m) == 12 else "red-8")
    drogue = drogue.model_copy(update={"marker_positions_m": positions_m})
    flip = flip_indices(drogue, 14, in_image_order=False)
    assert flip is not None and flip[len(positions_m) :] == list(range(len(positions_m), 14))
    places = np.array(positions_m)
    mirrored = (places * [-1, 1])[flip[: len(places)]]
    turn, misfit_m = Rotation.align_vectors(
        np.column_stack([mirrored, np.zeros(len(places))]), np.column_stack([places, np.zeros(len(places))])
    )
    # Root of the sum of squares; rounding to millimetres moves each of seven by up to 0.7 mm.
    assert misfit_m < 4e-3 and turn.as_matrix()[2, 2] == pytest.approx(1)


def test_markers_without_a_mirror_axis_have_no_flip() -> None:
    free = ((0.27, 0.0), (-0.25, 0.05), (0.0, 0.27), (0.1, -0.24))
    drogue = PRESETS["red-8"].model_copy(update={"marker_positions_m": free})
    assert flip_indices(drogue, 8, in_image_order=False) is None
    assert flip_indices(drogue, 8, in_image_order=True) == [0, 3, 2, 1, 4, 5, 6, 7]
    assert flip_indices(PRESETS["red-7"], 8, in_image_order=False) == [0, 6, 5, 4, 3, 2, 1, 7]


def test_several_drogues_have_no_common_flip(mixed_dataset: Path, small_dataset: Path, tmp_path: Path) -> None:
    told = "values of flip_idx that do not fit all drogues: train with fliplr=0"
    for dataset, count in ((mixed_dataset, 1), (small_dataset, 0)):
        log = ExportLog()
        write_export("yolo", dataset, tmp_path / str(count), log)
        assert log.losses.get(told, 0) == count


def test_a_missing_split_is_replaced_and_told(dataset_by_preset: Callable[..., Any], tmp_path: Path) -> None:
    dataset = dataset_by_preset("rgb-ideal")
    splits = set(Dataset(dataset).manifest.split_of_frame().values())
    log = ExportLog()
    write_export("yolo", dataset, tmp_path / "out", log)
    table = yaml.safe_load((tmp_path / "out" / "data.yaml").read_text())
    for split in ("train", "val"):
        assert (tmp_path / "out" / table[split]).is_dir()
    lacking = [split for split in ("train", "val") if split not in splits]
    assert [name for name in log.losses if name.startswith("splits without pairs")] == [
        f"splits without pairs: data.yaml names {table[split]} for {split}" for split in lacking
    ]


def test_twelve_bits_become_eight_and_are_told(dataset_by_preset: Callable[..., Any], tmp_path: Path) -> None:
    dataset = dataset_by_preset("mono", {"output_bits": 12})
    log = ExportLog()
    write_export("yolo", dataset, tmp_path / "out", log)
    assert log.losses["images of 12 bits: written with 8, on the sRGB curve"] == 6
    for path in (tmp_path / "out").rglob("*.png"):
        index, eye = path.stem.split("_")
        whole = cv2.imread(str(dataset / "frames" / index / f"{eye}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(
            cv2.imread(str(path), cv2.IMREAD_UNCHANGED), shown(whole, Dataset(dataset), int(index))
        )


@pytest.mark.parametrize("name", NAMES)
def test_ultralytics_reads_it_without_a_corrupt_file(
    name: str, exports: dict[str, Path], mixed_dataset: Path, tmp_path: Path
) -> None:
    told = read_by("ultralytics", READ_BY_ULTRALYTICS, exports[name] / "data.yaml", folder=tmp_path)
    empty = sum(view.box_visible_xywh_px is None for _, _, view, _ in views(mixed_dataset))
    assert sum(split["corrupt"] + split["missing"] for split in told.values()) == 0
    assert sum(split["found"] for split in told.values()) == 18
    assert sum(split["empty"] for split in told.values()) == empty
    boxes = {key: value for split in told.values() for key, value in split["boxes"].items()}
    keypoints = {key: value for split in told.values() for key, value in split["keypoints"].items()}
    for record, eye, _, _ in views(mixed_dataset):
        rows, key = label_rows(exports[name], record, eye), f"{record.frame_index:06d}_{eye}.png"
        assert len(boxes[key]) == len(rows)
        if len(rows):
            # ultralytics reads single precision; its rows come in an order of their own.
            np.testing.assert_allclose(np.sort(boxes[key], axis=0), np.sort(rows[:, 1:5], axis=0), atol=1e-6)
        if len(rows) and name != "yolo-detect":
            np.testing.assert_allclose(np.ravel(keypoints[key]), rows[0, 5:], atol=1e-6)
