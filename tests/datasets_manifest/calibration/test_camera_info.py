"""Rigs of ROS's CameraInfo against OpenCV's rectification."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from datasets_manifest.calibration.camera_info import CameraInfo, rig_of_camera_info
from geometry.stereo import EYES
from tests.support.stereo_calibrations import opencv_ideal_px

SIZE_PX = (1280, 960)
M1 = np.array([[2140.0, 0, 650.0], [0, 2138.0, 470.0], [0, 0, 1]])
M2 = np.array([[2129.0, 0, 633.0], [0, 2131.0, 484.0], [0, 0, 1]])
D1, D2 = np.array([-0.06, 0.02, 1e-4, -2e-4, 0.01]), np.array([-0.05, 0.01, -1e-4, 1e-4, 0.0])
R = cv2.Rodrigues(np.array([0.003, -0.02, 0.004]))[0]
T = np.array([-0.1203, 0.0007, -0.0011])


def pair(decimals: int | None = None, flags: int = cv2.CALIB_ZERO_DISPARITY, **options: Any) -> tuple[CameraInfo, ...]:
    """What ROS's calibrator gives for the two cameras, with as many decimals as it prints."""
    R1, R2, P1, P2, *_ = cv2.stereoRectify(M1, D1, M2, D2, SIZE_PX, R, T[:, None], flags=flags, **options)
    infos = []
    for name, D, K, rotation, P in (("left.yaml", D1, M1, R1, P1), ("right.yaml", D2, M2, R2, P2)):
        arrays = [m if decimals is None else np.round(m, decimals) for m in (D, K, rotation, P)]
        infos.append(CameraInfo(name, SIZE_PX, "plumb_bob", *arrays))
    return tuple(infos)


def seen_px(points_m: np.ndarray) -> list[np.ndarray]:
    """Where both cameras see points that are given in the left one's axes."""
    left = cv2.projectPoints(points_m, np.zeros(3), np.zeros(3), M1, D1)[0][:, 0]
    return [left, cv2.projectPoints(points_m, cv2.Rodrigues(R)[0], T, M2, D2)[0][:, 0]]


POINTS_M = np.random.default_rng(7).uniform([-0.2, -0.15, 1], [0.2, 0.15, 1], (40, 3)) * np.linspace(2, 40, 40)[:, None]


@pytest.mark.parametrize("options", [{}, {"alpha": 0}, {"alpha": 1}, {"flags": 0}, {"newImageSize": (640, 480)}])
def test_the_given_rectification_is_the_frame(options: dict[str, Any]) -> None:
    left, right = pair(**options)
    rig = rig_of_camera_info(left, right)
    in_rig = POINTS_M @ left.R.T
    for eye, info, px in zip(EYES, (left, right), seen_px(POINTS_M), strict=True):
        # Double precision on both sides.
        np.testing.assert_allclose(rig.image(in_rig, eye), px, atol=1e-8)
        rectified = opencv_ideal_px(px, info.K, info.D, info.R, info.P[:, :3])
        if eye == "left":
            np.testing.assert_allclose(rig.ideal_px(px, eye), rectified, atol=1e-7)
        # The right rectified image may begin at another column, which is not part of the frame.
        rays = np.column_stack([rectified, np.ones(len(px))]) @ np.linalg.inv(info.P[:, :3]).T
        np.testing.assert_allclose(rig.rays(px, eye), rays, atol=1e-10)
    triangulated = rig.triangulate(*(rig.ideal_px(px, eye) for px, eye in zip(seen_px(POINTS_M), EYES, strict=True)))
    # Disparities of more than 6 px, to 1e-8 px.
    np.testing.assert_allclose(triangulated, in_rig, rtol=1e-7)


@pytest.mark.parametrize("decimals", [5, 6])
def test_printed_decimals_are_enough(decimals: int) -> None:
    left, right = pair(decimals)
    rig = rig_of_camera_info(left, right)
    in_rig = POINTS_M @ pair()[0].R.T
    for eye, px in zip(EYES, seen_px(POINTS_M), strict=True):
        # Half a unit of the last decimal in a few entries of R at a focal length of 2140 px.
        np.testing.assert_allclose(rig.image(in_rig, eye), px, atol=2140 * 3 * 0.5 * 10**-decimals)


