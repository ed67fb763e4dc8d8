"""Rigs from Kalibr's camera chain and from EuRoC's `sensor.yaml`, which hold the poses of the cameras."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from datasets_manifest.calibration.stereo_calibration import (
    calibrated_lens,
    camera_of_matrix,
    distortion_of_coefficients,
    finite_matrix,
    image_size,
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
    if table["camera_model"] != "pinhole" or (model not in _RADTAN and coefficients.any()):
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
