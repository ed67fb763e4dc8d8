"""Pipes, devices and endless files where a command expects a file: one line, at once."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.storage.layout import frame_folder
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.writer import write_calibration
from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run
from geometry.pinhole import PinholeCamera
from geometry.stereo import StereoRig
from labelgen.validation.dataset_checks import validate_dataset

Replace = Callable[[Path], None]


def by_pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def by_device(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to("/dev/zero")


def by_terabyte(path: Path) -> None:
    """A file that takes no room on the disk."""
    path.touch()
    os.truncate(path, 2**40)


REPLACEMENTS = {"pipe": by_pipe, "device": by_device, "terabyte": by_terabyte}


@pytest.fixture(params=REPLACEMENTS)
def replace(request: pytest.FixtureRequest) -> Replace:
    found: Replace = REPLACEMENTS[request.param]
    return found


def refusal(*arguments: str | Path) -> str:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = run([str(argument) for argument in arguments])
    assert code == WRONG_INPUT, out.getvalue() + err.getvalue()
    (line,) = [line for line in err.getvalue().splitlines() if line.startswith("droguekit: error: ")]
    return line


def test_a_file_of_a_dataset(dataset: Path, tmp_path: Path, replace: Replace) -> None:
    replace(dataset / "manifest.json")
    for command in (
        ["navigate", "--out", tmp_path / "e.jsonl"],
        ["export", "--format", "coco", "--out", tmp_path / "c"],
    ):
        assert "manifest.json: cannot be read: " in refusal(command[0], dataset, *command[1:])
    (fault,) = validate_dataset(dataset).faults
    assert "manifest.json: cannot be read: " in fault


@pytest.mark.parametrize(
    "name", ["record.json", "left.png", "right_parts.png", "left.exr", "all.json", "opencv_stereo.yaml"]
)
def test_a_file_of_a_frame_is_a_fault_beside_others(dataset: Path, name: str, replace: Replace) -> None:
    folder = {"all.json": dataset / "annotations", "opencv_stereo.yaml": dataset / "calibration"}
    path = folder.get(name, frame_folder(dataset, 1)) / name
    replace(path)
    with redirect_stdout(io.StringIO()) as told:
        assert run(["validate", str(dataset)]) == FAULT
    assert str(path) in told.getvalue()
    assert "3 pairs" in told.getvalue()
    if name == "record.json":
        with pytest.raises(ValueError, match=r"record\.json: (cannot be read|leads outside)"):
            Dataset(dataset).record(1)


def test_files_that_a_user_names(dataset: Path, tmp_path: Path, replace: Replace) -> None:
    pipe = tmp_path / "pipe.toml"
    replace(pipe)
    assert f"{pipe}: cannot be read: " in refusal("render", pipe, "--out", tmp_path / "out")
    assert f"{pipe}: cannot be read: " in refusal("model", pipe, "--out", tmp_path / "m.ply")
    assert f"{pipe}" in refusal("benchmark", dataset, "--estimates", pipe)
    assert f"{pipe}: cannot be read: " in refusal("benchmark", dataset, "--detections", pipe)
    network = tmp_path / "pipe.onnx"
    replace(network)
    assert f"{network}: cannot be read: " in refusal("detect", dataset, "--detector", network, "--out", tmp_path / "d")
    assert not list(tmp_path.glob("out*"))


def test_files_of_an_import(tmp_path: Path, replace: Replace) -> None:
    for eye in ("left", "right"):
        (tmp_path / "in" / eye).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "in" / eye / "1.png"), np.zeros((12, 16), np.uint8))
    write_calibration(tmp_path, StereoRig(PinholeCamera(16, 12, 20.0, 20.0, 7.5, 5.5), 0.1))
    calibration, boxes = tmp_path / "calibration" / "opencv_stereo.yaml", tmp_path / "boxes.json"
    other = tmp_path / "other.yaml"
    replace(boxes)
    command = ["import", tmp_path / "in", "--out", tmp_path / "out", "--calibration", calibration]
    assert f"{boxes}: cannot be read: " in refusal(*command, "--boxes", boxes)
    replace(other)
    assert str(other) in refusal(*command[:-1], other)
    replace(tmp_path / "in" / "left" / "1.png")
    assert "left" in refusal(*command)
    assert not (tmp_path / "out").exists()


def test_a_label_at_the_end_of_all_floats_is_drawn_outside(dataset: Path, tmp_path: Path) -> None:
    for index in range(3):
        path = frame_folder(dataset, index) / "record.json"
        table = json.loads(path.read_text())
        for view in table["views"].values():
            for marker in view["markers"]:
                marker["center_ellipse_px"] = marker["center_proj_px"] = [1e308, -1e308]
            if view["box_visible_xywh_px"] is not None:
                view["box_visible_xywh_px"] = [-1e308, 0.0, 1e308, 1e308]
        path.write_text(json.dumps(table))
    with redirect_stdout(io.StringIO()):
        assert run(["preview", str(dataset), "--out", str(tmp_path / "sheet.png")]) == DONE
    assert (tmp_path / "sheet.png").stat().st_size > 0


def test_a_number_of_many_digits_is_named_with_its_file(dataset: Path, tmp_path: Path) -> None:
    path = frame_folder(dataset, 1) / "record.json"
    path.write_text(path.read_text().replace('"frame_index":1', '"frame_index":' + "1" * 5000))
    assert "record.json: is truncated or not JSON: has a number of 5000 digits" in refusal(
        "preview", dataset, "--out", tmp_path / "sheet.png"
    )
