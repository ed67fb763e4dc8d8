"""Keypoints of a ring: an order that does not depend on how they come, and poses that do not depend on the order."""

from __future__ import annotations

import numpy as np
import pytest

from drogue_models.marker_layout import MarkerLayout, marker_layout
from drogue_models.presets import load_drogue
from geometry.circles import project_disc_centers
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES, StereoRig, paper_rig
from nav.pose.joint import joint
from nav.pose.pose_method import Solution
from studies.learned_pose.eye_poses import pose_of_eye, refined_sqpnp
from studies.learned_pose.ring_keypoints import (
    EyeKeypoints,
    clockwise_from_top,
    ring_center,
    ring_observation,
    ring_slots,
)

RIG, LAYOUT = paper_rig(), marker_layout(load_drogue("red-8"))


def ring(count: int = 8, phase_deg: float = 10.0, radius_px: float = 80.0) -> np.ndarray:
    """Points of a regular ring about (120, 130), clockwise; the first `phase_deg` to the right of the top."""
    angles = np.radians(phase_deg) + 2 * np.pi * np.arange(count) / count
    return np.array([120.0, 130.0]) + radius_px * np.column_stack([np.sin(angles), -np.cos(angles)])


def pose(roll_deg: float, distance_m: float = 6.0) -> RigidTransform:
    rotation = rotation_from_angles(np.radians(7.0), np.radians(-5.0), np.radians(roll_deg))
    return RigidTransform(rotation, np.array([0.3, -0.2, distance_m]))


def images(left_from_drogue: RigidTransform, rig: StereoRig = RIG) -> list[np.ndarray]:
    return [project_disc_centers(rig, left_from_drogue, LAYOUT.centers_m, LAYOUT.radius_m, eye) for eye in EYES]


def observed(points: list[np.ndarray]) -> Solution:
    first, second = (EyeKeypoints(each, 0.1) for each in points)
    answer = joint(ring_observation(RIG, LAYOUT, (first, second)))
    assert isinstance(answer, Solution)
    return answer


def test_the_first_is_the_first_clockwise_from_the_top() -> None:
    top, right, bottom, left = [10.0, 0.0], [20.0, 10.0], [10.0, 20.0], [0.0, 10.0]
    points = np.array([left, bottom, top, right])
    assert clockwise_from_top(points + np.array([0.01, 0.0])).tolist() == [2, 3, 1, 0]


@pytest.mark.parametrize("seed", range(5))
def test_the_order_does_not_depend_on_how_the_points_come(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = ring(phase_deg=float(rng.uniform(1, 44)))
    mixed = rng.permutation(points)
    np.testing.assert_array_equal(mixed[clockwise_from_top(mixed)], points)


def test_missing_and_double_points_do_not_move_the_centre() -> None:
    points = ring()
    # Rounding of a least-squares fit of numbers near 100.
    np.testing.assert_allclose(ring_center(points[[0, 1, 1, 2, 4]]), [120.0, 130.0], atol=1e-9)
    slots, phase = ring_slots(points[[5, 1, 1, 0, 7]], 8)
    assert slots.tolist() == [5, 1, 1, 0, 7]
    assert phase == pytest.approx(np.radians(10.0), abs=1e-9)


def test_both_eyes_agree_where_the_top_lies_between_their_first_markers() -> None:
    # The left ring is turned a little more than the right one, across the place where the order changes.
    slots, phase = ring_slots(ring(phase_deg=44.5), 8)
    others, other_phase = ring_slots(ring(phase_deg=45.5), 8, phase)
    assert slots.tolist() == others.tolist() == list(range(8))
    assert other_phase - phase == pytest.approx(np.radians(1.0), abs=1e-9)
    assert ring_slots(ring(phase_deg=45.5), 8)[0].tolist() == [1, 2, 3, 4, 5, 6, 7, 0]


def test_red_8_is_a_regular_ring() -> None:
    assert LAYOUT.symmetry_order == LAYOUT.count == 8 and LAYOUT.is_flat


@pytest.mark.parametrize("roll_deg", [-40.0, -0.3, 0.0, 0.3, 10.0, 100.0])
def test_position_and_axis_do_not_depend_on_the_order(roll_deg: float) -> None:
    true, rng = pose(roll_deg), np.random.default_rng(3)
    points = [rng.permutation(image) for image in images(true)]
    first, second = (EyeKeypoints(each, 0.1) for each in points)
    observation = ring_observation(RIG, LAYOUT, (first, second))
    found = [pose_of_eye(observation, eye, refined_sqpnp) for eye in range(2)]
    for each in (observed(points).left_from_drogue, *found):
        assert each is not None
        # The second pass corrects the discs' shift of 0.02 px by a pose that errs by as little: 1e-5 m are left at 6 m.
        np.testing.assert_allclose(each.translation_m, true.translation_m, atol=1e-5)
        np.testing.assert_allclose(each.rotation[:, 2], true.rotation[:, 2], atol=1e-5)
        turn = np.degrees(np.arctan2(*(true.rotation.T @ each.rotation)[[1, 0], 0]))
        # The shift is a whole number of steps.
        assert abs(turn / 45 - round(turn / 45)) < 1e-4


def test_points_at_one_place_count_once_and_few_points_not_at_all() -> None:
    left, right = images(pose(5.0))
    double = np.vstack([left, left[:1] + np.array([0.2, 0.0])])
    observation = ring_observation(RIG, LAYOUT, (EyeKeypoints(double, 0.1), EyeKeypoints(right[:2], 0.1)))
    assert observation.seen.tolist() == [[True] * 8, [False] * 8]
    moved = np.abs(observation.pixels_px[0][:, None] - left).sum(axis=2).min(axis=1)
    # Half of 0.2 px, at one marker.
    np.testing.assert_allclose(np.sort(moved), [0] * 7 + [0.1], atol=1e-9)


def test_other_drogues_and_bad_keypoints_are_refused() -> None:
    uneven = MarkerLayout(LAYOUT.centers_m[:5], LAYOUT.radius_m, None)
    none = EyeKeypoints(np.zeros((0, 2)), 0.1)
    with pytest.raises(ValueError, match="layout: must be a regular ring"):
        ring_observation(RIG, uneven, (none, none))
    with pytest.raises(ValueError, match="keypoints: must be finite"):
        EyeKeypoints(np.array([[np.nan, 0.0]]), 0.1)
    with pytest.raises(ValueError, match="positive deviation"):
        EyeKeypoints(np.zeros((1, 2)), 0.0)
