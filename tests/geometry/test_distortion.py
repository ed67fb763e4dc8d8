"""Lens distortion and misaligned eyes: round trips, and OpenCV's own projection as the judge."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry.circles import disc_image_centers, disc_outline, project_disc_centers
from geometry.distortion import BrownConrady, Lens, OpenCvDistortion, border_px
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform, exp_twist, rotation_from_angles
from geometry.stereo import EYES, Eye, StereoRig, paper_rig

IDEAL = paper_rig()
LEFT = Lens(PinholeCamera(1280, 960, 2140.0, 2136.0, 634.0, 484.5), BrownConrady(-0.08, 0.03, 2e-4, -1e-4, 0.01))
RIGHT = Lens(
    PinholeCamera(1280, 960, 2130.0, 2131.0, 645.0, 472.0),
    BrownConrady(-0.05, 0.0, -1e-4, 2e-4),
    exp_twist([0, 0, 0, 0.003, -0.004, 0.005]).rotation,
)
RIG = StereoRig(IDEAL.camera, IDEAL.baseline_m, lenses=(LEFT, RIGHT))


def sample_points_m(count: int) -> np.ndarray:
    rng = np.random.default_rng(5)
    points = rng.uniform([-0.25, -0.2, 1.5], [0.25, 0.2, 40.0], size=(count, 3))
    points[:, :2] *= points[:, 2:]
    return points


@settings(max_examples=50, deadline=None)
@given(
    st.tuples(*(st.floats(-limit, limit) for limit in (0.2, 0.1, 2e-3, 2e-3, 0.05))),
    st.floats(-0.35, 0.35),
    st.floats(-0.35, 0.35),
)
def test_undistort_inverts_distort(coefficients: tuple[float, ...], x: float, y: float) -> None:
    model = BrownConrady(*coefficients)
    # Newton's method ends at rounding.
    np.testing.assert_allclose(model.undistort(model.distort([x, y])), [x, y], atol=1e-12)


@pytest.mark.parametrize("eye", EYES)
def test_images_are_opencv_s(eye: Eye) -> None:
    points, lens = sample_points_m(200), RIG.lens(eye)
    real_from_ideal = lens.ideal_from_real.T
    turn, _ = cv2.Rodrigues(real_from_ideal)
    shift = -real_from_ideal @ RIG.eye_offset_m(eye)
    wanted, _ = cv2.projectPoints(points, turn, shift, lens.camera.matrix(), lens.distortion.coefficients())
    # A handful of roundings at 1e3 px; Rodrigues and back costs most of them.
    np.testing.assert_allclose(RIG.image(points, eye), wanted[:, 0], atol=1e-9)


@pytest.mark.parametrize("eye", EYES)
def test_real_and_ideal_pixels_go_back_and_forth(eye: Eye) -> None:
    ideal = np.random.default_rng(3).uniform(-0.5, [1279.5, 959.5], (300, 2))
    real = RIG.real_px(ideal, eye)
    assert np.abs(real - ideal).max() > 3
    np.testing.assert_allclose(RIG.ideal_px(real, eye), ideal, atol=1e-9)
    np.testing.assert_allclose(RIG.image(RIG.rays(real, eye) * 7.0 + RIG.eye_offset_m(eye), eye), real, atol=1e-9)


@pytest.mark.parametrize("eye", EYES)
def test_slopes_are_those_of_the_way_to_the_delivered_image(eye: Eye) -> None:
    ideal, step = np.random.default_rng(4).uniform(-0.5, [1279.5, 959.5], (100, 2)), 1e-3
    ends = [RIG.real_px(ideal + d, eye) - RIG.real_px(ideal - d, eye) for d in step * np.eye(2)]
    # Rounding of 1e3 px in float64, over steps of 1e-3 px.
    np.testing.assert_allclose(RIG.real_slopes(ideal, eye), np.stack(ends, axis=-1) / (2 * step), atol=1e-8)
    np.testing.assert_array_equal(IDEAL.real_slopes(ideal, eye), np.tile(np.eye(2), (100, 1, 1)))


def test_rectified_places_triangulate_to_the_point() -> None:
    points = sample_points_m(100)
    left, right = (RIG.ideal_px(RIG.image(points, eye), eye) for eye in EYES)
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-9)
    # At 40 m a disparity of 6.4 px is held to 1e-11 px.
    np.testing.assert_allclose(RIG.triangulate(left, right), points, rtol=1e-9)


def test_ideal_rig_changes_nothing() -> None:
    pixels = np.array([[3.25, 700.5], [1000.0, 12.0]])
    for eye in EYES:
        assert np.array_equal(IDEAL.real_px(pixels, eye), pixels)
        assert np.array_equal(IDEAL.image([[0.1, 0.2, 5.0]], eye), IDEAL.project([[0.1, 0.2, 5.0]], eye))
    assert IDEAL.largest_shift_px() == 0.0


def test_largest_shift_bounds_every_pixel_of_the_border() -> None:
    u = np.linspace(-0.5, 1279.5, 500)
    edge = np.stack([u, np.full(500, -0.5)], axis=-1)
    shifts = [np.linalg.norm(RIG.real_px(edge, eye) - edge, axis=-1).max() for eye in EYES]
    # The border is sampled every 41 px, over which a shift changes by less than a tenth of a pixel.
    assert max(shifts) <= RIG.largest_shift_px() + 0.1
    border = border_px(IDEAL.camera)
    assert border.min(axis=0).tolist() == [-0.5, -0.5] and border.max(axis=0).tolist() == [1279.5, 959.5]


def test_disc_centres_are_the_ellipse_s_without_and_the_area_s_with_a_lens() -> None:
    pose = RigidTransform(rotation_from_angles(0.2, -0.3, 0.4), np.array([0.3, -0.2, 1.9]))
    centers, radii = np.array([[0.27, 0, 0], [0, -0.27, 0]]), np.array([0.05, 0.05])
    bare = Lens(IDEAL.camera)
    through_nothing = StereoRig(IDEAL.camera, IDEAL.baseline_m, lenses=(bare, bare))
    for eye in EYES:
        wanted = project_disc_centers(IDEAL, pose, centers, radii, eye)
        # Polygons of 256 sides against the closed form.
        np.testing.assert_allclose(disc_image_centers(through_nothing, pose, centers, radii, eye), wanted, atol=1e-4)
        for center, radius, found in zip(
            centers, radii, disc_image_centers(RIG, pose, centers, radii, eye), strict=True
        ):
            outline = RIG.image(disc_outline(pose, center, radius, 2000), eye)
            moments = cv2.moments(((outline - found) * 1.0).astype(np.float32))
            # float32 of places within 60 px of the centre.
            assert abs(moments["m10"] / moments["m00"]) < 1e-4 and abs(moments["m01"] / moments["m00"]) < 1e-4


def test_a_fold_and_a_foreign_size_are_refused() -> None:
    with pytest.raises(ValueError, match="is not invertible over the whole image"):
        Lens(PinholeCamera(1280, 960, 500.0, 500.0, 639.5, 479.5), BrownConrady(k1=-0.6))
    with pytest.raises(ValueError, match="finite"):
        BrownConrady(k1=float("nan"))
    small = Lens(PinholeCamera(640, 480, 1000.0, 1000.0, 319.5, 239.5))
    with pytest.raises(ValueError, match="lenses: images must be"):
        StereoRig(IDEAL.camera, 0.12, lenses=(small, small))


def test_an_eye_that_looks_behind_the_rig_is_refused() -> None:
    camera = PinholeCamera(1280, 960, 1000.0, 1000.0, 639.5, 479.5)
    # The border lies 32.6 degrees aside of the axis.
    Lens(camera, ideal_from_real=rotation_from_angles(0.0, np.radians(57), 0.0))
    for turn_deg in (58, 170):
        with pytest.raises(ValueError, match=f"ideal_from_real: .* got a rotation by {turn_deg} degrees"):
            Lens(camera, ideal_from_real=rotation_from_angles(0.0, np.radians(turn_deg), 0.0))


@pytest.mark.parametrize(
    ("focal_px", "k1", "k2", "k3"),
    [
        # Found at random: the border is past both folds, and a ring around the middle has three rays a pixel.
        pytest.param(300.0, -1.46, 0.886, 0.0, id="wide"),
        pytest.param(400.0, -1.2, 0.6, 0.0, id="long"),
        # Three rays meet a pixel only in a ring of 0.2 px, which no coarse grid of pixels meets.
        pytest.param(400.0, -0.8, 0.287, 0.0, id="narrow"),
    ],
)
def test_a_fold_inside_the_image_is_refused(focal_px: float, k1: float, k2: float, k3: float) -> None:
    with pytest.raises(ValueError, match="is not invertible over the whole image"):
        Lens(PinholeCamera(1280, 960, focal_px, focal_px, 639.5, 479.5), BrownConrady(k1=k1, k2=k2, k3=k3))


def test_every_pixel_of_an_accepted_lens_has_a_ray() -> None:
    rng = np.random.default_rng(7)
    pixels = np.stack(np.meshgrid(np.arange(0, 1280, 40.0), np.arange(0, 960, 40.0)), axis=-1)
    accepted = 0
    for _ in range(100):
        focal_px, k1, k2, k3 = rng.uniform([300.0, -2.0, -2.0, -2.0], [800.0, 2.0, 2.0, 2.0])
        try:
            lens = Lens(PinholeCamera(1280, 960, focal_px, focal_px, 639.5, 479.5), BrownConrady(k1=k1, k2=k2, k3=k3))
        except ValueError:
            continue
        accepted += 1
        np.testing.assert_allclose(lens.project_rays(lens.rays(pixels)), pixels, atol=1e-8)
    assert accepted > 20


# Two folds follow each other beyond the image, and a step from a pixel's distorted place leads behind both.
TWICE_FOLDED = BrownConrady(k1=0.3444, k2=0.1809, k3=-0.2004, p1=-0.0465, p2=0.0013)


def test_rays_of_neighbouring_pixels_are_neighbours() -> None:
    """A ray of another branch of the polynomial has the right pixel, and no neighbours near it."""
    lens = Lens(PinholeCamera(320, 240, 201.54, 201.54, 107.45, 141.22), TWICE_FOLDED)
    rays = lens.rays(np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1))
    steps = [np.linalg.norm(np.diff(rays, axis=axis), axis=-1) for axis in (0, 1)]
    assert max(float(step.max()) for step in steps) < 0.1


@pytest.mark.parametrize("seed", range(8))
def test_no_place_beyond_the_field_comes_onto_the_image(seed: int) -> None:
    rng, lenses = np.random.default_rng(seed), 0
    while lenses < 20:
        camera = PinholeCamera(320, 240, *np.repeat(rng.uniform(180.0, 500.0), 2), *rng.uniform([100, 80], [220, 160]))
        k1, k2, k3 = rng.uniform(-0.5, 0.5, 3)
        p1, p2 = rng.uniform(-0.05, 0.05, 2)
        bent = BrownConrady(k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)
        turn = exp_twist([0, 0, 0, *rng.normal(scale=0.05, size=3)]).rotation
        try:
            rig = StereoRig(camera, 0.12, lenses=(Lens(camera, bent, turn), Lens(camera, bent)))
        except ValueError:
            continue
        lenses += 1
        field = rig.field_px("left")
        reach = 0.3 * (field[1] - field[0])
        ideal = rng.uniform(field[0] - reach, field[1] + reach, (4000, 2))
        beyond = ~rig.is_in_field(ideal, "left")
        assert beyond.any() and not camera.contains(rig.image_px(ideal[beyond], "left")).any()


def strong_rig(k1: float = -0.5) -> StereoRig:
    """Small images of a lens that folds, for k1 < 0, atan(1 / sqrt(-3 k1)) from the axis, far outside of them."""
    camera = PinholeCamera(320, 240, 533.0, 533.0, 159.5, 119.5)
    lens = Lens(camera, BrownConrady(k1=k1))
    turned = Lens(camera, BrownConrady(k1=k1), exp_twist([0, 0, 0, 0.01, -0.02, 0.03]).rotation)
    return StereoRig(camera, 0.12, lenses=(lens, turned))


def test_a_drogue_without_markers_has_no_centres() -> None:
    pose = RigidTransform(np.eye(3), np.array([0.0, 0.0, 5.0]))
    assert disc_image_centers(RIG, pose, np.zeros((0, 3)), np.zeros(0), "left").shape == (0, 2)


@pytest.mark.parametrize("eye", EYES)
def test_the_field_holds_the_image_and_nothing_that_folds_into_it(eye: Eye) -> None:
    rig = strong_rig()
    pixels = np.stack(np.meshgrid(np.linspace(-0.5, 319.5, 50), np.linspace(-0.5, 239.5, 40)), axis=-1)
    assert rig.is_in_field(rig.ideal_px(pixels, eye), eye).all()
    # Half a turn of places up to 80 degrees from the axis; those on the image by the polynomial alone are many.
    angle, off_axis = np.meshgrid(np.linspace(0, 2 * np.pi, 100), np.radians(np.linspace(0, 80, 400)))
    rays = np.stack([np.cos(angle) * np.tan(off_axis), np.sin(angle) * np.tan(off_axis), np.ones_like(angle)], axis=-1)
    ideal = rig.camera.project(rays)
    delivered, seen = rig.real_px(ideal, eye), rig.is_in_field(ideal, eye)
    on_image = rig.camera.contains(delivered)
    assert (on_image & ~seen).sum() > 100
    np.testing.assert_allclose(rig.ideal_px(delivered[on_image & seen], eye), ideal[on_image & seen], atol=1e-8)


@pytest.mark.parametrize("k1", [-0.5, -1.04, 0.5])
@pytest.mark.parametrize("eye", EYES)
def test_images_of_points_beyond_the_field_lie_outside_the_image_on_their_side(eye: Eye, k1: float) -> None:
    """With k1 = -1.04 the lens folds right beyond the corners of the image."""
    rig = strong_rig(k1)
    points = np.random.default_rng(2).uniform([-5.0, -5.0, 1.0], [5.0, 5.0, 1.0], (2000, 3))
    ideal = rig.project(points, eye)
    beyond = ~rig.is_in_field(ideal, eye)
    image = rig.image(points, eye)
    assert beyond.sum() > 1000 and not rig.camera.contains(image[beyond]).any()
    assert np.array_equal(image[~beyond], rig.real_px(ideal[~beyond], eye))
    to_the_right = beyond & (ideal[:, 0] > 400) & (np.abs(ideal[:, 1] - 119.5) < 80)
    assert to_the_right.sum() > 10 and (image[to_the_right, 0] > 319.5).all()


def test_an_ideal_eye_has_no_end_of_its_field() -> None:
    points = np.array([[50.0, -40.0, 1.0], [0.1, 0.2, 5.0]])
    assert IDEAL.is_in_field(IDEAL.project(points, "left"), "left").all()
    assert np.array_equal(IDEAL.image(points, "left"), IDEAL.project(points, "left"))


# Of a wide-angle RGB-D camera, by orders of magnitude: rational with near-cancelling numerator and denominator.
WIDE = OpenCvDistortion(0.52, -2.5, 4e-4, -3e-4, 1.5, k4=0.40, k5=-2.3, k6=1.4)
PRISM = OpenCvDistortion(-0.1, 0.05, 2e-4, -1e-4, 0.01, 0.02, -0.01, 0.003, 1e-3, -5e-4, -8e-4, 3e-4)
TILTED = OpenCvDistortion(-0.1, 0.05, 2e-4, -1e-4, 0.01, 0.02, -0.01, 0.003, 1e-3, -5e-4, -8e-4, 3e-4, 0.02, -0.03)


@pytest.mark.parametrize("model", [WIDE, PRISM, TILTED], ids=["rational", "prism", "tilted"])
def test_the_long_models_are_opencv_s(model: OpenCvDistortion) -> None:
    places = np.random.default_rng(8).uniform(-0.6, 0.6, (500, 2))
    points = np.column_stack([places, np.ones(500)])
    camera = PinholeCamera(1280, 960, 1000.0, 1010.0, 634.0, 484.5)
    wanted, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix(), model.coefficients())
    found = Lens(camera, model).project_rays(points)
    # A handful of roundings at 1e3 px.
    np.testing.assert_allclose(found, wanted[:, 0], atol=1e-9)
    np.testing.assert_allclose(model.undistort(model.distort(places)), places, atol=1e-12)
    # Central differences of a smooth function at unit scale.
    step = 1e-6
    slopes = np.stack([(model.distort(places + d) - model.distort(places - d)) / (2 * step) for d in step * np.eye(2)])
    _, j_xx, j_xy, j_yx, j_yy = model._distort(places)
    np.testing.assert_allclose(np.stack([[j_xx, j_xy], [j_yx, j_yy]]), slopes.transpose(2, 0, 1), atol=1e-8)


def test_the_long_model_with_zeros_is_brown_conrady_s() -> None:
    places = np.random.default_rng(9).uniform(-0.5, 0.5, (50, 2))
    short = BrownConrady(-0.08, 0.03, 2e-4, -1e-4, 0.01)
    long = OpenCvDistortion(*short.coefficients())
    # Division by 1 and sums with 0 in another order.
    np.testing.assert_allclose(long.distort(places), short.distort(places), atol=1e-15)
    np.testing.assert_allclose(long.undistort(places), short.undistort(places), atol=1e-13)


def test_a_long_model_that_folds_the_image_is_refused() -> None:
    with pytest.raises(ValueError, match="is not invertible over the whole image"):
        Lens(PinholeCamera(1280, 960, 500.0, 500.0, 639.5, 479.5), OpenCvDistortion(k4=3.0))
