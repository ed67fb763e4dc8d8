"""`import` with the calibrations of other programs: the same poses as without, and one line where it cannot be."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from datasets_manifest.calibration.calibration_files import calibration_files
from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.layout import BLIND_FILE
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import PoseEstimate, read_estimates
from datasets_manifest.types.field_types import write_rig
from droguekit.cli.main import DONE, WRONG_INPUT, run
from geometry.se3 import RigidTransform
from geometry.stereo import StereoRig
from tests.support.recipe_builder import recipe_text, stations
from tests.support.small_datasets import rendered

# The shipped rigs with half their pixels a side, which are quick to render.
SMALL: dict[str, Any] = {"width_px": 640, "height_px": 480, "focal_px": 1066.0}
RIGS: dict[str, dict[str, Any]] = {
    "ideal": {"preset": "rgb-ideal"},
    "real": {
        "preset": "paper-real",
        "eyes": {
            "k1": -0.06,
            "k2": 0.02,
            "p1": 1e-4,
            "principal_point_px": 6.0,
            "focal_fraction": 0.003,
            "right_rotation_deg": 0.4,
        },
    },
    "mono": {"preset": "mono"},
    "bayer": {"preset": "paper-colour", "eyes": {"k1": -0.05, "right_rotation_deg": 0.2}},
}


@pytest.fixture(scope="module", params=RIGS)
def dataset(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three pairs of one of the rigs, with its calibration files."""
    recipe = recipe_text(
        name="calibrated",
        seed=5,
        rig=RIGS[request.param] | SMALL,
        frames={"count": 3, "scenes": 3},
        distance=stations(2.0, 4.0, 8.0),
        environment={"clouds": {"scene_fraction": 0.0}},
        render={"engine": "analytic"},
    )
    return rendered(recipe, tmp_path_factory.mktemp(request.param) / "dataset")


def pictures(rendering: Path, folder: Path) -> Path:
    """The images as a folder for each eye; a Bayer sensor's as the camera's software interpolates them."""
    source = Dataset(rendering)
    for eye in ("left", "right"):
        (folder / eye).mkdir(parents=True)
        for index in source.frame_indices:
            pixels = getattr(source.images(index), eye)
            image = pixels if pixels.ndim == 2 else pixels[:, :, ::-1]
            assert cv2.imwrite(str(folder / eye / f"{index:04d}.png"), image)
    return folder


def estimates(images: Path, out: Path) -> dict[int, PoseEstimate]:
    assert run(["navigate", str(images), "--method", "joint", "--out", str(out)]) == DONE
    return {e.frame_index: e for e in read_estimates(out) if isinstance(e, PoseEstimate)}


def same_pixels(rendering: Path, imported: Path, folder: Path) -> Path:
    """The rendered dataset itself; of a Bayer sensor the imported, interpolated images with the dataset's own rig."""
    if Dataset(rendering).images(0).left_mosaic is None:
        return rendering
    shutil.copytree(imported, folder)
    table = json.loads((folder / BLIND_FILE).read_text())
    table["rig"] = write_rig(Dataset(rendering).manifest.recipe.rig)
    (folder / BLIND_FILE).write_text(json.dumps(table))
    return folder


def turn_to_rig(rig: StereoRig) -> np.ndarray:
    return np.eye(3) if rig.lenses is None else rig.lenses[0].ideal_from_real


LAYOUTS = {
    "opencv": ["opencv_stereo.yaml"],
    "ros": ["ros_left.yaml", "ros_right.yaml"],
    "kalibr": ["kalibr_camchain.yaml"],
}


def test_poses_are_those_of_the_dataset(dataset: Path, tmp_path: Path) -> None:
    source = Dataset(dataset)
    folder = pictures(dataset, tmp_path / "pictures")
    black_level = source.record(0).image_black_level_dn
    want: dict[int, PoseEstimate] = {}
    for layout, files in LAYOUTS.items():
        calibrations = [part for file in files for part in ("--calibration", str(dataset / "calibration" / file))]
        out = tmp_path / layout
        order = ["import", str(folder), "--out", str(out), *calibrations]
        assert run([*order, "--encoding", source.images(0).encoding, "--black-level", str(black_level)]) == DONE
        if not want:
            want = estimates(same_pixels(dataset, out, tmp_path / "direct"), tmp_path / "direct.jsonl")
            assert len(want) == 3
        rig, back = source.manifest.recipe.rig, BlindDataset(out).pair(0).rig
        # Kalibr's files hold no rectification, so that OpenCV's is the frame; it differs by a turn about the left eye.
        turn = turn_to_rig(back) @ turn_to_rig(rig).T
        if layout != "kalibr":
            np.testing.assert_allclose(turn, np.eye(3), atol=1e-14)
        got = estimates(out, tmp_path / f"{layout}.jsonl")
        assert sorted(got) == sorted(want)
        for index, estimate in want.items():
            pose, direct = got[index].left_from_drogue, estimate.left_from_drogue
            direct = RigidTransform(turn, np.zeros(3)) @ direct
            deviation_m = np.sqrt(np.diag(estimate.covariance)[:3])
            assert (np.abs(pose.translation_m - direct.translation_m) < deviation_m / 10).all()
            # The axis: pitch and yaw, for the roll of a ring of equal markers is known up to its symmetry.
            deviation_rad = np.sqrt(np.diag(estimate.covariance)[3:5].min())
            assert np.arccos(min(1.0, pose.rotation[:, 2] @ direct.rotation[:, 2])) < deviation_rad / 10


