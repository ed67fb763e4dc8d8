"""Residuals, derivatives and minima of poses against OpenCV, finite differences, numpy and scipy."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from geometry.circles import project_disc_centers
from geometry.se3 import RigidTransform
from geometry.stereo import EYES
from nav.pose.adjustment import AdjustmentState, Loss, adjust, linearise, project_features
from nav.pose.features import Features, stack_features
from nav.pose.pose_method import StatedTolerances
from tests.support.painted_pairs import Draws, draw_poses

SIGMA_PX = 0.1
STATED = StatedTolerances(
    ring_radius_m=5e-4, ellipticity=0.002, placement_m=3e-4, hub_lateral_m=1e-3, disparity_px=0.19
)
LOSSES = [Loss(), Loss(huber_sigmas=1.0), Loss(tilt_prior_rad=0.1)]


def features_of(draws: Draws, radii_count: float = 1.0, tolerances: StatedTolerances | None = None) -> Features:
    cov = np.array([[1.0, 0.3], [0.3, 2.0]]) * SIGMA_PX**2
    given = () if tolerances is None else (tolerances,)
    features = stack_features(draws.rig, draws.layout, draws.pixels_px, cov, *given)
    return replace(features, radii_m=radii_count * features.radii_m)


def poses_of(draws: Draws) -> tuple[np.ndarray, np.ndarray]:
    return np.array([p.rotation for p in draws.places]), np.array([p.translation_m for p in draws.places])


def test_residuals_are_those_of_opencv_whitened() -> None:
    draws = draw_poses(np.random.default_rng(70), 6, (1.7, 10.0), SIGMA_PX)
    features = features_of(draws, radii_count=0.0)
    rotations, translations = poses_of(draws)
    residuals = linearise(features, AdjustmentState.nominal(features, rotations, translations)).residuals
    camera, points = draws.rig.camera, features.points_m
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    root = np.linalg.inv(np.linalg.cholesky(np.array([[1.0, 0.3], [0.3, 2.0]]) * SIGMA_PX**2))
    for s in range(6):
        for eye in range(2):
            place = translations[s] - draws.rig.eye_offset_m(("left", "right")[eye])
            seen = cv2.projectPoints(points, cv2.Rodrigues(rotations[s])[0], place, matrix, None)[0][:, 0]
            expected = (seen - draws.pixels_px[s, eye]) @ root.T
            found = residuals[s].reshape(2, 2, len(points))[:, eye].T
            # Rounding of pixels of 1e3, in whitening units of a tenth of a pixel.
            np.testing.assert_allclose(found, expected, atol=1e-8)
            np.testing.assert_allclose(project_features(features, rotations, translations)[s, eye], seen, atol=1e-9)


@pytest.mark.parametrize("tolerances", [None, STATED])
@pytest.mark.parametrize("loss", [Loss(), Loss(tilt_prior_rad=0.1)])
def test_derivatives_by_the_pose_are_those_of_the_residuals(tolerances: StatedTolerances | None, loss: Loss) -> None:
    draws = draw_poses(np.random.default_rng(71), 5, (1.7, 10.0), SIGMA_PX)
    features = features_of(draws, 0.0, tolerances)
    rotations, translations = poses_of(draws)
    departures = np.full((5, features.departures), 0.3)
    now = linearise(features, AdjustmentState(rotations, translations, departures), loss).jacobian
    step = 1e-5
    for k in range(6):
        sides = []
        for sign in (1, -1):
            move = sign * step * np.eye(6)[k]
            turn = cv2.Rodrigues(move[3:])[0]
            sides.append(
                linearise(features, AdjustmentState(turn @ rotations, translations + move[:3], departures), loss)
            )
        slope = (sides[0].residuals - sides[1].residuals) / (2 * step)
        # Third derivatives times the step's square; rounding of 1e4 deviations over the step.
        np.testing.assert_allclose(now[:, k], slope, atol=1e-8 * np.abs(slope).max() + 1e-6)


@pytest.mark.parametrize("loss", LOSSES)
def test_costs_are_sums_over_residuals(loss: Loss) -> None:
    draws = draw_poses(np.random.default_rng(72), 8, (1.7, 10.0), SIGMA_PX)
    features = features_of(draws, 1.0, STATED)
    rotations, translations = poses_of(draws)
    state = AdjustmentState(rotations, translations, np.full((8, features.departures), -0.2))
    plain = linearise(features, state).residuals
    sizes = np.sqrt((plain[:, :40].reshape(8, 2, 2, 10) ** 2).sum(axis=1)).reshape(8, -1)
    k = min(loss.huber_sigmas, 1e9)
    beyond = sizes > k
    assert beyond.any() == np.isfinite(loss.huber_sigmas)
    expected = np.where(beyond, k * (sizes - k / 2), sizes**2 / 2)
    tilts = (rotations[:, :2, 2] ** 2).sum(axis=1) / (2 * loss.tilt_prior_rad**2)
    departed = 0.2**2 * features.departures / 2
    found = linearise(features, state, loss)
    np.testing.assert_allclose(found.costs, expected.sum(axis=1) + tilts + departed, rtol=1e-9)
    # Beyond the threshold, weights leave the gradient of the loss, of length k a feature.
    weighed = np.sqrt((found.residuals[:, :40].reshape(8, 2, 2, 10) ** 2).sum(axis=1)).reshape(8, -1)
    np.testing.assert_allclose(weighed, np.where(beyond, np.sqrt(sizes * k), sizes), rtol=1e-9)


@pytest.mark.parametrize("loss", LOSSES)
def test_adjusted_poses_are_minima(loss: Loss) -> None:
    draws = draw_poses(np.random.default_rng(73), 12, (1.7, 10.0), SIGMA_PX)
    features = features_of(draws, 1.0, STATED)
    found = adjust(features, *poses_of(draws), loss)
    at = linearise(features, AdjustmentState(found.rotations, found.translations_m, found.departures), loss)
    np.testing.assert_allclose(at.costs, found.costs, rtol=1e-9)
    np.testing.assert_allclose(at.information, found.information, rtol=1e-9, atol=1e-9 * at.information.max())
    gradient = np.einsum("skm,sm->sk", at.jacobian, at.residuals)
    # What a further step would gain, to second order; the shift of ellipse centres is left out of the derivatives.
    gain = np.einsum("sk,sk->s", gradient, np.linalg.solve(at.information, gradient[..., None])[..., 0]) / 2
    # 1e-5 are 0.004 deviations, to which Huber's weights converge within the number of steps.
    assert gain.max() < 1e-5


def minimum_by_scipy(draws: Draws, features: Features, index: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation, translation and cost of the least-squares pose, from the true pose as start."""
    true = draws.places[index]
    root = np.linalg.inv(np.linalg.cholesky(np.array([[1.0, 0.3], [0.3, 2.0]]) * SIGMA_PX**2))

    def moved(step: np.ndarray) -> RigidTransform:
        return RigidTransform(Rotation.from_rotvec(step[3:]).as_matrix() @ true.rotation, true.translation_m + step[:3])

    def residuals(step: np.ndarray) -> np.ndarray:
        seen = [project_disc_centers(draws.rig, moved(step), features.points_m, features.radii_m, eye) for eye in EYES]
        return ((np.array(seen) - draws.pixels_px[index]) @ root.T).ravel()

    found = least_squares(residuals, np.zeros(6), jac="3-point", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    pose = moved(found.x)
    return pose.rotation, pose.translation_m, float(found.cost)


# Points: the last step is taken where it would lower the cost by less than 1e-9, from within sqrt(2e-9) = 4.5e-5
# deviations of the minimum. Discs: the derivatives neglect the shift of the ellipse centres, of a relative size of
# (0.075 m / 1.7 m)^2 = 2e-3; times the root of 40 residuals of one deviation this is 0.012 deviations.
@pytest.mark.parametrize(("radii_count", "sigmas"), [(0.0, 1e-4), (1.0, 0.02)])
def test_adjusted_poses_are_those_of_scipy(radii_count: float, sigmas: float) -> None:
    draws = draw_poses(np.random.default_rng(76), 6, (1.7, 10.0), SIGMA_PX)
    features = features_of(draws, radii_count)
    found = adjust(features, *poses_of(draws))
    for index in range(len(draws.places)):
        rotation, translation_m, cost = minimum_by_scipy(draws, features, index)
        turn = Rotation.from_matrix(found.rotations[index] @ rotation.T).as_rotvec()
        error = np.append(found.translations_m[index] - translation_m, turn)
        assert np.sqrt(error @ found.information[index] @ error) < sigmas
        # A cost is quadratic about its minimum; rounding of pixels of 1e3 in deviations of 0.1 px is below 1e-9.
        assert 0 <= found.costs[index] - cost + 1e-9 < sigmas**2 / 2 + 2e-9


def test_a_pose_behind_the_cameras_has_infinite_cost_and_is_not_adjusted() -> None:
    draws = draw_poses(np.random.default_rng(74), 2, 3.0, SIGMA_PX)
    features = features_of(draws)
    rotations, translations = poses_of(draws)
    translations[0, 2] *= -1
    found = adjust(features, rotations, translations)
    assert np.isinf(found.costs[0]) and np.isfinite(found.costs[1])
    np.testing.assert_array_equal(found.translations_m[0], translations[0])


def test_an_unmeasured_feature_has_no_residuals() -> None:
    draws = draw_poses(np.random.default_rng(75), 3, 4.0, SIGMA_PX)
    whole = features_of(draws, 1.0, STATED)
    mask = np.arange(10) == 3
    rotations, translations = poses_of(draws)
    less = linearise(whole.without(mask), AdjustmentState.nominal(whole, rotations, translations))
    rows = np.zeros(40, dtype=bool).reshape(4, 10)
    rows[:, 3] = True
    blind = np.append(rows.ravel(), np.zeros(whole.departures, dtype=bool))
    assert not less.residuals[:, blind].any() and not less.jacobian[:, :, blind].any()
    full = linearise(whole, AdjustmentState.nominal(whole, rotations, translations))
    np.testing.assert_array_equal(less.residuals[:, ~blind], full.residuals[:, ~blind])
