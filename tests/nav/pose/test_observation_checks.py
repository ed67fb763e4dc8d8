"""Invalid measurements, for monocular methods and those that use the hub."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drogue_models.marker_layout import MarkerLayout
from geometry.pinhole import PinholeCamera
from nav.pair_navigator import RIM_METHODS
from nav.pose.joint import solve_joint_batch
from nav.pose.method_registry import METHODS
from nav.pose.pose_method import NoFixReason, Observation, Solution, StatedTolerances
from tests.support.painted_pairs import Draws, draw_poses

MARKER_METHODS = [name for name in METHODS if name not in RIM_METHODS]
MONO = [name for name in METHODS if name.startswith("mono-")]
HUB = ["joint-hub", "joint-robust"]


@pytest.fixture
def draws() -> Draws:
    return draw_poses(np.random.default_rng(71), 1, 5.0, 0.05, tilt_deg=(6.0, 8.0))


def changed(draws: Draws, change: Callable[..., Any]) -> Observation:
    good = draws.observation(0)
    arrays = [np.array(a) for a in (good.pixels_px, good.cov_px2, good.hub_px, good.hub_cov_px2)]
    change(*arrays)
    return Observation(good.rig, good.layout, *arrays)


def reason_of(method: str, observation: Observation) -> str:
    answer = METHODS[method](observation)
    assert isinstance(answer, NoFixReason)
    return answer.reason


@pytest.mark.parametrize("method", MONO)
def test_the_left_eye_suffices(draws: Draws, method: str) -> None:
    def right_eye_lost(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
        pixels[1], hub[1] = np.nan, np.nan

    solution = METHODS[method](changed(draws, right_eye_lost))
    assert isinstance(solution, Solution)
    both = METHODS[method](draws.observation(0))
    # Rounding.
    np.testing.assert_allclose(solution.left_from_drogue.as_matrix(), both.left_from_drogue.as_matrix(), atol=1e-9)
    assert solution.used.sum(axis=1).tolist() == [8, 0]


@pytest.mark.parametrize("method", MONO)
@pytest.mark.parametrize("left_over", [0, 3])
def test_the_right_eye_replaces_the_left_one(draws: Draws, method: str, left_over: int) -> None:
    def left_eye_lost(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
        pixels[0, left_over:], hub[0] = np.nan, np.nan

    solution = METHODS[method](changed(draws, left_eye_lost))
    assert isinstance(solution, Solution)
    assert solution.used.sum(axis=1).tolist() == [0, 8]
    # The same measurements as those of a left eye that stands where the right one does.
    as_left = Observation(
        draws.rig,
        draws.layout,
        *(values[::-1] for values in (draws.observation(0).pixels_px, draws.observation(0).cov_px2)),
        *(values[::-1] for values in (draws.observation(0).hub_px, draws.observation(0).hub_cov_px2)),
    )
    there = METHODS[method](as_left)
    moved_m = solution.left_from_drogue.translation_m - there.left_from_drogue.translation_m
    # Rounding.
    np.testing.assert_allclose(moved_m, [draws.rig.baseline_m, 0, 0], atol=1e-9)
    np.testing.assert_allclose(solution.left_from_drogue.rotation, there.left_from_drogue.rotation, atol=1e-9)
    np.testing.assert_allclose(solution.covariance, there.covariance, rtol=1e-6)
    for mode, other in zip(solution.modes, there.modes, strict=True):
        step_m = mode.left_from_drogue.translation_m - other.left_from_drogue.translation_m
        np.testing.assert_allclose(step_m, [draws.rig.baseline_m, 0, 0], atol=1e-9)


@pytest.mark.parametrize("method", MONO)
def test_the_right_eye_is_as_exact(method: str) -> None:
    draws = draw_poses(np.random.default_rng(73), 6, (1.7, 10.0), 0.01, tilt_deg=(6.0, 10.0))
    for index, place in enumerate(draws.places):
        pixels = draws.exact_px[index].copy()
        pixels[0] = np.nan
        solution = METHODS[method](draws.observation(index, pixels_px=pixels))
        assert isinstance(solution, Solution)
        # As for the left eye (test_pose_rivals): OpenCV's methods take the discs' shift from a first pass.
        atol = 3e-5 if method in ("mono-ippe", "mono-sqpnp") else 1e-6
        np.testing.assert_allclose(solution.left_from_drogue.translation_m, place.translation_m, atol=atol)


def nothing_seen(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
    pixels[:] = np.nan


def three_left(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
    pixels[0, 3:], pixels[1] = np.nan, np.nan


def two_in_each(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
    pixels[:, 2:] = np.nan


def on_one_line(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
    pixels[0, :, 1] = 300.0


def on_one_line_right(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
    pixels[0], pixels[1, :, 1] = np.nan, 300.0


def huge(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
    pixels[0, 3] = 1e300


def infinite_right(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
    pixels[0], pixels[1, 5, 0] = np.nan, np.inf


def huge_covariance(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
    cov[0, 2] = 1e300 * np.eye(2)


def not_a_number(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
    cov[0, 2, 0, 0] = np.nan


def asymmetric(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
    cov[0, 2] = [[0.01, 0.009], [-0.009, 0.01]]


@pytest.mark.parametrize("method", MONO)
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (nothing_seen, "0 markers in the left eye"),
        (three_left, "3 markers in the left eye"),
        (two_in_each, "2 markers in the left eye and 2 in the right one"),
        (on_one_line, "the left eye sees lie on one line"),
        (on_one_line_right, "the right eye sees lie on one line"),
        (huge, "marker 3 of the left eye lies far outside"),
        (infinite_right, "marker 5 of the right eye lies far outside"),
        (huge_covariance, "marker 2 of the left eye has no positive covariance"),
        (not_a_number, "marker 2 of the left eye has no positive covariance"),
        (asymmetric, "marker 2 of the left eye has no symmetric covariance"),
    ],
)
def test_reasons_of_monocular_methods(draws: Draws, method: str, change: Callable[..., Any], reason: str) -> None:
    assert reason in reason_of(method, changed(draws, change))


@pytest.mark.parametrize("method", [name for name in MARKER_METHODS if name not in MONO])
@pytest.mark.parametrize("factor", [0.5, 0.67, 1.5, 2.0])
@pytest.mark.parametrize("z_m", [3.0, 10.0])
def test_another_rigs_baseline(method: str, factor: float, z_m: float) -> None:
    draws = draw_poses(np.random.default_rng(74), 1, z_m, 0.05, tilt_deg=(6.0, 8.0))
    good = draws.observation(0)
    assert isinstance(METHODS[method](good), Solution)
    other = replace(draws.rig, baseline_m=factor * draws.rig.baseline_m)
    wrong = Observation(other, good.layout, good.pixels_px, good.cov_px2, good.hub_px, good.hub_cov_px2)
    assert "rig and drogue do not fit" in reason_of(method, wrong)


@pytest.mark.parametrize("method", MARKER_METHODS)
def test_a_rig_of_much_smaller_images(draws: Draws, method: str) -> None:
    good, camera = draws.observation(0), draws.rig.camera
    small = PinholeCamera(camera.width_px // 5, camera.height_px // 5, camera.fx_px / 5, camera.fy_px / 5, 127.5, 95.5)
    rig = replace(draws.rig, camera=small)
    assert "far outside the image" in reason_of(method, Observation(rig, good.layout, good.pixels_px, good.cov_px2))


def bad_measurements() -> st.SearchStrategy[tuple[str, int, int, float]]:
    """What goes wrong, in which eye, with which marker, by which number."""
    numbers = st.sampled_from([np.nan, np.inf, -np.inf, 1e12, -1e12, 1e300])
    return st.tuples(st.sampled_from(["few", "line", "number"]), st.integers(0, 1), st.integers(0, 7), numbers)


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(bad=bad_measurements())
def test_invalid_measurements_give_no_pose(draws: Draws, method: str, bad: tuple[str, int, int, float]) -> None:
    kind, eye, marker, number = bad

    def spoilt(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
        hub[:] = np.nan
        if kind == "few":
            kept = pixels[:, [marker, (marker + 3) % 8]].copy()
            pixels[:] = np.nan
            pixels[:, [marker, (marker + 3) % 8]] = kept
        elif kind == "line":
            pixels[:, :, eye] = 400.0 - 50.0 * np.arange(2)[:, None] * (1 - eye)
        elif np.isnan(number):
            cov[:, marker, eye, eye] = number
        else:
            pixels[:, marker, eye] = number

    # A reason, and neither a pose nor an exception.
    assert reason_of(method, changed(draws, spoilt))


@pytest.mark.parametrize("method", [*MONO, "joint", "joint-hub"])
def test_a_wrong_order_of_markers(draws: Draws, method: str) -> None:
    def shuffled(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
        pixels[:] = pixels[:, [0, 4, 1, 5, 2, 6, 3, 7]]

    reason = reason_of(method, changed(draws, shuffled))
    assert "do not fit" in reason or "no pose in front of the camera" in reason


@pytest.mark.parametrize("method", HUB)
def test_reasons_of_a_bad_hub(draws: Draws, method: str) -> None:
    def far_away(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
        hub[1, 0] = np.inf

    def no_covariance(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
        hub_cov[0, 1] = 0

    def skew_covariance(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
        hub_cov[0, 1, 0, 1] = 0.002

    assert "hub edge 1 of the left eye has no symmetric covariance" in reason_of(
        method, changed(draws, skew_covariance)
    )
    assert "hub edge 0 of the right eye lies far outside" in reason_of(method, changed(draws, far_away))
    assert "hub edge 1 of the left eye has no positive covariance" in reason_of(method, changed(draws, no_covariance))


def test_a_wrong_feature_as_the_hub(draws: Draws) -> None:
    def elsewhere(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
        hub += 300.0

    assert "do not fit the drogue" in reason_of("joint-hub", changed(draws, elsewhere))
    assert isinstance(METHODS["joint-robust"](changed(draws, elsewhere)), Solution)


def test_joint_robust_needs_enough_inliers(draws: Draws) -> None:
    def scattered(pixels: np.ndarray, cov: np.ndarray, hub: np.ndarray, hub_cov: np.ndarray) -> None:
        pixels += np.random.default_rng(72).uniform(-15, 15, pixels.shape)

    assert "agree with each other" in reason_of("joint-robust", changed(draws, scattered))


def test_observation_checks_the_hub(draws: Draws) -> None:
    good = draws.observation(0)
    with pytest.raises(ValueError, match="hub_px, hub_cov_px2: give both or neither"):
        Observation(good.rig, good.layout, good.pixels_px, good.cov_px2, good.hub_px)
    with pytest.raises(ValueError, match=r"hub_px: must have shape \(2, 2, 2\)"):
        Observation(good.rig, good.layout, good.pixels_px, good.cov_px2, np.zeros((2, 2)), good.hub_cov_px2)
    bare = MarkerLayout(good.layout.centers_m, 0.05, None)
    with pytest.raises(ValueError, match="hub_px: the drogue has no hub"):
        Observation(good.rig, bare, good.pixels_px, good.cov_px2, good.hub_px, good.hub_cov_px2)


def test_masks_of_what_was_measured_follow_the_pixels_and_cannot_be_changed(draws: Draws) -> None:
    count, pixels = draws.layout.count, draws.pixels_px[0].copy()
    pixels[1, 2] = np.nan
    every = np.broadcast_to(0.0025 * np.eye(2), (*pixels.shape, 2))
    parts = pixels[:, :count], every[:, :count], pixels[:, count:], every[:, count:]
    observation = Observation(draws.rig, draws.layout, *parts)
    masks = observation.seen, observation.hub_seen, observation.paired
    assert np.argwhere(~masks[0]).tolist() == [[1, 2]] and masks[1].all()
    assert np.flatnonzero(~masks[2]).tolist() == [2]
    assert not any(mask.flags.writeable for mask in masks)
    assert replace(observation, pixels_px=draws.pixels_px[0, :, :count]).seen.all()


@pytest.mark.parametrize("name", ["ring_radius_m", "ellipticity", "placement_m", "hub_lateral_m", "disparity_px"])
@pytest.mark.parametrize("value", [-1e-3, np.nan, np.inf])
def test_a_tolerance_is_a_size(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name}: must be 0 or more"):
        StatedTolerances(**{name: value})


def test_arrays_of_the_batch(draws: Draws) -> None:
    with pytest.raises(ValueError, match=r"pixels_px: must have shape \(B, 1 or 2, 8, 2\), got \(1, 2, 7, 2\)"):
        solve_joint_batch(draws.rig, draws.layout, draws.pixels_px[:, :, :7], np.eye(2))
    crooked = MarkerLayout(draws.layout.centers_m * np.linspace(1, 1.1, 8)[:, None], 0.05, None)
    with pytest.raises(ValueError, match="ring_radius_m: the markers lie on no circle"):
        solve_joint_batch(draws.rig, crooked, draws.pixels_px[:, :, :8], np.eye(2), StatedTolerances(5e-4))


def test_a_batch_marks_frames_that_have_no_pose(draws: Draws) -> None:
    frames = np.repeat(draws.pixels_px, 4, axis=0)
    frames[1] = np.nan
    frames[2, :, 2:] = np.nan
    batch = solve_joint_batch(draws.rig, draws.layout, frames, 0.0025 * np.eye(2))
    assert batch.sound.tolist() == [True, False, False, True]
    # Rounding.
    np.testing.assert_allclose(batch.translations_m[0], batch.translations_m[3], atol=1e-9)