def test_rectified_images_need_no_lenses() -> None:
    left, right = pair()
    infos = [replace(info, D=np.zeros(5), R=np.eye(3), K=info.P[:, :3]) for info in (left, right)]
    for models in (("plumb_bob", "plumb_bob"), ("rational_polynomial", ""), ("pinhole", "None")):
        rig = rig_of_camera_info(*(replace(i, distortion_model=m) for i, m in zip(infos, models, strict=True)))
        assert rig.lenses is None
        np.testing.assert_array_equal(rig.camera.matrix(), left.P[:, :3])
        assert rig.baseline_m == pytest.approx(np.linalg.norm(T), rel=1e-12)


def test_zeros_beyond_the_fifth_coefficient_are_no_other_model() -> None:
    left, right = pair()
    want = rig_of_camera_info(left, right)
    for count in (8, 12, 14):
        long = (
            replace(info, distortion_model="rational_polynomial", D=np.pad(info.D, (0, count - 5)))
            for info in (left, right)
        )
        got = rig_of_camera_info(*long)
        assert got.lenses is not None and want.lenses is not None
        for one, other in zip(got.lenses, want.lenses, strict=True):
            assert one.distortion == other.distortion


@pytest.mark.parametrize(
    ("left", "right", "fault"),
    [
        ({"K": np.zeros((3, 3))}, {}, "left.yaml: K: is 0: the camera is not calibrated"),
        ({}, {"K": M2.T}, "right.yaml: K: is transposed"),
        ({}, {"R": np.zeros((3, 3))}, "right.yaml: R: is not a rotation"),
        ({}, {"distortion_model": "equidistant"}, "right.yaml: distortion model 'equidistant' is not read"),
        # Without coefficients too, a fisheye's radius is f theta, and not that of a pinhole.
        ({}, {"distortion_model": "equidistant", "D": np.zeros(4)}, "right.yaml: distortion model 'equidistant' is"),
        ({}, {"distortion_model": "kannala_brandt", "D": ()}, "right.yaml: distortion model 'kannala_brandt' is not"),
        ({}, {"size_px": (640, 480)}, r"right.yaml: its images have \(640, 480\) px"),
        ({}, {"P": np.zeros((3, 4))}, "right.yaml: P: must be fx 0 cx tx"),
        ({}, {"P": np.hstack([M1, np.zeros((3, 1))])}, "right.yaml: P: entry .0, 3. must be -fx times the baseline"),
        ({}, {"D": np.zeros(3)}, "right.yaml: D: must have 4, 5, 8, 12 or 14"),
    ],
)
def test_cameras_that_are_no_pair_are_refused(left: dict[str, Any], right: dict[str, Any], fault: str) -> None:
    infos = pair()
    with pytest.raises(ValueError, match=fault):
        rig_of_camera_info(replace(infos[0], **left), replace(infos[1], **right))


def test_swapped_cameras_are_refused() -> None:
    left, right = pair()
    with pytest.raises(ValueError, match=r"right\.yaml: P: is that of a right camera, and left\.yaml: P of a left one"):
        rig_of_camera_info(right, left)


def test_one_camera_above_the_other_is_refused() -> None:
    left, right = pair()
    above = right.P.copy()
    above[:2, 3] = above[[1, 0], 3]
    with pytest.raises(ValueError, match=r"right\.yaml: P: .* above each other"):
        rig_of_camera_info(left, replace(right, P=above))


def test_different_rows_are_no_rectification() -> None:
    left, right = pair()
    for entry in ((0, 0), (1, 1), (1, 2)):
        other = right.P.copy()
        other[entry] += 0.5
        with pytest.raises(ValueError, match=r"right\.yaml: P: fx, fy and cy must be those of left\.yaml: P"):
            rig_of_camera_info(left, replace(right, P=other))


def test_a_baseline_in_another_unit_is_scaled_or_refused() -> None:
    left, right = pair()
    millimetres = replace(right, P=right.P * [1, 1, 1, 1000])
    with pytest.raises(ValueError, match=r"right\.yaml: P: .*120\.\d+ m is not a plausible baseline"):
        rig_of_camera_info(left, millimetres)
    want_m = rig_of_camera_info(left, right).baseline_m
    assert rig_of_camera_info(left, millimetres, unit_m=1e-3).baseline_m == pytest.approx(want_m, rel=1e-12)
