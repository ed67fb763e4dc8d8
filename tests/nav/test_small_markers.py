"""Small markers from peaks of light to poses: layouts that are no ring, at several depths, and ambiguous ones."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import MarkerLayout
from geometry.circles import disc_image_centers, disc_outline
from geometry.distortion import BrownConrady, Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES, StereoRig
from nav.centroids.binary_centroids import quantisation_variance_px2, small_centroids
from nav.centroids.disc_coverage import spread_discs, spread_ring_shares
from nav.centroids.discs import DiscFits
from nav.centroids.ellipses import Ellipses, outline_shapes
from nav.centroids.face_background import FaceBackground
from nav.centroids.small_discs import fit_small_discs
from nav.matching.face_ring import find_face_ring, fit_face_ring, has_narrow_face
from nav.matching.marker_channel import Blobs
from nav.matching.ring_matching import match_ring
from nav.pair_navigator import correspond
from nav.pose.joint import joint
from nav.pose.pose_method import NoFixReason, Observation, Solution
from nav.refinement import refine

RADIUS_M, RIM_M = 0.01, 0.305
CAMERA = PinholeCamera(640, 480, 1740.0, 1740.0, 319.5, 239.5)
RIG = StereoRig(CAMERA, 0.25, RigidTransform(np.eye(3), np.zeros(3)), np.zeros(3))


def ring(count: int, radius_m: float = 0.28, depth_m: float = 0.0, turn: float = 0.0) -> np.ndarray:
    angle = 2 * np.pi * np.arange(count) / count + turn
    return np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), np.full(count, depth_m)], axis=1)


def layout_of(centers_m: np.ndarray) -> MarkerLayout:
    return MarkerLayout(centers_m, RADIUS_M, None)


def pair_of(layout: MarkerLayout, pose: RigidTransform, rng: np.random.Generator) -> StereoImages:
    """A pair that shows lamps before an even background, with the noise of a sensor."""
    images = []
    for eye in EYES:
        mean_e = np.full((CAMERA.height_px, CAMERA.width_px), 400.0)
        for center_px in RIG.image(pose.apply(layout.centers_m), eye):
            x, y = np.rint(center_px).astype(int)
            radius = np.array([CAMERA.fx_px * RADIUS_M / pose.translation_m[2]])
            drawn = spread_discs(center_px[None] - (x, y), radius, np.array([0.5]), 6, 4).light[0]
            mean_e[y - 6 : y + 7, x - 6 : x + 7] += 3000 * drawn
        images.append(np.rint(0.35 * (rng.poisson(mean_e) + rng.normal(0, 5, mean_e.shape))).clip(0, 4095) + 64)
    return StereoImages(*(image.astype(np.uint16) for image in images), 0.0, 1e-3, bits=12, black_level_dn=64.0)


def measured(layout: MarkerLayout, images: StereoImages, pose: RigidTransform) -> Observation | NoFixReason:
    """Peaks, correspondence, and fits, as navigation chains them."""
    scale, found = CAMERA.fx_px / pose.translation_m[2], []
    for eye, image in zip(EYES, (images.left, images.right), strict=True):
        x, y = RIG.image(pose.translation_m, eye)
        reach = 1.3 * RIM_M * scale
        left, top, right, bottom = (int(side) for side in (x - reach, y - reach, x + reach, y + reach))
        found.append(small_centroids(image[top:bottom, left:right], (left, top), layout, 1.2 * scale))
    matched = correspond(*found, RIG, layout)
    if isinstance(matched, NoFixReason):
        return matched
    rough = joint(matched)
    assert isinstance(rough, Solution)
    return refine(images, None, matched, rough)


LAYOUTS = {
    "ring of 12": ring(12),
    "ring of 24": ring(24),
    "four of a kite": np.array([[0.28, 0, 0], [0.05, 0.27, 0], [-0.22, 0.03, 0], [0.02, -0.2, 0]]),
    "uneven six": np.array(
        [[0.28, 0, 0], [0.2, 0.2, 0], [-0.05, 0.27, 0], [-0.28, 0.05, 0], [-0.1, -0.2, 0], [0.15, -0.2, 0]]
    ),
    "two depths": np.concatenate([ring(8), ring(6, 0.2, 0.12, 0.2)]),
}


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("distance_m", [12.0, 24.0])
def test_lamps_of_a_centimetre_give_a_pose_within_its_covariance(name: str, distance_m: float) -> None:
    layout, rng = layout_of(LAYOUTS[name]), np.random.default_rng(7)
    pose = RigidTransform(rotation_from_angles(*np.radians([5, -6, 4])), np.array([0.1, -0.2, distance_m]))
    observation = measured(layout, pair_of(layout, pose, rng), pose)
    assert isinstance(observation, Observation), observation
    assert observation.seen.all()
    solution = joint(observation)
    assert isinstance(solution, Solution)
    error_m = solution.left_from_drogue.translation_m - pose.translation_m
    assert np.all(np.abs(error_m) < 4 * np.sqrt(np.diag(solution.covariance)[:3]))


def test_a_layout_that_fits_in_two_orders_is_told() -> None:
    """Eleven of twelve places: with the marker beside the gap hidden, the gap may be on either side of its place."""
    layout = layout_of(ring(12)[:11])
    places = ring(12)[:10, :2] * 200 + 100
    blobs = Blobs(places, np.full(10, np.pi * (200 * RADIUS_M) ** 2))
    found = match_ring(blobs, layout)
    assert found is not None
    assert found.is_ambiguous
    whole = match_ring(Blobs(ring(12)[:11, :2] * 200 + 100, np.full(11, np.pi * (200 * RADIUS_M) ** 2)), layout)
    assert whole is not None
    assert not whole.is_ambiguous


def test_lamps_that_are_too_faint_are_told() -> None:
    layout, rng = layout_of(ring(12)), np.random.default_rng(8)
    pose = RigidTransform(np.eye(3), np.array([0.0, 0.0, 20.0]))
    images = pair_of(layout_of(np.zeros((0, 3))), pose, rng)
    told = measured(layout, images, pose)
    assert isinstance(told, NoFixReason)
    assert "peaks of light" in told.reason


@pytest.mark.parametrize(("scatter", "is_kept"), [(1.0, True), (6.0, False)])
def test_centres_that_no_fit_confirms_count_only_while_they_scatter_as_they_state(
    scatter: float, is_kept: bool
) -> None:
    """Centres of mass of discs of 1.7 px before nothing that a fit could see."""
    layout, rng = layout_of(ring(8)), np.random.default_rng(3)
    pose = RigidTransform(rotation_from_angles(*np.radians([5, -6, 4])), np.array([0.1, -0.2, 10.0]))
    images = pair_of(layout_of(np.zeros((0, 3))), pose, rng)
    radius_px = np.full(8, CAMERA.fx_px * RADIUS_M / 10.0)
    variance = quantisation_variance_px2(radius_px)[:, None, None] * np.eye(2)
    centers = np.stack([disc_image_centers(RIG, pose, layout.centers_m, np.full(8, RADIUS_M), eye) for eye in EYES])
    noise = np.sqrt(variance[0, 0, 0]) * rng.standard_normal(centers.shape)
    matched = Observation(RIG, layout, centers + scatter * noise, np.stack([variance, variance]))
    rough = joint(matched)
    assert isinstance(rough, Solution)
    found = refine(images, None, matched, rough)
    assert (found is matched) == is_kept
    assert isinstance(found, NoFixReason) != is_kept


def test_small_discs_are_fitted_where_and_as_large_as_the_lens_shows_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the corner of a wide lens, with a marker that was not found and is fitted for its light beside the others."""
    camera = PinholeCamera(640, 480, 400.0, 400.0, 319.5, 239.5)
    lens = Lens(camera, BrownConrady(k1=-0.15, k2=0.02))
    rig = StereoRig(camera, 0.25, RigidTransform(np.eye(3), np.zeros(3)), np.zeros(3), lenses=(lens, lens))
    layout = MarkerLayout(ring(12), 0.015, None)
    pose = RigidTransform(np.eye(3), np.array([-3.4, 2.5, 5.0]))
    centers = np.stack([rig.project(pose.apply(layout.centers_m), eye) for eye in EYES])
    centers[0, 4] = np.nan
    matched = Observation(rig, layout, centers, np.broadcast_to(0.01 * np.eye(2), (2, 12, 2, 2)))
    images = StereoImages(*2 * [np.full((480, 640), 64, np.uint16)], 0.0, 1e-3, bits=12)
    begun = []

    def fit(images: StereoImages, discs: Ellipses, face: FaceBackground | None) -> DiscFits:
        begun.append(discs)
        return fit_small_discs(images, discs, face)

    monkeypatch.setattr("nav.refinement.fit_small_discs", fit)
    refine(images, None, matched, Solution(pose, matched.seen))
    discs, outlines = begun[0], [disc_outline(pose, each, layout.radius_m, 64) for each in layout.centers_m]
    shown = np.stack([rig.image(outline, eye) for eye in EYES for outline in outlines])
    np.testing.assert_allclose(discs.centers_px, shown.mean(axis=1), atol=0.02)
    # The size is that of a disc in the middle of the ring; an ideal lens would show 1.2 px.
    np.testing.assert_allclose(discs.shapes_px, outline_shapes(shown - shown.mean(axis=1, keepdims=True)), atol=0.04)
    assert discs.radii_px.max() < 1.1


