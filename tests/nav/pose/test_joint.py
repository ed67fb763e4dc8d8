"""The joint adjustment at centroid level: errors against the Cramer-Rao bound, and consistency of its covariances."""

from __future__ import annotations

from collections.abc import Callable
from math import erfc
from typing import Any

import numpy as np
import pytest

from geometry.circles import project_disc_centers
from nav.pose.features import observed_features
from nav.pose.joint import JointBatch, joint, joint_hub, joint_robust, solve_features, solve_joint_batch
from nav.pose.pose_method import EXACT, Solution, StatedTolerances
from tests.support.painted_pairs import Draws, draw_poses, make_pose

FOCAL_PX = 8e-3 / 3.75e-6
BASELINE_M = 0.12
RING_M = 0.28


def solve(draws: Draws, hub: bool, tolerances: StatedTolerances = EXACT) -> JointBatch:
    pixels = draws.pixels_px if hub else draws.pixels_px[:, :, : draws.layout.count]
    batch = solve_joint_batch(draws.rig, draws.layout, pixels, draws.sigma_px**2 * np.eye(2), tolerances)
    assert batch.sound.all()
    return batch


def errors_of(draws: Draws, batch: JointBatch) -> np.ndarray:
    return np.array([draws.errors(i, batch.rotations[i], batch.translations_m[i]) for i in range(len(draws.places))])


def nees(errors: np.ndarray, batch: JointBatch) -> float:
    tangent = errors[:, [0, 1, 2, 5, 6, 7]]
    return float(np.mean([e @ np.linalg.solve(c, e) / 6 for e, c in zip(tangent, batch.covariances, strict=True)]))


def flips(draws: Draws, batch: JointBatch) -> np.ndarray:
    """Whether the estimated pitch and yaw point away from the true ones."""
    return np.array(
        [
            estimate[:2, 2] @ true.rotation[:2, 2] < 0
            for estimate, true in zip(batch.rotations, draws.places, strict=True)
        ]
    )


def tilt_rmse_deg(errors: np.ndarray) -> float:
    return float(np.degrees(np.sqrt((errors[:, 3:5] ** 2).mean())))


@pytest.mark.parametrize("sigma_px", [0.02, 0.1])
@pytest.mark.parametrize("z_m", [1.7, 5.0, 15.0, 40.0])
def test_joint_hub_reaches_the_bound_and_never_flips(z_m: float, sigma_px: float) -> None:
    draws = draw_poses(np.random.default_rng(11), 500, z_m, sigma_px)
    batch = solve(draws, hub=True)
    errors = errors_of(draws, batch)
    bounds = draws.bounds(10)
    ratio = np.sqrt(((errors[:, :5] / bounds) ** 2).mean(axis=0))
    # Measured as 0.99-1.04 in every cell. A root mean square of 500 is known to 1/sqrt(1000) = 3.2 %; three of it and a
    # half, as the worst of 40 is looked at.
    assert ratio.max() < 1.04 + 0.11
    assert ratio.min() > 0.99 - 0.11
    # Flips are counted where the tilt is five deviations and more.
    tilted = np.array([np.linalg.norm(p.rotation[:2, 2]) for p in draws.places]) > 5 * bounds[:, 3:].max(axis=1)
    assert not flips(draws, batch)[tilted].any()
    # 500 chi-squares of 6 degrees have a mean with a deviation of sqrt(2 / 3000) = 0.026; four of it.
    assert nees(errors, batch) == pytest.approx(1.0, abs=0.104)


def frontal_tilt_sigma_deg(sigma_px: float, z_m: float) -> float:
    """The published law without a hub."""
    spread = np.sqrt(8 * (RING_M**2 / 2 + BASELINE_M**2 / 4))
    return float(np.degrees(sigma_px * z_m**2 / (FOCAL_PX * RING_M * spread)))


def flip_law_is_met(z_m: float, pitch_deg: float, count: int, seed: int) -> None:
    draws = draw_poses(np.random.default_rng(seed), 1, z_m, 0.1)
    place = make_pose(0.06, 0, z_m, pitch_deg, 0, 5)
    rng = np.random.default_rng(seed)
    exact = np.stack(
        [project_disc_centers(draws.rig, place, draws.layout.centers_m, 0.05, e) for e in ("left", "right")]
    )
    pixels = exact + 0.1 * rng.standard_normal((count, *exact.shape))
    batch = solve_joint_batch(draws.rig, draws.layout, pixels, 0.01 * np.eye(2))
    rate = float((batch.rotations[:, :2, 2] @ place.rotation[:2, 2] < 0).mean())
    law = erfc(pitch_deg / frontal_tilt_sigma_deg(0.1, z_m) / np.sqrt(2)) / 2
    # The law is known within 0.02; three binomial deviations.
    assert rate == pytest.approx(law, abs=0.02 + 3 * np.sqrt(law * (1 - law) / count))


@pytest.mark.parametrize(("z_m", "pitch_deg"), [(10.0, 2.0), (15.0, 5.0), (20.0, 6.0)])
def test_flips_without_a_hub_follow_the_law(z_m: float, pitch_deg: float) -> None:
    flip_law_is_met(z_m, pitch_deg, 1500, 12)


