from __future__ import annotations

import cv2
import numpy as np
import pytest

from geometry.se3 import RigidTransform
from geometry.stereo import EYES, StereoRig, paper_rig

RIG = paper_rig()


def sample_points_m(count: int) -> np.ndarray:
    rng = np.random.default_rng(5)
    points = rng.uniform([-0.2, -0.2, 1.5], [0.2, 0.2, 40.0], size=(count, 3))
    points[:, :2] *= points[:, 2:]
    return points


def test_paper_rig_is_the_paper_s() -> None:
    camera = RIG.camera
    assert (camera.width_px, camera.height_px, camera.cx_px, camera.cy_px) == (1280, 960, 639.5, 479.5)
    assert camera.fx_px == camera.fy_px == pytest.approx(2133.333, abs=5e-4)  # printed to three decimals
    assert RIG.baseline_m == 0.12


def test_rig_is_opencv_s_rectified_rig() -> None:
    camera = RIG.camera
    size = (camera.width_px, camera.height_px)
    # OpenCV's T takes left coordinates to right ones.
    T = np.array([[-RIG.baseline_m], [0.0], [0.0]])
    K, undistorted = camera.matrix(), np.zeros(5)
    R1, R2, P1, P2, Q, _, _ = cv2.stereoRectify(
        K, undistorted, K, undistorted, size, np.eye(3), T, flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1, newImageSize=size
    )
    np.testing.assert_allclose([R1, R2], [np.eye(3)] * 2, rtol=0, atol=1e-12)
    P_left = np.hstack([camera.matrix(), np.zeros((3, 1))])
    P_right = P_left.copy()
    P_right[0, 3] = -camera.fx_px * RIG.baseline_m
    # OpenCV computes the new focal length and principal point from float32 corners of the image.
    np.testing.assert_allclose(P1, P_left, rtol=0, atol=2e-4)
    np.testing.assert_allclose(P2, P_right, rtol=0, atol=2e-4)
    points = sample_points_m(50)
    left, right = (RIG.project(points, eye) for eye in EYES)
    homogeneous = np.column_stack([left, left[:, 0] - right[:, 0], np.ones(len(points))]) @ Q.T
    # The 2e-4 px of OpenCV's principal point, seen at 40 m.
    np.testing.assert_allclose(homogeneous[:, :3] / homogeneous[:, 3:], points, rtol=0, atol=2e-4 / 2133 * 40 * 2)


def test_projection_of_each_eye_agrees_with_opencv() -> None:
    points = sample_points_m(200)
    for eye, offset in (("left", 0.0), ("right", -RIG.baseline_m)):
        expected, _ = cv2.projectPoints(points, np.zeros(3), np.array([offset, 0.0, 0.0]), RIG.camera.matrix(), None)
        np.testing.assert_allclose(RIG.project(points, eye), expected[:, 0], rtol=0, atol=1e-9)  # 1e3 px in float64


def test_triangulation_agrees_with_opencv() -> None:
    points = sample_points_m(200)
    left, right = RIG.project(points, "left"), RIG.project(points, "right")
    P_left = np.hstack([RIG.camera.matrix(), np.zeros((3, 1))])
    P_right = P_left.copy()
    P_right[0, 3] = -RIG.camera.fx_px * RIG.baseline_m
    homogeneous = cv2.triangulatePoints(P_left, P_right, left.T, right.T)
    # Rounding of the pixels (1e-13 px) times dZ/dd = Z^2/(f B) = 6 m/px; OpenCV's homogeneous solution loses a factor.
    np.testing.assert_allclose(RIG.triangulate(left, right), points, rtol=0, atol=1e-10)
    np.testing.assert_allclose(RIG.triangulate(left, right), (homogeneous[:3] / homogeneous[3]).T, rtol=0, atol=1e-6)


def test_one_point_has_the_same_row_in_both_eyes_exactly() -> None:
    points = sample_points_m(1000)
    assert np.all(RIG.project(points, "left")[:, 1] - RIG.project(points, "right")[:, 1] == 0)


