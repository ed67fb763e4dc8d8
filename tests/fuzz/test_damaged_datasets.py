"""A dataset with damaged files, or links in their place: read, validated, exported."""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.image_codecs import read_passes
from datasets_manifest.storage.layout import RECORD_FILE, frame_folder
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.writer import canonical_json
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
        kinds += [st.sampled_from(["remove", "link", "folder"])]
        found.append((name, draw(st.one_of(kinds))))
    return found, draw(st.booleans())


def apply(dataset: Path, secret: Path, found: list[tuple[str, Edit | str]], is_repaired: bool) -> None:
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


def repair(dataset: Path) -> None:
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


def content_sha256(table: dict[str, Any]) -> str:
    return hashlib.sha256(canonical_json(table).encode("utf-8")).hexdigest()


def listing(folder: Path) -> dict[Path, Any]:
    """Every name below a folder with what it holds, links not followed."""
    return {
        path.relative_to(folder): path.read_bytes() if path.is_file() and not path.is_symlink() else None
        for path in folder.rglob("*")
    }


@fuzz(190)
@given(damage=damages(), name=st.sampled_from([*FORMATS, "validate", "validate", "validate", "read", "blind"]))
def test_damaged_datasets(whole: Path, damage: Damage, name: str) -> None:
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


def read_all(dataset: Path) -> None:
    source = Dataset(dataset)
    for index in source.frame_indices:
        source.verify(index)
        source.images(index)
        record = source.record(index)
        for eye in EYES:
            source.part_ids(index, eye)
            camera = record.frame.rig.camera
            read_passes((frame_folder(dataset, index) / f"{eye}.exr").read_bytes(), "passes", camera)
