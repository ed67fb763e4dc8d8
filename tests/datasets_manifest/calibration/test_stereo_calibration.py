"""Rigs of calibrations against OpenCV's own projection."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from datasets_manifest.calibration.stereo_calibration import (
    calibrated_lens,
    camera_of_matrix,
    distortion_of_coefficients,
    nearest_rotation,
    rig_of_cameras,
)
from geometry.se3 import RigidTransform
from geometry.stereo import StereoRig

SIZE_PX = (1280, 960)
# A calibration as one finds it: both cameras turned a little, and not equal.
REAL: dict[str, Any] = {
    "M1": np.array([[2140.0, 0, 650.0], [0, 2138.0, 470.0], [0, 0, 1]]),
    "D1": np.array([-0.06, 0.02, 1e-4, -2e-4, 0.01]),
    "M2": np.array([[2129.0, 0, 633.0], [0, 2131.0, 484.0], [0, 0, 1]]),
    "D2": np.array([-0.05, 0.01, -1e-4, 1e-4]),
    "R": cv2.Rodrigues(np.array([0.003, -0.02, 0.004]))[0],
    "T": np.array([-0.1203, 0.0007, -0.0011]),
}


def rig_of(**changes: Any) -> StereoRig:
    """The rig of `REAL` with other values."""
    m = REAL | changes
    left, right = (
        calibrated_lens(
            camera_of_matrix(m[f"M{number}"], SIZE_PX, f"M{number}"),
            distortion_of_coefficients(m[f"D{number}"], f"D{number}"),
            np.eye(3),
            f"D{number}",
        )
        for number in (1, 2)
    )
    return rig_of_cameras(left, right, RigidTransform(nearest_rotation(m["R"], "R"), m["T"]), "T")


RATIONAL = np.array([0.52, -2.5, 4e-4, -3e-4, 1.5, 0.40, -2.3, 1.4])
THIN_PRISM = np.append(RATIONAL, [1e-3, -5e-4, -8e-4, 3e-4])
TILTED = np.append(THIN_PRISM, [0.02, -0.03])


@pytest.mark.parametrize("D1", [REAL["D1"], RATIONAL, THIN_PRISM, TILTED], ids=["5", "8", "12", "14"])
def test_the_rig_shows_points_where_opencv_does(D1: np.ndarray) -> None:
    rig = rig_of(D1=D1)
    assert rig.lenses is not None
    rng = np.random.default_rng(5)
    points = np.stack([rng.uniform(-0.2, 0.2, 50), rng.uniform(-0.15, 0.15, 50), rng.uniform(1.0, 4.0, 50)], axis=1)
    points[:, :2] *= points[:, 2:]
    left_px = cv2.projectPoints(points, np.zeros(3), np.zeros(3), REAL["M1"], D1)[0][:, 0]
    right_px = cv2.projectPoints(points, cv2.Rodrigues(REAL["R"])[0], REAL["T"], REAL["M2"], REAL["D2"])[0][:, 0]
    in_rig = points @ rig.lenses[0].ideal_from_real.T
    # Both are double precision; OpenCV undistorts nothing here.
    np.testing.assert_allclose(rig.image(in_rig, "left"), left_px, atol=1e-8)
    np.testing.assert_allclose(rig.image(in_rig, "right"), right_px, atol=1e-8)


@pytest.mark.parametrize("count", [0, 4, 5, 8, 12, 14])
def test_coefficients_that_are_missing_are_zero(count: int) -> None:
    padded = np.concatenate([REAL["D1"][: min(count, 5)], np.zeros(14)])
    given, long = (rig_of(D1=coefficients) for coefficients in (padded[:count], padded[:14]))
    assert given.lenses is not None
    np.testing.assert_array_equal(given.lenses[0].distortion.coefficients(), padded[:5])
    assert given.camera == long.camera


@pytest.mark.parametrize("count", [1, 2, 3, 6, 7, 15])
def test_a_number_of_coefficients_without_a_model_is_refused(count: int) -> None:
    # MATLAB's RadialDistortion has two or three, and its third is not OpenCV's third.
    with pytest.raises(ValueError, match=f"D1: must have 4, 5, 8, 12 or 14 coefficients, got {count}"):
        rig_of(D1=np.full(count, 0.001))


MATRIX = np.array([[2140.0, 0, 650.0], [0, 2138.0, 470.0], [0, 0, 1]])


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (MATRIX.T, "file: M1: is transposed, as MATLAB's IntrinsicMatrix is"),
        # MATLAB's skew lies where OpenCV has a zero.
        (MATRIX.T + np.eye(3, k=-1) * [[0], [0.4], [0]], "is transposed"),
        (MATRIX + np.eye(3, k=1) * [[0.4], [0], [0]], "file: M1: has a skew of 0.4 px"),
        (2 * MATRIX, "file: M1: must be fx 0 cx"),
        (MATRIX * [[1], [1], [2]], "file: M1: must be fx 0 cx"),
        (-MATRIX, "file: M1: must be fx 0 cx"),
        (np.zeros((3, 3)), "file: M1: must be fx 0 cx"),
        (np.eye(3), r"file: M1: has focal lengths of \(1, 1\) px"),
        (MATRIX * [[1e-3], [1e-3], [1]], r"file: M1: has focal lengths of \(2.14, 2.138\) px"),
        (
            np.add(MATRIX, [[0, 0, 700], [0, 0, 0], [0, 0, 0]]),
            r"principal point \(1350, 470\) lies outside the image of 1280x",
        ),
        (MATRIX - [[0, 0, 0], [0, 0, 471], [0, 0, 0]], r"principal point \(650, -1\) lies outside"),
        (MATRIX * np.nan, "file: M1: must be finite"),
        (MATRIX[:2], "file: M1: must have 3x3 entries, got 6"),
    ],
)
def test_what_is_no_camera_matrix_is_refused(change: np.ndarray, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        camera_of_matrix(change, SIZE_PX, "file: M1")


def test_printed_decimals_are_a_rotation() -> None:
    exact = REAL["R"]
    np.testing.assert_array_equal(nearest_rotation(exact, "R"), exact)
    for decimals in (4, 5, 6):
        found = nearest_rotation(np.round(exact, decimals), "R")
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-15)
        # Half a unit of the last decimal in each entry.
        np.testing.assert_allclose(found, exact, atol=0.5 * 10**-decimals)
    for fault in (np.round(exact, 2), exact * [[1.001], [1], [1]], exact * [[-1], [1], [1]], 2 * exact):
        with pytest.raises(ValueError, match="file: R: is not a rotation matrix"):
            nearest_rotation(fault, "file: R")


@pytest.mark.parametrize(
    ("fields", "fault"),
    [
        ({"T": -REAL["T"]}, "are the two swapped"),
        ({"T": np.array([0.0, -0.12, 0.0])}, "must stand to the right"),
        ({"D1": np.array([0.0, 0, 0, 0, 0, 9.0, 0, 0])}, r"D1: \[.*\] fold the image of 1280x960 px: are they of cv2"),
        ({"D2": np.array([-9.0, 0, 0, 0])}, r"D2: \[-9\.0, .*\] fold the image .* calibrate again$"),
        ({"D2": np.array([1e300, 0, 0, 0])}, r"D2: \[1e\+300, .*\] fold the image"),
    ],
)
def test_what_the_rig_cannot_have_is_refused(fields: dict[str, Any], fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        rig_of(**fields)
