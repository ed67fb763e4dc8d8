from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from drogue_models.marker_layout import MarkerLayout, marker_layout
from drogue_models.parameters import even_ring
from droguekit.scoring.poses.cramer_rao import angles_jacobian, center_jacobian, feature_points, pose_bound
from geometry.circles import disc_image_centers, project_disc_centers
from geometry.distortion import BrownConrady, Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform, angles_from_axis, exp_twist
from geometry.stereo import EYES, Eye, StereoRig

RING_M = 0.28


def layout_of(count: int = 8, hub_m: float | None = None, disc: float = 1.0) -> MarkerLayout:
    centers = np.zeros((count, 3))
    centers[:, :2] = even_ring(count, RING_M)
    hub = None if hub_m is None else np.array([0.0, 0.0, hub_m])
    edges = (0.0, 0.0) if hub is None else (0.05 * disc, 0.075 * disc)
    return MarkerLayout(centers, 0.05 * disc, hub, *edges)


def bound_of(build: SimpleNamespace, layout: MarkerLayout, pose: RigidTransform) -> np.ndarray:
    bound = pose_bound(build.rig, pose, layout, np.ones((2, len(feature_points(layout)[0])), dtype=bool))
    assert bound is not None
    return bound


def moved(pose: RigidTransform, twist: np.ndarray) -> RigidTransform:
    return RigidTransform(exp_twist(np.r_[0, 0, 0, twist[3:]]).rotation @ pose.rotation, pose.translation_m + twist[:3])


@pytest.mark.parametrize("eye", EYES)
def test_the_jacobian_is_the_slope_of_the_projection(build: SimpleNamespace, eye: Eye) -> None:
    layout, pose = layout_of(hub_m=0.25), build.pose(0.2, -0.1, 2.5, 9, -14, 21)
    centers, radii = feature_points(layout)
    step = 1e-6
    numeric = np.stack(
        [
            project_disc_centers(build.rig, moved(pose, step * axis), centers, radii, eye)
            - project_disc_centers(build.rig, moved(pose, -step * axis), centers, radii, eye)
            for axis in np.eye(6)
        ],
        axis=-1,
    ) / (2 * step)
    # Central differences of values of 1e3 px with 1e-16 relative rounding over steps of 1e-6: 1e-7; slopes reach 1e3.
    np.testing.assert_allclose(center_jacobian(build.rig, pose, layout, eye)[..., :6], numeric, atol=1e-5)


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize(
    ("focal_px", "k1", "turn_rad"), [(2560.0, 0.0, 0.0), (2133.3, -0.3, 0.0), (2133.3, 0.0, 0.03), (1900.0, -0.2, 0.02)]
)
def test_the_jacobian_of_a_rig_with_lenses_is_that_of_the_delivered_image(
    build: SimpleNamespace, eye: Eye, focal_px: float, k1: float, turn_rad: float
) -> None:
    camera = PinholeCamera(1280, 960, focal_px, focal_px, 630.0, 490.0)
    lens = Lens(camera, BrownConrady(k1), exp_twist([0, 0, 0, turn_rad, -turn_rad, turn_rad]).rotation)
    rig = StereoRig(build.rig.camera, build.rig.baseline_m, lenses=(lens, lens))
    layout, pose, step = layout_of(hub_m=0.25, disc=0.2), build.pose(1.0, -0.7, 5, 9, -14, 21), 1e-5
    centers, radii = feature_points(layout)
    numeric = np.stack(
        [
            disc_image_centers(rig, moved(pose, step * axis), centers, radii, eye)
            - disc_image_centers(rig, moved(pose, -step * axis), centers, radii, eye)
            for axis in np.eye(6)
        ],
        axis=-1,
    ) / (2 * step)
    # The lens also moves a disc's centroid from its ellipse's centre, by a share of k1 (r / Z)^2 = 1e-6 of the place.
    found = center_jacobian(rig, pose, layout, eye)[..., :6]
    np.testing.assert_allclose(found, numeric, atol=1e-4 * np.abs(numeric).max())


