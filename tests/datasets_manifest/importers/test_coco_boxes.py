"""Boxes find their view, however the images are laid out."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from datasets_manifest.importers.coco_boxes import boxes_of_pair, read_boxes

WIDTH = 100


def boxes(folder: Path, *entries: tuple[str, list[float]]) -> Path:
    images = [{"id": k, "file_name": name} for k, (name, _) in enumerate(entries, start=1)]
    annotations = [{"id": k, "image_id": k, "bbox": bbox} for k, (_, bbox) in enumerate(entries, start=1)]
    path = folder / "boxes.json"
    path.write_text(json.dumps({"images": images, "annotations": annotations}))
    return path


@pytest.mark.parametrize("names", [("left/1.png", "right/1.png"), ("left_1.png", "right_1.png")])
def test_each_view_gets_its_own(names: tuple[str, str], tmp_path: Path) -> None:
    both = read_boxes(boxes(tmp_path, (f"flight/{names[0]}", [10, 20, 5, 6]), (f"flight/{names[1]}", [30, 20, 5, 6])))
    # COCO counts from the corner of the image, half a pixel before the first pixel's centre.
    assert boxes_of_pair(both, names, WIDTH) == ((9.5, 19.5, 5, 6), (29.5, 19.5, 5, 6))
    right = read_boxes(boxes(tmp_path, (names[1], [30, 20, 5, 6])))
    assert boxes_of_pair(right, names, WIDTH) == (None, (29.5, 19.5, 5, 6))


def test_views_side_by_side_share_an_image(tmp_path: Path) -> None:
    wide = read_boxes(boxes(tmp_path, ("1.png", [130, 20, 5, 6])))
    assert boxes_of_pair(wide, ("1.png", "1.png"), WIDTH) == (None, (29.5, 19.5, 5, 6))


def test_two_boxes_in_a_view_are_refused(tmp_path: Path) -> None:
    path = boxes(tmp_path, ("1.png", [10, 20, 5, 6]), ("2.png", [1, 2, 3, 4]))
    table = json.loads(path.read_text())
    table["annotations"][1]["image_id"] = 1
    path.write_text(json.dumps(table))
    with pytest.raises(ValueError, match=r"1\.png has 2 in one view"):
        boxes_of_pair(read_boxes(path), ("1.png", "1.png"), WIDTH)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"images": [{"id": true, "file_name": "a"}], "annotations": []}'])
def test_files_that_are_no_boxes_are_named(text: str, tmp_path: Path) -> None:
    (tmp_path / "boxes.json").write_text(text)
    with pytest.raises(ValueError, match=r"boxes\.json"):
        read_boxes(tmp_path / "boxes.json")
