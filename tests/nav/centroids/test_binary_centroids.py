"""Channels, the paper's marker chain and the detector, on drawn pictures."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from drogue_models.presets import PRESETS
from geometry.circles import project_disc_centers
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform
from geometry.stereo import EYES, Eye, StereoRig, paper_rig
from nav.centroids.binary_centroids import binary_centroids, quantisation_variance_px2
from nav.detector.ring_detectors import ColorBlobDetector
from nav.matching.marker_channel import marker_channel, marker_color
from tests.support.painted_pairs import make_pose, paint_pair

RIG = paper_rig()
DROGUE = PRESETS["red-8"]
LAYOUT = marker_layout(DROGUE)
WHITE_RGB = (200.0, 200.0, 195.0)


def same(image: np.ndarray, **kwargs: float | str) -> StereoImages:
    return StereoImages(image, image, 0.0, 1e-3, **kwargs)


def rim_box(
    rig: StereoRig, place: RigidTransform, drogue: DrogueParameters, eye: Eye
) -> tuple[float, float, float, float]:
    x, y = rig.project(place.translation_m, eye)
    reach = rig.camera.fx_px * drogue.rim_radius_m / place.translation_m[2]
    return x - reach, y - reach, 2 * reach, 2 * reach


def overlap(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Intersection over union of two boxes."""
    width = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    height = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    shared = max(width, 0) * max(height, 0)
    return shared / (a[2] * a[3] + b[2] * b[3] - shared)


def test_colour_of_markers() -> None:
    assert marker_color(DROGUE) == 0
    assert marker_color(PRESETS["white-8"]) is None
    assert marker_color(DROGUE.model_copy(update={"marker_reflectance_rgb": (0.1, 0.7, 0.1)})) == 1
    lit = PRESETS["white-8"].model_copy(update={"marker_luminance_cd_m2": 50.0})
    assert marker_color(lit) == 0


def test_channel_is_the_colours_lead_over_the_others() -> None:
    image = np.array([[[200, 30, 50], [40, 90, 160], [210, 205, 208]]], np.uint8)
    assert marker_channel(same(image), "left", 0).tolist() == [[150, 0, 2]]
    assert marker_channel(same(image), "left", None).tolist() == [[30, 40, 205]]
    mono = image[..., 0]
    assert marker_channel(same(mono), "right", 0).tolist() == mono.tolist()


def test_channel_without_black_level() -> None:
    image = np.array([[[100, 60, 70], [3, 9, 20]]], np.uint16)
    images = same(image, bits=12, black_level_dn=64.0)
    assert marker_channel(images, "left", None).tolist() == [[0, 0]]
    assert marker_channel(images, "left", 0).tolist() == [[30, 0]]


def test_channel_of_gamma_images_is_linear() -> None:
    light = np.linspace(0, 1, 64)
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    image = np.round(255 * code).astype(np.uint8)[None, :, None] * np.array([1, 0, 0], np.uint8)
    channel = marker_channel(same(image, encoding="gamma"), "left", 0)
    # Half a code of 255 at the curve's largest slope of light over code, 2.4 / 1.055.
    np.testing.assert_allclose(channel[0] / 65535, light, atol=0.5 / 255 * 2.4 / 1.055)


@pytest.mark.parametrize("color", [0, 1, 2])
def test_mosaic_channel_lies_on_the_images_grid(color: int) -> None:
    # A plane of light in one colour: its interpolated value must be the plane's, at every pixel inside.
    v, u = np.mgrid[:40, :60].astype(np.float64)
    plane = 100 + 6.0 * u + 10.0 * v
    rgb = np.stack([plane if c == color else np.zeros_like(plane) for c in range(3)], axis=-1)
    mosaic = rgb[..., 1].copy()
    mosaic[0::2, 0::2], mosaic[1::2, 1::2] = rgb[0::2, 0::2, 0], rgb[1::2, 1::2, 2]
    images = StereoImages(
        rgb.astype(np.uint16),
        rgb.astype(np.uint16),
        0.0,
        1e-3,
        bits=12,
        left_mosaic=mosaic.astype(np.uint16),
        right_mosaic=mosaic.astype(np.uint16),
    )
    channel = marker_channel(images, "left", color)
    assert channel.shape == plane.shape
    # Two roundings to integers, of the mean of both greens and of the interpolation.
    np.testing.assert_allclose(channel[2:-2, 2:-2], plane[2:-2, 2:-2], atol=1.01)


@pytest.mark.parametrize("z_m", [1.7, 5.0, 10.0, 20.0, 40.0])
def test_centroids_are_as_good_as_their_declared_variance(z_m: float) -> None:
    errors, variances = [], []
    for seed in range(4):
        rng = np.random.default_rng([seed, int(z_m)])
        place = make_pose(*rng.uniform([0.05, -0.01], [0.07, 0.01]), z_m, *rng.uniform(-9, 9, 2), rng.uniform(-22, 22))
        images = paint_pair(RIG, DROGUE, place, rng)
        for eye in EYES:
            box = rim_box(RIG, place, DROGUE, eye)
            found = binary_centroids(marker_channel(images, eye, 0), box, LAYOUT)
            truth = project_disc_centers(RIG, place, LAYOUT.centers_m, LAYOUT.radius_m, eye)
            gaps = np.linalg.norm(found.blobs.centers_px[:, None] - truth, axis=2)
            nearest = gaps.argmin(axis=0)
            errors.append(found.blobs.centers_px[nearest] - truth)
            variances.append(found.cov_px2[nearest, 0, 0])
    rms, declared = np.sqrt(np.mean(np.square(errors))), np.sqrt(np.mean(variances))
    # 128 errors know their rms to 6 %; the law leaves out the sensor's noise and how median and opening depend on the
    # disc's size, which moved it by up to 30 % where it was measured.
    assert 0.6 < rms / declared < 1.5
    # No systematic shift: four standard errors of the mean of 64 values per axis.
    assert np.abs(np.mean(np.concatenate(errors), axis=0)).max() < 4 * declared / np.sqrt(64)