def test_the_angles_turn_as_the_axis_does(build: SimpleNamespace) -> None:
    pose, step = build.pose(0.2, -0.1, 2.5, 9, -14, 21), 1e-6
    slopes = [
        np.subtract(
            angles_from_axis(moved(pose, step * axis).rotation[:, 2]),
            angles_from_axis(moved(pose, -step * axis).rotation[:, 2]),
        )
        / (2 * step)
        for axis in np.eye(6)[3:]
    ]
    # Rounding of 1e-16 over steps of 1e-6, and the third derivative times its square.
    np.testing.assert_allclose(angles_jacobian(pose), np.stack(slopes, axis=-1), atol=1e-9)


@pytest.mark.parametrize("distance_m", [5.0, 10.0, 40.0])
def test_a_facing_ring_has_the_closed_form(build: SimpleNamespace, distance_m: float) -> None:
    f, b, n = build.rig.camera.fx_px, build.rig.baseline_m, 8
    _, _, z, pitch, _ = bound_of(build, layout_of(n, disc=1e-3), build.pose(b / 2, 0, distance_m))
    expected_z = distance_m**2 / (f * np.sqrt(2 * n * RING_M**2 + n * b**2 / 2))
    expected_tilt = distance_m**2 / (f * RING_M * np.sqrt(n * (RING_M**2 / 2 + b**2 / 4)))
    # Points instead of discs; what is left out is of the order (R / Z)^2.
    assert z == pytest.approx(expected_z, rel=(RING_M / distance_m) ** 2)
    assert np.deg2rad(pitch) == pytest.approx(expected_tilt, rel=(RING_M / distance_m) ** 2)


@pytest.mark.parametrize(
    ("count", "hub_m", "tilt_deg", "distance_m", "component", "expected"),
    [
        # Distance 10 m, 1 px, facing: Z 40.9 mm, X 1.62 mm, pitch 16.4 deg; with a hub pitch 0.836 deg, X 1.19 mm.
        (8, None, 0, 10, 2, 40.9e-3),
        (8, None, 0, 10, 0, 1.62e-3),
        (8, None, 0, 10, 3, 16.4),
        (8, 0.25, 0, 10, 3, 0.836),
        (8, 0.25, 0, 10, 0, 1.19e-3),
        (8, 0.25, 0, 1.5, 0, 0.202e-3),
        (8, 0.25, 0, 1.5, 3, 0.143),
        (8, 0.35, 0, 5, 3, 0.312),
        (5, None, 0, 40, 2, 0.828),
        (5, None, 7, 20, 2, 0.286),
        (8, None, 7, 20, 2, 0.226),
        (8, None, 7, 40, 3, 11.0),
        (8, 0.25, 7, 1.5, 2, 0.955e-3),
        (8, 0.25, 7, 40, 2, 0.673),
        (8, 0.25, 7, 40, 3, 3.12),
        (8, 0.20, 7, 8, 3, 0.785),
    ],
)
def test_golden_numbers(
    build: SimpleNamespace,
    count: int,
    hub_m: float,
    tilt_deg: float,
    distance_m: float,
    component: int,
    expected: float,
) -> None:
    pose = build.pose(0.06, 0, distance_m, tilt_deg, tilt_deg)
    # Golden numbers are of points instead of discs and have three digits.
    points = layout_of(count, hub_m, disc=1e-3)
    assert bound_of(build, points, pose)[component] == pytest.approx(expected, rel=0.005)


