"""A dataset with damaged files, or links in their place: read, validated, exported."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import shutil
import socket
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.image_codecs import read_passes
from datasets_manifest.storage.layout import RECORD_FILE, frame_folder
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.writer import canonical_json
from droguekit.batch.progress import PlainProgress
from droguekit.visualization.browse.page import write_browse
from droguekit.visualization.contact_sheet import write_contact_sheet
from droguekit.visualization.rerun_viewer import open_pairs, view_pairs
from droguekit.workflows.benchmarking import benchmark_dataset
from geometry.stereo import EYES
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import FORMATS, write_export
from labelgen.validation.dataset_checks import validate_dataset
from tests.support.damage_strategies import Edit, byte_edits, fuzz, json_edits, quietly

SECRET = "must not be read, changed or joined"
FRAME_FILES = ["record.json", *(f"{eye}{rest}" for eye in EYES for rest in (".png", "_parts.png", ".exr"))]
OTHER_FILES = ["manifest.json", "recipe.toml", "calibration/opencv_stereo.yaml", "calibration/ros_left.yaml"]
OTHER_FILES += ["annotations/all.json", "annotations/train.json"]


# Files with what is done to each, and whether the hashes are made to fit again.
Damage = tuple[list[tuple[str, Edit | str]], bool]


@st.composite
def damages(draw: st.DrawFn) -> Damage:
    """One or two files of a dataset, what to do with each, and whether the hashes are made to fit again."""
    found = []
    for _ in range(draw(st.integers(1, 2))):
        name = draw(st.sampled_from([*FRAME_FILES, "record.json", "record.json", *OTHER_FILES]))
        if name in FRAME_FILES:
            name = f"frames/{draw(st.integers(0, 2)):06d}/{name}"
        kinds = [byte_edits(), *([json_edits()] * 3 if name.endswith(".json") else [])]
        kinds += [st.sampled_from(["remove", "link", "folder", "pipe", "device", "socket", "sparse"])]
        found.append((name, draw(st.one_of(kinds))))
    return found, draw(st.booleans())


def apply(dataset: Path, secret: Path, found: list[tuple[str, Edit | str]], is_repaired: bool) -> None:
    for name, edit in found:
        path = dataset / name
        if path.is_dir():
            continue
        if isinstance(edit, str):
            path.unlink(missing_ok=True)
            if edit in ("link", "device"):
                path.symlink_to(secret if edit == "link" else "/dev/zero")
            elif edit == "pipe" and not path.exists():
                os.mkfifo(path)
            elif edit == "socket" and not path.exists():
                make_socket(path)
            elif edit == "sparse" and not path.exists():
                path.touch()
                os.truncate(path, 2**40)
            elif edit == "folder" and not path.exists():
                path.mkdir()
        elif is_small(path):
            try:
                path.write_bytes(edit(path.read_bytes()))
            except (ValueError, RecursionError):  # what an earlier edit left is no JSON any more
                continue
    if is_repaired:
        # Damage that leaves nothing to repair stays as it is.
        with contextlib.suppress(KeyError, TypeError, ValueError, OSError, AttributeError, RecursionError):
            repair(dataset)


def make_socket(path: Path) -> None:
    # The name of a socket has at most some hundred bytes.
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        with socket.socket(socket.AF_UNIX) as end:
            end.bind(f"/proc/self/fd/{folder}/{path.name}")
    finally:
        os.close(folder)


def repair(dataset: Path) -> None:
    """Make the hashes of records and manifest fit what lies there, so that damage gets past them."""
    table = json.loads(contents(dataset / "manifest.json"))
    for entry in table["frames"]:
        folder = frame_folder(dataset, entry["frame_index"])
        record = json.loads(contents(folder / RECORD_FILE))
        for name in record["file_sha256"]:
            if (folder / name).parent == folder and is_small(folder / name):
                record["file_sha256"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        (folder / RECORD_FILE).write_bytes(json.dumps(record).encode("utf-8", "surrogatepass"))
        entry["record_sha256"] = hashlib.sha256((folder / RECORD_FILE).read_bytes()).hexdigest()
    records = sorted(entry["record_sha256"] for entry in table["frames"])
    table["dataset_sha256"] = content_sha256({"recipe": table["recipe"], "records": records})
    del table["manifest_sha256"]
    table["manifest_sha256"] = content_sha256(table)
    (dataset / "manifest.json").write_bytes(json.dumps(table).encode("utf-8", "surrogatepass"))


def content_sha256(table: dict[str, Any]) -> str:
    return hashlib.sha256(canonical_json(table).encode("utf-8")).hexdigest()


def is_small(path: Path) -> bool:
    return path.is_file() and not path.is_symlink() and path.stat().st_size < 2**30


def contents(path: Path) -> bytes:
    if not is_small(path):
        raise OSError("is no file of a dataset")
    return path.read_bytes()


def listing(folder: Path) -> dict[Path, Any]:
    """Every name below a folder with what it holds, links not followed."""
    return {path.relative_to(folder): path.read_bytes() if is_small(path) else None for path in folder.rglob("*")}


VIEWS: dict[str, Callable[[Path, Path], object]] = {
    "validate": lambda dataset, out: validate_dataset(dataset).table(),
    "read": lambda dataset, out: read_all(dataset),
    "blind": lambda dataset, out: [BlindDataset(dataset).pair(k) for k in BlindDataset(dataset).frame_indices],
    "preview": lambda dataset, out: write_contact_sheet(dataset, out / "sheet.png", 3, 2, 64, by_family=False),
    "browse": lambda dataset, out: write_browse(dataset, out, None, 0, PlainProgress(io.StringIO())),
    "benchmark": lambda dataset, out: benchmark(dataset, out),
    "view": lambda dataset, out: view(dataset, out),
}


def benchmark(dataset: Path, out: Path) -> None:
    """Score what a stranger's program sent, and write the report."""
    frames, estimates = (0, 1, 2), out.with_name("estimates.jsonl")
    methods = ["joint", "<script>alert(1)</script>", "\x1b[2J"]
    lines = [
        {"status": "fix", "frame_index": index, "method": name, "left_from_drogue": pose, "covariance": covariance}
        for index in frames
        for name, pose, covariance in zip(methods, POSES, COVARIANCES, strict=True)
    ]
    out.mkdir()
    estimates.write_text("".join(json.dumps(line) + "\n" for line in lines))
    try:
        benchmark_dataset(dataset, estimates, out / "b.json", out / "report.html")
        assert "<script>alert(1)" not in (out / "report.html").read_text()
    finally:
        estimates.unlink()