FACE = MarkerLayout(ring(12), RADIUS_M, None, face_inner_radius_m=0.25, face_outer_radius_m=RIM_M)


def face_image(affine: np.ndarray, lamp_dn: float, rng: np.random.Generator) -> np.ndarray:
    """A dark face with lamps before a sky of 3000 DN with a slope, and noise of 30 DN."""
    half, middle = 60, np.array([100.0, 80.0])
    shift = affine[:, 2] - middle
    opening, beyond = spread_ring_shares(shift[None], affine[None, :, :2], (0.25, RIM_M), 0.45, half, 1)[0]
    image = 200 + 2800 * (opening + beyond)
    places = FACE.centers_m[:, :2] @ affine[:, :2].T + shift
    radius = np.full(12, RADIUS_M * np.sqrt(np.linalg.det(affine[:, :2])))
    for place, one in zip(np.rint(places).astype(int), range(12), strict=True):
        drawn = spread_discs(places[one : one + 1] - place, radius[:1], np.array([0.45]), 4, 1).light[0]
        x, y = place + half
        image[y - 4 : y + 5, x - 4 : x + 5] += lamp_dn * drawn
    whole = np.full((160, 200), 3000.0)
    whole[20:141, 40:161] = image
    return (whole + np.arange(200) + rng.normal(0, 30, whole.shape)).clip(0, 4095).astype(np.uint16)


