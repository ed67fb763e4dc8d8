"""Rigs from ROS's CameraInfo, in messages and in files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from datasets_manifest.calibration.stereo_calibration import (
    calibrated_lens,
    camera_of_matrix,
    distortion_of_coefficients,
    image_size,
    is_ideal_pinhole,
    nearest_rotation,
    numbers,
    rig_of_rectification,
)
from geometry.distortion import Lens
from geometry.stereo import StereoRig

# Models whose coefficients are OpenCV's; drivers of ideal cameras leave the name empty.
_MODELS = ("plumb_bob", "rational_polynomial", "")
_FILE_KEYS = {
    "D": "distortion_coefficients",
    "K": "camera_matrix",
    "R": "rectification_matrix",
    "P": "projection_matrix",
}


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """What ROS says about one camera of a stereo pair.

    Attributes:
        name: topic or file, for errors.
        size_px: (width, height) of the images.
        distortion_model: `plumb_bob`, `rational_polynomial` or empty; both have OpenCV's coefficients.
        D: distortion coefficients, as many as the model has; none for an ideal lens.
        K: (3, 3) intrinsics of the delivered images, or its entries row by row. [px]
        R: (3, 3) rotation from the camera's axes to those of the rectified pair.
        P: (3, 4) projection of the rectified images; the right one's last column begins with -fx B. [px, px m]
        keys: what D, K, R and P are called in the file, where it has other names for them.

    Source: the definition of `sensor_msgs/CameraInfo`.
    """

    name: str
    size_px: tuple[int, int]
    distortion_model: str
    D: object
    K: object
    R: object
    P: object
    keys: Mapping[str, str] = field(default_factory=dict)

    def place(self, matrix: str) -> str:
        """Camera and key of `D`, `K`, `R` or `P`, as errors call it."""
        return f"{self.name}: {self.keys.get(matrix, matrix)}"


def rig_of_camera_info(left: CameraInfo, right: CameraInfo, unit_m: float = 1.0) -> StereoRig:
    """The rig of a stereo pair; its left frame is the rectified left camera that R and P describe.

    Images that are rectified already have D = 0, R = 1 and the left part of P as K, and give a rig without lenses.

    Args:
        left, right: of the two cameras.
        unit_m: the unit of the baseline; ROS's is the metre. [m]

    Raises:
        ValueError: a camera that is not calibrated, another lens model, or matrices that do not rectify the pair; names
            the camera and the field.
    """
    if left.size_px != right.size_px:
        raise ValueError(f"{right.name}: its images have {right.size_px} px, and those of {left.name} {left.size_px}")
    names = left.place("P"), right.place("P")
    return rig_of_rectification((_lens(left), _lens(right)), (left.P, right.P), names, unit_m)


def is_camera_info(table: Mapping[str, Any]) -> bool:
    """Whether a YAML table is a `camera_info` file, or a printed message."""
    return "projection_matrix" in table or "P" in table or ("p" in table and "k" in table)


def camera_info_of_table(table: Mapping[str, Any], name: str) -> CameraInfo:
    """One camera of a YAML table: a `camera_info` file, or a message as `ros2 topic echo` and `rostopic echo` print it.

    Args:
        table: the file's.
        name: of the file, for errors.

    Raises:
        ValueError: something is missing or of another form; names it.
    """
    matrices: dict[str, Any] = {}
    keys: dict[str, str] = {}
    for matrix, usual in _FILE_KEYS.items():
        keys[matrix] = next((key for key in (usual, matrix, matrix.lower()) if key in table), usual)
        found = table.get(keys[matrix])
        found = found.get("data") if isinstance(found, Mapping) else found
        if found is None:
            raise ValueError(f"{name}: lacks {keys[matrix]}, as ROS's calibrator names it")
        matrices[matrix] = found
    size_px = image_size(table.get("image_width", table.get("width")), table.get("image_height", table.get("height")))
    if size_px is None:
        raise ValueError(f"{name}: lacks image_width or image_height")
    # Of fisheye lenses ROS's calibrator writes no other model than this.
    model = str(table.get("distortion_model") or table.get("camera_model") or "")
    return CameraInfo(name, size_px, "" if model == "pinhole" else model, **matrices, keys=keys)


def _lens(info: CameraInfo) -> Lens:
    matrix, coefficients = numbers(info.K, info.place("K")), numbers(info.D, info.place("D"))
    if not matrix.any():
        raise ValueError(f"{info.place('K')}: is 0: the camera is not calibrated")
    if info.distortion_model not in _MODELS and not is_ideal_pinhole(info.distortion_model, coefficients):
        raise ValueError(
            f"{info.name}: distortion model {info.distortion_model!r} is not read; calibrate with plumb_bob or "
            "rational_polynomial, or leave the name empty where the images are rectified"
        )
    return calibrated_lens(
        camera_of_matrix(matrix, info.size_px, info.place("K")),
        distortion_of_coefficients(coefficients, info.place("D")),
        nearest_rotation(info.R, info.place("R")),
        info.place("D"),
    )