def order(folder: Path, out: Path, *calibrations: Path) -> list[str]:
    parts = [part for path in calibrations for part in ("--calibration", str(path))]
    return ["import", str(folder), "--out", str(out), *parts]


@pytest.fixture
def flight(tmp_path: Path, smoke_dataset: Path) -> Path:
    """One pair in a folder for each eye."""
    folder = tmp_path / "flight"
    for eye in ("left", "right"):
        (folder / eye).mkdir(parents=True)
        shutil.copy(smoke_dataset / "frames" / "000000" / f"{eye}.png", folder / eye / "0000.png")
    return folder


def test_the_rig_is_told(flight: Path, smoke_dataset: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    rig = Dataset(smoke_dataset).manifest.recipe.rig
    path = tmp_path / "stereo.yaml"
    path.write_text(calibration_files(rig)["opencv_stereo.yaml"])
    assert run(order(flight, tmp_path / "a", path)) == DONE
    said = "".join(capfd.readouterr())
    camera = rig.camera
    assert f"baseline {rig.baseline_m:g} m, images of {camera.width_px}x{camera.height_px} px" in said
    assert f"left: focal lengths {camera.fx_px:.6g}, {camera.fy_px:.6g} px" in said
    assert "the images are rectified" in said and "warning" not in said


def test_centimetres_that_pass_for_metres_are_warned_of(
    flight: Path, smoke_dataset: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    rig = Dataset(smoke_dataset).manifest.recipe.rig
    path = tmp_path / "stereo.yaml"
    # 6 cm, as somebody calibrates with a board whose squares he gave in centimetres.
    far = StereoRig(rig.camera, 6.0)
    path.write_text(calibration_files(far)["opencv_stereo.yaml"])
    assert run(order(flight, tmp_path / "a", path)) == DONE
    said = "".join(capfd.readouterr())
    assert "warning: a baseline of 6 m is unusual" in said and "--calibration-unit" in said
    assert run([*order(flight, tmp_path / "b", path), "--calibration-unit", "cm"]) == DONE
    assert "warning" not in "".join(capfd.readouterr())
    assert BlindDataset(tmp_path / "b").pair(0).rig.baseline_m == pytest.approx(0.06)


def test_an_image_size_is_given_where_the_files_lack_it(
    flight: Path, smoke_dataset: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    text = (smoke_dataset / "calibration" / "opencv_stereo.yaml").read_text()
    path = tmp_path / "stereo.yaml"
    path.write_text("".join(line for line in text.splitlines(keepends=True) if not line.startswith("image_")))
    camera = Dataset(smoke_dataset).manifest.recipe.rig.camera
    assert run(order(flight, tmp_path / "a", path)) == WRONG_INPUT
    assert "stereo.yaml: lacks image_width or image_height; add them, or give --image-size" in capfd.readouterr().err
    size = f"{camera.width_px}x{camera.height_px}"
    assert run([*order(flight, tmp_path / "a", path), "--image-size", size]) == DONE
    for wrong in ("1280", "1280*960", "0x960", "big"):
        assert run([*order(flight, tmp_path / "b", path), "--image-size", wrong]) == WRONG_INPUT
        assert "--image-size: must be WIDTHxHEIGHT" in capfd.readouterr().err


def test_a_transposed_matrix_leaves_nothing(
    flight: Path, smoke_dataset: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    storage = cv2.FileStorage(str(tmp_path / "stereo.yaml"), cv2.FILE_STORAGE_WRITE)
    given = cv2.FileStorage(str(smoke_dataset / "calibration" / "opencv_stereo.yaml"), cv2.FILE_STORAGE_READ)
    for name in ("image_width", "image_height"):
        storage.write(name, int(given.getNode(name).real()))
    for name in ("M1", "D1", "M2", "D2", "R", "T"):
        matrix = given.getNode(name).mat()
        storage.write(name, matrix.T.copy() if name.startswith("M") else matrix)
    storage.release()
    assert run(order(flight, tmp_path / "a", tmp_path / "stereo.yaml")) == WRONG_INPUT
    said = capfd.readouterr().err
    assert "stereo.yaml: M1: is transposed" in said and said.count("\n") == 1
    assert not (tmp_path / "a").exists()
