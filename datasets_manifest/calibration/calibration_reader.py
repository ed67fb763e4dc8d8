"""Reads the stereo calibrations of other programs: OpenCV, ROS, Kalibr, ORB-SLAM, and EuRoC's layout.

Kalibr's camera chain and EuRoC's `sensor.yaml` hold the poses of the cameras.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from yaml import MarkedYAMLError
from yaml.reader import ReaderError

from datasets_manifest.calibration.camera_info import camera_info_of_table, is_camera_info, rig_of_camera_info
from datasets_manifest.calibration.opencv_storage import (
    is_table_of_matrices,
    read_calibration_text,
    read_opencv_storage,
    rig_of_tables,
)
from datasets_manifest.calibration.stereo_calibration import (
    calibrated_lens,
    camera_of_matrix,
    distortion_of_coefficients,
    finite_matrix,
    image_size,
    is_ideal_pinhole,
    nearest_rotation,
    numbers,
    rig_of_cameras,
)
from geometry.distortion import Lens
from geometry.se3 import RigidTransform
from geometry.stereo import StereoRig

_CAMERAS = ("cam0", "cam1")
# The names of radial and tangential distortion; coefficients are k1, k2, p1, p2.
_RADTAN = ("radtan", "radial-tangential")
_COUNT = 4
_LAST_ROW = (0.0, 0.0, 0.0, 1.0)
# Printed decimals.
_TOLERANCE = 1e-6


def is_camera_chain(table: Mapping[str, Any]) -> bool:
    """Whether a YAML table is Kalibr's camera chain."""
    return isinstance(table.get("cam0"), Mapping)


def is_sensor_file(table: Mapping[str, Any]) -> bool:
    """Whether a YAML table is EuRoC's description of a camera."""
    return "T_BS" in table and "intrinsics" in table


def rig_of_camera_chain(table: Mapping[str, Any], name: str, unit_m: float = 1.0) -> StereoRig:
    """The rig of Kalibr's `camchain.yaml`: `cam0` is the left camera, `cam1` the right one.

    Args:
        table: the file's.
        name: of the file, for errors.
        unit_m: the unit of the translations; Kalibr's is the metre. [m]

    Raises:
        ValueError: other lenses than `pinhole` with `radtan`, more or fewer cameras than two, or something that is
            missing or impossible; names it.

    Source: Kalibr's documentation of its YAML formats.
    """
    cameras = sorted(key for key in map(str, table) if re.fullmatch("cam[0-9]+", key))
    if cameras != list(_CAMERAS):
        raise ValueError(f"{name}: must have the cameras cam0 (left) and cam1 (right), got {', '.join(cameras)}")
    left, right = (_table(table[camera], f"{name}: {camera}") for camera in _CAMERAS)
    eyes = [_lens(camera, f"{name}: {key}") for camera, key in ((left, "cam0"), (right, "cam1"))]
    place = f"{name}: cam1: T_cn_cnm1"
    if "T_cn_cnm1" in right:
        right_from_left = _transform(right["T_cn_cnm1"], place, unit_m)
    elif "T_imu_cam" in left and "T_imu_cam" in right:
        place = f"{name}: cam1: T_imu_cam"
        imu_from_left = _transform(left["T_imu_cam"], f"{name}: cam0: T_imu_cam", unit_m)
        right_from_left = _transform(right["T_imu_cam"], place, unit_m).inverse() @ imu_from_left
    elif "T_cam_imu" in left and "T_cam_imu" in right:
        place = f"{name}: cam1: T_cam_imu"
        left_from_imu = _transform(left["T_cam_imu"], f"{name}: cam0: T_cam_imu", unit_m)
        right_from_left = _transform(right["T_cam_imu"], place, unit_m) @ left_from_imu.inverse()
    else:
        raise ValueError(f"{name}: cam1: lacks T_cn_cnm1, the pose of the right camera")
    return _rig(eyes[0], eyes[1], right_from_left, place)


def rig_of_sensor_files(
    left: Mapping[str, Any], right: Mapping[str, Any], names: tuple[str, str], unit_m: float = 1.0
) -> StereoRig:
    """The rig of the `sensor.yaml` of two cameras, as the EuRoC dataset and others in its layout have them.

    Args:
        left, right: tables of the files; `T_BS` takes points from the camera's axes to the body's.
        names: of the files, for errors.
        unit_m: the unit of the translations; EuRoC's is the metre. [m]

    Raises:
        ValueError: other lenses than pinholes with radial and tangential distortion, or something that is missing or
            impossible; names it.
    """
    eyes = [_lens(table, name) for table, name in zip((left, right), names, strict=True)]
    body_from_left, body_from_right = (
        _transform(table["T_BS"], f"{name}: T_BS", unit_m) for table, name in zip((left, right), names, strict=True)
    )
    return _rig(eyes[0], eyes[1], body_from_right.inverse() @ body_from_left, f"{names[1]}: T_BS")


