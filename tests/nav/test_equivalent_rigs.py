"""Eyes can be described by ideal images of any focal length and middle: what they see must not depend on it."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.types.estimates import PoseEstimate
from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.presets import PRESETS
from geometry.circles import project_disc_centers
from geometry.distortion import Lens
from geometry.pinhole import PinholeCamera
from geometry.stereo import EYES, StereoRig, paper_rig
from nav.centroids.binary_centroids import BinaryCentroids
from nav.lens_correction import undistort_centroids
from nav.matching.marker_channel import Blobs
from nav.pair_navigator import PairNavigator, correspond
from nav.pose.joint import joint
from nav.pose.pose_method import NoFixReason, Observation, Solution
from tests.support.painted_pairs import FLIGHT_RIG, make_pose, paint_pair

DROGUE = PRESETS["red-8"]
LAYOUT = marker_layout(DROGUE)
PLAIN = paper_rig()


def described(eyes: StereoRig, scale: float, shift_px: float = 0.0) -> StereoRig:
    """The same ideal eyes, as lenses without distortion behind ideal images of another focal length and middle."""
    own = eyes.camera
    focal_px = scale * own.fx_px
    ideal = PinholeCamera(own.width_px, own.height_px, focal_px, focal_px, own.cx_px + shift_px, own.cy_px)
    return StereoRig(ideal, eyes.baseline_m, lenses=(Lens(own), Lens(own)))


def fixes(rig: StereoRig, images: StereoImages) -> list[PoseEstimate]:
    """By methods of markers that are fitted, of binary centroids, and of one eye."""
    found = PairNavigator(rig, DROGUE).estimate(0, images, ["joint-hub", "mean-plane", "mono-lm"])
    return [each for each in found if isinstance(each, PoseEstimate)]


def assert_alike(rig: StereoRig, other: StereoRig, images: StereoImages) -> None:
    one, two = fixes(rig, images), fixes(other, images)
    assert len(one) == len(two) == 3
    for own, same in zip(one, two, strict=True):
        assert [(each.eye, each.index, each.used) for each in own.features] == [
            (each.eye, each.index, each.used) for each in same.features
        ]
        # Iterations that end at rounding in other pixels.
        np.testing.assert_allclose(same.left_from_drogue.as_matrix(), own.left_from_drogue.as_matrix(), atol=2e-6)
        for name in ("center_px", "cov_px2"):
            values = [[getattr(each, name) for each in fix.features] for fix in (own, same)]
            np.testing.assert_allclose(values[1], values[0], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("z_m", [1.8, 6.0, 15.0])
@pytest.mark.parametrize(("scale", "shift_px"), [(0.45, 0.0), (1.0, 130.0), (2.2, -60.0)])
def test_the_focal_length_of_the_ideal_images_does_not_matter(scale: float, shift_px: float, z_m: float) -> None:
    images = paint_pair(PLAIN, DROGUE, make_pose(0.05, -0.04, z_m, 6, -7, 12), np.random.default_rng(3))
    assert_alike(PLAIN, described(PLAIN, scale, shift_px), images)


@pytest.mark.parametrize("stretch", [0.85, 1.2])
@pytest.mark.parametrize("z_m", [1.8, 6.0])
def test_pixels_that_are_not_square_measure_as_well_without_lenses(stretch: float, z_m: float) -> None:
    own = PLAIN.camera
    camera = PinholeCamera(own.width_px, own.height_px, own.fx_px, stretch * own.fx_px, own.cx_px, own.cy_px)
    eyes = StereoRig(camera, PLAIN.baseline_m)
    images = paint_pair(eyes, DROGUE, make_pose(0.05, -0.04, z_m, 6, -7, 12), np.random.default_rng(4))
    assert_alike(eyes, described(eyes, 1.0), images)


@pytest.mark.parametrize("stretch", [0.8, 1.25])
@pytest.mark.parametrize("z_m", [2.5, 8.0])
def test_pixels_that_are_not_square_show_the_true_pose(stretch: float, z_m: float) -> None:
    own = FLIGHT_RIG.camera
    camera = PinholeCamera(own.width_px, own.height_px, own.fx_px, stretch * own.fx_px, own.cx_px, own.cy_px)
    rig = StereoRig(camera, FLIGHT_RIG.baseline_m)
    place = make_pose(0.1, -0.05, z_m, 5, -8, 11)
    (found,) = PairNavigator(rig, DROGUE).estimate(
        0, paint_pair(rig, DROGUE, place, np.random.default_rng(3)), ["joint"]
    )
    assert isinstance(found, PoseEstimate)
    assert found.covariance is not None
    off_m = found.left_from_drogue.translation_m - place.translation_m
    # Five of the deviations that it states.
    assert (np.abs(off_m) < 5 * np.sqrt(np.diag(found.covariance)[:3])).all()


def test_a_rig_of_tall_pixels_is_no_wrong_rig() -> None:
    camera = PinholeCamera(1280, 960, 900.0, 2000.0, 639.5, 479.5)
    rig = StereoRig(camera, PLAIN.baseline_m)
    place = make_pose(0.05, -0.04, 3.0, 6, -7, 12)
    cov = np.broadcast_to(1e-4 * np.eye(2), (len(EYES), LAYOUT.count, 2, 2))
    pixels = np.stack([project_disc_centers(rig, place, LAYOUT.centers_m, LAYOUT.radius_m, eye) for eye in EYES])
    solution = joint(Observation(rig, LAYOUT, pixels, cov))
    assert isinstance(solution, Solution)
    np.testing.assert_allclose(solution.left_from_drogue.translation_m, place.translation_m, atol=1e-6)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("shift_px", [0.0, 150.0, -150.0])
def test_the_edge_that_cuts_a_ring_is_that_of_the_delivered_image(side: int, shift_px: float) -> None:
    rig, camera, z_m = described(PLAIN, 1.0, shift_px), PLAIN.camera, 5.0
    middle_px = side * camera.width_px / 2 + 25 - 8 * side
    place = make_pose(middle_px / camera.fx_px * z_m, 0.02, z_m, 3, 1, 22.5)
    radius_px = camera.fx_px * LAYOUT.radius_m / z_m
    seen = []
    for eye in EYES:
        centers = PLAIN.project(place.apply(LAYOUT.centers_m), eye)
        last_px = np.array([camera.width_px, camera.height_px]) - 1
        whole = ((centers > radius_px + 1) & (centers < last_px - radius_px - 1)).all(axis=1)
        assert whole.sum() == 4
        blobs = Blobs(centers[whole], np.full(4, np.pi * radius_px**2))
        cov = np.broadcast_to(0.01 * np.eye(2), (4, 2, 2))
        seen.append(undistort_centroids(BinaryCentroids(blobs, cov), rig, eye))
    observation = correspond(seen[0], seen[1], rig, LAYOUT)
    assert not isinstance(observation, NoFixReason), observation.reason
    assert observation.paired.sum() == 4


@pytest.mark.parametrize("scale", [0.7, 1.3])
def test_the_other_eye_s_box_is_predicted_through_the_lens(scale: float) -> None:
    boxes = [
        PairNavigator(rig, DROGUE)._boxes_in_both({"left": (600.0, 400.0, 240.0, 236.0)})["right"]
        for rig in (PLAIN, described(PLAIN, scale))
    ]
    np.testing.assert_allclose(boxes[1], boxes[0], atol=1.0)
