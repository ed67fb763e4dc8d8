"""Rigs from the CameraInfo of ROS, in messages and in files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from datasets_manifest.calibration.stereo_calibration import (
    calibrated_lens,
    camera_of_matrix,
    distortion_of_coefficients,
    nearest_rotation,
    rig_of_rectification,
)
from geometry.distortion import Lens
from geometry.stereo import StereoRig

# Models whose coefficients are OpenCV's; drivers of ideal cameras leave the name empty.
_MODELS = ("plumb_bob", "rational_polynomial", "")


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

    Source: the definition of `sensor_msgs/CameraInfo`.
    """

    name: str
    size_px: tuple[int, int]
    distortion_model: str
    D: ArrayLike
    K: ArrayLike
    R: ArrayLike
    P: ArrayLike


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
    names = f"{left.name}: P", f"{right.name}: P"
    return rig_of_rectification(_lens(left), _lens(right), left.P, right.P, names, unit_m)


def _lens(info: CameraInfo) -> Lens:
    if not np.any(np.asarray(info.K)):
        raise ValueError(f"{info.name}: K is 0: the camera is not calibrated")
    if info.distortion_model not in _MODELS and np.any(np.asarray(info.D)):
        raise ValueError(
            f"{info.name}: distortion model {info.distortion_model!r} is not read; calibrate with plumb_bob or "
            "rational_polynomial"
        )
    return calibrated_lens(
        camera_of_matrix(info.K, info.size_px, f"{info.name}: K"),
        distortion_of_coefficients(info.D, f"{info.name}: D"),
        nearest_rotation(info.R, f"{info.name}: R"),
        f"{info.name}: D",
    )