@pytest.mark.slow
@pytest.mark.parametrize("z_m", [10.0, 15.0, 20.0, 30.0, 40.0])
@pytest.mark.parametrize("share", [0.3, 0.6, 1.0, 1.5, 2.0])
def test_flips_without_a_hub_follow_the_law_everywhere(z_m: float, share: float) -> None:
    pitch_deg = share * frontal_tilt_sigma_deg(0.1, z_m)
    if pitch_deg > 10:
        pytest.skip("the law is of tilts up to 10 degrees")
    flip_law_is_met(z_m, pitch_deg, 10_000, 13)


@pytest.mark.parametrize(("z_m", "published_deg", "lower_cost_deg"), [(20.0, 2.98, 3.62), (40.0, 5.29, 7.28)])
def test_the_mean_over_both_tilts_beats_the_lower_cost(z_m: float, published_deg: float, lower_cost_deg: float) -> None:
    draws = draw_poses(np.random.default_rng(14), 800, z_m, 0.1)
    batch = solve(draws, hub=False)
    assert not batch.tilt_sign_reliable.any()
    errors = errors_of(draws, batch)
    # 1600 angles: 1/sqrt(3200) = 1.8 %; three of it.
    assert tilt_rmse_deg(errors) < 1.054 * published_deg
    assert tilt_rmse_deg(errors) < lower_cost_deg
    np.testing.assert_allclose(batch.mode_weights.sum(axis=1), 1, atol=1e-12)
    # Two Gaussians stand for a banana; the bar for reported covariances is 0.85 to 1.20.
    assert 0.85 < nees(errors, batch) < 1.2


@pytest.mark.parametrize("z_m", [2.0, 5.0, 8.0])
def test_joint_without_hub_reaches_the_bound_where_the_tilt_is_certain(z_m: float) -> None:
    draws = draw_poses(np.random.default_rng(15), 500, z_m, 0.05, tilt_deg=(5.0, 10.0))
    batch = solve(draws, hub=False)
    assert batch.tilt_sign_reliable.all()
    errors = errors_of(draws, batch)
    bounds = draws.bounds(8)
    ratio = np.sqrt(((errors[:, :5] / bounds) ** 2).mean(axis=0))
    # Measured as 0.98-1.05; sampling as above.
    assert ratio.max() < 1.05 + 0.11
    assert nees(errors, batch) == pytest.approx(1.0, abs=0.104)


def test_batch_and_single_frame_agree() -> None:
    draws = draw_poses(np.random.default_rng(16), 12, (1.7, 40.0), 0.1)
    for method, hub in ((joint, False), (joint_hub, True)):
        batch = solve(draws, hub)
        for index in range(12):
            single = method(draws.observation(index))
            assert isinstance(single, Solution)
            # Batches stop together, single frames alone; what is left of either is 5e-5 deviations.
            scale = np.sqrt(np.diag(single.covariance))
            away = single.left_from_drogue.translation_m - batch.translations_m[index]
            assert (np.abs(away) < 1e-3 * scale[:3]).all()
            np.testing.assert_allclose(
                single.covariance, batch.covariances[index], rtol=1e-2, atol=1e-2 * scale.min() ** 2
            )


def test_every_edge_of_the_hub_has_its_own_ellipse_centre() -> None:
    draws = draw_poses(np.random.default_rng(17), 20, (1.7, 3.0), 0.05)
    for index, place in enumerate(draws.places):
        solution = joint_hub(draws.observation(index, pixels_px=draws.exact_px[index]))
        # One radius for both edges would shift their centres by 0.2 px here, and the pose by tenths of millimetres.
        np.testing.assert_allclose(solution.left_from_drogue.translation_m, place.translation_m, atol=1e-7)
        np.testing.assert_allclose(solution.left_from_drogue.rotation, place.rotation, atol=1e-6)
        assert solution.used_hub is not None
        assert solution.used_hub.all()
        assert solution.note == ""


def test_without_a_measured_hub_the_solution_is_that_of_joint_with_a_note() -> None:
    draws = draw_poses(np.random.default_rng(18), 5, 15.0, 0.1)
    for index in range(5):
        plain, without = joint(draws.observation(index)), joint_hub(draws.observation(index, hub=False))
        # Rounding.
        np.testing.assert_allclose(plain.left_from_drogue.as_matrix(), without.left_from_drogue.as_matrix(), atol=1e-9)
        np.testing.assert_allclose(plain.covariance, without.covariance, rtol=1e-6, atol=1e-15)
        assert "no hub was measured" in without.note
        assert without.used_hub is None
        # The ring's own tilt is known to degrees at 15 m, with the hub to a tenth of one.
        with_hub = joint_hub(draws.observation(index))
        assert without.covariance[3, 3] > 20 * with_hub.covariance[3, 3]