def _rig(left: Lens, right: Lens, right_from_left: RigidTransform, name: str) -> StereoRig:
    size_px, other_px = ((lens.camera.width_px, lens.camera.height_px) for lens in (left, right))
    if size_px != other_px:
        raise ValueError(f"{name}: the images of both cameras must have the same size, got {size_px} and {other_px} px")
    return rig_of_cameras(left, right, right_from_left, name)


def _lens(table: Mapping[str, Any], name: str) -> Lens:
    lacks = [key for key in ("camera_model", "intrinsics", "resolution", "distortion_model") if key not in table]
    if lacks:
        raise ValueError(f"{name}: lacks {', '.join(lacks)}")
    resolution = table["resolution"]
    size_px = image_size(*resolution) if isinstance(resolution, list) and len(resolution) == 2 else None
    if size_px is None:
        raise ValueError(f"{name}: resolution: must be width and height, got {resolution}")
    given = table.get("distortion_coeffs", table.get("distortion_coefficients"))
    coefficients = numbers([] if given is None else given, f"{name}: distortion coefficients")
    model = str(table["distortion_model"])
    if table["camera_model"] != "pinhole" or not (model in _RADTAN or is_ideal_pinhole(model, coefficients)):
        raise ValueError(
            f"{name}: lens model {table['camera_model']}-{model} is not read; calibrate with pinhole-radtan"
        )
    if coefficients.size not in (0, _COUNT):
        raise ValueError(f"{name}: distortion coefficients: must be k1, k2, p1, p2, got {coefficients.tolist()}")
    fu, fv, pu, pv = finite_matrix(table["intrinsics"], (4, 1), f"{name}: intrinsics")[:, 0]
    return calibrated_lens(
        camera_of_matrix([[fu, 0, pu], [0, fv, pv], [0, 0, 1]], size_px, f"{name}: intrinsics"),
        distortion_of_coefficients(coefficients, f"{name}: distortion coefficients"),
        np.eye(3),
        f"{name}: distortion coefficients",
    )


def _transform(value: Any, name: str, unit_m: float) -> RigidTransform:
    """A rigid transform of four rows, or of a table with `data`."""
    matrix = finite_matrix(value.get("data") if isinstance(value, Mapping) else value, (4, 4), name)
    if np.abs(matrix[3] - _LAST_ROW).max() > _TOLERANCE:
        raise ValueError(f"{name}: its last row must be 0 0 0 1, got {matrix[3].tolist()}")
    return RigidTransform(nearest_rotation(matrix[:3, :3], name), matrix[:3, 3] * unit_m)


