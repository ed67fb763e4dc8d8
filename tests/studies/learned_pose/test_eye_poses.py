"""Poses of one eye: exact without noise, OpenCV's step with it, and no bias that more points do not remove."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from drogue_models.marker_layout import marker_layout
from drogue_models.presets import load_drogue
from geometry.circles import project_disc_centers
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform, exp_rotation, left_jacobian, log_rotation, rotation_from_angles
from geometry.stereo import paper_rig
from nav.pose.pose_method import Observation
from studies.learned_pose import eye_poses
from studies.learned_pose.eye_poses import (
    bias_eliminated_pose,
    consistent_pnp,
    gauss_newton_step,
    pose_of_eye,
    refined_sqpnp,
)

RIG, LAYOUT = paper_rig(), marker_layout(load_drogue("red-8"))
CAMERA = RIG.camera
# A wide lens near a large plane, where perspective is strong and the bias of linear equations is large.
WIDE = PinholeCamera(1000, 1000, 500.0, 500.0, 499.5, 499.5)
WIDE_POSE = RigidTransform(rotation_from_angles(0.5, -0.4, 0.3), np.array([0.2, -0.1, 2.5]))


def pose(distance_m: float = 5.0) -> RigidTransform:
    return RigidTransform(rotation_from_angles(0.15, -0.1, 0.2), np.array([0.4, -0.3, distance_m]))


def noisy(left_from_drogue: RigidTransform, points: np.ndarray, sigma_px: float, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, sigma_px, (len(points), 2))
    return CAMERA.project(left_from_drogue.apply(points)) + noise


def plane_points(count: int, seed: int) -> np.ndarray:
    """(N, 3) points of a plane with mean zero. [m]"""
    places = np.random.default_rng(seed).uniform(-1, 1, (count, 2))
    return np.column_stack([places - places.mean(axis=0), np.zeros(count)])


@pytest.mark.parametrize("solve", [refined_sqpnp, consistent_pnp])
@pytest.mark.parametrize("depth_m", [0.0, 0.3])
def test_points_without_noise_give_the_pose(solve: eye_poses.PointPose, depth_m: float) -> None:
    points = LAYOUT.centers_m[:6] + np.array([0.1, -0.05, depth_m])
    found = solve(points, CAMERA.project(pose().apply(points)), CAMERA)
    assert found is not None
    # Refinement ends at steps of 1e-7; the closed form has the rounding of 1e-16 times its condition of about 1e8.
    np.testing.assert_allclose(found.as_matrix(), pose().as_matrix(), atol=2e-6)


def test_the_step_is_that_of_opencvs_derivatives() -> None:
    true, points = pose(), LAYOUT.centers_m
    start = RigidTransform(exp_rotation(np.array([0.02, -0.03, 0.01])) @ true.rotation, true.translation_m + 0.05)
    pixels = noisy(true, points, 0.3, 1)
    turn, shift = log_rotation(start.rotation), start.translation_m
    projected, slopes = cv2.projectPoints(points, turn, shift, CAMERA.matrix(), None)
    step = np.linalg.lstsq(slopes[:, :6], (pixels - projected[:, 0]).ravel(), rcond=None)[0]
    # OpenCV differentiates by the rotation vector; its left Jacobian turns that into a turn from the left.
    expected = exp_rotation(left_jacobian(turn) @ step[:3]) @ start.rotation
    found = gauss_newton_step(start, points, pixels, CAMERA)
    assert found is not None
    # Rounding: 1e-16 times the condition of the normal equations of some 1e8.
    np.testing.assert_allclose(found.rotation, expected, atol=1e-8)
    np.testing.assert_allclose(found.translation_m, shift + step[3:], atol=1e-7)


def test_many_steps_end_where_opencvs_refinement_ends() -> None:
    points = LAYOUT.centers_m
    pixels = noisy(pose(), points, 0.2, 2)
    found: RigidTransform | None = pose()
    for _ in range(10):
        assert found is not None
        found = gauss_newton_step(found, points, pixels, CAMERA)
    turn, shift = cv2.solvePnPRefineLM(
        points, pixels, CAMERA.matrix(), None, log_rotation(pose().rotation), pose().translation_m.copy()
    )
    assert found is not None
    # OpenCV stops at steps of 1e-7 of the parameters; the pose's condition makes some ten times that of it.
    np.testing.assert_allclose(found.translation_m, shift.ravel(), atol=2e-6)
    np.testing.assert_allclose(found.rotation, exp_rotation(turn.ravel()), atol=2e-6)


def closed_form_errors(count: int, sigma_px: float = 16.0, draws: int = 40) -> np.ndarray:
    """(draws, 3) errors of the closed form's position. [m]"""
    errors = []
    for seed in range(draws):
        points = plane_points(count, seed)
        pixels = WIDE.project(WIDE_POSE.apply(points))
        pixels += np.random.default_rng(1000 + seed).normal(0, sigma_px, pixels.shape)
        found = bias_eliminated_pose(points, pixels, WIDE)
        assert found is not None
        errors.append(found.translation_m - WIDE_POSE.translation_m)
    return np.array(errors)


