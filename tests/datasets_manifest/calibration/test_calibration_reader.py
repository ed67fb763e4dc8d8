"""Calibration files of other programs: our exports back, and files as those programs and their users write them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from datasets_manifest.calibration.calibration_files import calibration_files
from datasets_manifest.calibration.calibration_reader import read_calibration
from datasets_manifest.recipe.rigs import resolve_rig
from geometry.distortion import Lens, OpenCvDistortion
from geometry.se3 import exp_twist
from geometry.stereo import EYES, StereoRig

SIZE_PX = (1280, 960)
M1 = np.array([[2140.0, 0, 650.0], [0, 2138.0, 470.0], [0, 0, 1]])
M2 = np.array([[2129.0, 0, 633.0], [0, 2131.0, 484.0], [0, 0, 1]])
D1, D2 = np.array([-0.06, 0.02, 1e-4, -2e-4, 0.01]), np.array([-0.05, 0.01, -1e-4, 1e-4, 0.0])
R = cv2.Rodrigues(np.array([0.003, -0.02, 0.004]))[0]
T = np.array([-0.1203, 0.0007, -0.0011])
R1, R2, P1, P2, Q, *_ = cv2.stereoRectify(M1, D1, M2, D2, SIZE_PX, R, T, flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1)
INTRINSICS: dict[str, Any] = {"M1": M1, "D1": D1, "M2": M2, "D2": D2}
POSE: dict[str, Any] = {"R": R, "T": T[:, None]}
RECTIFICATION: dict[str, Any] = {"R1": R1, "R2": R2, "P1": P1, "P2": P2}
SIZE: dict[str, Any] = {"image_width": 1280, "image_height": 960}
EVERYTHING = SIZE | INTRINSICS | POSE | RECTIFICATION | {"Q": Q}

POINTS_M = np.random.default_rng(7).uniform([-0.2, -0.15, 1], [0.2, 0.15, 1], (40, 3)) * np.linspace(2, 40, 40)[:, None]


def storage(path: Path, values: dict[str, Any]) -> Path:
    """A file of `cv2.FileStorage`: YAML, XML or JSON by its name."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        file.write(name, value)
    file.release()
    return path


def check_rig(rig: StereoRig, turn: np.ndarray, D1: np.ndarray = D1, atol_px: float = 1e-8) -> None:
    """Points in the frame that `turn` takes the left camera's axes to are seen where OpenCV sees them."""
    left_px = cv2.projectPoints(POINTS_M, np.zeros(3), np.zeros(3), M1, D1)[0][:, 0]
    right_px = cv2.projectPoints(POINTS_M, cv2.Rodrigues(R)[0], T, M2, D2)[0][:, 0]
    for eye, px in zip(EYES, (left_px, right_px), strict=True):
        np.testing.assert_allclose(rig.image(POINTS_M @ turn.T, eye), px, atol=atol_px)


def long_models() -> StereoRig:
    """The paper's rig with lenses of OpenCV's whole model."""
    ideal = resolve_rig("rgb-ideal")[0]
    turn = exp_twist([0, 0, 0, 0.003, -0.004, 0.005]).rotation
    model = OpenCvDistortion(0.52, -2.5, 4e-4, -3e-4, 1.5, 0.40, -2.3, 1.4, 1e-3, -5e-4, -8e-4, 3e-4, 0.02, -0.03)
    rational = OpenCvDistortion(-0.08, 0.03, 2e-4, -1e-4, 0.01, 0.02, -0.01, 0.003)
    return StereoRig(
        ideal.camera, ideal.baseline_m, lenses=(Lens(ideal.camera, model), Lens(ideal.camera, rational, turn))
    )


