"""Navigation through real lenses: centres are measured where the light fell, and poses are as good as ideal eyes'."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from datasets_manifest.recipe.rigs import resolve_rig
from datasets_manifest.types.estimates import PoseEstimate
from geometry.circles import disc_image_centers, disc_outline, project_disc_centers
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES, Eye, paper_rig
from labelgen.frame_labels import label_frame
from nav.centroids.ellipses import outline_shapes
from nav.lens_correction import distort_points, undistort_points
from nav.pair_navigator import PairNavigator
from render.camera.sensor import expose
from render.engine import load_engine
from scenes.sampler import sample_frame
from tests.support.recipe_builder import PLAIN_SKY, build_recipe, stations

DISCS = 5.0 * np.stack([np.eye(2)] * 2)
RIG, _ = resolve_rig("paper-real", 3)
POSE = RigidTransform(rotation_from_angles(0.1, -0.1, 0.3), np.array([0.2, -0.15, 1.8]))


def shapes_of(project: Callable[..., Any], centers_m: np.ndarray, eye: Eye) -> np.ndarray:
    outlines = np.stack([project(disc_outline(POSE, center, 0.05, 64), eye) for center in centers_m])
    return outline_shapes(outlines - outlines.mean(axis=1, keepdims=True))


@pytest.mark.parametrize("eye", EYES)
def test_centres_of_discs_go_back_and_forth(eye: Eye) -> None:
    """Against polygons through the discs' true edges; a lens shifts a centre otherwise than a point."""
    centers_m = np.array([[0.27, 0.0, 0.0], [0.0, 0.27, 0.0], [-0.27, 0.0, 0.0]])
    radii_m = np.full(3, 0.05)
    ideal = project_disc_centers(RIG, POSE, centers_m, radii_m, eye)
    real = disc_image_centers(RIG, POSE, centers_m, radii_m, eye)
    cov = np.broadcast_to(np.eye(2), (3, 2, 2))
    # What is left is of the third order in the disc's size: perspective within it, and higher slopes of the lens.
    back, delivered = distort_points(RIG, eye, ideal, shapes_of(RIG.project, centers_m, eye), cov)
    np.testing.assert_allclose(back, real, atol=3e-3)
    found, moved = undistort_points(RIG, eye, real, shapes_of(RIG.image, centers_m, eye), cov)
    np.testing.assert_allclose(found, ideal, atol=3e-3)
    outline = disc_outline(POSE, centers_m[0], 0.05, 64)
    growth = np.ptp(RIG.project(outline, eye), axis=0) / np.ptp(RIG.image(outline, eye), axis=0)
    # Sizes of the disc in both images against the slopes that errors are moved by, without their cross terms.
    np.testing.assert_allclose(np.sqrt(np.diagonal(moved[0])), growth, rtol=3e-3)
    np.testing.assert_allclose(np.sqrt(np.diagonal(delivered[0])), 1 / growth, rtol=3e-3)


def test_what_was_not_measured_stays_so() -> None:
    centers = np.array([[np.nan, np.nan], [600.0, 300.0]])
    found, cov = undistort_points(RIG, "right", centers, DISCS, np.full((2, 2, 2), np.nan))
    assert np.isnan(found[0]).all() and np.isfinite(found[1]).all() and np.isnan(cov[0]).all()
    found, cov = distort_points(RIG, "right", centers, DISCS, np.full((2, 2, 2), np.nan))
    assert np.isnan(found[0]).all() and np.isfinite(found[1]).all() and np.isnan(cov[0]).all()


def test_ideal_eyes_change_nothing() -> None:
    centers, cov = np.array([[10.0, 20.0]]), np.ones((1, 2, 2))
    assert undistort_points(paper_rig(), "left", centers, DISCS[:1], cov) == (centers, cov)
    assert distort_points(paper_rig(), "left", centers, DISCS[:1], cov) == (centers, cov)


def test_poses_through_real_lenses() -> None:
    recipe = build_recipe(
        name="real-eyes",
        seed=3,
        rig="paper-real",
        frames={"count": 10},
        distance=stations(2.0, 6.0),
        environment=PLAIN_SKY,
        render={"engine": "analytic"},
    )
    engine, navigator = load_engine("analytic"), PairNavigator(recipe.rig, recipe.drogue)
    for index in range(4):
        frame = sample_frame(recipe, index)
        radiance = engine.render(frame, recipe.render)
        images = expose(frame, radiance)
        record = label_frame(frame, radiance, images)
        (answer,) = navigator.estimate(index, images, ["joint-hub"])
        assert isinstance(answer, PoseEstimate), answer
        error_m = answer.left_from_drogue.translation_m - frame.left_from_drogue.translation_m
        # Five of the estimate's own deviations; a pixel of distortion left in would be hundreds.
        assert (np.abs(error_m) < 5 * np.sqrt(np.diag(answer.covariance)[:3]) + 2e-6).all()
        for feature in answer.features:
            view = record.views.left if feature.eye == "left" else record.views.right
            truth = view.hub if feature.index == "hub" else view.markers[feature.index]
            # Measured centres are told in the delivered image; the hub's are some three times as noisy.
            limit_px = 0.06 if feature.index == "hub" else 0.02
            np.testing.assert_allclose(feature.center_px, truth.center_ellipse_px, atol=limit_px)
