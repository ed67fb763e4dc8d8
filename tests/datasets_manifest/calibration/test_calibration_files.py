"""The files for OpenCV, Kalibr and ROS, read as those programs read them: by OpenCV and PyYAML."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from datasets_manifest.calibration.calibration_files import (
    calibration_files,
    camera_info,
    kalibr_camchain,
    opencv_stereo_matrices,
    yaml_number,
)
from datasets_manifest.recipe.rigs import resolve_rig
from datasets_manifest.storage.writer import write_calibration
from geometry.pinhole import PinholeCamera
from geometry.stereo import EYES, StereoRig, paper_rig
from tests.support.stereo_calibrations import opencv_ideal_px

RIGS = [paper_rig(), resolve_rig("paper-real", 6)[0]]
POINTS_M = np.random.default_rng(4).uniform([-0.2, -0.15, 1], [0.2, 0.15, 1], (30, 3)) * 7.0
# Numbers of 16 digits, through a few products of numbers of 1e3.
EXACT_PX = 1e-9


def data_of(table: dict[str, Any], name: str) -> np.ndarray:
    matrix = table[name]
    return np.array(matrix["data"], dtype=np.float64).reshape(matrix["rows"], matrix["cols"])


@pytest.mark.parametrize("rig", RIGS, ids=["ideal", "real"])
def test_kalibr_s_chain_projects_points_to_where_they_are_seen(rig: StereoRig) -> None:
    chain = yaml.safe_load(kalibr_camchain(rig))
    assert list(chain) == ["cam0", "cam1"]
    in_camera = POINTS_M
    if rig.lenses is not None:
        in_camera = POINTS_M @ rig.lenses[0].ideal_from_real
    for eye, camera in zip(EYES, chain.values(), strict=True):
        assert (camera["camera_model"], camera["distortion_model"]) == ("pinhole", "radtan")
        assert camera["resolution"] == [1280, 960]
        transform = np.array(camera.get("T_cn_cnm1", np.eye(4).tolist()))
        in_camera = in_camera @ transform[:3, :3].T + transform[:3, 3]
        fu, fv, pu, pv = camera["intrinsics"]
        matrix = np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1.0]])
        image, _ = cv2.projectPoints(
            in_camera, np.zeros(3), np.zeros(3), matrix, np.array(camera["distortion_coeffs"], dtype=np.float64)
        )
        np.testing.assert_allclose(image[:, 0], rig.image(POINTS_M, eye), atol=EXACT_PX)
    shift = np.linalg.norm(np.array(chain["cam1"]["T_cn_cnm1"])[:3, 3])
    assert shift == pytest.approx(0.12, rel=1e-12)


@pytest.mark.parametrize("rig", RIGS, ids=["ideal", "real"])
def test_camera_info_rectifies_what_is_seen(rig: StereoRig) -> None:
    for eye in EYES:
        table = yaml.safe_load(camera_info(rig, eye))
        assert (table["image_width"], table["image_height"], table["camera_name"]) == (1280, 960, eye)
        assert table["distortion_model"] == "plumb_bob"
        projection = data_of(table, "projection_matrix")
        # ROS's definition of the baseline: P[0, 3] = -fx B.
        assert projection[0, 3] == (0.0 if eye == "left" else -256.0)
        found = opencv_ideal_px(
            rig.image(POINTS_M, eye),
            data_of(table, "camera_matrix"),
            data_of(table, "distortion_coefficients"),
            data_of(table, "rectification_matrix"),
            projection[:, :3],
        )
        # The right eye's point in the left frame, by the whole projection matrix.
        homogeneous = np.column_stack([POINTS_M, np.ones(len(POINTS_M))]) @ projection.T
        np.testing.assert_allclose(found, homogeneous[:, :2] / homogeneous[:, 2:], atol=1e-8)


def test_a_third_radial_coefficient_has_no_place_in_kalibr(tmp_path: Path) -> None:
    rig, _ = resolve_rig({"preset": "paper-real", "eyes": {"k3": {"low": 0.01, "high": 0.01}}})
    with pytest.raises(ValueError, match="no k3"):
        kalibr_camchain(rig)
    assert [path.name for path in write_calibration(tmp_path, rig)] == [
        "opencv_stereo.yaml",
        "ros_left.yaml",
        "ros_right.yaml",
    ]
    assert "kalibr_camchain.yaml" in calibration_files(paper_rig())


@pytest.mark.parametrize("value", [0.0, 1e-5, -2.5e-300, 3e22, 0.1, 1 / 3, 2133.3333333333335])
def test_numbers_are_read_as_numbers(value: float) -> None:
    # YAML 1.1 takes 1e-05 for a word.
    read = yaml.safe_load(yaml_number(value))
    assert isinstance(read, float) and read == value


NAMES = ("M1", "D1", "M2", "D2", "R", "T", "R1", "R2", "P1", "P2", "Q")


def test_opencv_reads_what_was_written(tmp_path: Path) -> None:
    rig = paper_rig()
    path = write_calibration(tmp_path, rig)[0]
    assert path.parent == tmp_path / "calibration"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert (storage.getNode("image_width").real(), storage.getNode("image_height").real()) == (1280, 960)
    for name, matrix in opencv_stereo_matrices(rig).items():
        # The file holds 16 to 17 digits.
        np.testing.assert_allclose(storage.getNode(name).mat(), matrix, rtol=1e-15)
    assert set(opencv_stereo_matrices(rig)) == set(NAMES)
    assert storage.getNode("T").mat().ravel().tolist() == [-0.12, 0.0, 0.0]
    # The ROS and OpenCV form of the baseline: -f B.
    assert storage.getNode("P2").mat()[0, 3] == -256.0


def test_rectification_is_what_opencv_computes() -> None:
    rig = paper_rig()
    m = opencv_stereo_matrices(rig)
    r1, r2, p1, p2, q, _, _ = cv2.stereoRectify(
        m["M1"], m["D1"], m["M2"], m["D2"], (1280, 960), m["R"], m["T"], flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1
    )
    # Exact but for the rounding of a few products.
    np.testing.assert_allclose(r1, m["R1"], atol=1e-12)
    np.testing.assert_allclose(r2, m["R2"], atol=1e-12)
    # OpenCV may choose a principal point of its own: only focal length and baseline are fixed by the rig.
    for ours, theirs in ((m["P1"], p1), (m["P2"], p2)):
        np.testing.assert_allclose(theirs[[0, 1, 0], [0, 1, 3]], ours[[0, 1, 0], [0, 1, 3]], rtol=1e-12)
    np.testing.assert_allclose(q[[2, 3], [3, 2]], m["Q"][[2, 3], [3, 2]], rtol=1e-12)


def test_reprojection_matrix_inverts_the_projection() -> None:
    rig = StereoRig(PinholeCamera(640, 480, 800.0, 810.0, 320.5, 239.0), 0.25)
    points = np.random.default_rng(5).uniform([-1, -1, 2], [1, 1, 20], (20, 3))
    left, right = rig.project(points, "left"), rig.project(points, "right")
    seen = np.column_stack([left, left[:, 0] - right[:, 0], np.ones(20)]) @ opencv_stereo_matrices(rig)["Q"].T
    # Of disparities down to 10 px rounded to 1e-14 px.
    np.testing.assert_allclose(seen[:, :3] / seen[:, 3:], points, rtol=1e-11)


def test_the_same_rig_gives_the_same_bytes(tmp_path: Path) -> None:
    one, other = (write_calibration(tmp_path / name, paper_rig())[0] for name in ("a", "b"))
    assert one.read_bytes() == other.read_bytes()
