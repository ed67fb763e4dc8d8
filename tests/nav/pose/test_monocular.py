"""Monocular methods: the closed form of a circle's pose, the bound of one eye, and known error laws."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from geometry.circles import project_disc_centers
from geometry.stereo import EYES
from nav.pose.method_registry import METHODS
from nav.pose.monocular import circle_poses, conic_through
from nav.pose.pose_method import EXACT, Observation, StatedTolerances
from tests.support.painted_pairs import draw_poses


def circle_cone(center: np.ndarray, normal: np.ndarray, radius: float) -> np.ndarray:
    """Conic of the rays d with |(n.c) d / (n.d) - c| = r, with one negative eigenvalue."""
    n_c = normal @ center
    cone = n_c**2 * np.eye(3) - n_c * (np.outer(center, normal) + np.outer(normal, center))
    cone += (center @ center - radius**2) * np.outer(normal, normal)
    return cone if np.linalg.det(cone) < 0 else -cone


def test_pose_of_a_circle_in_closed_form() -> None:
    rng = np.random.default_rng(51)
    for _ in range(200):
        center = np.append(rng.uniform(-0.3, 0.3, 2), 1.0) * rng.uniform(1.5, 20)
        normal = np.append(rng.uniform(-0.5, 0.5, 2), 1.0)
        normal /= np.linalg.norm(normal)
        radius = rng.uniform(0.1, 0.3)
        centers, normals = circle_poses(rng.uniform(0.1, 10) * circle_cone(center, normal, radius), radius)
        best = np.argmin(np.linalg.norm(centers - center, axis=1))
        # The ring's share of the cone is (r/z)^2 >= 2.5e-5, so rounding of 2e-16 grows to 1e-11 of the distance.
        np.testing.assert_allclose(centers[best], center, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(normals[best], normal, atol=1e-9)
        # The other solution shows the same ellipse.
        other = circle_cone(centers[1 - best], normals[1 - best], radius)
        mine = circle_cone(center, normal, radius)
        np.testing.assert_allclose(other / np.linalg.norm(other), mine / np.linalg.norm(mine), atol=1e-9)


def test_conic_through_points_of_a_circle() -> None:
    rng = np.random.default_rng(52)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 7))
    points = np.column_stack([0.2 + 0.1 * np.cos(angle), -0.3 + 0.05 * np.sin(angle)])
    conic = conic_through(points)
    rays = np.column_stack([points, np.ones(7)])
    # Seven exact points: float64 of numbers near one, divided by the ellipse's size squared.
    np.testing.assert_allclose(np.einsum("ki,ij,kj->k", rays, conic, rays) / np.abs(conic).max(), 0, atol=1e-12)
    hyperbola = np.column_stack([np.cosh(np.linspace(-1, 1, 7)), np.sinh(np.linspace(-1, 1, 7))])
    assert conic_through(hyperbola) is None


@pytest.mark.parametrize("z_m", [2.0, 5.0])
@pytest.mark.parametrize("name", ["mono-ippe", "mono-sqpnp", "mono-lm"])
def test_monocular_methods_reach_the_bound_of_one_eye(name: str, z_m: float) -> None:
    draws = draw_poses(np.random.default_rng(54), 250, z_m, 0.05, tilt_deg=(6.0, 10.0))
    left = type(draws)(draws.rig, draws.layout, 0.05, draws.places, draws.exact_px[:, :1], draws.pixels_px[:, :1])
    errors = []
    for index in range(250):
        pose = METHODS[name](draws.observation(index)).left_from_drogue
        errors.append(draws.errors(index, pose.rotation, pose.translation_m)[:5])
    ratios = np.array(errors) / left.bounds(8)
    # Measured as 0.96-1.14; 1/sqrt(500) = 4.5 %, three of it.
    ratio = np.sqrt(np.mean(np.square(ratios), axis=0))
    assert ratio.max() < 1.14 + 0.14
    assert ratio.min() > 0.96 - 0.14


@pytest.mark.parametrize("name", ["mono-ippe", "mono-sqpnp"])
@pytest.mark.parametrize(
    "tolerances", [EXACT, StatedTolerances(ring_radius_m=5e-4, ellipticity=2e-3, placement_m=3e-4)]
)
def test_covariance_of_solvers_that_weigh_a_bad_marker_like_good_ones(name: str, tolerances: StatedTolerances) -> None:
    rng = np.random.default_rng(57)
    draws = draw_poses(rng, 100, 4.0, 0.03, tilt_deg=(6.0, 10.0))
    sigma_px = np.full((2, 8), 0.03)
    sigma_px[:, 2] = 0.3
    squares = []
    for index, place in enumerate(draws.places):
        # Ring and markers depart from nominal as stated; the ellipse's direction is drawn.
        turn, arms = rng.uniform(0, 2 * np.pi), draws.layout.centers_m[:, :2]
        stretch = np.array([[np.cos(turn), np.sin(turn)], [np.sin(turn), -np.cos(turn)]]) * tolerances.ellipticity / 2
        arms = arms @ (np.eye(2) * (1 + tolerances.ring_radius_m / 0.28 * rng.standard_normal()) + stretch)
        centers = np.column_stack([arms, np.zeros(8)]) + tolerances.placement_m * rng.standard_normal((8, 3))
        exact = [project_disc_centers(draws.rig, place, centers, np.full(8, 0.05), eye) for eye in EYES]
        pixels = np.array(exact) + sigma_px[..., None] * rng.standard_normal((2, 8, 2))
        cov = sigma_px[..., None, None] ** 2 * np.eye(2)
        solution = METHODS[name](Observation(draws.rig, draws.layout, pixels, cov, tolerances=tolerances))
        pose = solution.left_from_drogue
        error = np.delete(draws.errors(index, pose.rotation, pose.translation_m), [3, 4])
        squares.append(error @ np.linalg.solve(solution.covariance, error) / 6)
    # 1 by definition, measured as 0.96-1.11; sqrt(2 / 600) = 6 %, four of it. As if well weighted, it would be 8.
    assert 0.76 < np.mean(squares) < 1.24


def test_poses_of_ippe_that_are_refined_to_one_minimum_are_one_mode() -> None:
    draws = draw_poses(np.random.default_rng(58), 60, (3.0, 8.0), 0.05)
    single = 0
    for index in range(60):
        modes = METHODS["mono-ippe"](draws.observation(index)).modes
        axes = [mode.left_from_drogue.rotation[:, 2] for mode in modes]
        # Measured: equal to rounding, or 0.06 apart and more.
        assert all(np.linalg.norm(one - other) > 1e-3 for one, other in combinations(axes, 2))
        assert sum(mode.weight for mode in modes) == pytest.approx(1)
        single += len(modes) == 1
    # Near, where the image is far from affine, some drogues leave one minimum only.
    assert single > 0


@pytest.mark.parametrize(("z_m", "z_rmse_mm"), [(2.0, 0.41), (5.0, 2.5), (10.0, 10.0)])
def test_depth_of_the_ellipse(z_m: float, z_rmse_mm: float) -> None:
    draws = draw_poses(np.random.default_rng(55), 200, z_m, 0.1)
    errors = [
        METHODS["mono-circle"](draws.observation(i)).left_from_drogue.translation_m[2] - place.translation_m[2]
        for i, place in enumerate(draws.places)
    ]
    # Published for the closed form; the refinement may only gain. 1/sqrt(400) = 5 %, three of it.
    assert 1e3 * np.sqrt(np.mean(np.square(errors))) < 1.15 * z_rmse_mm


def test_the_hub_chooses_the_branch_of_the_ellipse() -> None:
    draws = draw_poses(np.random.default_rng(56), 60, 15.0, 0.1, tilt_deg=(5.0, 10.0))
    wrong = {True: 0, False: 0}
    for index, place in enumerate(draws.places):
        for hub in wrong:
            axis = METHODS["mono-circle"](draws.observation(index, hub=hub)).left_from_drogue.rotation[:2, 2]
            wrong[hub] += axis @ place.rotation[:2, 2] < 0
    assert wrong[True] == 0
    # One eye's deviation at the frontal pose is 5.3 degrees here: one in ten is wrong.
    assert wrong[False] > 0