RIGS = {
    "ideal": resolve_rig("rgb-ideal")[0],
    "real": resolve_rig("paper-real", 3)[0],
    "mono": resolve_rig({"preset": "mono", "width_px": 640, "height_px": 480, "focal_px": 700.5}, 3)[0],
    "bayer": resolve_rig({"preset": "paper-colour", "baseline_m": 0.2371, "eyes": {"k1": -0.07, "p2": 3e-4}}, 3)[0],
    "long": long_models(),
}
LAYOUTS = {
    "OpenCV": ("opencv_stereo.yaml",),
    "ROS": ("ros_left.yaml", "ros_right.yaml"),
    "Kalibr": ("kalibr_camchain.yaml",),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", RIGS)
def test_every_export_comes_back(name: str, layout: str, tmp_path: Path) -> None:
    rig, files = RIGS[name], calibration_files(RIGS[name])
    if layout == "Kalibr" and name == "long":
        assert "kalibr_camchain.yaml" not in files
        return
    paths = [tmp_path / file for file in LAYOUTS[layout]]
    for path in paths:
        path.write_text(files[path.name])
    found = read_calibration(paths)
    back = found.rig
    assert found.layout == layout
    assert (back.lenses is None) == (rig.lenses is None)
    # Files hold 16 digits.
    assert back.baseline_m == pytest.approx(rig.baseline_m, rel=1e-14)
    points, seen = POINTS_M, POINTS_M
    if layout != "Kalibr":
        assert found.is_rectification_given
        np.testing.assert_allclose(back.camera.matrix(), rig.camera.matrix(), rtol=1e-14)
    elif rig.lenses is not None and back.lenses is not None:
        # Kalibr's file holds no rectification: the frames agree in the axes of the left lens.
        points, seen = (POINTS_M @ one.lenses[0].ideal_from_real.T for one in (rig, back) if one.lenses is not None)
    for eye in EYES:
        np.testing.assert_allclose(back.image(seen, eye), rig.image(points, eye), atol=1e-8)
    for one, other in zip(rig.lenses or (), back.lenses or (), strict=True):
        assert type(one.distortion) is type(other.distortion)
        np.testing.assert_allclose(one.distortion.coefficients(), other.distortion.coefficients(), rtol=1e-14)


@pytest.mark.parametrize("suffix", ["yaml", "yml", "xml", "json"])
def test_the_rectification_of_a_file_is_the_frame(suffix: str, tmp_path: Path) -> None:
    found = read_calibration([storage(tmp_path / f"stereo.{suffix}", EVERYTHING)])
    assert found.layout == "OpenCV" and found.is_rectification_given
    check_rig(found.rig, R1)
    np.testing.assert_allclose(found.rig.camera.matrix(), P1[:, :3], rtol=1e-14)


def test_another_rectification_than_opencv_s_is_kept(tmp_path: Path) -> None:
    # Both rectified cameras may turn about the baseline.
    turn = cv2.Rodrigues(np.array([0.02, 0.0, 0.0]))[0]
    turned = {"R1": turn @ R1, "R2": turn @ R2}
    found = read_calibration([storage(tmp_path / "stereo.yml", EVERYTHING | turned)])
    check_rig(found.rig, turn @ R1)


def test_without_a_rectification_it_is_opencv_s(tmp_path: Path) -> None:
    found = read_calibration([storage(tmp_path / "stereo.yml", SIZE | INTRINSICS | POSE)])
    assert not found.is_rectification_given
    check_rig(found.rig, R1)


def test_the_file_of_the_documentation_is_read(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs/how-to/calibrate.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    namespace: dict[str, Any] = {}
    exec(compile(code, "calibrate.md", "exec", dont_inherit=True), namespace)
    namespace["write_stereo"](tmp_path / "stereo.yaml", SIZE_PX, (0.1, M1, D1, M2, D2, R, T[:, None], None, None))
    check_rig(read_calibration([tmp_path / "stereo.yaml"]).rig, R1)


@pytest.mark.parametrize("extrinsics", [POSE, POSE | RECTIFICATION, RECTIFICATION], ids=["pose", "both", "rectified"])
def test_intrinsics_and_extrinsics_are_two_files(extrinsics: dict[str, Any], tmp_path: Path) -> None:
    paths = [storage(tmp_path / "intrinsics.yml", INTRINSICS), storage(tmp_path / "extrinsics.yml", extrinsics)]
    for order in (paths, paths[::-1]):
        check_rig(read_calibration(order, size_px=SIZE_PX).rig, R1)
    with pytest.raises(ValueError, match=r"intrinsics\.yml and .*extrinsics\.yml: lacks image_width .* --image-size"):
        read_calibration(paths)
    with pytest.raises(ValueError, match=r"intrinsics\.yml: lacks R, T"):
        read_calibration(paths[:1], size_px=SIZE_PX)
    with pytest.raises(ValueError, match=r"extrinsics\.yml: lacks M1, D1, M2, D2"):
        read_calibration(paths[1:], size_px=SIZE_PX)


@pytest.mark.parametrize(
    "names",
    [
        ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"),
        ("K1", "D1", "K2", "D2"),
        ("CM1", "D1", "CM2", "D2"),
    ],
)
def test_other_names_of_the_same_matrices(names: tuple[str, ...], tmp_path: Path) -> None:
    renamed = dict(zip(names, INTRINSICS.values(), strict=True))
    path = storage(tmp_path / "stereo.yml", SIZE | renamed | POSE | RECTIFICATION)
    check_rig(read_calibration([path]).rig, R1)
    with pytest.raises(ValueError, match=f"M1: stands beside|{names[0]}: stands beside"):
        read_calibration([storage(tmp_path / "both.yml", EVERYTHING | renamed)])


@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_lists_of_numbers_under_opencv_s_names(suffix: str, tmp_path: Path) -> None:
    values = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in EVERYTHING.items()}
    path = tmp_path / f"stereo.{suffix}"
    path.write_text(yaml.safe_dump(values) if suffix == "yaml" else json.dumps(values))
    check_rig(read_calibration([path]).rig, R1)


@pytest.mark.parametrize("count", [8, 12, 14])
def test_long_models_of_files_are_read_in_full(count: int, tmp_path: Path) -> None:
    long = np.array([0.52, -2.5, 4e-4, -3e-4, 1.5, 0.40, -2.3, 1.4, 1e-3, -5e-4, -8e-4, 3e-4, 0.02, -0.03])[:count]
    path = storage(tmp_path / "stereo.yml", EVERYTHING | {"D1": long})
    check_rig(read_calibration([path]).rig, R1, D1=long)


@pytest.mark.parametrize("decimals", [5, 6])
def test_printed_decimals_are_read(decimals: int, tmp_path: Path) -> None:
    names = ("R", "R1", "R2")
    path = storage(tmp_path / "stereo.yml", EVERYTHING | {n: np.round(EVERYTHING[n], decimals) for n in names})
    # Half a unit of the last decimal in a few entries at a focal length of 2140 px.
    check_rig(read_calibration([path]).rig, R1, atol_px=2140 * 3 * 0.5 * 10**-decimals)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"M1": M1.T}, r"stereo\.yml: M1: is transposed"),
        ({"D2": D2[:3]}, r"stereo\.yml: D2: must have 4, 5, 8, 12 or 14"),
        ({"R": np.round(R, 2)}, r"stereo\.yml: R: is not a rotation"),
        ({"R1": 1.001 * R1}, r"stereo\.yml: R1: is not a rotation"),
        (
            {"R": R.T},
            r"stereo\.yml: P2: the rectification .* does not fit R and T: its eyes are turned by 2\.\d+ degrees",
        ),
        ({"T": 1000 * T}, r"stereo\.yml: P2: .* 0\.12\d+ m long instead of 120\.\d+ m"),
        ({"T": T * [1, 1, -5]}, r"stereo\.yml: P2: .* baseline by 3\.\d+ degrees"),
        ({"T": -T}, r"stereo\.yml: P2: .* baseline by 180 degrees"),
        ({"T": 0 * T}, r"stereo\.yml: P2: does not fit a T of 0"),
        ({"T": np.array([0.0])}, r"stereo\.yml: T: must have 3x1 entries"),
        ({"P2": P1}, r"stereo\.yml: P2: entry .0, 3. must be -fx times the baseline"),
        ({"image_width": 600}, r"stereo\.yml: M1: the principal point .* outside the image of 600x960 px"),
        ({"image_width": 0}, "lacks image_width or image_height"),
        ({"M1": "2140"}, r"stereo\.yml: M1: must have 3x3 entries"),
        ({"R2": "none"}, r"stereo\.yml: R2: must be numbers"),
    ],
)
def test_what_contradicts_is_refused(changes: dict[str, Any], fault: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=fault):
        read_calibration([storage(tmp_path / "stereo.yml", EVERYTHING | changes)])


