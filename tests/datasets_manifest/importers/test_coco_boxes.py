"""Boxes find their view, however the images are laid out and whichever tool wrote the file."""

from __future__ import annotations

import json
import unicodedata
from pathlib import Path
from typing import Any

import pytest

from datasets_manifest.importers.coco_boxes import read_boxes

VIEW = (100, 80)


def boxes(folder: Path, *entries: tuple[str, list[float]], **changes: Any) -> Path:
    """A COCO file with one box per image; `changes` replace its lists."""
    images = [{"id": k, "file_name": name} for k, (name, _) in enumerate(entries, start=1)]
    annotations = [
        {"id": 10 + k, "image_id": k, "category_id": 1, "bbox": bbox} for k, (_, bbox) in enumerate(entries, start=1)
    ]
    path = folder / "boxes.json"
    path.write_text(json.dumps({"images": images, "annotations": annotations, **changes}))
    return path


@pytest.mark.parametrize("names", [("left/1.png", "right/1.png"), ("left_1.png", "right_1.png")])
@pytest.mark.parametrize("before", ["", "flight/", "./", "C:\\\\flight\\", "/data/local-files/?d=flight%207/"])
def test_each_view_gets_its_own(names: tuple[str, str], before: str, tmp_path: Path) -> None:
    separator = "\\" if "\\" in before else "/"
    left, right = (before + name.replace("/", separator) for name in names)
    both = read_boxes(boxes(tmp_path, (left, [10, 20, 5, 6]), (right, [30, 20, 5, 6])))
    # COCO counts from the corner of the image, half a pixel before the first pixel's centre.
    assert both.of_views([names], VIEW) == {(0, 0): (9.5, 19.5, 5, 6), (0, 1): (29.5, 19.5, 5, 6)}
    only = read_boxes(boxes(tmp_path, (right, [30, 20, 5, 6])))
    assert only.of_views([("left/0.png", "right/0.png"), names], VIEW) == {(1, 1): (29.5, 19.5, 5, 6)}


def test_the_prefix_of_uploads_is_taken_off(tmp_path: Path) -> None:
    path = boxes(
        tmp_path, ("images\\3f2a9c01-left_1.png", [1, 2, 3, 4]), ("images/0b44de77-right__1b.png", [5, 6, 7, 8])
    )
    views = [("left_1.png", "right_ 1(b).png"), ("left_11.png", "right_11.png")]
    assert read_boxes(path).of_views(views, VIEW) == {(0, 0): (0.5, 1.5, 3, 4), (0, 1): (4.5, 5.5, 7, 8)}


@pytest.mark.parametrize("name", ["1.png", "3f2a9c01-1.png"])
def test_a_name_that_fits_two_views_is_refused(name: str, tmp_path: Path) -> None:
    drawn = read_boxes(boxes(tmp_path, (name, [1, 2, 3, 4])))
    with pytest.raises(
        ValueError, match=r"boxes\.json: .*1\.png may be left/1\.png or right/1\.png; give each file_name"
    ):
        drawn.of_views([("left/1.png", "right/1.png")], VIEW)


@pytest.mark.parametrize(("in_file", "on_disk"), [("NFC", "NFD"), ("NFD", "NFC")])
@pytest.mark.parametrize("before", ["", "3f2a9c01-"])
def test_names_in_another_form_of_unicode_are_found(in_file: Any, on_disk: Any, before: str, tmp_path: Path) -> None:
    drawn = read_boxes(boxes(tmp_path, (unicodedata.normalize(in_file, f"{before}été_1.png"), [1, 2, 3, 4])))
    names = [unicodedata.normalize(on_disk, name) for name in ("été_0.png", "été_1.png")]
    assert drawn.of_images(names, [VIEW, VIEW]) == {1: ((0.5, 1.5, 3, 4),)}


def test_a_whole_name_is_no_part_of_another(tmp_path: Path) -> None:
    path = boxes(tmp_path, ("1.png", [1, 2, 3, 4]), ("left/1.png", [5, 6, 7, 8]))
    found = read_boxes(path).of_images(["1.png", "left/1.png"], [VIEW, VIEW])
    assert found == {0: ((0.5, 1.5, 3, 4),), 1: ((4.5, 5.5, 7, 8),)}


@pytest.mark.parametrize("name", ["2-1.png", "21.png", "flight7_left_1.png", "right/left_1.jpg"])
def test_boxes_of_other_images_alone_are_refused(name: str, tmp_path: Path) -> None:
    drawn = read_boxes(boxes(tmp_path, (name, [1, 2, 3, 4])))
    with pytest.raises(
        ValueError, match=r"none of its 1 boxes belongs to these images: it names .*, and the images are"
    ):
        drawn.of_views([("left_1.png", "right_1.png"), ("left_2.png", "right_2.png")], VIEW)


def test_views_side_by_side_share_an_image(tmp_path: Path) -> None:
    wide = read_boxes(boxes(tmp_path, ("1.png", [130, 20, 5, 6]), ("0.png", [97, 20, 4, 6])))
    views = [("0.png", "0.png"), ("1.png", "1.png")]
    # A box belongs to the view with its middle.
    assert wide.of_views(views, VIEW) == {(1, 1): (29.5, 19.5, 5, 6), (0, 0): (96.5, 19.5, 4, 6)}


def test_two_boxes_in_a_view_are_refused(tmp_path: Path) -> None:
    drawn = read_boxes(boxes(tmp_path, ("1.png", [10, 20, 5, 6]), ("a/1.png", [1, 2, 3, 4])))
    with pytest.raises(ValueError, match=r"a/1\.png has two boxes in one view"):
        drawn.of_views([("1.png", "1.png")], VIEW)