@pytest.mark.parametrize("hub_m", [None, 0.25])
@pytest.mark.parametrize("tilt_deg", [0, 7])
@pytest.mark.parametrize("distance_m", [2.0, 10.0, 40.0])
def test_discs_are_nearly_points(build: SimpleNamespace, hub_m: float, tilt_deg: float, distance_m: float) -> None:
    pose = build.pose(0.06, 0, distance_m, tilt_deg, tilt_deg)
    points, discs = (bound_of(build, layout_of(hub_m=hub_m, disc=disc), pose) for disc in (1e-3, 1.0))
    # The ellipse centre of a disc that turns moves (r / R)^2 = 3 % of what its place on the ring does.
    np.testing.assert_allclose(discs, points, rtol=0.04)


def test_one_eye_sees_depth_by_the_ring_alone(build: SimpleNamespace) -> None:
    visible = np.zeros((2, 8), dtype=bool)
    visible[0] = True
    bound = pose_bound(build.rig, build.pose(0.06, 0, 10), layout_of(), visible)
    assert bound is not None
    # Three digits of the golden number.
    assert bound[2] == pytest.approx(60.5e-3, rel=6e-3)


def test_more_features_never_raise_the_bound(build: SimpleNamespace, rng: np.random.Generator) -> None:
    layout, pose = layout_of(hub_m=0.25), build.pose(-0.3, 0.2, 6, 5, -8, 3)
    visible = np.ones((2, 9), dtype=bool)
    last = pose_bound(build.rig, pose, layout, visible)
    assert last is not None
    for place in rng.permutation(18)[:13]:
        visible.flat[place] = False
        bound = pose_bound(build.rig, pose, layout, visible)
        if bound is None:
            return
        # Equal up to the rounding of a 6x6 inverse.
        assert (bound >= last * (1 - 1e-9)).all()
        last = bound


def test_turning_by_the_symmetry_leaves_the_bound(build: SimpleNamespace) -> None:
    layout = marker_layout(build.drogue(hub=build.hub()))
    poses = [build.pose(0.5, -0.2, 9, 4, 6, roll) for roll in (5, 50)]
    first, second = (bound_of(build, layout, pose) for pose in poses)
    # Rounding of a 6x6 inverse whose condition is 1e6.
    np.testing.assert_allclose(first, second, rtol=1e-9)


@pytest.mark.parametrize("seen", [[], [0], [0, 1]])
def test_two_markers_leave_the_pose_open(build: SimpleNamespace, seen: list[int]) -> None:
    visible = np.zeros((2, 8), dtype=bool)
    visible[:, seen] = True
    assert pose_bound(build.rig, build.pose(0.06, 0, 10), layout_of(), visible) is None


def test_least_squares_reaches_the_bound(build: SimpleNamespace, rng: np.random.Generator) -> None:
    """The bound is the spread of a real estimator: linear least squares on noisy pixels, by finite differences."""
    layout, pose, sigma = layout_of(hub_m=0.25), build.pose(0.4, -0.3, 7, 6, -4, 2), 0.05
    centers, radii = feature_points(layout)

    def image(at: RigidTransform) -> np.ndarray:
        return np.concatenate([project_disc_centers(build.rig, at, centers, radii, eye).ravel() for eye in EYES])

    step = 1e-6
    ends = [(image(moved(pose, step * axis)), image(moved(pose, -step * axis))) for axis in np.eye(6)]
    slope = np.stack([(high - low) / (2 * step) for high, low in ends], axis=1)
    noise = rng.normal(0, sigma, (4000, len(slope)))
    twists = noise @ np.linalg.pinv(slope).T
    truth = np.array(angles_from_axis(pose.rotation[:, 2]))
    angles = np.array([np.subtract(angles_from_axis(moved(pose, t).rotation[:, 2]), truth) for t in twists])
    spread = np.concatenate([twists[:, :3].std(axis=0), np.rad2deg(angles.std(axis=0))])
    # A standard deviation of 4000 samples is known to 1/sqrt(8000) = 1.1 %; four of those.
    np.testing.assert_allclose(spread, sigma * bound_of(build, layout, pose), rtol=0.045)
