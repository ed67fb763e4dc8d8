"""Starts, weights and mean of the two tilts against closed forms and numpy. Tolerances are rounding."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array
from nav.pose.adjustment import information_at, inverse_information
from nav.pose.features import Features, stack_features
from nav.pose.tilt_pairs import (
    TiltPairs,
    line_of_sight_rotations,
    mixture_mean,
    mode_weights,
    two_fold_starts,
)
from tests.support.painted_pairs import Draws, draw_poses

Z_M = 12.0


@pytest.fixture(scope="module")
def draws() -> Draws:
    return draw_poses(np.random.default_rng(5), 1, Z_M, 0.0)


def _weak_perspective(draws: Draws, rotations: Array, middles_m: Array) -> Features:
    """What eyes would see of markers whose depth they take for that of the drogue's origin, (B, 3) between the eyes."""
    camera, places_m = draws.rig.camera, draws.layout.centers_m[:, :2]
    toward = line_of_sight_rotations(middles_m)
    flat = (np.swapaxes(toward, 1, 2) @ rotations)[:, :2, :2]
    arms = places_m @ np.swapaxes(flat, 1, 2) / middles_m[:, None, 2:]
    rays = middles_m[:, None, :2] / middles_m[:, None, 2:] + arms
    pixels = rays * (camera.fx_px, camera.fy_px) + (camera.cx_px, camera.cy_px)
    # Any disparity: the starts follow the mean of both eyes.
    shift_px = np.array([[30.0, 0.0], [-30.0, 0.0]])[None, :, None]
    return stack_features(draws.rig, draws.layout, pixels[:, None] + shift_px, np.eye(2))


def test_starts_are_the_tilt_that_was_seen_and_its_mirror_image(draws: Draws) -> None:
    rng = np.random.default_rng(1)
    tilts = rng.uniform(-0.6, 0.6, (40, 2))
    rotations = Rotation.from_euler("YXZ", np.column_stack([tilts, rng.uniform(-3, 3, 40)])).as_matrix()
    middles_m = np.column_stack([rng.uniform(-2, 2, (40, 2)), rng.uniform(5, 40, 40)])
    starts, translations_m = two_fold_starts(_weak_perspective(draws, rotations, middles_m))
    middle_x_m = draws.rig.baseline_m / 2
    np.testing.assert_allclose(translations_m[:, 0], middles_m + np.array([middle_x_m, 0, 0]), rtol=1e-9)
    np.testing.assert_array_equal(translations_m[:, 0], translations_m[:, 1])
    # Along the line of sight the mirror image has the other sign of what the third row has of the rim plane.
    toward = line_of_sight_rotations(middles_m)
    seen = np.swapaxes(toward, 1, 2) @ rotations
    sign = np.array([[1, 1, -1], [1, 1, -1], [-1, -1, 1]])
    expected = toward[:, None] @ np.stack([seen, seen * sign], axis=1)
    gaps = np.abs(starts[:, :, None] - expected[:, None]).max(axis=(3, 4))
    # In either order.
    assert np.minimum(gaps[:, [0, 1], [0, 1]].max(axis=1), gaps[:, [0, 1], [1, 0]].max(axis=1)).max() < 1e-9


def test_starts_leave_out_markers_that_one_eye_did_not_measure(draws: Draws) -> None:
    features = _weak_perspective(draws, np.eye(3)[None], np.array([[0.3, -0.2, Z_M]]))
    features.measured[:2, 0, 1, 2], features.measured[2:, 0, 1, 2] = 1e3, 0.0
    _, translations_m = two_fold_starts(features)
    np.testing.assert_allclose(translations_m[0, 0], [0.3 + draws.rig.baseline_m / 2, -0.2, Z_M], rtol=1e-9)
    features.measured[2] = 0.0
    assert np.isnan(two_fold_starts(features)[0]).all()


def test_rotations_to_lines_of_sight_are_the_smallest() -> None:
    directions = np.random.default_rng(2).normal(size=(30, 3)) + np.array([0, 0, 4])
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    turns = np.cross([0.0, 0.0, 1.0], unit)
    angles = np.arccos(unit[:, 2])
    expected = Rotation.from_rotvec(turns / np.sin(angles)[:, None] * angles[:, None]).as_matrix()
    np.testing.assert_allclose(line_of_sight_rotations(directions), expected, rtol=0, atol=1e-12)


def _pairs(rng: np.random.Generator, count: int) -> TiltPairs:
    arms = rng.normal(size=(count, 2, 7, 9))
    return TiltPairs(
        Rotation.from_rotvec(rng.normal(size=(2 * count, 3)) * 0.2).as_matrix().reshape(count, 2, 3, 3),
        rng.normal(size=(count, 2, 3)) + np.array([0, 0, Z_M]),
        rng.uniform(0, 4, (count, 2)),
        arms @ np.swapaxes(arms, 2, 3),
    )