@pytest.mark.parametrize("scale", [31.0, 38.0, 55.0])
def test_lamps_that_drown_in_the_sky_are_placed_by_the_picture_of_all_of_them(scale: float) -> None:
    """Lamps of 0.3 to 0.55 px, none of which the sky beside the face leaves as a peak of its own."""
    rng = np.random.default_rng(11)
    turn = np.array([[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]])
    affine = np.column_stack([scale * turn @ np.diag([1.0, 0.95]), [101.3, 79.6]])
    image = face_image(affine, 8000.0, rng)
    expected = FACE.centers_m[:, :2] @ affine[:, :2].T + affine[:, 2]
    for found in (fit_face_ring(image, FACE, np.array([102.0, 81.0]), 1.1 * scale), find_face_ring(image, FACE)):
        assert found is not None
        places = FACE.centers_m[:, :2] @ found.affine[:, :2].T + found.affine[:, 2]
        off = min(np.hypot(*(np.roll(expected, k, axis=0) - places).T).max() for k in range(12))
        # A quarter of the smallest lamp's spread; peaks of noise are a pixel and more away.
        assert off < 0.15


@pytest.mark.parametrize("level", [0, 4095])
def test_an_even_picture_shows_no_face(level: int) -> None:
    # As the colour of the markers does in a picture of a grey camera.
    even = np.full((160, 200), level, np.uint16)
    assert fit_face_ring(even, FACE, np.array([102.0, 81.0]), 38.0) is None
    assert find_face_ring(even, FACE) is None


def test_a_face_without_lamps_and_a_sky_without_a_face_are_no_drogue() -> None:
    rng = np.random.default_rng(12)
    affine = np.column_stack([38.0 * np.eye(2), [101.3, 79.6]])
    assert find_face_ring(face_image(affine, 0.0, rng), FACE) is None
    assert find_face_ring(rng.normal(3000, 30, (160, 200)).astype(np.uint16), FACE) is None
    assert not has_narrow_face(layout_of(ring(12)))


@pytest.mark.parametrize("tilt_deg", [12.0, 20.0])
def test_markers_that_are_small_beside_their_ring_are_matched_in_a_tilted_one(tilt_deg: float) -> None:
    layout = layout_of(ring(12))
    places = ring(12)[:, :2] * [260.0, 260.0 * np.cos(np.radians(tilt_deg))] + 200
    found = match_ring(Blobs(places, np.full(12, np.pi * 2.9**2)), layout)
    assert found is not None
    assert found.count == 12
