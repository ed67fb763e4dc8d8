"""The rig's calibration as ROS camera drivers read it: a `camera_info` YAML file for each eye."""

from __future__ import annotations

from datasets_manifest.calibration.opencv_matrices import opencv_stereo_matrices
from datasets_manifest.calibration.yaml_text import yaml_list
from geometry.se3 import Array
from geometry.stereo import EYES, Eye, StereoRig


def camera_info_file(eye: Eye) -> str:
    """The file of one eye."""
    return f"ros_{eye}.yaml"


def camera_info(rig: StereoRig, eye: Eye) -> str:
    """The text of one eye's file.

    Matrix and distortion are those of the delivered images, rectification and projection lead to the rectified pair:
    `P[0, 3]` of the right eye is `-fx * baseline`. [px m]

    Source: the definition of `sensor_msgs/CameraInfo`; file format of the package `camera_calibration_parsers`.
    """
    m, number = opencv_stereo_matrices(rig), EYES.index(eye) + 1
    lines = [
        f"image_width: {rig.camera.width_px}",
        f"image_height: {rig.camera.height_px}",
        f"camera_name: {eye}",
        *_matrix("camera_matrix", m[f"M{number}"]),
        "distortion_model: plumb_bob",
        *_matrix("distortion_coefficients", m[f"D{number}"]),
        *_matrix("rectification_matrix", m[f"R{number}"]),
        *_matrix("projection_matrix", m[f"P{number}"]),
    ]
    return "\n".join(lines) + "\n"


def _matrix(name: str, values: Array) -> list[str]:
    rows, columns = values.shape
    return [f"{name}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: {yaml_list(values)}"]
