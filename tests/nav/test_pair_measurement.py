"""Measurements that do not determine a pose: every method gives a reason, never a pose or an exception."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from datasets_manifest.types.estimates import NoFix, PoseEstimate
from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import MarkerLayout, marker_layout
from drogue_models.presets import PRESETS
from geometry.circles import project_disc_centers
from geometry.stereo import EYES, paper_rig
from nav.pair_measurement import PairMeasurement, estimate_pose
from nav.pair_navigator import RIM_METHODS, PairNavigator
from nav.pose.method_registry import METHODS, pose_method
from nav.pose.pose_method import NoFixReason, Observation
from tests.support.painted_pairs import make_pose, paint_pair

RIG = paper_rig()
DROGUE = PRESETS["red-8"]
LAYOUT = marker_layout(DROGUE)


def one_eye_only(pixels: np.ndarray, cov: np.ndarray) -> None:
    pixels[1] = np.nan


def nothing_seen(pixels: np.ndarray, cov: np.ndarray) -> None:
    pixels[:] = np.nan


def two_pairs(pixels: np.ndarray, cov: np.ndarray) -> None:
    pixels[:, 2:] = np.nan


def no_common_markers(pixels: np.ndarray, cov: np.ndarray) -> None:
    pixels[0, :4], pixels[1, 4:] = np.nan, np.nan


def on_one_line(pixels: np.ndarray, cov: np.ndarray) -> None:
    pixels[..., 1] = 480.0


def huge(pixels: np.ndarray, cov: np.ndarray) -> None:
    pixels[0, 3, 0] = 1e12


def infinite(pixels: np.ndarray, cov: np.ndarray) -> None:
    pixels[1, 3, 1] = np.inf


def wrong_order(pixels: np.ndarray, cov: np.ndarray) -> None:
    pixels[0] = pixels[0, [0, 4, 1, 5, 2, 6, 3, 7]]
    pixels[1] = pixels[1, [0, 4, 1, 5, 2, 6, 3, 7]]


def eyes_swapped(pixels: np.ndarray, cov: np.ndarray) -> None:
    pixels[:] = pixels[::-1].copy()


def covariance_not_a_number(pixels: np.ndarray, cov: np.ndarray) -> None:
    cov[0, 2] = np.nan


def covariance_zero(pixels: np.ndarray, cov: np.ndarray) -> None:
    cov[0, 2] = 0


FAULTS = {
    one_eye_only: "one eye only",
    nothing_seen: "no markers in either eye",
    two_pairs: "2 markers in both eyes",
    no_common_markers: "0 markers in both eyes",
    on_one_line: "on one line",
    huge: "marker 3 of the left eye lies far outside",
    infinite: "marker 3 of the right eye lies far outside",
    eyes_swapped: "disparity is not positive",
    covariance_not_a_number: "marker 2 of the left eye has no positive covariance",
    covariance_zero: "marker 2 of the left eye has no positive covariance",
}


def broken(corrupt: Callable[..., Any]) -> Observation:
    place = make_pose(0.06, 0, 5, 7, 7)
    pixels = np.stack([project_disc_centers(RIG, place, LAYOUT.centers_m, LAYOUT.radius_m, eye) for eye in EYES])
    cov = np.tile(0.01 * np.eye(2), (2, 8, 1, 1))
    corrupt(pixels, cov)
    return Observation(RIG, LAYOUT, pixels, cov)


# Methods of one eye answer without the other; tests/nav/pose/test_observation_checks.py has what turns them down.
STEREO_METHODS = [name for name in METHODS if not name.startswith("mono-") and name not in RIM_METHODS]


@pytest.mark.parametrize("method", STEREO_METHODS)
@pytest.mark.parametrize("corrupt", FAULTS, ids=lambda corrupt: corrupt.__name__)
def test_every_method_gives_the_reason(method: str, corrupt: Callable[..., Any]) -> None:
    answer = METHODS[method](broken(corrupt))
    assert isinstance(answer, NoFixReason)
    assert FAULTS[corrupt] in answer.reason


def test_joint_refuses_markers_in_a_wrong_order() -> None:
    answer = METHODS["joint"](broken(wrong_order))
    assert isinstance(answer, NoFixReason)
    assert "do not fit the drogue" in answer.reason


def test_the_papers_method_needs_a_circle() -> None:
    centers = LAYOUT.centers_m.copy()
    centers[0] *= 1.1
    good = broken(lambda pixels, cov: None)
    observation = Observation(RIG, MarkerLayout(centers, 0.05, None), good.pixels_px, good.cov_px2)
    answer = METHODS["paper"](observation)
    assert isinstance(answer, NoFixReason)
    assert "one circle" in answer.reason


@pytest.mark.parametrize("method", METHODS)
def test_random_points_never_raise(method: str) -> None:
    rng = np.random.default_rng(6)
    for _ in range(60):
        pixels = rng.uniform(0, 1280, (2, 8, 2))
        pixels[0, :, 0] = pixels[1, :, 0] + rng.uniform(0.01, 400, 8)
        # Anything but an exception will do; a pose must be a proper one, which its type checks.
        METHODS[method](Observation(RIG, LAYOUT, pixels, np.tile(0.01 * np.eye(2), (2, 8, 1, 1))))


@pytest.mark.parametrize("size", [(480, 640), (961, 1280), (1, 1)])
def test_images_of_another_size_than_the_rigs(size: tuple[int, int]) -> None:
    image = np.zeros((*size, 3), np.uint8)
    estimates = PairNavigator(RIG, DROGUE).estimate(4, StereoImages(image, image, 0.0, 1e-3), list(METHODS))
    assert [estimate.method for estimate in estimates] == list(METHODS)
    for estimate in estimates:
        assert isinstance(estimate, NoFix)
        assert estimate.frame_index == 4
        assert f"the images are {size[1]}x{size[0]} px" in estimate.reason


@pytest.mark.parametrize("level", [0, 128, 255])
def test_flat_images(level: int) -> None:
    image = np.full((960, 1280, 3), level, np.uint8)
    measurement = PairNavigator(RIG, DROGUE).observe(StereoImages(image, image, 0.0, 1e-3))
    assert isinstance(measurement.observation, NoFixReason)
    assert "no drogue detected in the left image, nor in the right one" in measurement.observation.reason


@pytest.mark.parametrize("blind", EYES)
@pytest.mark.parametrize("z_m", [3.0, 12.0])
def test_one_blind_eye(blind: str, z_m: float) -> None:
    place = make_pose(0.1, 0.05, z_m, 8, -7, 10)
    images = paint_pair(RIG, DROGUE, place, np.random.default_rng(8))
    images = replace(images, **{blind: np.zeros_like(images.left)})
    for estimate in PairNavigator(RIG, DROGUE).estimate(2, images, list(METHODS)):
        if estimate.method in RIM_METHODS:
            assert isinstance(estimate, NoFix)
            continue
        if estimate.method in STEREO_METHODS:
            assert isinstance(estimate, NoFix)
            assert estimate.reason == f"markers in one eye only: no drogue detected in the {blind} image"
            continue
        assert isinstance(estimate, PoseEstimate), estimate.reason
        assert {feature.eye for feature in estimate.features} == {eye for eye in EYES if eye != blind}
        # mono-circle works on binary centroids of 0.05 px; single-eye depth errs by 44 mm at 10 m and 0.1 px, by its
        # square with distance. The right eye's frame is 120 mm off.
        limit_m = np.array([0.01, 0.01, 4 * 0.044]) * max(1.0, (z_m / 10) ** 2)
        error_m = np.abs(estimate.left_from_drogue.translation_m - place.translation_m)
        assert (error_m < limit_m).all(), estimate.method


def test_a_single_eye_is_measured_by_the_edge_model_too() -> None:
    place = make_pose(0.1, 0.05, 5.0, 8, -7, 10)
    images = paint_pair(RIG, DROGUE, place, np.random.default_rng(9))
    navigator = PairNavigator(RIG, DROGUE)
    seen = navigator.refine(images, navigator.observe(images)).observation
    alone = replace(images, left=np.zeros_like(images.left))
    single = navigator.refine(alone, navigator.observe(alone)).observation
    assert isinstance(seen, Observation)
    assert isinstance(single, Observation)
    assert not single.seen[0].any()
    # Noise and widths are the frame's, of two eyes or of one: that moves a weight, not a centre.
    np.testing.assert_allclose(single.pixels_px[1], seen.pixels_px[1], atol=0.002)


@pytest.mark.parametrize("kind", ["sky", "cloud", "ground"])
def test_pictures_without_a_drogue(kind: str) -> None:
    images = paint_pair(RIG, None, make_pose(0, 0, 5), np.random.default_rng(7), kind=kind)
    assert isinstance(PairNavigator(RIG, DROGUE).observe(images).observation, NoFixReason)


def test_a_reason_of_the_method_keeps_the_features() -> None:
    measurement = PairMeasurement(broken(on_one_line), {"detect": 0.01})
    estimate = estimate_pose(3, measurement, "joint")
    assert isinstance(estimate, NoFix)
    assert len(estimate.features) == 16
    assert not any(feature.used for feature in estimate.features)
    assert set(estimate.stage_s) == {"detect", "pose"}


def test_a_pose_has_the_note_of_its_method() -> None:
    without_hub = PairMeasurement(broken(lambda pixels, cov: None), {})
    noted, plain = (estimate_pose(0, without_hub, method) for method in ("joint-hub", "joint"))
    assert isinstance(noted, PoseEstimate) and "no hub was measured" in noted.note
    assert isinstance(plain, PoseEstimate) and plain.note == ""


def test_unknown_method() -> None:
    with pytest.raises(ValueError, match="method: there is no pose method named 'best'; there are paper, paper-lit"):
        pose_method("best")


def test_observation_checks_its_shapes() -> None:
    with pytest.raises(ValueError, match=r"pixels_px: must have shape \(2, 8, 2\)"):
        Observation(RIG, LAYOUT, np.zeros((2, 7, 2)), np.zeros((2, 8, 2, 2)))
    with pytest.raises(ValueError, match=r"cov_px2: must have shape \(2, 8, 2, 2\)"):
        Observation(RIG, LAYOUT, np.zeros((2, 8, 2)), np.zeros((2, 8, 2)))
