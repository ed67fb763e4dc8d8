"""Layouts that do not lie in the rim plane: methods against OpenCV, and one line from those that need a plane."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from datasets_manifest.recipe.rigs import paper_rig
from drogue_models.marker_layout import MarkerLayout, marker_layout
from drogue_models.parameters import even_ring
from drogue_models.presets import load_drogue
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES
from nav.matching.marker_channel import Blobs
from nav.matching.ring_matching import match_ring
from nav.pose.method_registry import METHODS
from nav.pose.pose_method import NoFixReason, Observation, Solution

RIG = paper_rig()
# Points: OpenCV knows no discs.
POINT_M = 1e-6


def two_rings(marker_radius_m: float = POINT_M) -> MarkerLayout:
    """Six markers near the mouth and six further in, the inner ones turned by half a step."""
    outer, inner = np.array(even_ring(6, 0.295)), np.array(even_ring(12, 0.225))[1::2]
    depths = np.repeat([0.012, 0.085], 6)
    return MarkerLayout(np.column_stack([np.vstack([outer, inner]), depths]), marker_radius_m, None)


def poses(count: int, seed: int) -> list[RigidTransform]:
    rng = np.random.default_rng(seed)
    return [
        RigidTransform(
            rotation_from_angles(*np.radians(rng.uniform(-12, 12, 2)), np.radians(rng.uniform(-25, 25))),
            np.append(rng.uniform(-0.15, 0.25, 2), 1.0) * np.array([1.0, 1.0, rng.uniform(2.5, 12.0)]),
        )
        for _ in range(count)
    ]


def opencv_images(layout: MarkerLayout, pose: RigidTransform) -> np.ndarray:
    turn, _ = cv2.Rodrigues(pose.rotation)
    shifts = [pose.translation_m - RIG.eye_offset_m(eye) for eye in EYES]
    images = [cv2.projectPoints(layout.centers_m, turn, shift, RIG.camera.matrix(), None)[0] for shift in shifts]
    return np.stack([image[:, 0] for image in images])


def observed(layout: MarkerLayout, pixels: np.ndarray, sigma_px: float) -> Observation:
    return Observation(RIG, layout, pixels, np.tile(sigma_px**2 * np.eye(2), (2, layout.count, 1, 1)))


@pytest.mark.parametrize("method", ["joint", "joint-robust", "mono-lm", "mono-sqpnp", "constant"])
def test_methods_that_need_no_plane_find_the_pose(method: str) -> None:
    layout = two_rings()
    for pose in poses(12, 1):
        if method == "constant":
            pose = RigidTransform(rotation_from_angles(0.0, 0.0, 0.1), pose.translation_m)
        solution = METHODS[method](observed(layout, opencv_images(layout, pose), 0.02))
        assert isinstance(solution, Solution)
        # Exact measurements: what is left is the iterations' tolerance over the weakest direction, depth from one eye.
        np.testing.assert_allclose(solution.left_from_drogue.translation_m, pose.translation_m, rtol=0, atol=2e-6)
        turn = solution.left_from_drogue.rotation.T @ pose.rotation
        assert np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)) < 1e-4


def test_one_eye_agrees_with_opencv_on_noisy_points() -> None:
    layout, rng = two_rings(), np.random.default_rng(2)
    for pose in poses(12, 3):
        pixels = opencv_images(layout, pose) + 0.1 * rng.standard_normal((2, layout.count, 2))
        solution = METHODS["mono-lm"](observed(layout, pixels, 0.1))
        assert isinstance(solution, Solution)
        start, _ = cv2.Rodrigues(pose.rotation)
        _, turn, shift = cv2.solvePnP(
            layout.centers_m, pixels[0], RIG.camera.matrix(), None, start, pose.translation_m.copy(), True,
            cv2.SOLVEPNP_ITERATIVE,
        )  # fmt: skip
        ours = solution.left_from_drogue
        # Both are the least-squares pose; OpenCV stops at steps of its float epsilon, 1e-7 of the parameters.
        np.testing.assert_allclose(ours.translation_m, shift.ravel(), rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(ours.rotation, cv2.Rodrigues(turn)[0], rtol=0, atol=2e-4)


@pytest.mark.parametrize(
    ("method", "reason"),
    [
        ("mean-plane", "this method fits a plane, and the drogue's markers lie at several depths"),
        ("disparity-plane", "this method fits a plane, and the drogue's markers lie at several depths"),
        ("mono-ippe", "IPPE needs all markers in one plane, and the drogue's lie at several depths"),
        ("circle-fit", "a circle fit needs all markers on one circle about the drogue's origin"),
        ("paper", "the paper's method needs all markers on one circle about the drogue's origin"),
        ("mono-circle", "an ellipse needs all markers on one circle about the drogue's origin"),
    ],
)
def test_methods_that_need_a_plane_or_a_circle_say_so(method: str, reason: str) -> None:
    layout = two_rings()
    answer = METHODS[method](observed(layout, opencv_images(layout, poses(1, 4)[0]), 0.02))
    assert answer == NoFixReason(reason)


@pytest.mark.parametrize("method", ["mean-plane", "disparity-plane", "mono-ippe", "joint"])
def test_a_ring_behind_the_rim_plane_is_as_good_as_one_in_it(method: str) -> None:
    layout = MarkerLayout(np.column_stack([np.array(even_ring(8, 0.25)), np.full(8, 0.04)]), POINT_M, None)
    assert layout.ring_radius_m is None and layout.is_flat
    for pose in poses(6, 5):
        solution = METHODS[method](observed(layout, opencv_images(layout, pose), 0.02))
        assert isinstance(solution, Solution)
        np.testing.assert_allclose(solution.left_from_drogue.translation_m, pose.translation_m, rtol=0, atol=2e-6)


def test_symmetry_of_markers_at_depths() -> None:
    layout = marker_layout(load_drogue("basket-strut-markers"))
    assert layout.symmetry_order == 6 and not layout.is_flat
    centers = layout.centers_m.copy()
    centers[0, 2] += 0.01
    assert MarkerLayout(centers, layout.radius_m, None).symmetry_order == 1
    none = MarkerLayout(np.zeros((0, 3)), 0.05, None)
    assert (none.count, none.symmetry_order, none.ring_radius_m, none.is_flat) == (0, 1, None, True)


# Within 2 m perspective, which the map leaves out, moves markers of 24 mm radius at depths 73 mm apart by 9 mm.
@pytest.mark.parametrize(("distance_m", "least"), [(1.9, 9), (2.5, 12), (12.0, 12)])
def test_tilted_markers_at_depths_are_matched(distance_m: float, least: int) -> None:
    layout = two_rings(0.024)
    rng = np.random.default_rng(6)
    for pitch_deg, yaw_deg in ((15.0, 0.0), (0.0, -15.0), (11.0, 11.0)):
        rotation = rotation_from_angles(np.radians(pitch_deg), np.radians(yaw_deg), 0.05)
        centers = opencv_images(layout, RigidTransform(rotation, np.array([0.05, 0.02, distance_m])))[0]
        order = rng.permutation(layout.count)
        radius_px = RIG.camera.fx_px * layout.radius_m / distance_m
        areas = np.full(layout.count, np.pi * radius_px**2)
        found = match_ring(Blobs(centers[order], areas), layout)
        assert found is not None and found.count >= least
        marker = np.flatnonzero(found.blob_of_marker >= 0)
        true = order[found.blob_of_marker[marker]]
        # Each ring keeps to itself, and both are turned by the same multiple of 60 degrees.
        np.testing.assert_array_equal(true // 6, marker // 6)
        assert len(set(((true - marker) % 6).tolist())) == 1