def view(dataset: Path, out: Path) -> None:
    source = open_pairs(dataset)
    view_pairs(source, list(source.frame_indices), {}, out / "view.rrd", PlainProgress(io.StringIO()))


POSES = [np.diag([1.0, 1.0, 1.0, 1.0]).tolist() for _ in range(3)]
for depth_m, pose in zip((2.5, 1e-3, 1e9), POSES, strict=True):
    pose[2][3] = depth_m
COVARIANCES = [(scale * np.eye(6)).tolist() for scale in (1e-4, 1e-300, 1e300)]


@fuzz(100)
@given(damage=damages(), name=st.sampled_from([*FORMATS, *VIEWS, "validate", "validate"]))
def test_damaged_datasets(whole: Path, damage: Damage, name: str) -> None:
    with tempfile.TemporaryDirectory(prefix="droguekit-fuzz-") as place:
        base = Path(place)
        (base / "secret").write_text(SECRET)
        shutil.copytree(whole, base / "in" / "dataset")
        dataset, out = base / "in" / "dataset", base / "out" / "export"
        out.parent.mkdir()
        apply(dataset, base / "secret", *damage)
        before = listing(base)
        if name in VIEWS:
            quietly(lambda: VIEWS[name](dataset, out))
        else:
            quietly(lambda: write_export(name, dataset, out, ExportLog()))
        after = listing(base)
        new = {path for path in after if path not in before and out.relative_to(base) not in (path, *path.parents)}
        assert new == set()
        assert {path: after.get(path) for path in before} == before
        assert not [path for path, data in after.items() if path not in before and data and SECRET.encode() in data]


def read_all(dataset: Path) -> None:
    source = Dataset(dataset)
    for index in source.frame_indices:
        source.verify(index)
        source.images(index)
        record = source.record(index)
        for eye in EYES:
            source.part_ids(index, eye)
            camera = record.frame.rig.camera
            read_passes(source.frames.read(index, f"{eye}.exr"), "passes", camera)