def test_triangulation_minimises_the_reprojection_error() -> None:
    rng = np.random.default_rng(6)
    points = sample_points_m(20)
    seen = {eye: RIG.project(points, eye) + rng.normal(scale=0.3, size=(20, 2)) for eye in EYES}

    def cost(candidates: np.ndarray) -> np.ndarray:
        return sum(((RIG.project(candidates, eye) - seen[eye]) ** 2).sum(axis=1) for eye in EYES)

    best = RIG.triangulate(seen["left"], seen["right"])
    for axis in range(3):
        for step in (-1e-3, 1e-3):
            moved = best.copy()
            moved[:, axis] += step
            assert np.all(cost(moved) > cost(best))


def test_depth_error_grows_with_the_square_of_the_distance() -> None:
    depths = np.array([2.0, 5.0, 10.0, 20.0, 40.0])
    points = np.stack([np.zeros(5), np.zeros(5), depths], axis=-1)
    left = RIG.project(points, "left") + np.array([0.01, 0.0])
    errors = np.abs(RIG.triangulate(left, RIG.project(points, "right"))[:, 2] - depths)
    # The next order of the law, 0.01 px of a disparity of 6.4 px, bends the slope by a thousandth.
    assert np.polyfit(np.log(depths), np.log(errors), 1)[0] == pytest.approx(2.0, abs=2e-3)


def test_crossed_disparity_is_no_point() -> None:
    assert np.isnan(RIG.triangulate([600.0, 400.0], [601.0, 400.0])).all()


def test_common_field_has_the_limits_of_the_specification() -> None:
    for depth in (1.6, 2.0, 10.0, 40.0):
        limits = RIG.common_field_m(depth, 0.33)
        expected = (0.45 - 0.3 * depth, 0.3 * depth - 0.33, 0.33 - 0.225 * depth, 0.225 * depth - 0.33)
        np.testing.assert_allclose(limits, expected, rtol=0, atol=1e-12)  # 12 m in float64
    assert RIG.nearest_full_view_m(0.33) == pytest.approx(1.467, abs=5e-4)  # printed to three decimals
    assert RIG.common_field_m(1.466, 0.33) is None
    assert RIG.common_field_m(1.468, 0.33) is not None


def test_common_field_is_where_both_eyes_see_the_whole_disc() -> None:
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    edge = 0.33 * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    rng = np.random.default_rng(4)
    for depth in (1.5, 1.7, 3.0, 12.0):
        x_low, x_high, y_low, y_high = RIG.common_field_m(depth, 0.33)
        for center in rng.uniform(
            [1.3 * x_low, 1.5 * y_low, depth], [1.3 * x_high, 1.5 * y_high, depth], size=(200, 3)
        ):
            whole = all(RIG.camera.contains(RIG.project(center + edge, eye)).all() for eye in EYES)
            assert whole == (x_low <= center[0] <= x_high and y_low <= center[1] <= y_high)


def test_nearest_full_view_is_bounded_by_the_tighter_side() -> None:
    wide = StereoRig(RIG.camera, 0.6)
    depth = wide.nearest_full_view_m(0.33)
    x_low, x_high, *_ = wide.common_field_m(depth + 1e-9, 0.33)
    assert depth == pytest.approx((0.66 + 0.6) / 0.6) and x_high - x_low < 1e-8


def test_body_axes_are_forward_right_down() -> None:
    forward, right, down = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
    np.testing.assert_array_equal(RIG.body_from_left.rotate([forward, right, down]), np.eye(3))


@pytest.mark.parametrize("baseline_m", [0.0, -0.1, float("nan"), float("inf")])
def test_impossible_baselines_are_refused(baseline_m: float) -> None:
    with pytest.raises(ValueError, match="baseline_m: must be positive"):
        StereoRig(RIG.camera, baseline_m, RigidTransform.identity())