def test_quantisation_law() -> None:
    # The sum over rows, done directly for a disc of radius 20: 2 ends of 40 rows, variance 1/12, lever x.
    radius = 20.0
    rows = np.arange(-19.5, 20)
    variance = (2 * (radius**2 - rows**2) / 12).sum() / (np.pi * radius**2) ** 2
    # The sum of 40 rows instead of the integral errs by (1/40)^2 / 2.
    assert quantisation_variance_px2(np.array(radius)) == pytest.approx(variance, rel=1e-3)


def test_discs_at_the_images_edge_are_dropped() -> None:
    place = make_pose(0.06, 0.28, 1.7)
    images = paint_pair(RIG, DROGUE, place, None)
    truth = project_disc_centers(RIG, place, LAYOUT.centers_m, LAYOUT.radius_m, "left")
    outside = truth[:, 1] + RIG.camera.fx_px * LAYOUT.radius_m / 1.7 > RIG.camera.height_px
    assert 0 < outside.sum() < 4
    box = rim_box(RIG, place, DROGUE, "left")
    found = binary_centroids(marker_channel(images, "left", 0), box, LAYOUT)
    gaps = np.linalg.norm(found.blobs.centers_px[:, None] - truth, axis=2)
    assert (gaps.min(axis=0)[~outside] < 0.2).all()
    assert (gaps.min(axis=0)[outside] > 1).all()


@pytest.mark.parametrize("box", [(2000.0, 10.0, 50.0, 50.0), (-300.0, 10.0, 20.0, 50.0), (10.0, 10.0, 0.0, 0.0)])
def test_boxes_beside_the_image_hold_nothing(box: tuple[float, ...]) -> None:
    image = np.zeros((960, 1280), np.uint8)
    assert len(binary_centroids(image, box, LAYOUT).blobs) == 0


@pytest.mark.parametrize("name", ["red-8", "red-7", "red-5", "white-8"])
@pytest.mark.parametrize("kind", ["sky", "cloud", "ground"])
@pytest.mark.parametrize("z_m", [1.7, 6.0, 40.0])
def test_detector_boxes_the_rim(name: str, kind: str, z_m: float) -> None:
    if name == "white-8" and kind == "cloud" and z_m == 40:
        pytest.skip("white markers of 5 px before a white cloud show no contrast")
    drogue = PRESETS[name]
    rng = np.random.default_rng(11)
    place = make_pose(0.06, 0.01, z_m, 8, -6, 17)
    colors = {"marker_rgb": WHITE_RGB} if name == "white-8" else {}
    detection = ColorBlobDetector(drogue).detect(paint_pair(RIG, drogue, place, rng, kind=kind, **colors))
    for eye in EYES:
        found = detection.of(eye)
        assert found is not None
        assert 0.5 < found.score <= 1
        # The rim's true box differs from the facing circle's by the cosine of 10 degrees and the scale it is read from.
        assert overlap(found.box_xywh_px, rim_box(RIG, place, drogue, eye)) > 0.9


def test_detector_on_a_small_rig() -> None:
    rig = StereoRig(PinholeCamera(320, 240, 533.3, 533.3, 159.5, 119.5), 0.12)
    for z_m in (2.0, 5.0, 10.0):
        place = make_pose(0.06, 0, z_m, 5, 5, 10)
        detection = ColorBlobDetector(DROGUE).detect(paint_pair(rig, DROGUE, place, np.random.default_rng(12)))
        for eye in EYES:
            found = detection.of(eye)
            assert found is not None
            assert overlap(found.box_xywh_px, rim_box(rig, place, DROGUE, eye)) > 0.85


def test_detector_is_not_misled_by_other_red_things() -> None:
    place = make_pose(0.06, 0, 20, 5, 5, 10)
    images = paint_pair(RIG, DROGUE, place, np.random.default_rng(13))
    pictures = []
    for image in (images.left, images.right):
        painted = image.copy()
        cv2.rectangle(painted, (900, 100), (1200, 300), (250, 20, 20), -1)
        for x in range(50, 500, 37):
            cv2.circle(painted, (x, 800 + x % 53), 6, (180, 10, 10), -1)
        pictures.append(painted)
    detection = ColorBlobDetector(DROGUE).detect(replace(images, left=pictures[0], right=pictures[1]))
    for eye in EYES:
        found = detection.of(eye)
        assert found is not None
        assert overlap(found.box_xywh_px, rim_box(RIG, place, DROGUE, eye)) > 0.9