def _table(value: Any, name: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{name}: must be a table, got {str(value)[:100]}")
    return value


_KNOWN = (
    "OpenCV's stereo calibration (M1, D1, M2, D2, R, T), Kalibr's camchain, ROS's camera_info of both cameras, EuRoC's "
    "sensor.yaml of both cameras, or ORB-SLAM's settings"
)
# A calibration has a few kilobytes. Its reader takes a kilobyte of memory for every value.
_LARGEST_YAML = 2**18
_MOST_VALUES = 100_000
_OPENCV_BEGINNINGS = ("<?xml", "{")
_MATRIX_TAG = "!!opencv-matrix"


@dataclass(frozen=True, eq=False)
class StereoCalibration:
    """A rig, and what its calibration said.

    Attributes:
        rig: the cameras.
        layout: whose files they were.
        is_rectification_given: whether they hold a rectification, whose left camera then is the rig's left frame;
            otherwise it is that of OpenCV's `stereoRectify`.
    """

    rig: StereoRig
    layout: str
    is_rectification_given: bool


def read_calibration(
    paths: Sequence[Path], unit_m: float = 1.0, size_px: tuple[int, int] | None = None
) -> StereoCalibration:
    """The calibration in one file, or in two that belong together: left and right, or intrinsics and extrinsics.

    Args:
        paths: the files; of a file for each camera the left one first.
        unit_m: the unit of the baseline. [m]
        size_px: (width, height) of the images, where files of OpenCV do not hold it.

    Raises:
        ValueError: not a calibration, an incomplete or an impossible one; names file and key.
    """
    texts = [_text(path) for path in paths]
    if all(_is_opencv_storage(text) for text in texts):
        rig, is_given = read_opencv_storage(paths, unit_m, size_px)
        return StereoCalibration(rig, "OpenCV", is_given)
    tables = [_read_table(text, path) for text, path in zip(texts, paths, strict=True)]
    names = [str(path) for path in paths]
    if all(is_table_of_matrices(table) and not is_camera_info(table) for table in tables):
        rig, is_given = rig_of_tables(tables, paths, unit_m, size_px)
        return StereoCalibration(rig, "OpenCV's names", is_given)
    if size_px is not None:
        raise ValueError(f"{names[0]}: holds the size of its images; do not give one")
    if any(is_camera_chain(table) for table in tables):
        _check_count(paths, 1, "Kalibr's camchain is one file with both cameras")
        return StereoCalibration(rig_of_camera_chain(tables[0], names[0], unit_m), "Kalibr", False)
    if all(is_camera_info(table) for table in tables):
        _check_count(paths, 2, "ROS's camera_info is a file for each camera, the left one first")
        left, right = map(camera_info_of_table, tables, names)
        return StereoCalibration(rig_of_camera_info(left, right, unit_m), "ROS", True)
    if all(is_sensor_file(table) for table in tables):
        _check_count(paths, 2, "EuRoC's sensor.yaml is a file for each camera, the left one first")
        rig = rig_of_sensor_files(tables[0], tables[1], (names[0], names[1]), unit_m)
        return StereoCalibration(rig, "EuRoC", False)
    raise ValueError(f"{' and '.join(names)}: is not a calibration that can be read; give {_KNOWN}")


def _check_count(paths: Sequence[Path], count: int, rule: str) -> None:
    if len(paths) != count:
        raise ValueError(f"calibration: {rule}, got {len(paths)} ({', '.join(map(str, paths))})")


def _text(path: Path) -> str:
    try:
        return read_calibration_text(path)
    except OSError as error:
        if isinstance(error, FileNotFoundError | IsADirectoryError):
            raise ValueError(f"{path}: there is no such calibration file") from error
        if error.errno == errno.EFBIG:
            raise ValueError(f"{path}: is too large for a calibration; give {_KNOWN}") from error
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is not a text file; give {_KNOWN}") from error


def _check_value_count(table: object) -> None:
    """Refuse a table whose references stand for more values than it holds, or for itself.

    Raises:
        ValueError: it stands for too many.
    """
    waiting, count = [table], 0
    while waiting:
        value = waiting.pop()
        inner = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple | set) else ()
        waiting += inner
        count += 1
        if count > _MOST_VALUES or len(waiting) > _MOST_VALUES:
            raise ValueError(f"stands for more than {_MOST_VALUES} values")


def _is_opencv_storage(text: str) -> bool:
    """Whether a text is OpenCV's storage; other programs put its header before plain YAML."""
    return text.lstrip().startswith(_OPENCV_BEGINNINGS) or _MATRIX_TAG in text


def _read_table(text: str, path: Path) -> Mapping[str, Any]:
    """The first document of a YAML file."""
    if len(text) > _LARGEST_YAML:
        raise ValueError(f"{path}: is too large for a calibration; give {_KNOWN}")
    # OpenCV's header is no directive of YAML; a blank line in its place keeps the numbers of the others.
    lines = ["" if line.startswith("%YAML") else line for line in text.splitlines()]
    try:
        table = next(iter(yaml.safe_load_all("\n".join(lines))), None)
        _check_value_count(table)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: is not YAML: {_yaml_fault(error)}; correct it, or write it anew") from error
    if not isinstance(table, Mapping):
        raise ValueError(f"{path}: is not a calibration that can be read; give {_KNOWN}")
    return table


def _yaml_fault(error: Exception) -> str:
    """The reason for which a text is no YAML that is read, with its place but without the names of the parser's."""
    if isinstance(error, MarkedYAMLError) and error.problem_mark is not None:
        mark = error.problem_mark
        return f"line {mark.line + 1}, column {mark.column + 1}: {error.problem}"
    if isinstance(error, ReaderError):
        return f"it holds the character {error.character:#04x}, which is not allowed in YAML"
    return "it is nested too deep" if isinstance(error, RecursionError) else " ".join(str(error).split())[:200]