def test_the_noise_of_the_hub_counts() -> None:
    draws = draw_poses(np.random.default_rng(19), 1, 10.0, 0.05, tilt_deg=(6.0, 8.0))
    sharp = draws.observation(0)
    blunt = type(sharp)(sharp.rig, sharp.layout, sharp.pixels_px, sharp.cov_px2, sharp.hub_px, 1e8 * sharp.hub_cov_px2)
    # A hub that is known to 1e4 deviations adds 1e-8 of what the markers tell.
    np.testing.assert_allclose(joint_hub(blunt).covariance, joint(sharp).covariance, rtol=1e-3, atol=1e-12)


def test_one_edge_in_one_eye_is_enough_for_the_sign() -> None:
    draws = draw_poses(np.random.default_rng(20), 30, 20.0, 0.05, tilt_deg=(3.0, 10.0))
    for index, place in enumerate(draws.places):
        pixels = draws.pixels_px[index].copy()
        pixels[1, 8:], pixels[0, 8] = np.nan, np.nan
        solution = joint_hub(draws.observation(index, pixels_px=pixels))
        assert solution.left_from_drogue.rotation[:2, 2] @ place.rotation[:2, 2] > 0
        assert solution.used_hub.tolist() == [[False, True], [False, False]]


@pytest.mark.parametrize(("sigma_px", "fixed_mm", "prior_mm"), [(0.02, 16.1, 3.8), (0.1, 17.1, 13.4)])
def test_a_prior_on_the_rings_radius_corrects_for_a_wrong_radius(
    sigma_px: float, fixed_mm: float, prior_mm: float
) -> None:
    draws = draw_poses(np.random.default_rng(21), 1000, 10.0, sigma_px, ring_sigma_m=5e-4)
    fixed, free = solve(draws, hub=False), solve(draws, hub=False, tolerances=StatedTolerances(5e-4))
    errors_fixed, errors_free = errors_of(draws, fixed), errors_of(draws, free)
    z_mm = [1e3 * np.sqrt((errors[:, 2] ** 2).mean()) for errors in (errors_fixed, errors_free)]
    # 1000 draws: 1/sqrt(2000) = 2.2 %; three of it, and 3 % for the digits and draws of the published numbers.
    assert z_mm[0] == pytest.approx(fixed_mm, rel=0.1)
    assert z_mm[1] == pytest.approx(prior_mm, rel=0.1)
    # Without the prior the covariance knows nothing of the radius.
    assert nees(errors_fixed, fixed) > 3
    assert 0.85 < nees(errors_free, free) < 1.2


def test_a_tolerance_of_zero_is_the_fixed_ring() -> None:
    draws = draw_poses(np.random.default_rng(22), 5, 10.0, 0.05, tilt_deg=(6.0, 8.0))
    fixed, tight = solve(draws, hub=True), solve(draws, hub=True, tolerances=StatedTolerances(1e-9))
    # A nanometre of radius is 4e-8 m of distance at 10 m.
    np.testing.assert_allclose(tight.translations_m, fixed.translations_m, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("z_m", [1.7, 2.0, 3.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0])
def test_joint_hub_reaches_the_bound_closely(z_m: float) -> None:
    draws = draw_poses(np.random.default_rng(23), 10_000, z_m, 0.05)
    batch = solve(draws, hub=True)
    errors = errors_of(draws, batch)
    bounds = draws.bounds(10)
    # Measured as 0.99-1.04; 10,000 draws: 0.7 %, three of it.
    assert np.sqrt(((errors[:, :5] / bounds) ** 2).mean(axis=0)).max() < 1.04 + 0.021
    assert 0.97 < nees(errors, batch) < 1.03


@pytest.mark.parametrize("rows_px", [0.02, 0.1, 0.5])
@pytest.mark.parametrize(("method", "features"), [(joint, 8), (joint_hub, 10), (joint_robust, 10)])
def test_deviations_grow_with_an_error_that_all_markers_share(
    method: Callable[..., Any], features: int, rows_px: float
) -> None:
    sigma_px, freedom = 0.004, 4 * features - 6
    draws = draw_poses(np.random.default_rng(24), 10, 3.0, sigma_px)
    for index, place in enumerate(draws.places):
        pixels = draws.pixels_px[index] + np.array([[[0.0, 0.0]], [[0.0, rows_px]]])
        solution = method(draws.observation(index, pixels_px=pixels))
        off_m = solution.left_from_drogue.translation_m - place.translation_m
        # Half of the rows' error moves the pose by r sqrt(2 F) of the nominal deviations, where r is that half over the
        # noise, and half stays in the residuals: chi-square is 2 F r^2, and their quotient at most sqrt(freedom). One
        # more for the noise. The nominal deviations are exceeded by up to 25 r.
        assert (np.abs(off_m) < (np.sqrt(freedom) + 1) * np.sqrt(np.diag(solution.covariance)[:3])).all()


@pytest.mark.parametrize("z_m", [2.0, 10.0, 40.0])
def test_deviations_that_noise_explains_stay(z_m: float) -> None:
    draws = draw_poses(np.random.default_rng(25), 20, z_m, 0.05)
    for index in range(20):
        features = observed_features(draws.observation(index), with_hub=False)
        single = joint(draws.observation(index))
        np.testing.assert_array_equal(single.covariance, solve_features(features).covariances[0])
