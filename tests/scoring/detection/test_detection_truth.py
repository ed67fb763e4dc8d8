"""The ground truth of detection, and the files in which boxes are exchanged."""

from __future__ import annotations

import contextlib
import io
import json
import uuid
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pycocotools.coco import COCO

from datasets_manifest.storage.storage import open_storage
from datasets_manifest.types.records import NeighbourView, PairRecord, ViewRecord
from droguekit.scoring.detection.detection_truth import image_truth, read_detection_truth
from droguekit.scoring.poses.drogue_truth import LEAST_SEEN_FRACTION, seen_fraction
from droguekit.scoring.results.detection_result import (
    DetectedBox,
    center_box,
    clipped_box,
    corner_box,
    read_detections,
    write_detections,
)

SIZE_PX = (1280, 960)


def changed(view: ViewRecord, visible_share: float = 1.0, marker_fractions: float = 1.0) -> ViewRecord:
    """The view with its visible box cut to a share of the full one's width, and its markers covered."""
    assert view.box_full_xywh_px is not None
    x, y, width, height = view.box_full_xywh_px
    markers = tuple(marker.model_copy(update={"visible_fraction": marker_fractions}) for marker in view.markers)
    return view.model_copy(update={"box_visible_xywh_px": (x, y, visible_share * width, height), "markers": markers})


def memory_copy(folder: Path) -> str:
    """The dataset at a URL of this process."""
    location = f"memory://{uuid.uuid4().hex}"
    for file in folder.rglob("*"):
        if file.is_file():
            open_storage(location).write(file.relative_to(folder).as_posix(), file.read_bytes())
    return location


def with_left(record: PairRecord, view: ViewRecord) -> PairRecord:
    return record.model_copy(update={"views": record.views.model_copy(update={"left": view})})


def test_the_box_to_be_found_is_the_visible_one_counted_from_the_corner(build: SimpleNamespace) -> None:
    record = build.record(3, build.pose(0.1, 0.0, 10.0))
    view = changed(record.views.left, 0.8)
    truth = image_truth(with_left(record, view), "left", "test", SIZE_PX)
    x, y, width, height = view.box_visible_xywh_px or (0, 0, 0, 0)
    assert truth.box_xywh == (x + 0.5, y + 0.5, width, height)
    assert (truth.image_id, truth.distance_m, truth.family, truth.is_known_empty) == (7, 10.0, "clear", False)


@pytest.mark.parametrize(
    ("visible_share", "markers", "counts"),
    [(1.0, 1.0, True), (0.51, 1.0, True), (0.49, 1.0, False), (1.0, 0.51, True), (1.0, 0.49, False)],
)
def test_a_drogue_that_is_mostly_cut_off_or_hidden_is_ignored(
    build: SimpleNamespace, visible_share: float, markers: float, counts: bool
) -> None:
    record = build.record(0, build.pose(0.1, 0.0, 10.0))
    view = changed(record.views.left, visible_share, markers)
    truth = image_truth(with_left(record, view), "left", "test", SIZE_PX)
    assert (truth.box_xywh is not None, truth.ignored_xywh is None) == (counts, counts)
    share = seen_fraction(with_left(record, view), "left")
    assert share == pytest.approx(min(visible_share, markers))
    assert (share >= LEAST_SEEN_FRACTION) is counts


@pytest.mark.parametrize("tilt_deg", [0.0, 15.0])
def test_markers_too_small_for_any_pixel_hide_nothing(build: SimpleNamespace, tilt_deg: float) -> None:
    """A drogue in plain sight whose markers are a hundredth of a pixel, and one whose real markers something covers."""
    pose = build.pose(0.1013, 0.0, 20.0, tilt_deg)
    tiny = build.drogue().model_copy(update={"marker_radius_m": 1e-4})
    for drogue, expected in ((tiny, 0.8), (build.drogue(), 0.0)):
        record = build.record(0, pose, drogue)
        record = with_left(record, changed(record.views.left, 0.8, 0.0))
        assert seen_fraction(record, "left") == pytest.approx(expected)
        found = image_truth(record, "left", "test", SIZE_PX)
        assert (found.box_xywh is not None) is (expected > 0)
    # Markers beyond the edge tell that the drogue is cut off, whatever their size.
    record = build.record(0, pose, tiny)
    view = changed(record.views.left, 0.8, 0.0)
    outside = tuple(marker.model_copy(update={"in_image": False}) for marker in view.markers)
    assert seen_fraction(with_left(record, view.model_copy(update={"markers": outside})), "left") == 0


def test_an_ignored_drogue_is_known_by_its_full_box_inside_the_image(build: SimpleNamespace) -> None:
    record = build.record(0, build.pose(0.1, 0.0, 10.0))
    hidden = record.views.left.model_copy(update={"box_visible_xywh_px": None, "box_full_xywh_px": (-50, 900, 80, 90)})
    truth = image_truth(with_left(record, hidden), "left", "test", SIZE_PX)
    assert (truth.box_xywh, truth.ignored_xywh) == (None, (0.0, 900.5, 30.5, 59.5))


@pytest.mark.parametrize(("side_px", "counts"), [(24.1, True), (23.9, False)])
def test_a_drogue_beside_the_sought_one_counts_from_a_fortieth_of_the_height(
    build: SimpleNamespace, side_px: float, counts: bool
) -> None:
    record = build.record(0, build.pose(0.1, 0.0, 10.0))
    box = (100.0, 100.0, 0.8 * side_px, side_px)
    other = NeighbourView(box_full_xywh_px=box, box_visible_xywh_px=box, visible_drogue_px=300, truncated=False)
    view = record.views.left.model_copy(update={"neighbours": (other,)})
    truth = image_truth(with_left(record, view), "left", "test", SIZE_PX)
    assert (len(truth.others_xywh), len(truth.ignored_others_xywh)) == (counts, not counts)


