"""Batched scores against the benchmark's, frame by frame, and drawn poses against the protocol."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.random_streams import seeded_generator
from drogue_models.marker_layout import marker_layout
from drogue_models.presets import load_drogue
from droguekit.scoring.poses.cramer_rao import (
    FeatureNoise,
    angles_jacobian,
    feature_points,
    features_seen,
    pose_bound,
)
from droguekit.scoring.poses.pose_errors import pose_error
from geometry.circles import project_disc_centers
from geometry.se3 import RigidTransform
from geometry.stereo import EYES, paper_rig
from studies.acceptance.centroid_level.drawn_frames import (
    AS_BUILT,
    TOLERANCED,
    Corruption,
    Poses,
    Tolerances,
    draw_features,
    draw_poses,
    draw_shifts,
    ellipse_centers_px,
)
from studies.acceptance.centroid_level.monte_carlo import (
    bound_deviations,
    component_slopes,
    flipped,
    pose_errors,
    sight_tilts,
)

RIG = paper_rig()
DROGUE = load_drogue("red-8")
LAYOUT = marker_layout(DROGUE)
CENTERS, RADII = feature_points(LAYOUT)


def drawn(count: int = 40, distance_m: tuple[float, float] = (1.7, 40.0)) -> Poses:
    return draw_poses(seeded_generator(1, "test", "poses"), RIG, DROGUE.rim_radius_m, distance_m, count)


def transforms(poses: Poses) -> list[RigidTransform]:
    return [RigidTransform(r, t) for r, t in zip(poses.rotations, poses.translations_m, strict=True)]


def test_drawn_poses_keep_to_the_protocol() -> None:
    poses = drawn(2000)
    rim = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0, 2 * np.pi, 36)]) * DROGUE.rim_radius_m
    for pose in transforms(poses):
        for eye in EYES:
            # The field is that of a disc facing the cameras: tilted by 10 degrees, its near edge appears larger by
            # R sin(14 deg) / Z, at most 5 % of a radius of 420 px.
            assert RIG.camera.contains(RIG.project(pose.apply(rim), eye), margin_px=-22).all()
    assert poses.translations_m[:, 2].min() >= 1.7
    assert poses.translations_m[:, 2].max() <= 40.0


def test_draws_depend_on_seed_cell_and_stream_only() -> None:
    key = (1, "cell", "stream")
    first = seeded_generator(*key).random(4)
    assert (first == seeded_generator(*key).random(4)).all()
    for other in ((2, "cell", "stream"), (1, "other", "stream"), (1, "cell", "other")):
        assert (first != seeded_generator(*other).random(4)).all()


def test_a_drogue_too_near_is_refused() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        drawn(1, (1.2, 1.2))


def test_pixels_are_those_of_the_geometry_package() -> None:
    poses = drawn(5)
    pixels = ellipse_centers_px(RIG, poses, CENTERS, RADII)
    for index, pose in enumerate(transforms(poses)):
        for e, eye in enumerate(EYES):
            # Rounding of a thousand pixels.
            np.testing.assert_allclose(
                pixels[index, e], project_disc_centers(RIG, pose, CENTERS, RADII, eye), atol=1e-9
            )


def test_bounds_are_those_of_the_benchmark() -> None:
    poses = drawn()
    noise = FeatureNoise(0.1, 0.15)
    deviations = bound_deviations(RIG, poses, CENTERS, RADII, noise.by_feature(LAYOUT))
    expected = [pose_bound(RIG, pose, LAYOUT, features_seen(LAYOUT), noise) for pose in transforms(poses)]
    # Central differences are good to 1e-8 of a derivative; at 40 m the inverse magnifies that by the condition.
    np.testing.assert_allclose(deviations, np.array(expected), rtol=1e-4)


def test_slopes_and_errors_are_those_of_the_benchmark() -> None:
    truth, estimates = drawn(10), drawn(10, (5.0, 6.0))
    slopes, errors = component_slopes(truth.rotations), pose_errors(estimates, truth)
    for index, (true, found) in enumerate(zip(transforms(truth), transforms(estimates), strict=True)):
        # Rounding.
        np.testing.assert_allclose(np.deg2rad(slopes[index, 3:, 3:]), angles_jacobian(true), atol=1e-12)
        np.testing.assert_allclose(errors[index], pose_error(found, true).components, atol=1e-9)


def test_a_mirrored_tilt_is_a_flip_and_the_true_one_is_none() -> None:
    truth = drawn(50)
    tilts = sight_tilts(RIG, truth, truth)
    assert not flipped(tilts, tilts).any()
    sight = truth.translations_m - np.array([RIG.baseline_m / 2, 0, 0])
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    axes = truth.rotations[:, :, 2]
    mirrored = truth.rotations.copy()
    mirrored[:, :, 2] = 2 * np.einsum("ni,ni->n", axes, sight)[:, None] * sight - axes
    # A reflection about the line of sight keeps the angle, to rounding.
    np.testing.assert_allclose(sight_tilts(RIG, Poses(mirrored, truth.translations_m), truth), -tilts, atol=1e-9)
    assert flipped(-tilts, tilts).all()


def test_a_drogue_as_built_is_the_nominal_one() -> None:
    true = draw_features(seeded_generator(1, "test", "features"), LAYOUT, AS_BUILT, 3)
    np.testing.assert_array_equal(true.centers_m, np.broadcast_to(CENTERS, (3, *CENTERS.shape)))
    assert not true.right.yaw_rad.any()
    assert not true.right.cx_px.any()


def test_tolerances_have_the_spread_that_they_name() -> None:
    true = draw_features(seeded_generator(1, "test", "features"), LAYOUT, TOLERANCED, 20_000)
    ring = np.linalg.norm(true.centers_m[:, :8, :2], axis=-1).mean(axis=1)
    expected = np.hypot(0.5e-3, 0.3e-3 / np.sqrt(8))
    # Standard error of a spread from 20 000 draws: 0.5 %; four of them.
    assert ring.std() == pytest.approx(expected, rel=0.02)
    assert true.centers_m[:, 8, :2].std() == pytest.approx(1e-3, rel=0.02)
    assert (true.centers_m[:, 8, 2] == LAYOUT.hub_center_m[2]).all()
    assert np.rad2deg(true.right.yaw_rad.std()) == pytest.approx(0.005, rel=0.02)
    assert true.right.cx_px.std() == pytest.approx(0.05, rel=0.02)


def test_an_ellipse_has_the_axes_that_it_names() -> None:
    true = draw_features(seeded_generator(1, "test", "features"), LAYOUT, Tolerances(ellipticity=0.01), 500)
    mapped = np.linalg.lstsq(LAYOUT.centers_m[:, :2], np.moveaxis(true.centers_m[:, :8, :2], 0, 1).reshape(8, -1), None)
    axes = np.linalg.svd(np.moveaxis(mapped[0].reshape(2, 500, 2), 1, 0), compute_uv=False)
    # Exact but for rounding: 1 + e/2 and 1 - e/2.
    np.testing.assert_allclose(axes, np.broadcast_to([1.005, 0.995], (500, 2)), rtol=1e-9)


@pytest.mark.parametrize("bad", [0, 1, 2])
@pytest.mark.parametrize("where", ["one eye", "both eyes", "u only"])
def test_shifts_are_of_as_many_markers_as_asked(bad: int, where: str) -> None:
    shifts = draw_shifts(seeded_generator(1, "test", where), Corruption(bad, where), 300, 8)  # type: ignore[arg-type]
    size = np.linalg.norm(shifts, axis=-1)
    assert ((size > 0).any(axis=1).sum(axis=1) == bad).all()
    eyes = (size > 0).any(axis=2).sum(axis=1)
    assert (eyes == (0 if bad == 0 else 2 if where == "both eyes" else 1)).all()
    moved = size[size > 0]
    assert ((moved >= 3.0 - 1e-9) & (moved <= 10.0 + 1e-9)).all()
    # cos and sin of multiples of pi are off by rounding.
    assert where != "u only" or np.abs(shifts[..., 1]).max() < 1e-12


def test_more_bad_markers_than_there_are_is_an_error() -> None:
    with pytest.raises(ValueError, match="at most 5 markers"):
        draw_shifts(seeded_generator(1, "test", "shifts"), Corruption(6), 1, 5)