def test_boxes_drawn_on_smaller_copies_are_refused(tmp_path: Path) -> None:
    image = {"id": 1, "file_name": "left/1.png", "width": 50, "height": 40}
    drawn = read_boxes(boxes(tmp_path, ("left/1.png", [1, 2, 3, 4]), images=[image]))
    with pytest.raises(
        ValueError, match=r"left/1\.png was 50x40 px when its box was drawn, and the image is 100x80 px"
    ):
        drawn.of_views([("left/1.png", "right/1.png")], VIEW)
    same = read_boxes(boxes(tmp_path, ("1.png", [1, 2, 3, 4]), images=[{**image, "width": 200, "height": 80}]))
    assert same.of_views([("left/1.png", "left/1.png")], VIEW) == {(0, 0): (0.5, 1.5, 3, 4)}


@pytest.mark.parametrize("bbox", [[100, 2, 3, 4], [-3, 2, 3, 4], [1, 80, 3, 4], [1, -4, 3, 4]])
def test_a_box_outside_its_image_is_refused(bbox: list[float], tmp_path: Path) -> None:
    drawn = read_boxes(boxes(tmp_path, ("left/1.png", bbox)))
    fault = rf"left/1\.png: the box {', '.join(map(str, bbox))} lies outside its image of 100x80 px"
    with pytest.raises(ValueError, match=fault):
        drawn.of_views([("left/1.png", "right/1.png")], VIEW)
    with pytest.raises(ValueError, match=fault):
        drawn.of_images(["left/1.png"], [VIEW])
    # One that an edge cuts, by however little is left inside, is as it was drawn.
    inside = [min(max(bbox[0], -2.5), 99.5), min(max(bbox[1], -3.5), 79.5), 3, 4]
    (only,) = read_boxes(boxes(tmp_path, ("left/1.png", inside))).of_images(["left/1.png"], [VIEW]).values()
    assert only == ((inside[0] - 0.5, inside[1] - 0.5, 3, 4),)


def test_the_drogues_category_is_taken_or_asked_for(tmp_path: Path) -> None:
    categories = [{"id": 1, "name": "probe"}, {"id": 2, "name": "Drogue"}]
    path = boxes(tmp_path, ("1.png", [1, 2, 3, 4]), ("2.png", [5, 6, 7, 8]), categories=categories)
    table = json.loads(path.read_text())
    table["annotations"][1]["category_id"] = 2
    path.write_text(json.dumps(table))
    assert [drawn.image_name for drawn in read_boxes(path).boxes] == ["2.png"]
    assert [drawn.image_name for drawn in read_boxes(path, "probe").boxes] == ["1.png"]
    table["annotations"][0]["category_id"] = 3
    path.write_text(json.dumps(table))
    with pytest.raises(ValueError, match=r"boxes\.json: annotation 11: no category has its category_id 3"):
        read_boxes(path)
    with pytest.raises(ValueError, match=r"none named hose; choose by --box-category from probe, Drogue"):
        read_boxes(path, "hose")
    table["categories"][1]["name"] = "basket"
    path.write_text(json.dumps(table))
    with pytest.raises(ValueError, match=r"none named drogue; choose by --box-category from probe, basket"):
        read_boxes(path)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"bbox": None}, r"annotation 11 on 1\.png: its bbox must be x, y, width, height in pixels, got None"),
        ({"bbox": []}, r"annotation 11 on 1\.png: its bbox must be .* got \[\]"),
        ({"bbox": [1, 2, 0, 4]}, "annotation 11 on .* got \\[1, 2, 0, 4\\]"),
        ({"bbox": [1, 2, float("nan"), 4]}, "annotation 11 on .* its bbox must be"),
        ({"image_id": 7}, "annotation 11: no image has its image_id 7"),
        (
            {"attributes": {"rotation": 12.5}},
            r"annotation 11 on 1\.png: its box is turned by 12.5 degrees; draw it upright",
        ),
    ],
)
def test_a_faulty_annotation_is_named(change: dict[str, Any], fault: str, tmp_path: Path) -> None:
    annotation = {"id": 11, "image_id": 1, "category_id": 1, "bbox": [1, 2, 3, 4], **change}
    path = boxes(tmp_path, ("1.png", [1, 2, 3, 4]), annotations=[annotation])
    with pytest.raises(ValueError, match=rf"boxes\.json: {fault}"):
        read_boxes(path)
    del annotation["bbox"]
    path = boxes(tmp_path, ("1.png", [1, 2, 3, 4]), annotations=[annotation])
    with pytest.raises(ValueError, match=r"boxes\.json: annotation 11"):
        read_boxes(path)


@pytest.mark.parametrize(
    "text",
    [
        *("", "[]", "{}", '{"images": [{"id": true, "file_name": "a"}], "annotations": []}'),
        '{"images": [{"id": 1, "file_name": "a"}, {"id": 1, "file_name": "b"}], "annotations": []}',
        '{"images": [], "annotations": [3]}',
        '{"images": [], "annotations": [], "categories": [{"id": 1}]}',
    ],
)
def test_files_that_are_no_boxes_are_named(text: str, tmp_path: Path) -> None:
    (tmp_path / "boxes.json").write_text(text)
    with pytest.raises(ValueError, match=r"boxes\.json"):
        read_boxes(tmp_path / "boxes.json")
