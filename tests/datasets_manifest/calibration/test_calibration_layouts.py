"""Calibration files of ROS, Kalibr, EuRoC and ORB-SLAM, and files that are none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from datasets_manifest.calibration.calibration_reader import read_calibration
from geometry.se3 import exp_twist
from tests.support.stereo_calibrations import (
    D1,
    D2,
    INTRINSICS,
    M1,
    M2,
    P1,
    P2,
    R1,
    R2,
    SIZE,
    SIZE_PX,
    R,
    T,
    check_rig,
    storage,
)


def matrix_table(values: np.ndarray, decimals: int | None = None) -> dict[str, Any]:
    values = np.atleast_2d(values if decimals is None else np.round(values, decimals))
    return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}


def camera_info_tables(decimals: int | None = None) -> list[dict[str, Any]]:
    """Tables of `camera_info` files, with as many decimals as ROS's calibrator prints."""
    return [
        {
            **SIZE,
            "camera_name": name,
            "distortion_model": "plumb_bob",
            "camera_matrix": matrix_table(M, decimals),
            "distortion_coefficients": matrix_table(D, decimals),
            "rectification_matrix": matrix_table(rotation, decimals),
            "projection_matrix": matrix_table(P, decimals),
        }
        for name, M, D, rotation, P in (("left", M1, D1, R1, P1), ("right", M2, D2, R2, P2))
    ]


def write_yaml(
    folder: Path, *tables: Any, names: tuple[str, ...] = ("left.yaml", "right.yaml"), head: str = ""
) -> list[Path]:
    paths = [folder / name for name in names[: len(tables)]]
    for path, table in zip(paths, tables, strict=True):
        path.write_text(head + yaml.safe_dump(table))
    return paths


@pytest.mark.parametrize(("head", "decimals"), [("", 6), ("%YAML:1.0\n---\n", None), ("---\n", 5)])
def test_camera_info_of_both_cameras(head: str, decimals: int | None, tmp_path: Path) -> None:
    # Some programs put OpenCV's header before ROS's tables.
    found = read_calibration(write_yaml(tmp_path, *camera_info_tables(decimals), head=head))
    assert found.layout == "ROS" and found.is_rectification_given
    check_rig(found.rig, R1, atol_px=1e-8 if decimals is None else 2140 * 3 * 0.5 * 10**-decimals)


@pytest.mark.parametrize("is_ros_1", [True, False])
def test_printed_messages_are_camera_info(is_ros_1: bool, tmp_path: Path) -> None:
    tables = []
    for table in camera_info_tables():
        names = {
            "D": "distortion_coefficients",
            "K": "camera_matrix",
            "R": "rectification_matrix",
            "P": "projection_matrix",
        }
        matrices = {name if is_ros_1 else name.lower(): table[key]["data"] for name, key in names.items()}
        tables.append(
            {"header": {"frame_id": ""}, "width": 1280, "height": 960, "distortion_model": "plumb_bob", **matrices}
        )
    paths = write_yaml(tmp_path, *tables)
    for path in paths:
        path.write_text(path.read_text() + "---\n")
    check_rig(read_calibration(paths).rig, R1)


def test_numbers_that_yaml_takes_for_text_are_numbers(tmp_path: Path) -> None:
    paths = write_yaml(tmp_path, *camera_info_tables())
    for path in paths:
        text = path.read_text()
        assert "0.0001" in text
        path.write_text(text.replace("0.0001", "1e-4"))
        assert "1e-4" in yaml.safe_load(path.read_text())["distortion_coefficients"]["data"] or "left" not in path.name
    check_rig(read_calibration(paths).rig, R1)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"distortion_model": "equidistant"}, r"right\.yaml: distortion model 'equidistant' is not read"),
        ({"distortion_model": None, "camera_model": "fisheye"}, r"right\.yaml: distortion model 'fisheye' is not read"),
        (
            {"camera_matrix": matrix_table(M2 + np.eye(3, k=1) * [[-0.97], [0], [0]])},
            "right.yaml: camera_matrix: has a skew of -0.97 px",
        ),
        (
            {"camera_matrix": matrix_table(np.zeros((3, 3)))},
            r"right\.yaml: camera_matrix: is 0: the camera is not calibrated",
        ),
        ({"camera_matrix": None}, r"right\.yaml: lacks camera_matrix"),
        ({"image_width": "wide"}, r"right\.yaml: lacks image_width or image_height"),
        ({"rectification_matrix": {"data": "x"}}, r"right\.yaml: rectification_matrix: must be numbers"),
        (
            {"projection_matrix": matrix_table(P1)},
            r"right\.yaml: projection_matrix: entry .0, 3. must be -fx times the baseline",
        ),
    ],
)
def test_camera_info_that_cannot_be_used_is_refused(change: dict[str, Any], fault: str, tmp_path: Path) -> None:
    left, right = camera_info_tables()
    with pytest.raises(ValueError, match=fault):
        read_calibration(write_yaml(tmp_path, left, right | change))


