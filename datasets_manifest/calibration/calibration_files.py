"""The rig's calibration in the files of OpenCV, Kalibr and ROS."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from geometry.distortion import Lens
from geometry.se3 import Array
from geometry.stereo import EYES, Eye, StereoRig

OPENCV_STEREO_FILE = "opencv_stereo.yaml"

KALIBR_FILE = "kalibr_camchain.yaml"


# k1, k2, p1, p2.
_RADTAN_COUNT = 4
# k1, k2, p1, p2, k3.
_PLUMB_BOB_COUNT = 5


def calibration_files(rig: StereoRig) -> dict[str, str]:
    """All calibration files of a rig by name; without Kalibr's where it cannot describe the lenses."""
    files = {OPENCV_STEREO_FILE: opencv_stereo(rig)}
    if kalibr_fault(rig) is None:
        files[KALIBR_FILE] = kalibr_camchain(rig)
    return files | {camera_info_file(eye): camera_info(rig, eye) for eye in EYES}


def opencv_stereo(rig: StereoRig) -> str:
    """The text of a YAML file for `cv2.FileStorage`: image size and `opencv_stereo_matrices`."""
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", rig.camera.width_px)
    storage.write("image_height", rig.camera.height_px)
    for name, matrix in opencv_stereo_matrices(rig).items():
        storage.write(name, matrix)
    text: str = storage.releaseAndGetString()
    return text


def opencv_stereo_matrices(rig: StereoRig) -> dict[str, Array]:
    """A rig in the names and conventions of `cv2.stereoRectify`; the true values, without calibration errors.

    Returns:
        M1, M2: (3, 3) intrinsics of the delivered images [px]; D1, D2: (1, 5) their distortion; R, T: right from left
        [m]; R1, R2: rectifying rotations; P1, P2: (3, 4) projections of the rectified images; Q: (4, 4) from
        (u, v, disparity, 1) of those to homogeneous points [m].

    Source: OpenCV's documentation of `stereoRectify`; its pixels too count from the centre of the top-left one.
    """
    camera, baseline_m = rig.camera, rig.baseline_m
    first, second = rig.lenses or (Lens(camera), Lens(camera))
    left = np.hstack([camera.matrix(), np.zeros((3, 1))])
    right = left.copy()
    right[0, 3] = -camera.fx_px * baseline_m
    # A pixel's row counts in units of fy, its disparity in units of fx.
    row_scale = camera.fx_px / camera.fy_px
    reprojection = np.array(
        [
            [1.0, 0.0, 0.0, -camera.cx_px],
            [0.0, row_scale, 0.0, -camera.cy_px * row_scale],
            [0.0, 0.0, 0.0, camera.fx_px],
            [0.0, 0.0, 1.0 / baseline_m, 0.0],
        ]
    )
    return {
        "M1": first.camera.matrix(),
        "D1": first.distortion.coefficients()[None],
        "M2": second.camera.matrix(),
        "D2": second.distortion.coefficients()[None],
        "R": second.ideal_from_real.T @ first.ideal_from_real,
        "T": second.ideal_from_real.T @ np.array([[-baseline_m], [0.0], [0.0]]),
        "R1": np.array(first.ideal_from_real),
        "R2": np.array(second.ideal_from_real),
        "P1": left,
        "P2": right,
        "Q": reprojection,
    }


def kalibr_fault(rig: StereoRig) -> str | None:
    """The reason why Kalibr cannot describe a rig, or None."""
    if any(lens.distortion.coefficients()[_RADTAN_COUNT:].any() for lens in rig.lenses or ()):
        return "Kalibr's radtan model has no k3 and no coefficients after it, which the rig's lenses have"
    return None


def kalibr_camchain(rig: StereoRig) -> str:
    """Text of Kalibr's `camchain.yaml`, for the delivered images.

    `T_cn_cnm1` takes points from the camera before (cam0, the left) to this one (cam1, the right). [m]

    Raises:
        ValueError: Kalibr's distortion model cannot describe the rig's lenses.

    Source: Kalibr's documentation of its YAML formats; models `pinhole` (fu, fv, pu, pv) and `radtan` (k1, k2, p1, p2).
    """
    fault = kalibr_fault(rig)
    if fault is not None:
        raise ValueError(f"rig: {fault}; use another calibration format")
    m = opencv_stereo_matrices(rig)
    right_from_left = np.vstack([np.hstack([m["R"], m["T"]]), [0.0, 0.0, 0.0, 1.0]])
    lines = []
    for index, name in enumerate(("cam0", "cam1")):
        matrix, distortion = m[f"M{index + 1}"], m[f"D{index + 1}"][0]
        lines.append(f"{name}:")
        if index:
            lines += ["  T_cn_cnm1:", *(f"  - {yaml_list(row)}" for row in right_from_left)]
        lines += [
            f"  cam_overlaps: [{1 - index}]",
            "  camera_model: pinhole",
            f"  distortion_coeffs: {yaml_list(distortion[:4])}",
            "  distortion_model: radtan",
            f"  intrinsics: {yaml_list([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])}",
            f"  resolution: [{rig.camera.width_px}, {rig.camera.height_px}]",
            f"  rostopic: /stereo/{('left', 'right')[index]}/image_raw",
        ]
    return "\n".join(lines) + "\n"


def camera_info_file(eye: Eye) -> str:
    """Name of one eye's `camera_info` file."""
    return f"ros_{eye}.yaml"


def camera_info(rig: StereoRig, eye: Eye) -> str:
    """Text of one eye's `camera_info` file, as ROS camera drivers read it.

    Matrix and distortion are those of the delivered images; rectification and projection map to the rectified pair:
    `P[0, 3]` of the right eye is `-fx * baseline`. [px m]

    Source: the definition of `sensor_msgs/CameraInfo`; file format of the package `camera_calibration_parsers`.
    """
    m, number = opencv_stereo_matrices(rig), EYES.index(eye) + 1
    lines = [
        f"image_width: {rig.camera.width_px}",
        f"image_height: {rig.camera.height_px}",
        f"camera_name: {eye}",
        *_matrix("camera_matrix", m[f"M{number}"]),
        f"distortion_model: {ros_distortion_model(m[f'D{number}'])}",
        *_matrix("distortion_coefficients", m[f"D{number}"]),
        *_matrix("rectification_matrix", m[f"R{number}"]),
        *_matrix("projection_matrix", m[f"P{number}"]),
    ]
    return "\n".join(lines) + "\n"


def ros_distortion_model(coefficients: Array) -> str:
    """ROS's name of the model with these coefficients.

    Source: `sensor_msgs/distortion_models.hpp`.
    """
    return "plumb_bob" if coefficients.size <= _PLUMB_BOB_COUNT else "rational_polynomial"


def _matrix(name: str, values: Array) -> list[str]:
    rows, columns = values.shape
    return [f"{name}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: {yaml_list(values)}"]


def yaml_number(value: float) -> str:
    """Shortest digits that read back the same.

    YAML 1.1, which ROS and Kalibr read, takes `1e-05` for text: a number needs a point before the exponent.
    """
    digits = repr(float(value))
    mantissa, sign, exponent = digits.partition("e")
    return digits if not sign or "." in mantissa else f"{mantissa}.0e{exponent}"


def yaml_list(values: ArrayLike) -> str:
    """All numbers of an array, row by row, on one line."""
    return f"[{', '.join(yaml_number(value) for value in np.asarray(values, dtype=np.float64).ravel())}]"
