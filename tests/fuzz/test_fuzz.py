"""Damaged and hostile files through every reader, `validate` and every export: a clear error, or none, each time.

What counts as clear is one line of a ValueError or an OSError. Nothing may be written outside the folder that was
named, and nothing that a dataset leads to may be changed. `make fuzz` tries twenty times as many.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
from datetime import timedelta
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from datasets_manifest.blind import BlindDataset
from datasets_manifest.calibration import opencv_stereo, write_calibration
from datasets_manifest.estimates import read_estimates
from datasets_manifest.importers.ros_bag import RosBag
from datasets_manifest.importers.stereo_calibration import read_opencv_stereo, rig_of_calibration
from datasets_manifest.layout import RECORD_FILE, frame_folder
from datasets_manifest.manifest import build_manifest, read_manifest, write_manifest
from datasets_manifest.passes import decode_exr, read_passes
from datasets_manifest.png import decode_png
from datasets_manifest.reader import Dataset
from datasets_manifest.recipe import load_recipe, parse_recipe
from datasets_manifest.rigs import resolve_rig
from datasets_manifest.writer import canonical_json, write_frame
from droguekit.batch.frame_task import make_frame
from geometry.stereo import EYES
from labelgen.dataset_validation import validate_dataset
from labelgen.export.coco import write_annotations
from labelgen.export.formats import FORMATS, write_export
from labelgen.export.log import ExportLog
from render.engine import load_engine
from scenes.sampler import sample_frame
from scenes.surroundings import surroundings

# The suite's share of 500; `make fuzz` sets the variable.
TIMES = int(os.environ.get("DROGUEKIT_FUZZ_TIMES", "1"))
RECIPE = """
name = "fuzz"
seed = 5
[rig]
preset = "rgb-ideal"
width_px = 48
height_px = 36
focal_px = 80.0
[frames]
count = 3
scenes = 2
empty_fraction = 0.3
[distance]
law = "stations"
stations_m = [2.5]
[environment.clouds]
scene_fraction = 0.0
[render]
engine = "analytic"
[outputs]
exr = true
[split]
train = 0.5
test = 0.5
"""
SECRET = "must not be read, changed or joined"


def fuzz(examples):
    """Settings of one test; the suite's draws are always the same, those of `make fuzz` are new each time."""
    return settings(
        max_examples=examples * TIMES,
        derandomize=TIMES == 1,
        database=None,
        # Far beyond what any example takes on a busy machine: this is for what hangs.
        deadline=timedelta(minutes=2),
        suppress_health_check=list(HealthCheck),
        # Examples are small already, and to make them smaller takes minutes.
        phases=(Phase.generate,),
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A tiny dataset with EXR files."""
    folder, recipe, engine = tmp_path_factory.mktemp("fuzz") / "whole", parse_recipe(RECIPE), load_engine("analytic")
    for index in range(recipe.frames.count):
        record, files, _ = make_frame(recipe, index, engine)
        write_frame(folder, record, files)
    describe(folder, recipe)
    write_calibration(folder, recipe.rig)
    write_annotations(folder, folder / "annotations")
    (folder / "recipe.toml").write_text(RECIPE)
    assert validate_dataset(folder).faults == []
    return folder


def describe(folder, recipe):
    write_manifest(folder, build_manifest(folder, recipe, "1", lambda scene_id: ("train", "test")[scene_id % 2]))


def quietly(action):
    """Run what may fail by a clear error only."""
    try:
        action()
    except (ValueError, OSError) as error:
        assert str(error) and "\n" not in str(error).strip(), repr(error)


# What a careless program or an enemy writes in the place of a value.
_NUMBERS = [True, -1, 0, 2**31, 2**63, 10**30, 1e308, -1e-308, float("nan"), float("inf")]
_TEXTS = ["", "left", "../../secret", "/etc/passwd", "a/../../b", "\0", "x" * 5000, "\u00e9\ud800"]
HOSTILE = st.sampled_from([None, *_NUMBERS, *_TEXTS, [], {}, [[]], [None] * 40, {"left": 1}, [1e200] * 3])


@st.composite
def byte_edits(draw):
    """A change of a file's bytes: cut, turn over, double, insert."""
    kind = draw(st.sampled_from(["cut", "flip", "insert", "double", "empty"]))
    place, length = draw(st.floats(0, 1, exclude_max=True)), draw(st.integers(1, 40))
    junk = draw(st.binary(min_size=1, max_size=40))

    def edit(data):
        at = int(place * len(data))
        if kind == "cut":
            return data[:at]
        if kind == "empty":
            return b""
        if kind == "double":
            return data[:at] + data
        middle = junk if kind == "insert" else bytes(byte ^ junk[0] | 1 for byte in data[at : at + length])
        return data[:at] + middle + data[at + (0 if kind == "insert" else length) :]

    return edit


@st.composite
def json_edits(draw):
    """A change of one value, deep in a JSON file, or of a key."""
    steps, value = draw(st.lists(st.integers(0, 10**6), min_size=1, max_size=9)), draw(HOSTILE)
    kind = draw(st.sampled_from(["replace", "delete", "add"]))

    def edit(data):
        table = node = json.loads(data)
        for number, step in enumerate(steps):
            keys = list(node) if isinstance(node, dict) else list(range(len(node)))
            if not keys:
                break
            key = keys[step % len(keys)]
            if number + 1 < len(steps) and isinstance(node[key], dict | list):
                node = node[key]
                continue
            if kind == "replace":
                node[key] = value
            elif kind == "delete":
                del node[key]
            elif isinstance(node, dict):
                node[str(value)] = node[key]
            else:
                node.append(value)
            break
        return json.dumps(table).encode("utf-8", "surrogatepass")

    return edit


FRAME_FILES = ["record.json", *(f"{eye}{rest}" for eye in EYES for rest in (".png", "_parts.png", ".exr"))]
OTHER_FILES = ["manifest.json", "recipe.toml", "calibration/opencv_stereo.yaml", "calibration/ros_left.yaml"]
OTHER_FILES += ["annotations/all.json", "annotations/train.json"]


@st.composite
def damages(draw):
    """One or two files of a dataset, what to do with each, and whether the hashes are made to fit again."""
    found = []
    for _ in range(draw(st.integers(1, 2))):
        name = draw(st.sampled_from([*FRAME_FILES, "record.json", "record.json", *OTHER_FILES]))
        if name in FRAME_FILES:
            name = f"frames/{draw(st.integers(0, 2)):06d}/{name}"
        kinds = [byte_edits(), *([json_edits()] * 3 if name.endswith(".json") else [])]
        kinds += [st.sampled_from(["remove", "link", "folder"])]
        found.append((name, draw(st.one_of(kinds))))
    return found, draw(st.booleans())


def apply(dataset, secret, found, is_repaired):
    for name, edit in found:
        path = dataset / name
        if path.is_dir():
            continue
        if isinstance(edit, str):
            path.unlink(missing_ok=True)
            if edit == "link":
                path.symlink_to(secret)
            elif edit == "folder" and not path.exists():
                path.mkdir()
        elif path.is_file() and not path.is_symlink():
            try:
                path.write_bytes(edit(path.read_bytes()))
            except ValueError:  # what an earlier edit left is no JSON any more
                continue
    if is_repaired:
        # Damage that leaves nothing to repair stays as it is.
        with contextlib.suppress(KeyError, TypeError, ValueError, OSError, AttributeError):
            repair(dataset)


def repair(dataset):
    """Make the hashes of records and manifest fit what lies there, so that damage gets past them."""
    table = json.loads((dataset / "manifest.json").read_bytes())
    for entry in table["frames"]:
        folder = frame_folder(dataset, entry["frame_index"])
        record = json.loads((folder / RECORD_FILE).read_bytes())
        for name in record["file_sha256"]:
            if (folder / name).parent == folder and (folder / name).is_file():
                record["file_sha256"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        (folder / RECORD_FILE).write_bytes(json.dumps(record).encode("utf-8", "surrogatepass"))
        entry["record_sha256"] = hashlib.sha256((folder / RECORD_FILE).read_bytes()).hexdigest()
    records = sorted(entry["record_sha256"] for entry in table["frames"])
    table["dataset_sha256"] = content_sha256({"recipe": table["recipe"], "records": records})
    del table["manifest_sha256"]
    table["manifest_sha256"] = content_sha256(table)
    (dataset / "manifest.json").write_bytes(json.dumps(table).encode("utf-8", "surrogatepass"))


def content_sha256(table):
    return hashlib.sha256(canonical_json(table).encode("utf-8")).hexdigest()


def listing(folder):
    """Every name below a folder with what it holds, links not followed."""
    return {
        path.relative_to(folder): path.read_bytes() if path.is_file() and not path.is_symlink() else None
        for path in folder.rglob("*")
    }


@fuzz(250)
@given(damage=damages(), name=st.sampled_from([*FORMATS, "validate", "validate", "validate", "read", "blind"]))
def test_damaged_datasets(whole, damage, name):
    with tempfile.TemporaryDirectory(prefix="droguekit-fuzz-") as place:
        base = Path(place)
        (base / "secret").write_text(SECRET)
        shutil.copytree(whole, base / "in" / "dataset")
        dataset, out = base / "in" / "dataset", base / "out" / "export"
        out.parent.mkdir()
        apply(dataset, base / "secret", *damage)
        before = listing(base)
        if name == "validate":
            quietly(lambda: validate_dataset(dataset).table())
        elif name == "read":
            quietly(lambda: read_all(dataset))
        elif name == "blind":
            quietly(lambda: [BlindDataset(dataset).pair(index) for index in BlindDataset(dataset).frame_indices])
        else:
            quietly(lambda: write_export(name, dataset, out, ExportLog()))
        after = listing(base)
        new = {path for path in after if path not in before and out.relative_to(base) not in (path, *path.parents)}
        assert new == set()
        assert {path: after.get(path) for path in before} == before
        assert not [path for path, data in after.items() if path not in before and data and SECRET.encode() in data]


def read_all(dataset):
    source = Dataset(dataset)
    for index in source.frame_indices:
        source.verify(index)
        source.images(index)
        record = source.record(index)
        for eye in EYES:
            source.part_ids(index, eye)
            camera = record.frame.rig.camera
            read_passes((frame_folder(dataset, index) / f"{eye}.exr").read_bytes(), "passes", camera)


@fuzz(60)
@given(edits=st.lists(byte_edits(), min_size=1, max_size=3), swap=st.tuples(st.integers(0, 400), HOSTILE))
def test_damaged_recipes(edits, swap):
    text = load_recipe("smoke")[1] if swap[0] % 2 else RECIPE
    lines = text.splitlines()
    line = swap[0] % len(lines)
    if " = " in lines[line]:
        key, _, _ = lines[line].partition(" = ")
        lines[line] = f"{key} = {json.dumps(swap[1])}"
    data = "\n".join(lines).encode("utf-8", "surrogatepass")
    for edit in edits[1:]:
        data = edit(data)
    damaged = data.decode("utf-8", "replace")

    def use():
        recipe = parse_recipe(damaged)
        sample_frame(recipe, 0)

    quietly(use)


@fuzz(30)
@given(edit=st.one_of(byte_edits(), json_edits()), other=byte_edits(), is_once=st.booleans())
def test_damaged_estimates(edit, other, is_once):
    pose = np.eye(4).tolist()
    line = json.dumps({"status": "fix", "frame_index": 0, "method": "mine", "left_from_drogue": pose}).encode()
    data = edit(line) + b"\n" + line
    with tempfile.TemporaryDirectory(prefix="droguekit-fuzz-") as place:
        path = Path(place) / "estimates.jsonl"
        path.write_bytes(data if is_once else other(data))
        quietly(lambda: list(read_estimates(path)))


@fuzz(30)
@given(edit=byte_edits(), other=byte_edits(), suffix=st.sampled_from([".exr", ".hdr"]))
def test_damaged_environment_maps(edit, other, suffix):
    picture = np.full((8, 16, 3), 500.0, np.float32)
    with tempfile.TemporaryDirectory(prefix="droguekit-fuzz-") as place:
        path = Path(place) / f"map{suffix}"
        if suffix == ".hdr":
            cv2.imwrite(str(path), picture)
        else:
            OpenEXR.File({}, {name: picture[..., 0].copy() for name in "RGB"}).write(str(path))
        path.write_bytes(edit(other(path.read_bytes())))
        text = RECIPE.replace("[environment.clouds]", f'[environment]\nmap = "{path.name}"\n[environment.clouds]')
        quietly(lambda: surroundings(sample_frame(parse_recipe(text, Path(place)), 0).environment))


@pytest.fixture(scope="module")
def bag(whole):
    """The dataset as a ROS 2 bag."""
    write_export("rosbag", whole, whole.with_name("bag"), ExportLog())
    (file,) = whole.with_name("bag").rglob("*.mcap")
    return file.parent


@fuzz(40)
@given(edit=byte_edits(), other=byte_edits(), name=st.sampled_from([".mcap", ".mcap", "metadata.yaml"]))
def test_damaged_bags(bag, edit, other, name):
    with tempfile.TemporaryDirectory(prefix="droguekit-fuzz-") as place:
        copy = Path(place) / "bag"
        shutil.copytree(bag, copy)
        path = next(path for path in copy.iterdir() if path.name.endswith(name))
        path.write_bytes(edit(other(path.read_bytes())))

        def use():
            source = RosBag(copy)
            assert len(list(source)) == source.count
            rig_of_calibration(source.calibration())

        quietly(use)


@fuzz(30)
@given(edit=byte_edits(), other=byte_edits())
def test_damaged_images(whole, edit, other):
    for name in ("left.png", "right_parts.png"):
        data = (frame_folder(whole, 0) / name).read_bytes()
        quietly(lambda data=data: decode_png(edit(other(data)), "image"))


@fuzz(40)
@given(edit=byte_edits(), other=byte_edits())
def test_damaged_passes(whole, edit, other):
    data = edit(other((frame_folder(whole, 0) / "left.exr").read_bytes()))
    camera = read_manifest(whole).recipe.rig.camera
    quietly(lambda: read_passes(data, "passes", camera))
    quietly(lambda: decode_exr(data))


@fuzz(20)
@given(edit=byte_edits(), other=byte_edits())
def test_damaged_calibrations(edit, other):
    text = opencv_stereo(resolve_rig("paper-real", 3)[0])
    with tempfile.TemporaryDirectory(prefix="droguekit-fuzz-") as place:
        path = Path(place) / "calibration.yaml"
        path.write_bytes(edit(other(text.encode())))
        quietly(lambda: rig_of_calibration(read_opencv_stereo(path)))
