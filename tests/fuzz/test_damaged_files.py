"""Damaged files, each through the functions that read it."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
from hypothesis import given
from hypothesis import strategies as st

from datasets_manifest.importers.coco_boxes import read_boxes
from datasets_manifest.recipe.recipe import load_recipe, parse_recipe
from datasets_manifest.storage.image_codecs import decode_exr, decode_png, read_passes
from datasets_manifest.storage.layout import frame_folder
from datasets_manifest.storage.manifest import read_manifest
from datasets_manifest.types.estimates import read_estimates
from scenes.environment_radiance import environment_radiance
from scenes.sampler import sample_frame
from tests.support.damage_strategies import HOSTILE, Edit, byte_edits, fuzz, json_edits, quietly
from tests.support.whole_dataset import RECIPE


@fuzz(50)
@given(edits=st.lists(byte_edits(), min_size=1, max_size=3), swap=st.tuples(st.integers(0, 400), HOSTILE))
def test_damaged_recipes(edits: list[Edit], swap: tuple[int, Any]) -> None:
    text = load_recipe("smoke").text if swap[0] % 2 else RECIPE
    lines = text.splitlines()
    line = swap[0] % len(lines)
    if " = " in lines[line]:
        key, _, _ = lines[line].partition(" = ")
        lines[line] = f"{key} = {json.dumps(swap[1])}"
    data = "\n".join(lines).encode("utf-8", "surrogatepass")
    for edit in edits[1:]:
        data = edit(data)
    damaged = data.decode("utf-8", "replace")

    def use() -> None:
        recipe = parse_recipe(damaged)
        sample_frame(recipe, 0)

    quietly(use)


@fuzz(20)
@given(edit=st.one_of(byte_edits(), json_edits()), other=byte_edits(), is_once=st.booleans())
def test_damaged_estimates(edit: Edit, other: Edit, is_once: bool) -> None:
    pose = np.eye(4).tolist()
    line = json.dumps({"status": "fix", "frame_index": 0, "method": "mine", "left_from_drogue": pose}).encode()
    data = edit(line) + b"\n" + line
    with tempfile.TemporaryDirectory(prefix="droguekit-fuzz-") as place:
        path = Path(place) / "estimates.jsonl"
        path.write_bytes(data if is_once else other(data))
        quietly(lambda: list(read_estimates(path)))


@fuzz(40)
@given(edit=st.one_of(byte_edits(), json_edits()), other=byte_edits(), is_once=st.booleans())
def test_damaged_boxes(edit: Edit, other: Edit, is_once: bool) -> None:
    images = [
        {"id": 1, "file_name": "flight\\\\3f2a9c01-left_1.png", "width": 160, "height": 120},
        {"id": 2, "file_name": "right_1.png"},
    ]
    annotations = [
        {"id": k, "image_id": k, "category_id": 1, "bbox": [10, 20, 5, 6], "attributes": {"rotation": 0}}
        for k in (1, 2)
    ]
    table = {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "drogue"}]}
    with tempfile.TemporaryDirectory(prefix="droguekit-fuzz-") as place:
        path = Path(place) / "boxes.json"
        data = edit(json.dumps(table).encode())
        path.write_bytes(data if is_once else other(data))
        quietly(lambda: read_boxes(path).of_views([("left_1.png", "right_1.png")], (160, 120)))


@fuzz(30)
@given(edit=byte_edits(), other=byte_edits(), suffix=st.sampled_from([".exr", ".hdr"]))
def test_damaged_environment_maps(edit: Edit, other: Edit, suffix: str) -> None:
    picture = np.full((8, 16, 3), 500.0, np.float32)
    with tempfile.TemporaryDirectory(prefix="droguekit-fuzz-") as place:
        path = Path(place) / f"map{suffix}"
        if suffix == ".hdr":
            cv2.imwrite(str(path), picture)
        else:
            OpenEXR.File({}, {name: picture[..., 0].copy() for name in "RGB"}).write(str(path))
        path.write_bytes(edit(other(path.read_bytes())))
        text = RECIPE.replace("[environment]", f'[environment]\nmap = "{path.name}"')
        quietly(lambda: environment_radiance(sample_frame(parse_recipe(text, Path(place)), 0).environment))


@fuzz(20)
@given(edit=byte_edits(), other=byte_edits())
def test_damaged_images(whole: Path, edit: Edit, other: Edit) -> None:
    camera = read_manifest(whole).recipe.rig.camera
    for name in ("left.png", "right_parts.png"):
        data = (frame_folder(whole, 0) / name).read_bytes()
        quietly(lambda data=data: decode_png(edit(other(data)), "image", camera))


@fuzz(40)
@given(edit=byte_edits(), other=byte_edits())
def test_damaged_passes(whole: Path, edit: Edit, other: Edit) -> None:
    data = edit(other((frame_folder(whole, 0) / "left.exr").read_bytes()))
    camera = read_manifest(whole).recipe.rig.camera
    quietly(lambda: read_passes(data, "passes", camera))
    quietly(lambda: decode_exr(data))