def test_without_a_rectification_the_translation_is_named(tmp_path: Path) -> None:
    for shift, fault in ((-T, "stereo.yml: T: the right camera"), (100 * T, "stereo.yml: T: must be in metres")):
        with pytest.raises(ValueError, match=fault):
            read_calibration([storage(tmp_path / "stereo.yml", SIZE | INTRINSICS | POSE | {"T": shift})])


def test_half_a_rectification_is_refused(tmp_path: Path) -> None:
    values = {name: value for name, value in EVERYTHING.items() if name not in ("P1", "P2")}
    with pytest.raises(ValueError, match=r"stereo\.yml: has R1, R2 alone; give R1, R2, P1 and P2, or none"):
        read_calibration([storage(tmp_path / "stereo.yml", values)])


def test_files_that_differ_are_refused(tmp_path: Path) -> None:
    one, other = storage(tmp_path / "a.yml", EVERYTHING), storage(tmp_path / "b.yml", EVERYTHING | {"T": 2 * T})
    with pytest.raises(ValueError, match=r"b\.yml: T: differs from .*a\.yml: T"):
        read_calibration([one, other])


def test_an_image_size_that_contradicts_is_refused(tmp_path: Path) -> None:
    path = storage(tmp_path / "stereo.yml", EVERYTHING)
    assert read_calibration([path], size_px=SIZE_PX).rig.camera.width_px == 1280
    with pytest.raises(ValueError, match=r"--image-size: .*stereo\.yml is for images of 1280x960 px"):
        read_calibration([path], size_px=(640, 480))


def test_millimetres_are_scaled(tmp_path: Path) -> None:
    values = EVERYTHING | {"T": 1000 * T, "P2": P2 * [1, 1, 1, 1000]}
    path = storage(tmp_path / "stereo.yml", values)
    with pytest.raises(ValueError, match=r"120\.\d+ m is not a plausible baseline"):
        read_calibration([path])
    check_rig(read_calibration([path], unit_m=1e-3).rig, R1)


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
CHAIN_R1 = cv2.stereoRectify(M1, D2, M2, D2, SIZE_PX, R, T, flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1)[0]
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