def test_a_pair_without_a_drogue_has_nothing_to_be_found(build: SimpleNamespace) -> None:
    truth = image_truth(build.record(0, None), "right", "val", SIZE_PX)
    assert (truth.box_xywh, truth.ignored_xywh, truth.is_known_empty) == (None, None, True)


def test_a_dataset_is_read_pair_by_pair(dataset: tuple[Path, list[PairRecord]]) -> None:
    folder, records = dataset
    truth = read_detection_truth(folder)
    assert [image.image_id for image in truth.images] == list(range(1, 2 * len(records) + 1))
    assert sum(image.box_xywh is not None for image in truth.images) == 18
    location = memory_copy(folder)
    assert read_detection_truth(location) == truth


def test_corners_and_centres_are_half_a_pixel_apart_and_come_back() -> None:
    # A box over the whole image.
    assert corner_box((-0.5, -0.5, 1280, 960)) == (0, 0, 1280, 960)
    assert center_box(corner_box((3.25, 4.5, 10, 20))) == (3.25, 4.5, 10, 20)


def test_clipping_keeps_the_part_on_the_image(rng: np.random.Generator) -> None:
    for _ in range(200):
        box = tuple(rng.uniform([-400, -400, 1, 1], [1500, 1200, 700, 700]).tolist())
        clipped = clipped_box(box, SIZE_PX)
        # Pixel by pixel: which unit squares of the image does the box touch?
        columns = [
            max(0.0, min(box[0] + box[2], 1280.0) - max(box[0], 0.0)),
            max(0.0, min(box[1] + box[3], 960.0) - max(box[1], 0.0)),
        ]
        # Less than a thousandth of a pixel would be written as nothing.
        if min(columns) < 1e-3:
            assert clipped is None
        else:
            assert clipped is not None
            assert clipped[2:] == pytest.approx(columns)
            assert 0 <= clipped[0] <= 1280 and 0 <= clipped[1] <= 960


def test_files_of_boxes_are_read_by_pycocotools_and_come_back(tmp_path: Path) -> None:
    boxes = [DetectedBox(2, (1.5, 2.25, 30.125, 40.0), 0.75), DetectedBox(1, (0.0, 0.0, 1280.0, 960.0), 0.001)]
    path = tmp_path / "new" / "boxes.json"
    assert write_detections(path, boxes) == 2
    assert read_detections(path, {1, 2}) == boxes
    (tmp_path / "truth.json").write_text(
        json.dumps({"images": [{"id": 1}, {"id": 2}], "categories": [{"id": 1}], "annotations": []})
    )
    with contextlib.redirect_stdout(io.StringIO()):
        loaded = COCO(str(tmp_path / "truth.json")).loadRes(str(path))
    assert [entry["bbox"] for entry in loaded.dataset["annotations"]] == [list(box.box_xywh) for box in boxes]


@pytest.mark.parametrize("sliver", [1e-9, 4e-4, 6e-4, 1e-3, 0.0015])
def test_what_is_left_of_a_box_after_clipping_can_be_read_again(tmp_path: Path, sliver: float) -> None:
    boxes = [clipped_box((x, 10.0, 50.0, 40.0), SIZE_PX) for x in (sliver - 50.0, 1280.0 - sliver)]
    kept = [DetectedBox(1, box, 0.5) for box in boxes if box is not None]
    write_detections(tmp_path / "boxes.json", kept)
    assert len(read_detections(tmp_path / "boxes.json", {1})) == len(kept)
    assert not (kept and sliver < 9e-4)


def test_no_boxes_at_all_are_a_file_too(tmp_path: Path) -> None:
    path = tmp_path / "boxes.json"
    assert write_detections(path, []) == 0
    assert read_detections(path, {1}) == []


GOOD = {"image_id": 1, "category_id": 1, "bbox": [1, 2, 3, 4], "score": 0.5}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[{", "truncated or not JSON"),
        ('{"annotations": []}', "must hold a list"),
        ("[" * 100_000, "truncated or not JSON"),
        (json.dumps([GOOD, "box"]), "result 1: must be an object, got str"),
        (json.dumps([{"image_id": 1}]), "result 0: has no 'category_id'"),
        (
            json.dumps([GOOD | {"image_id": 9}]),
            "image_id: must be an image of the dataset's annotations/all.json, got 9",
        ),
        (json.dumps([GOOD | {"image_id": True}]), "image_id: must be"),
        (json.dumps([GOOD | {"category_id": 2}]), "category_id: must be 1"),
        (json.dumps([GOOD | {"bbox": [1, 2, 3]}]), "must be four finite numbers and one"),
        (json.dumps([GOOD | {"bbox": [1, 2, 3, float("nan")]}]), "must be four finite numbers and one"),
        (json.dumps([GOOD | {"bbox": [1, 2, -3, 4]}]), "must be x, y, width, height"),
        (json.dumps([GOOD | {"bbox": [1e300, 2, 3, 4]}]), "must be x, y, width, height"),
        (json.dumps([GOOD | {"bbox": None}]), "result 0"),
        (json.dumps([GOOD]).replace("4]", "4" * 400 + "]"), "a number of 400 digits"),
        (json.dumps([GOOD | {"score": "high"}]), "must be four finite numbers and one"),
    ],
)
def test_other_files_are_refused_in_one_line_that_names_them(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "boxes.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"boxes\.json") as caught:
        read_detections(path, {1, 2})
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none\.json: cannot be read"):
        read_detections(tmp_path / "none.json", {1})