def test_more_points_remove_the_error_and_without_elimination_they_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    few, many = (np.sqrt((closed_form_errors(count) ** 2).sum(axis=1).mean()) for count in (100, 6400))
    # 1 / sqrt(64) of it, with 40 draws of each: 11 % of either RMS, four deviations of the ratio.
    assert few / many == pytest.approx(8, rel=0.65)
    # The mean of 40 draws errs by 1 / sqrt(40) of the RMS.
    limit_m = 4 * many / np.sqrt(40)
    assert np.linalg.norm(closed_form_errors(6400).mean(axis=0)) < limit_m
    monkeypatch.setattr(eye_poses, "_noise_variance", lambda matrix, noisy, measured: 0.0)
    assert np.linalg.norm(closed_form_errors(6400).mean(axis=0)) > 3 * limit_m


def test_the_noise_is_estimated(monkeypatch: pytest.MonkeyPatch) -> None:
    estimates: list[float] = []
    estimate: Callable[..., float] = eye_poses._noise_variance

    def remember(*arguments: np.ndarray) -> float:
        estimates.append(estimate(*arguments))
        return estimates[-1]

    monkeypatch.setattr(eye_poses, "_noise_variance", remember)
    closed_form_errors(6400, sigma_px=3.0, draws=10)
    # A variance of 12,800 residuals errs by sqrt(2 / 12,800) = 1.25 %; the smallest of four eigenvalues by little more.
    np.testing.assert_allclose(estimates, 9.0, rtol=0.06)


@pytest.mark.parametrize("eye", [0, 1])
@pytest.mark.parametrize("solve", [refined_sqpnp, consistent_pnp])
def test_ellipses_of_either_eye_give_the_pose_in_the_left_camera(eye: int, solve: eye_poses.PointPose) -> None:
    true = pose(3.0)
    centers = [project_disc_centers(RIG, true, LAYOUT.centers_m, LAYOUT.radius_m, side) for side in ("left", "right")]
    pixels, cov = np.full((2, 8, 2), np.nan), np.full((2, 8, 2, 2), np.nan)
    pixels[eye], cov[eye] = centers[eye], 0.01 * np.eye(2)
    observation = Observation(RIG, LAYOUT, pixels, cov)
    found = pose_of_eye(observation, eye, solve)
    assert found is not None
    # Without the correction of the discs the error is 2e-4 m here; the pose of the first pass leaves a hundredth of it.
    np.testing.assert_allclose(found.as_matrix(), true.as_matrix(), atol=1e-5)
    assert pose_of_eye(observation, 1 - eye, solve) is None


def test_what_gives_no_pose() -> None:
    points, line = LAYOUT.centers_m, np.column_stack([np.linspace(0, 1, 8), np.zeros(8), np.zeros(8)])
    behind = RigidTransform(pose().rotation, -pose().translation_m)
    assert gauss_newton_step(behind, points, CAMERA.project(pose().apply(points)), CAMERA) is None
    assert consistent_pnp(line, CAMERA.project(pose().apply(line)), CAMERA) is None
    with pytest.raises(ValueError, match="points_m: must lie in a plane"):
        consistent_pnp(points + np.eye(8, 3), np.zeros((8, 2)), CAMERA)
