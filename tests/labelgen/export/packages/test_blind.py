"""The blind export: everything that navigation needs, and nothing of the truth."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import read_estimates
from droguekit.cli.main import DONE, WRONG_INPUT, run
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export

NUMBER = re.compile(r"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
# What the rig, the drogue and the shutter are called; everything else that a dataset names is truth.
ALLOWED = {"time_s", "exposure", "image_black_level_dn", "frame", "sought"}
# A number this long does not come up twice by chance.
LONG = 9


@pytest.fixture(scope="module")
def blind(mixed_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("blind") / "out"
    write_export("blind", mixed_dataset, out, ExportLog())
    return out


def keys_of(value: Any) -> set[str]:
    """All keys in JSON values."""
    if isinstance(value, dict):
        return set(value).union(*map(keys_of, value.values()))
    return set().union(*map(keys_of, value)) if isinstance(value, list) else set()


def numbers_of(value: Any) -> set[float]:
    """All numbers in JSON values."""
    if isinstance(value, dict | list):
        return set().union(*map(numbers_of, value.values() if isinstance(value, dict) else value))
    return {float(value)} if isinstance(value, int | float) and not isinstance(value, bool) else set()


def test_navigation_sees_the_same(blind: Path, mixed_dataset: Path) -> None:
    whole, given = BlindDataset(mixed_dataset), BlindDataset(blind)
    assert given.frame_indices == whole.frame_indices
    for index in whole.frame_indices:
        want, got = whole.pair(index), given.pair(index)
        np.testing.assert_array_equal(got.images.left, want.images.left)
        np.testing.assert_array_equal(got.images.right, want.images.right)
        assert got.images.time_s == want.images.time_s and got.images.exposure_s == want.images.exposure_s
        assert got.images.black_level_dn == want.images.black_level_dn
        assert got.drogue == want.drogue and got.rig.baseline_m == want.rig.baseline_m


@pytest.mark.parametrize(("preset", "rig"), [("paper-colour", {}), ("mono", {"output_bits": 12})])
def test_mosaics_and_twelve_bits_stay(
    preset: str, rig: dict[str, int], dataset_by_preset: Callable[..., Any], tmp_path: Path
) -> None:
    dataset = dataset_by_preset(preset, rig)
    write_export("blind", dataset, tmp_path / "out", ExportLog())
    want, got = BlindDataset(dataset).pair(0).images, BlindDataset(tmp_path / "out").pair(0).images
    np.testing.assert_array_equal(got.left, want.left)
    assert (got.left_mosaic is None) == (preset != "paper-colour") and got.bits == want.bits


def test_navigate_runs_on_it_and_what_needs_the_truth_says_so(
    blind: Path, mixed_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, folder in (("blind", blind), ("whole", mixed_dataset)):
        assert run(["navigate", str(folder), "--method", "paper", "--out", str(tmp_path / f"{name}.jsonl")]) == DONE
    got, want = (list(read_estimates(tmp_path / f"{name}.jsonl")) for name in ("blind", "whole"))
    assert [(one.frame_index, one.status) for one in got] == [(one.frame_index, one.status) for one in want]
    capsys.readouterr()
    assert run(["export", str(blind), "--format", "coco", "--out", str(tmp_path / "coco")]) == WRONG_INPUT
    assert "is a blind dataset, which has no truth" in capsys.readouterr().err
    # Nothing is wrong with it, so it is wrong input and no fault.
    assert run(["validate", str(blind)]) == WRONG_INPUT
    assert "is a blind or imported dataset, which has no labels to check" in capsys.readouterr().err


def test_only_what_is_needed_is_there(blind: Path) -> None:
    names = {re.sub(r"\d{6}", "N", str(path.relative_to(blind))) for path in blind.rglob("*") if path.is_file()}
    calibration = {name for name in names if name.startswith("calibration/")}
    assert "calibration/opencv_stereo.yaml" in calibration
    assert names - calibration == {
        "blind.json",
        *(f"frames/N/{name}" for name in ("left.png", "right.png", "record.json")),
    }


def test_no_key_of_the_truth_is_there(blind: Path, mixed_dataset: Path) -> None:
    index = json.loads((blind / "blind.json").read_text())
    known = keys_of(index["rig"]) | keys_of(index["sensor"]) | keys_of(index["drogue"]) | ALLOWED
    assert set(index) == {"schema_version", "name", "rig", "sensor", "drogue", "drogues_differ", "frames"}
    for path in blind.rglob("record.json"):
        assert keys_of(json.loads(path.read_text())) <= known
    manifest = json.loads((mixed_dataset / "manifest.json").read_text())
    for path in blind.rglob("*"):
        if path.suffix in (".json", ".yaml"):
            text = path.read_text()
            for secret in (
                str(manifest["recipe"]["seed"]),
                manifest["dataset_sha256"],
                '"split"',
                '"scene_id"',
                "empty",
            ):
                assert secret not in text


def test_no_number_of_the_truth_is_there(blind: Path, mixed_dataset: Path) -> None:
    source, index = Dataset(mixed_dataset), json.loads((blind / "blind.json").read_text())
    told = numbers_of(index["rig"]) | numbers_of(index["sensor"]) | numbers_of(index["drogue"])
    truth: set[float] = set()
    for frame_index in source.frame_indices:
        table = json.loads((mixed_dataset / "frames" / f"{frame_index:06d}" / "record.json").read_text())
        frame = table["frame"]
        told |= {table["time_s"], frame["exposure"]["time_s"], table["image_black_level_dn"]}
        told |= numbers_of(frame["drogue"] or frame["sought"])
        truth |= numbers_of(table)
    secrets = {number for number in truth - told if len(repr(number)) >= LONG}
    assert len(secrets) > 500
    for path in blind.rglob("*"):
        if path.suffix in (".json", ".yaml"):
            assert secrets.isdisjoint(map(float, NUMBER.findall(path.read_text()))), path


def test_whether_there_is_a_drogue_is_not_told(blind: Path, mixed_dataset: Path) -> None:
    source = Dataset(mixed_dataset)
    shapes = set()
    for index in source.frame_indices:
        table = json.loads((blind / "frames" / f"{index:06d}" / "record.json").read_text())
        shapes.add((tuple(sorted(table)), tuple(sorted(table["frame"]))))
    assert len(shapes) == 1 and source.manifest.counts.empty > 0


def test_a_damaged_index_is_one_line(blind: Path, tmp_path: Path) -> None:
    for text, fault in (("{", "is truncated or not JSON"), ("{}", "name: Field required"), ("[]", "valid dictionary")):
        (tmp_path / "blind.json").write_text(text)
        with pytest.raises(ValueError, match=fault):
            BlindDataset(tmp_path)