@pytest.mark.parametrize("prior_rad", [0.1, np.inf])
def test_weights_are_those_of_laplace(prior_rad: float) -> None:
    pairs = _pairs(np.random.default_rng(3), 20)
    tilt2 = (pairs.rotations[..., :2, 2] ** 2).sum(axis=-1)
    density = np.exp(-pairs.costs - tilt2 / (2 * prior_rad**2)) / np.sqrt(np.linalg.det(pairs.information))
    expected = density / density.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(mode_weights(pairs, prior_rad), expected, rtol=1e-9)


def test_impossible_and_equal_poses_have_no_weight() -> None:
    pairs = _pairs(np.random.default_rng(4), 5)
    pairs.translations_m[0, 0, 2] = -1.0
    pairs.rotations[1, 1, :, 2] *= -1
    pairs.rotations[2, 1] = pairs.rotations[2, 0]
    pairs.costs[3] = np.inf
    pairs.information[4, 0] = np.nan
    assert mode_weights(pairs, np.inf).tolist() == [[0, 1], [1, 0], [1, 0], [1, 0], [0, 1]]


def test_the_mean_of_two_poses_has_the_covariance_of_their_mixture() -> None:
    pairs, weights = _pairs(np.random.default_rng(8), 4), np.array([[1.0, 0.0], [0.7, 0.3], [0.7, 0.3], [0.5, 0.5]])
    half_turn = Rotation.from_rotvec([0.0, 0.05, 0.0]).as_matrix()
    pairs.rotations[1, 1] = pairs.rotations[1, 0]
    pairs.rotations[3, 1] = half_turn @ half_turn @ pairs.rotations[3, 0]
    rotations, translations_m, covariances = mixture_mean(pairs, weights)
    own = np.linalg.inv(pairs.information)[..., :6, :6]
    np.testing.assert_allclose(covariances[0], own[0, 0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(rotations[0], pairs.rotations[0, 0], atol=1e-12)
    np.testing.assert_allclose(translations_m, np.einsum("bs,bsi->bi", weights, pairs.translations_m), rtol=1e-12)
    # Of two means that are d apart, the mixture's covariance is the mean one and p (1 - p) d d^T.
    apart = np.append(pairs.translations_m[1, 1] - pairs.translations_m[1, 0], np.zeros(3))
    expected = 0.7 * own[1, 0] + 0.3 * own[1, 1] + 0.21 * np.outer(apart, apart)
    np.testing.assert_allclose(covariances[1], expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(rotations[3], half_turn @ pairs.rotations[3, 0], atol=1e-12)


def test_covariances_are_inverse_information_without_what_is_marginalised() -> None:
    rng = np.random.default_rng(6)
    # Metres and radians differ in size.
    sizes = np.array([1.0, 1.0, 1.0, 1e3, 1e3, 1e3, 10.0, 10.0])
    arms = rng.normal(size=(6, 8, 20)) * sizes[:, None]
    information = arms @ np.swapaxes(arms, 1, 2)
    # Two unknowns that move all measurements alike, no information at all on one, and numbers that are none.
    information[1, 7], information[1, :, 7] = information[1, 6], information[1, :, 6]
    information[1, 7, 7] = information[1, 6, 6]
    information[2, 5], information[2, :, 5] = 0.0, 0.0
    information[3, 0, 0], information[4, 2, 2] = np.nan, np.inf
    covariances, determined = inverse_information(information)
    assert determined.tolist() == [True, False, False, False, False, True]
    assert not covariances[1:5].any()
    for frame in (0, 5):
        expected = np.linalg.inv(information[frame])[:6, :6]
        np.testing.assert_allclose(
            covariances[frame] * sizes[:6] * sizes[:6, None],
            expected * sizes[:6] * sizes[:6, None],
            rtol=1e-9,
            atol=1e-12,
        )


def test_markers_on_a_line_determine_no_pose(draws: Draws) -> None:
    on_a_line = MarkerLayout(np.linspace(-1, 1, 6)[:, None] * np.array([0.25, 0.1, 0.0]), 0.04, None)
    rng = np.random.default_rng(7)
    rotations = Rotation.from_rotvec(rng.normal(size=(50, 3)) * 0.3).as_matrix()
    places_m = np.column_stack([rng.uniform(-1, 1, (50, 2)), rng.uniform(2, 40, 50)])
    features = stack_features(draws.rig, on_a_line, np.full((50, 2, 6, 2), 500.0), 0.01 * np.eye(2))
    assert not inverse_information(information_at(features, rotations, places_m))[1].any()
