"""Faint markers before a bright sky, as a mono and a mosaic sensor see them where exposure follows the sky."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from datasets_manifest.types.estimates import PoseEstimate
from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.presets import PRESETS
from geometry.circles import project_disc_centers
from geometry.se3 import RigidTransform
from geometry.stereo import EYES, Eye, paper_rig
from nav.centroids.binary_centroids import window_centroids
from nav.pair_measurement import PairMeasurement, regions_of
from nav.pair_navigator import DETECTOR, PairNavigator
from nav.pose.pose_method import OUTER_EDGE, NoFixReason
from nav.tracking.region import rim_boxes
from tests.support.painted_pairs import FACE_RGB, background, expose, make_pose, paint_disc

RIG = paper_rig()
DROGUE = PRESETS["red-8"]
LAYOUT = marker_layout(DROGUE)
NAVIGATOR = PairNavigator(RIG, DROGUE)
# In numbers of 8 bits, beside a face of 7 and a cloudy sky of 95 to 208: what is left of red paint towards the sun.
MARKER_RGB = (24.0, 7.0, 7.0)
LENS_SIGMA_PX = 0.5


def drawn_light(place: RigidTransform, eye: Eye, markers: int, face_behind_m: float) -> np.ndarray:
    """A face with the sky in its opening, and so many of its markers before it. [DN]"""
    image = background(RIG, "cloud")
    paint_disc(
        image,
        RIG,
        eye,
        place,
        (0, 0, face_behind_m),
        (LAYOUT.face_inner_radius_m, LAYOUT.face_outer_radius_m),
        FACE_RGB,
    )
    for center in LAYOUT.centers_m[:markers]:
        paint_disc(image, RIG, eye, place, center, (0.0, LAYOUT.radius_m), MARKER_RGB)
    paint_disc(image, RIG, eye, place, LAYOUT.hub_center_m, (0.0, LAYOUT.collar_radius_m), FACE_RGB)
    edges_m = LAYOUT.hub_inner_radius_m, LAYOUT.hub_outer_radius_m
    paint_disc(image, RIG, eye, place, LAYOUT.hub_center_m, edges_m, MARKER_RGB)
    return cv2.GaussianBlur(image, (0, 0), LENS_SIGMA_PX)


def seen_by(
    sensor: str,
    place: RigidTransform,
    rng: np.random.Generator,
    markers: int = LAYOUT.count,
    face_behind_m: float = 0.0,
) -> StereoImages:
    """The pair as a `mono` or a `mosaic` sensor behind a lens gives it."""
    shots, mosaics = [], []
    for eye in EYES:
        light = drawn_light(place, eye, markers, face_behind_m)
        if sensor == "mono":
            shots.append(expose(light.mean(axis=2), rng))
            continue
        shots.append(expose(light, rng))
        # Red and blue sites take turns with green ones.
        mosaics.append(shots[-1][..., 1].copy())
        mosaics[-1][0::2, 0::2], mosaics[-1][1::2, 1::2] = shots[-1][0::2, 0::2, 0], shots[-1][1::2, 1::2, 2]
    images = StereoImages(shots[0], shots[1], time_s=0.0, exposure_s=1e-3)
    return images if sensor == "mono" else replace(images, left_mosaic=mosaics[0], right_mosaic=mosaics[1])


def measured(images: StereoImages, place: RigidTransform) -> PairMeasurement:
    return NAVIGATOR.measure(images, regions_of(rim_boxes(RIG, DROGUE.rim_radius_m, place), DETECTOR))


@pytest.mark.parametrize("sensor", ["mono", "mosaic"])
@pytest.mark.parametrize(("z_m", "face_behind_m"), [(2.0, 0.0), (5.0, 0.0), (5.0, 0.02), (10.0, 0.0)])
def test_a_backlit_ring_is_found_and_fitted_to_its_covariance(sensor: str, z_m: float, face_behind_m: float) -> None:
    rng = np.random.default_rng([8, int(z_m)])
    place = make_pose(0.06, 0.01, z_m, 6, -5, 10)
    # From 20 mm behind the markers the face seems to end a pixel earlier than the layout says, at 5 m.
    images = seen_by(sensor, place, rng, face_behind_m=face_behind_m)
    measurement = measured(images, place)
    assert not isinstance(measurement.observation, NoFixReason), measurement.observation.reason
    assert measurement.observation.paired.all()
    truth = np.stack([project_disc_centers(RIG, place, LAYOUT.centers_m, LAYOUT.radius_m, eye) for eye in EYES])
    # Of black and white pixels 0.05 px at 10 m; the dim side towards the sky adds as much.
    assert np.sqrt(np.mean((measurement.observation.pixels_px - truth) ** 2)) < 0.15
    fine = NAVIGATOR.refine(images, measurement).observation
    assert fine.seen.all()
    error, cov = (fine.pixels_px - truth).reshape(-1, 2), fine.cov_px2.reshape(-1, 2, 2)
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error).mean() / 2
    # Chi-square of 32: standard deviation of the mean square 0.25; the drawing's samples within a pixel add to it.
    assert nees < 2
    # Noise of 0.7 numbers on a contrast of 6, or a quarter of the pixels of one of 17, leaves 0.02 px at 10 m.
    assert np.sqrt(np.mean(error**2)) < 0.04
    assert fine.hub_seen[:, OUTER_EDGE].all()
    hub = np.concatenate(
        [project_disc_centers(RIG, place, LAYOUT.hub_center_m[None], LAYOUT.hub_outer_radius_m, eye) for eye in EYES]
    )
    error, cov = fine.hub_px[:, OUTER_EDGE] - hub, fine.hub_cov_px2[:, OUTER_EDGE]
    # Chi-square of 4 over 2, exceeded once in ten thousand.
    assert np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error).sum() < 24
    # Of such noise 0.02 px; with sky among its pixels it was off by 0.09 px at 10 m.
    assert np.abs(error).max() < 0.06
    (estimate,) = NAVIGATOR.estimate_measured(0, images, measurement, ["joint-hub"])
    assert isinstance(estimate, PoseEstimate)
    # The depth of such centroids, 0.3 mm/px and 0.03 px at 10 m with the square of the distance; five deviations.
    error_m = np.linalg.norm(estimate.left_from_drogue.translation_m - place.translation_m)
    assert error_m < 5e-3 * (z_m / 10) ** 2


@pytest.mark.parametrize("sensor", ["mono", "mosaic"])
@pytest.mark.parametrize("z_m", [2.0, 5.0, 10.0])
def test_a_face_without_markers_shows_no_ring(sensor: str, z_m: float) -> None:
    place = make_pose(0.06, 0.01, z_m, 6, -5, 10)
    images = seen_by(sensor, place, np.random.default_rng([9, int(z_m)]), markers=0)
    observation = measured(images, place).observation
    assert isinstance(observation, NoFixReason)
    assert "no ring of markers" in observation.reason


@pytest.mark.parametrize("part", ["noise", "clouds", "half"])
def test_no_ring_is_read_into_noise(part: str) -> None:
    for seed in range(20):
        rng = np.random.default_rng([10, seed])
        light = np.full((180, 180), 6.0)
        if part == "clouds":
            light = 100 + cv2.GaussianBlur(rng.normal(0, 500, light.shape), (0, 0), 8)
        if part == "half":
            light[:70] = 200
        assert window_centroids(expose(light, rng), (0, 0), LAYOUT).ring is None
