"""A rig from a user's stereo calibration.

Images are not resampled. The rectified cameras of OpenCV's `stereoRectify` become the rig's ideal eyes, and the
calibrated cameras its lenses, so that navigation measures in the original images and rectifies its measurements.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from geometry.distortion import BrownConrady, Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array, RigidTransform
from geometry.stereo import StereoRig

# A baseline outside this range is taken to be in another unit. [m]
_BASELINES_M = (1e-3, 10.0)
# Radial k1, k2, tangential p1, p2, radial k3; OpenCV's longer models go on from there.
_COEFFICIENTS = 5
_SHAPES = {"M1": (3, 3), "D1": None, "M2": (3, 3), "D2": None, "R": (3, 3), "T": (3, 1)}


@dataclass(frozen=True, eq=False)
class StereoCalibration:
    """The result of `cv2.stereoCalibrate`.

    Attributes:
        size_px: (width, height) of both images.
        M1, M2: (3, 3) intrinsics of the left and the right camera. [px]
        D1, D2: (K,) distortion coefficients, OpenCV's order.
        R, T: (3, 3) and (3,) right camera's axes from the left one's. [m]
    """

    size_px: tuple[int, int]
    M1: Array
    D1: Array
    M2: Array
    D2: Array
    R: Array
    T: Array


def read_opencv_stereo(path: Path, unit_m: float = 1.0) -> StereoCalibration:
    """A calibration from OpenCV's YAML, XML or JSON storage, with the names that OpenCV's own samples use.

    Args:
        path: the file, with M1, D1, M2, D2, R, T, image_width and image_height.
        unit_m: the unit of T, which is that of the calibration board's squares. [m]

    Raises:
        ValueError: it cannot be read, or something is missing or impossible; names the file.
    """
    if not path.is_file():
        raise ValueError(f"{path}: there is no such calibration file")
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        found = {name: storage.getNode(name).mat() for name in _SHAPES}
        sizes = [storage.getNode(name) for name in ("image_width", "image_height")]
        width, height = (int(node.real()) if node.isInt() or node.isReal() else 0 for node in sizes)
    except (cv2.error, SystemError, OverflowError, ValueError) as error:
        raise ValueError(f"{path}: is not an OpenCV storage file: {' '.join(str(error).split())[:200]}") from error
    missing = [name for name, value in found.items() if value is None]
    missing += [name for name, value in (("image_width", width), ("image_height", height)) if value < 1]
    if missing:
        raise ValueError(f"{path}: lacks {', '.join(missing)}, as cv2.stereoCalibrate names them")
    matrices = {}
    for name, shape in _SHAPES.items():
        matrix = np.asarray(found[name], dtype=np.float64)
        if not np.isfinite(matrix).all() or (shape is not None and matrix.size != np.prod(shape)):
            raise ValueError(f"{path}: {name}: must be finite{f' and {shape}' if shape else ''}, got {matrix.tolist()}")
        matrices[name] = matrix.reshape(3, 3) if shape == (3, 3) else matrix.reshape(-1)
    matrices["T"] = matrices["T"] * unit_m
    return StereoCalibration((width, height), **matrices)


def rig_of_calibration(calibration: StereoCalibration) -> StereoRig:
    """The rig that a calibration describes; its left frame is the rectified left camera's.

    Raises:
        ValueError: a distortion model, an arrangement or a baseline that the rig cannot have.
    """
    left = Lens(_camera(calibration.M1, calibration.size_px, "M1"), _distortion(calibration.D1, "D1"))
    right = Lens(_camera(calibration.M2, calibration.size_px, "M2"), _distortion(calibration.D2, "D2"))
    RigidTransform(calibration.R, calibration.T)  # raises where R is no rotation
    baseline_m = float(np.linalg.norm(calibration.T))
    if not _BASELINES_M[0] <= baseline_m <= _BASELINES_M[1]:
        raise ValueError(f"T: must be in metres, and {baseline_m:g} m is not a plausible baseline; give its unit")
    if _is_ideal(calibration, left, right):
        return StereoRig(left.camera, baseline_m)
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        calibration.M1,
        left.distortion.coefficients(),
        calibration.M2,
        right.distortion.coefficients(),
        calibration.size_px,
        calibration.R,
        calibration.T,
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=-1,
    )
    if not P2[0, 3] < 0 or P2[1, 3] != 0:
        raise ValueError(
            f"T: the right camera must stand to the right of the left one, got {calibration.T.tolist()} m as its "
            "axes from the left one's (negative x); are the two swapped?"
        )
    lenses = Lens(left.camera, left.distortion, R1), Lens(right.camera, right.distortion, R2)
    return StereoRig(_camera(P1, calibration.size_px, "P1"), baseline_m, lenses=lenses)


def _camera(matrix: Array, size_px: tuple[int, int], name: str) -> PinholeCamera:
    try:
        return PinholeCamera(*size_px, *(float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2))))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _distortion(coefficients: Array, name: str) -> BrownConrady:
    if np.any(coefficients[_COEFFICIENTS:]):
        raise ValueError(
            f"{name}: must be k1, k2, p1, p2, k3; calibrate without the rational, thin-prism and tilted models, "
            f"got {coefficients.tolist()}"
        )
    given = np.zeros(_COEFFICIENTS)
    given[: len(coefficients)] = coefficients[:_COEFFICIENTS]
    return BrownConrady(*given.tolist())


def _is_ideal(calibration: StereoCalibration, left: Lens, right: Lens) -> bool:
    """Whether the images are rectified already, in which case rectification would only add rounding errors."""
    return (
        not left.distortion.coefficients().any()
        and not right.distortion.coefficients().any()
        and left.camera == right.camera
        and np.array_equal(calibration.R, np.eye(3))
        and bool(calibration.T[0] < 0)
        and not calibration.T[1:].any()
    )
