from __future__ import annotations

import contextlib
import io
import json
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pycocotools.coco import COCO

from datasets_manifest.storage.storage import open_storage
from labelgen.validation import coco_index
from labelgen.validation.coco_index import CocoIndex


def table(images: int = 5) -> dict[str, Any]:
    """Annotations out of order, two of some images and none of others; texts that are not ASCII before them."""
    annotations = [
        {
            "id": 10 * image + number,
            "image_id": image,
            "category_id": 1,
            "bbox": [0.25 * image, 1e-3],
            "note": '}],"\\é',
        }
        for image in range(images, 0, -1)
        for number in range(image % 3)
    ]
    return {
        "info": {"description": "Körbe, 燃料"},
        "images": [{"id": image, "file_name": f"ü{image}.png"} for image in range(1, images + 1)],
        "annotations": annotations,
        "categories": [{"id": 1, "name": "drogue"}],
        "version": 12345,
    }


def write(folder: Path, text: str) -> Path:
    (folder / "all.json").write_text(text, encoding="utf-8")
    return folder


def index_of(folder: Path) -> CocoIndex:
    return CocoIndex(open_storage(folder), "all.json", lambda image_id: "even" if image_id % 2 == 0 else None)


@pytest.mark.parametrize("block_bytes", [1, 7, 2**18])
@pytest.mark.parametrize("layout", [{}, {"indent": 2}, {"ensure_ascii": False, "separators": (",", ":")}])
def test_an_index_has_what_pycocotools_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_bytes: int, layout: dict[str, Any]
) -> None:
    monkeypatch.setattr(coco_index, "_BLOCK_BYTES", block_bytes)
    # Annotations of an image are read one by one, some at once, or all at once.
    monkeypatch.setattr(coco_index, "_NEAR_BYTES", 20 * block_bytes)
    index = index_of(write(tmp_path, json.dumps(table(60), **layout)))
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO(str(tmp_path / "all.json"))
    np.testing.assert_array_equal(index.image_ids, sorted(coco.imgs))
    assert sorted(index.annotation_ids) == sorted(coco.anns)
    assert index.categories == [(1, "drogue")]
    for image_id in range(62):
        assert index.has_image(image_id) == (image_id in coco.imgs)
        assert index.annotations_of(image_id) == coco.imgToAnns.get(image_id, [])


def test_digests_of_a_group_follow_its_entries_and_not_their_order_or_layout(tmp_path: Path) -> None:
    whole = table()
    first = index_of(write(tmp_path, json.dumps(whole))).digests
    whole["images"].reverse()
    whole["annotations"].reverse()
    assert index_of(write(tmp_path, json.dumps(whole, indent=1))).digests == first
    even = [each for each in whole["annotations"] if each["image_id"] % 2 == 0]
    even[0]["bbox"][0] += 1e-9
    changed = index_of(write(tmp_path, json.dumps(whole))).digests
    assert changed["even"] != first["even"] and changed[None] == first[None]


def test_a_truncated_file_is_refused_wherever_it_ends(tmp_path: Path) -> None:
    text = json.dumps(table(2))
    for end in range(len(text)):
        with pytest.raises((ValueError, KeyError)):
            index_of(write(tmp_path, text[:end]))


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[]", "'{' expected at byte 0, got '\\['"),
        ('{"images":{"1":{}}}', "'\\[' expected at byte 10"),
        ('{"images":[],"annotations":[],"categories":[]} x', "goes on behind its end"),
        ('{"images":[],"annotations":[]}', "categories"),
        ('{"images":[{"id":"1"}]}', "str"),
        ('{"images":[{"file_name":"1"}]}', "id"),
        ('{"images":[{"id":1e999}]}', "inite|Infinity|float"),
        ('{"images":[' + "[" * 100_000, "nested"),
        ('{"images":[null],"annotations":[],"categories":[]}', "NoneType"),
        ('{"images":[],"annotations":[null],"categories":[]}', "NoneType"),
        ('{"images":[],"annotations":[],"annotations":[],"categories":[]}', "annotations twice"),
        ('{"images":[],"info":"' + "b" * 300 + '",]', "at byte 323"),
        ('{"info":"' + "a" * 3000 + '"}', "a value of more than 1000 bytes at byte 8"),
        ('{"info":"' + "a" * 1020 + '"}', "a value of more than 1000 bytes at byte 8"),
    ],
)
def test_what_is_no_coco_file_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, fault: str
) -> None:
    monkeypatch.setattr(coco_index, "_BLOCK_BYTES", 100)
    if "aaa" in text:
        monkeypatch.setattr(coco_index, "MOST_ENTRY_BYTES", 1000)
    with pytest.raises((ValueError, KeyError, TypeError), match=fault):
        index_of(write(tmp_path, text))


def test_a_file_is_not_held(tmp_path: Path) -> None:
    whole = table(3000)
    for each in whole["annotations"]:
        each["note"] = f"{each['id']} " * 400
    write(tmp_path, json.dumps(whole))
    size = (tmp_path / "all.json").stat().st_size
    tracemalloc.start()
    try:
        index_of(tmp_path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # Two blocks of a quarter MiB as bytes and text, the value at hand, and 40 bytes an annotation.
    assert size > 4 * 2**20 > 2 * peak