def test_the_order_of_files_matters(tmp_path: Path) -> None:
    left, right = write_yaml(tmp_path, *camera_info_tables())
    with pytest.raises(
        ValueError,
        match=r"right\.yaml: projection_matrix: is that of a right camera, and .*left\.yaml: .* of a left one; swap",
    ):
        read_calibration([right, left])
    with pytest.raises(ValueError, match="is a file for each camera, the left one first, got 1"):
        read_calibration([left])


CHAIN: dict[str, Any] = {
    "cam0": {
        "cam_overlaps": [1],
        "camera_model": "pinhole",
        "distortion_coeffs": D2[:4].tolist(),
        "distortion_model": "radtan",
        "intrinsics": [2140.0, 2138.0, 650.0, 470.0],
        "resolution": [1280, 960],
        "rostopic": "/cam0/image_raw",
    },
    "cam1": {
        "T_cn_cnm1": np.vstack([np.column_stack([R, T]), [0, 0, 0, 1]]).tolist(),
        "cam_overlaps": [0],
        "camera_model": "pinhole",
        "distortion_coeffs": D2[:4].tolist(),
        "distortion_model": "radtan",
        "intrinsics": [2129.0, 2131.0, 633.0, 484.0],
        "resolution": [1280, 960],
        "rostopic": "/cam1/image_raw",
    },
}
CHAIN_R1 = cv2.stereoRectify(M1, D2, M2, D2, SIZE_PX, R, T[:, None], flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1)[0]
CAMERA_FROM_IMU = exp_twist([0.1, -0.2, 0.3, 1.2, -0.7, 2.0]).as_matrix()


def test_a_camera_chain_of_kalibr(tmp_path: Path) -> None:
    check_rig(read_calibration(write_yaml(tmp_path, CHAIN)).rig, CHAIN_R1, D1=D2)
    # Calibrated with an IMU, and the pose of the camera before left out.
    right_from_left = np.array(CHAIN["cam1"]["T_cn_cnm1"])
    cam0 = CHAIN["cam0"] | {"T_cam_imu": CAMERA_FROM_IMU.tolist()}
    cam1 = {key: value for key, value in CHAIN["cam1"].items() if key != "T_cn_cnm1"}
    cam1["T_cam_imu"] = (right_from_left @ CAMERA_FROM_IMU).tolist()
    check_rig(read_calibration(write_yaml(tmp_path, {"cam0": cam0, "cam1": cam1})).rig, CHAIN_R1, D1=D2)
    # OpenVINS has the inverse, behind OpenCV's header.
    for camera in (cam0, cam1):
        camera["T_imu_cam"] = np.linalg.inv(camera.pop("T_cam_imu")).tolist()
    paths = write_yaml(tmp_path, {"cam0": cam0, "cam1": cam1}, head="%YAML:1.0\n")
    check_rig(read_calibration(paths).rig, CHAIN_R1, D1=D2)
    del cam1["T_imu_cam"]
    with pytest.raises(ValueError, match="cam1: lacks T_cn_cnm1"):
        read_calibration(write_yaml(tmp_path, {"cam0": cam0, "cam1": cam1}))


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"distortion_model": "equidistant"}, "cam1: lens model pinhole-equidistant is not read"),
        (
            {"distortion_model": "equidistant", "distortion_coeffs": [0.0] * 4},
            "cam1: lens model pinhole-equidistant is not read",
        ),
        ({"distortion_model": "fov", "distortion_coeffs": []}, "cam1: lens model pinhole-fov is not read"),
        ({"camera_model": "omni"}, "cam1: lens model omni-radtan is not read"),
        ({"distortion_coeffs": [0.1]}, "cam1: distortion coefficients: must be k1, k2, p1, p2"),
        ({"T_cn_cnm1": None}, "cam1: T_cn_cnm1: must"),
        ({"T_cn_cnm1": np.eye(4).T.tolist()}, "baseline"),
        ({"T_cn_cnm1": np.array(CHAIN["cam1"]["T_cn_cnm1"]).T.tolist()}, "its last row must be 0 0 0 1"),
        (
            {"T_cn_cnm1": np.linalg.inv(CHAIN["cam1"]["T_cn_cnm1"]).tolist()},
            "T_cn_cnm1: the right .* are the two swapped",
        ),
        ({"resolution": [640, 480]}, "outside the image of 640x480 px"),
        ({"resolution": 640}, "cam1: resolution: must be width and height"),
        ({"intrinsics": [2129.0, 2131.0, 633.0]}, "cam1: intrinsics: must have 4x1 entries"),
    ],
)
def test_a_chain_that_cannot_be_used_is_refused(change: dict[str, Any], fault: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=fault):
        read_calibration(write_yaml(tmp_path, CHAIN | {"cam1": CHAIN["cam1"] | change}))


