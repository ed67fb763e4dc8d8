"""Drogues and rigs that depart from nominal, and methods that know the tolerances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nav.pose.adjustment import AdjustmentState, linearise
from nav.pose.features import Features, stack_features, whiten, whiten_with_displacement
from nav.pose.joint import joint_hub, joint_robust, solve_joint_batch
from nav.pose.method_registry import METHODS
from nav.pose.pose_method import EXACT, StatedTolerances
from tests.support.painted_pairs import Draws, draw_poses

STATED = StatedTolerances(
    ring_radius_m=5e-4, ellipticity=0.002, placement_m=3e-4, hub_lateral_m=1e-3, disparity_px=0.19
)
EACH = [
    StatedTolerances(**{name: getattr(STATED, name)})
    for name in ("ring_radius_m", "ellipticity", "placement_m", "hub_lateral_m", "disparity_px")
]


def features_of(draws: Draws, tolerances: StatedTolerances, eyes: int = 2) -> Features:
    pixels = draws.pixels_px[:, :eyes]
    return stack_features(draws.rig, draws.layout, pixels, draws.sigma_px**2 * np.eye(2), tolerances)


def state_of(draws: Draws, features: Features, departures: float | np.ndarray) -> AdjustmentState:
    rotations = np.array([place.rotation for place in draws.places])
    translations = np.array([place.translation_m for place in draws.places])
    return AdjustmentState(rotations, translations, departures * np.ones((len(rotations), features.departures)))


@pytest.mark.parametrize("eyes", [1, 2])
def test_a_displaced_feature_has_the_joint_covariance_of_both_eyes(eyes: int) -> None:
    draws = draw_poses(np.random.default_rng(60), 4, (1.7, 10.0), 0.1)
    rng = np.random.default_rng(61)
    roots = rng.normal(0, 0.1, (4, eyes, 10, 2, 2))
    cov = roots @ np.swapaxes(roots, -1, -2) + 1e-3 * np.eye(2)
    depths, displacement = np.array([2.0, 3.0, 5.0, 9.0]), np.append(np.full(8, 3e-4), [0, 0])
    camera = draws.rig.camera
    measured, coupling = whiten_with_displacement(camera, whiten(draws.pixels_px[:, :eyes], cov), depths, displacement)
    for frame in range(4):
        for feature in range(10):
            whole, matrix, slopes = np.zeros((2 * eyes,) * 2), np.zeros((2 * eyes,) * 2), []
            for eye in range(eyes):
                part = slice(2 * eye, 2 * eye + 2)
                whole[part, part] = cov[frame, eye, feature]
                x, y = camera.rays(draws.pixels_px[frame, eye, feature])[:2]
                focal = np.diag([camera.fx_px, camera.fy_px]) / depths[frame]
                slopes.append(focal @ [[1, 0, -x], [0, 1, -y]])
                a, b, c = measured[2:, frame, eye, feature]
                matrix[part, part] = [[a, 0], [b, c]]
            if eyes == 2:
                matrix[2:, :2] = coupling[:, frame, feature].reshape(2, 2) @ matrix[:2, :2]
            whole += displacement[feature] ** 2 * np.vstack(slopes) @ np.vstack(slopes).T
            # Rounding.
            np.testing.assert_allclose(matrix @ whole @ matrix.T, np.eye(2 * eyes), atol=1e-9)


@pytest.mark.parametrize("tolerances", [STATED, *EACH])
def test_derivatives_are_those_of_the_residuals(tolerances: StatedTolerances) -> None:
    draws = draw_poses(np.random.default_rng(62), 5, (1.7, 10.0), 0.1)
    features = features_of(draws, tolerances)
    step = 1e-4
    for number in range(features.departures):
        one = np.eye(features.departures)[number]
        ahead, behind = (linearise(features, state_of(draws, features, 0.3 + s * one)) for s in (step, -step))
        slope = (ahead.residuals - behind.residuals) / (2 * step)
        now = linearise(features, state_of(draws, features, 0.3)).jacobian[:, 6 + number]
        # What the shift of the ellipse centre adds is left out of the derivatives: (r / Z)^2, a thousandth.
        np.testing.assert_allclose(now, slope, atol=2e-3 * max(1.0, np.abs(slope).max()))


def test_a_marker_in_one_eye_has_its_own_covariance() -> None:
    draws = draw_poses(np.random.default_rng(63), 1, 3.0, 0.1)
    for lost in (0, 1):
        pixels = draws.pixels_px.copy()
        pixels[:, lost, 2] = np.nan
        two = stack_features(draws.rig, draws.layout, pixels, 0.01 * np.eye(2), STATED)
        one = stack_features(draws.rig, draws.layout, pixels[:, 1 - lost : 2 - lost], 0.01 * np.eye(2), STATED)
        assert not two.coupling[:, 0, 2].any()
        # The depth at which the placement counts comes from fifteen discs there and eight here.
        np.testing.assert_allclose(two.measured[2:, 0, 1 - lost, 2], one.measured[2:, 0, 0, 2], rtol=0.01)


def toleranced(draws: Draws, rng: np.random.Generator, tolerances: StatedTolerances) -> np.ndarray:
    """Pixels of drogues and rigs that depart from the nominal, to first order in the departures."""
    features = features_of(draws, replace(tolerances, placement_m=0.0))
    nominal = linearise(features, state_of(draws, features, 0.0))
    size = 2 * 2 * 10
    pixels = np.moveaxis(draws.pixels_px, -1, 1)
    shape = pixels.shape[1:]
    shared = np.einsum("sg,sgm->sm", rng.standard_normal((len(pixels), features.departures)), nominal.jacobian[:, 6:])
    moved = tolerances.placement_m * rng.standard_normal((len(pixels), 3, 10)) * (np.arange(10) < 8)
    own = np.einsum("saf,sacef->scef", moved, nominal.jacobian[:, :3, :size].reshape(-1, 3, *shape))
    return np.moveaxis(pixels + draws.sigma_px * (shared[:, :size].reshape(-1, *shape) + own), 1, -1)


@pytest.mark.parametrize("tolerances", [STATED, *EACH])
@pytest.mark.parametrize("features", [8, 10])
def test_covariances_include_the_stated_tolerances(tolerances: StatedTolerances, features: int) -> None:
    rng = np.random.default_rng(64)
    draws = draw_poses(rng, 120, (1.7, 6.0), 0.03, tilt_deg=(6.0, 10.0))
    pixels = toleranced(draws, rng, tolerances)[:, :, :features]
    batch = solve_joint_batch(draws.rig, draws.layout, pixels, draws.sigma_px**2 * np.eye(2), tolerances)
    assert batch.sound.all()
    squares = []
    for index in range(120):
        errors = draws.errors(index, batch.rotations[index], batch.translations_m[index])
        tangent = errors[[0, 1, 2, 5, 6, 7]]
        squares.append(tangent @ np.linalg.solve(batch.covariances[index], tangent) / 6)
    # 720 degrees of freedom: sqrt(2 / 720) = 5 %, three of it; the covariance takes the weights at one depth for all
    # markers, within 3 %.
    assert np.mean(squares) == pytest.approx(1.0, abs=0.19)


def test_one_eye_has_no_disparity_tolerance() -> None:
    draws = draw_poses(np.random.default_rng(65), 3, 5.0, 0.1)
    for index in range(3):
        exact, told = (
            METHODS["mono-lm"](replace(draws.observation(index), tolerances=tolerances))
            for tolerances in (EXACT, StatedTolerances(disparity_px=0.2))
        )
        # Rounding.
        np.testing.assert_allclose(exact.covariance, told.covariance, rtol=1e-6, atol=1e-15)


def test_a_displaced_marker_is_no_outlier() -> None:
    rng = np.random.default_rng(66)
    draws = draw_poses(rng, 5, 2.0, 0.02)
    pixels = toleranced(draws, rng, STATED)
    for index in range(5):
        told = replace(draws.observation(index, pixels_px=pixels[index]), tolerances=STATED)
        # Placement alone moves discs by 0.3 px here, 15 deviations.
        assert joint_robust(told).used.all()
        spoilt = pixels[index].copy()
        spoilt[1, 3] += (0.0, 6.0)
        wrong = joint_robust(replace(draws.observation(index, pixels_px=spoilt), tolerances=STATED))
        assert np.flatnonzero(~wrong.used.all(axis=0)).tolist() == [3]


def test_tiny_tolerances_change_nothing() -> None:
    draws = draw_poses(np.random.default_rng(67), 3, 5.0, 0.1)
    tiny = StatedTolerances(1e-9, 1e-9, 1e-9, 1e-9, 1e-9)
    for index in range(3):
        exact, told = (joint_hub(replace(draws.observation(index), tolerances=t)) for t in (EXACT, tiny))
        away = exact.left_from_drogue.translation_m - told.left_from_drogue.translation_m
        # Both stop within 5e-5 deviations of their minimum.
        assert (np.abs(away) < 1e-3 * np.sqrt(np.diag(exact.covariance))[:3]).all()
        np.testing.assert_allclose(told.covariance, exact.covariance, rtol=1e-3, atol=1e-15)