def test_more_or_fewer_cameras_than_two_are_refused(tmp_path: Path) -> None:
    for chain in (CHAIN | {"cam2": CHAIN["cam1"]}, {"cam0": CHAIN["cam0"]}):
        with pytest.raises(ValueError, match=r"left\.yaml: must have the cameras cam0 .left. and cam1"):
            read_calibration(write_yaml(tmp_path, chain))
    with pytest.raises(ValueError, match="camchain is one file with both cameras, got 2"):
        read_calibration(write_yaml(tmp_path, CHAIN, CHAIN))


def sensor_files() -> list[dict[str, Any]]:
    left_from_body = CAMERA_FROM_IMU
    right_from_body = np.array(CHAIN["cam1"]["T_cn_cnm1"]) @ left_from_body
    return [
        {
            "sensor_type": "camera",
            "T_BS": {"rows": 4, "cols": 4, "data": np.linalg.inv(transform).ravel().tolist()},
            "rate_hz": 20,
            "resolution": [1280, 960],
            "camera_model": "pinhole",
            "intrinsics": CHAIN[camera]["intrinsics"],
            "distortion_model": "radial-tangential",
            "distortion_coefficients": D2[:4].tolist(),
        }
        for camera, transform in (("cam0", left_from_body), ("cam1", right_from_body))
    ]


def test_the_sensor_files_of_euroc(tmp_path: Path) -> None:
    paths = write_yaml(tmp_path, *sensor_files())
    found = read_calibration(paths)
    assert found.layout == "EuRoC" and not found.is_rectification_given
    check_rig(found.rig, CHAIN_R1, D1=D2)
    with pytest.raises(ValueError, match=r"left\.yaml: T_BS: .* are the two swapped"):
        read_calibration(paths[::-1])
    left, right = sensor_files()
    with pytest.raises(ValueError, match=r"right\.yaml: lacks intrinsics|not a calibration"):
        read_calibration(write_yaml(tmp_path, left, {key: v for key, v in right.items() if key != "intrinsics"}))


def orb_slam_settings(path: Path, values: dict[str, Any]) -> Path:
    """OpenCV reads names with points, and does not write them."""
    storage(path, {name.replace(".", "_point_"): value for name, value in values.items()})
    path.write_text(path.read_text().replace("_point_", "."))
    return path


def test_the_settings_of_orb_slam(tmp_path: Path) -> None:
    sides = (("LEFT", M1, D1, R1, P1), ("RIGHT", M2, D2, R2, P2))
    values: dict[str, Any] = {"Camera.fx": 2133.0, "Camera.width": 1280}
    for side, M, D, rotation, P in sides:
        values |= {f"{side}.width": 1280, f"{side}.height": 960}
        values |= {f"{side}.D": D, f"{side}.K": M, f"{side}.R": rotation, f"{side}.P": P}
    found = read_calibration([orb_slam_settings(tmp_path / "settings.yaml", values)])
    assert found.is_rectification_given
    check_rig(found.rig, R1)
    del values["RIGHT.P"]
    with pytest.raises(ValueError, match=r"less\.yaml: lacks RIGHT\.P, as ORB-SLAM names them"):
        read_calibration([orb_slam_settings(tmp_path / "less.yaml", values)])


@pytest.mark.parametrize(
    "content",
    [
        "",
        "hello",
        "%YAML:1.0\n---\nM1: 3\n",
        "{",
        "{}",
        "[1, 2]",
        "%YAML:1.0\n---\nimage_width: [1",
        "a: &x [*x, *x]",
        "M1: [[1",
    ],
)
def test_files_that_are_no_calibration_are_named(content: str, tmp_path: Path) -> None:
    path = tmp_path / "stereo.yaml"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"stereo\.yaml"):
        read_calibration([path])


def test_places_without_a_calibration_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none\.yaml: there is no such calibration"):
        read_calibration([tmp_path / "none.yaml"])
    np.savez(tmp_path / "stereo.npz", **INTRINSICS)
    with pytest.raises(ValueError, match=r"stereo\.npz: is not a text file"):
        read_calibration([tmp_path / "stereo.npz"])
    (tmp_path / "large.yaml").write_text("a" * 2_000_000)
    with pytest.raises(ValueError, match=r"large\.yaml: is too large"):
        read_calibration([tmp_path / "large.yaml"])
