"""The smoother against batch least squares, and with gaps, outliers and ambiguity."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from datasets_manifest.types.estimates import Estimate, Feature, Mode, NoFix, PoseEstimate
from geometry.se3 import RigidTransform
from nav.filtering.measurement_update import pose_difference
from nav.filtering.motion_model import FilterSettings
from nav.filtering.pose_filter import PoseFilter
from nav.filtering.smoother import smooth

Measure = Callable[..., PoseEstimate]


def _no_fix(index: int) -> NoFix:
    return NoFix(frame_index=index, method="drawn", reason="no drogue detected")


def _rms_m(estimates: list[Estimate], truth: list[RigidTransform]) -> float:
    away = [
        pose_difference(estimate.left_from_drogue, pose)[:3]
        for estimate, pose in zip(estimates, truth, strict=True)
        if isinstance(estimate, PoseEstimate)
    ]
    assert len(away) == len(truth)
    return float(np.sqrt((np.array(away) ** 2).sum(axis=1).mean()))


def _batch(
    times: np.ndarray, depths: np.ndarray, sd_m: float, settings: FilterSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Depth as seen, and speed, with their covariance, of all times at once by scipy.

    Unknowns are depth, speed and vibration at each time; nan is a depth that was not measured.
    """
    count = len(times)
    rows, values = [], []

    def add(places: list[int], factors: np.ndarray, value: float, covariance: np.ndarray) -> None:
        row = np.zeros((len(factors), 3 * count))
        row[:, places] = factors
        white = np.linalg.inv(np.linalg.cholesky(covariance))
        rows.append(white @ row)
        values.append(white @ np.full(len(factors), value))

    shaking = settings.vibration_m**2
    add([1], np.eye(1), 0.0, np.array([[settings.start_speed_m_s**2]]))
    add([2], np.eye(1), 0.0, np.array([[shaking]]))
    for k, depth in enumerate(depths):
        if not np.isnan(depth):
            add([3 * k, 3 * k + 2], np.array([[1.0, 1.0]]), depth, np.array([[sd_m**2]]))
    for k, h in enumerate(np.diff(times)):
        persists = np.exp(-h / settings.vibration_s)
        before = np.array([[1, h, 0], [0, 1, 0], [0, 0, persists]])
        moves = settings.acceleration_m2_s3 * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
        noise = block_diag(moves, (1 - persists**2) * shaking)
        add(list(range(3 * k, 3 * k + 6)), np.hstack([-before, np.eye(3)]), 0.0, noise)
    matrix, right = np.vstack(rows), np.concatenate(values)
    solved = lsq_linear(matrix, right, lsq_solver="exact").x
    told = np.kron(np.eye(count), [[1, 0, 1], [0, 1, 0]])
    covariance = told @ np.linalg.inv(matrix.T @ matrix) @ told.T
    return (told @ solved).reshape(count, 2), covariance


def test_the_smoother_is_batch_least_squares_on_a_line(rng: np.random.Generator, measure: Measure) -> None:
    settings = FilterSettings(long_term_excess=0, vibration_m=0.004, vibration_s=0.05, noise_scale_variance_per_s=0)
    sd_m = 0.01
    times = np.cumsum(rng.choice([0.03, 0.04, 0.11], 25))
    depths = 6 - 0.7 * times + 0.2 * np.sin(times) + rng.normal(size=25) * sd_m
    depths[[5, 6, 14]] = np.nan
    estimates: list[Estimate] = [
        _no_fix(index)
        if np.isnan(depth)
        else measure(RigidTransform(np.eye(3), np.array([0, 0, depth])), np.diag([sd_m**2] * 3 + [1e-6] * 3))
        for index, depth in enumerate(depths)
    ]
    smoothed = smooth(times.tolist(), estimates, settings, 1)
    expected, covariance = _batch(times, depths, sd_m, settings)
    for k, estimate in enumerate(smoothed):
        assert isinstance(estimate, PoseEstimate) and estimate.motion is not None and estimate.covariance is not None
        got = [estimate.left_from_drogue.translation_m[2], estimate.motion.velocity_m_s[2]]
        # Two ways to the same solution of 75 unknowns: rounding times the condition of the normal equations.
        np.testing.assert_allclose(got, expected[k], atol=1e-7)
        spread = covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        np.testing.assert_allclose(estimate.covariance[2, 2], spread[0, 0], rtol=1e-5)
        np.testing.assert_allclose(estimate.motion.covariance[2, 2], spread[1, 1], rtol=1e-5)


def _swinging(time_s: float) -> RigidTransform:
    attitude = Rotation.from_euler("YXZ", [0.1 * np.sin(1.6 * time_s), 0.05 * np.cos(1.6 * time_s), 0.1]).as_matrix()
    return RigidTransform(attitude, np.array([0.3 * np.sin(1.6 * time_s), 0.1, 8 - 0.6 * time_s]))


def test_the_smoother_beats_the_filter_which_beats_the_fixes(
    rng: np.random.Generator, measure: Measure, covariance: np.ndarray
) -> None:
    settings = FilterSettings(vibration_m=0, vibration_rad=0)
    times = [index * 0.04 for index in range(150)]
    truth = [_swinging(time) for time in times]
    raw = [measure(pose, covariance * 25, rng, index) for index, pose in enumerate(truth)]
    fixes = PoseFilter(settings, 8)
    filtered: list[Estimate] = []
    for time, estimate in zip(times, raw, strict=True):
        state = fixes.update(time, estimate).state
        assert state is not None
        filtered.append(state.to_estimate(estimate.frame_index, "drawn+filter", estimate))
    smoothed = smooth(times, raw, settings, 8)
    assert [estimate.method for estimate in smoothed] == ["drawn+smoother"] * 150
    assert [estimate.frame_index for estimate in smoothed] == list(range(150))
    errors = [_rms_m(list(each), truth) for each in (raw, filtered, smoothed)]
    # Measured: 0.43 and 0.25 of the fixes' error.
    assert errors[1] < 0.6 * errors[0] and errors[2] < 0.8 * errors[1]


def test_image_points_of_a_rejected_fix_are_not_those_of_the_pose(measure: Measure, covariance: np.ndarray) -> None:
    settings, times = FilterSettings(), [index * 0.04 for index in range(30)]
    point = Feature(eye="left", index=3, center_px=(5.0, 6.0), cov_px2=((0.01, 0.0), (0.0, 0.01)), used=True)
    far = RigidTransform(np.eye(3), np.array([1.0, 0, 0]))
    poses = [_swinging(time) if index != 20 else far @ _swinging(time) for index, time in enumerate(times)]
    estimates: list[Estimate] = [
        measure(pose, covariance, None, index).model_copy(update={"features": (point,)})
        for index, pose in enumerate(poses)
    ]
    smoothed = smooth(times, estimates, settings, 8)
    assert all(isinstance(estimate, PoseEstimate) for estimate in smoothed)
    used = [[(feature.index, feature.used) for feature in estimate.features] for estimate in smoothed]
    assert used == [[(3, index != 20)] for index in range(30)]


def test_gaps_outliers_and_pauses(measure: Measure, covariance: np.ndarray) -> None:
    settings = FilterSettings()
    times = [index * 0.04 for index in range(60)]
    times[40:] = [time + 10 for time in times[40:]]
    estimates: list[Estimate] = [measure(_swinging(time), covariance, None, index) for index, time in enumerate(times)]
    estimates[0] = _no_fix(0)
    estimates[10:15] = [_no_fix(index) for index in range(10, 15)]
    far = RigidTransform(np.eye(3), np.array([1.0, 0, 0]))
    estimates[30] = measure(far @ _swinging(times[30]), covariance, None, 30)
    estimates[50] = measure(_swinging(times[50]), covariance).model_copy(update={"covariance": None})
    estimates[59] = _no_fix(59)
    smoothed = smooth(times, estimates, settings, 8)
    none = [index for index, estimate in enumerate(smoothed) if isinstance(estimate, NoFix)]
    assert none == [0, 59]
    for index in (*range(10, 15), 30, 50):
        estimate = smoothed[index]
        assert isinstance(estimate, PoseEstimate) and estimate.covariance is not None
        away = pose_difference(estimate.left_from_drogue, _swinging(times[index]))
        assert away @ np.linalg.solve(estimate.covariance, away) < 22.5  # chi-square, 99.9 %
    # In the middle of a gap less is known than at its ends.
    sizes = [
        np.trace(estimate.covariance)
        for estimate in smoothed[9:16]
        if isinstance(estimate, PoseEstimate) and estimate.covariance is not None
    ]
    assert np.argmax(sizes) == 3


def test_pairs_without_a_fix_change_nothing_elsewhere(
    rng: np.random.Generator, measure: Measure, covariance: np.ndarray
) -> None:
    times = [index * 0.04 for index in range(30)]
    estimates: list[Estimate] = [
        _no_fix(index) if 10 <= index < 18 else measure(_swinging(time), covariance, rng, index)
        for index, time in enumerate(times)
    ]
    kept = [index for index, estimate in enumerate(estimates) if isinstance(estimate, PoseEstimate)]
    everywhere = smooth(times, estimates, FilterSettings(), 8)
    there = smooth([times[index] for index in kept], [estimates[index] for index in kept], FilterSettings(), 8)
    for index, other in zip(kept, there, strict=True):
        one = everywhere[index]
        assert isinstance(one, PoseEstimate) and isinstance(other, PoseEstimate)
        assert one.motion is not None and other.motion is not None
        # One step or nine differ by where the lever of the camera's turn is taken: 0.03 m of 8 m.
        np.testing.assert_allclose(np.diag(one.motion.covariance), np.diag(other.motion.covariance), rtol=0.01)
        assert np.abs(pose_difference(one.left_from_drogue, other.left_from_drogue)).max() < 1e-4


def test_accelerations_are_correlated_over_a_gap(measure: Measure, covariance: np.ndarray) -> None:
    times = [index * 0.04 for index in range(30)]
    estimates: list[Estimate] = [
        _no_fix(index) if 10 <= index < 18 else measure(_swinging(time), covariance, None, index)
        for index, time in enumerate(times)
    ]
    variances = []
    for long_term_excess in (0.0, 3.0):
        middle = smooth(
            times, estimates, FilterSettings(long_term_excess=long_term_excess, noise_scale_variance_per_s=0), 8
        )[14]
        assert isinstance(middle, PoseEstimate) and middle.covariance is not None
        variances.append(middle.covariance[0, 0])
    # Over 0.36 s the density is 1 + 3 (1 - exp(-1.8)) = 3.5 times as large, over single periods 1.5 times; the fixes
    # beside the gap are better than what it adds.
    assert variances[1] > 2.5 * variances[0]


def test_later_fixes_decide_between_hypotheses(measure: Measure, covariance: np.ndarray) -> None:
    times = [index * 0.04 for index in range(20)]

    def pose(time_s: float, tilt_rad: float) -> RigidTransform:
        return RigidTransform(Rotation.from_rotvec([tilt_rad, 0, 0]).as_matrix(), np.array([0, 0, 8 - 0.6 * time_s]))

    estimates: list[Estimate] = []
    for index, time in enumerate(times):
        shares = (0.55, 0.45) if index < 10 else (0.0, 1.0)
        poses = (pose(time, -0.1), pose(time, 0.1))
        modes = tuple(
            Mode(left_from_drogue=one, weight=share) for one, share in zip(poses, shares, strict=True) if share > 0
        )
        mean = pose(time, 0.1 * (shares[1] - shares[0]))
        spread = np.zeros((6, 6))
        spread[3, 3] = 0.04 * shares[0] * shares[1]
        estimates.append(measure(mean, covariance + spread, None, index).model_copy(update={"modes": modes}))
    for time, estimate in zip(times, smooth(times, estimates, FilterSettings(), 8), strict=True):
        assert isinstance(estimate, PoseEstimate)
        assert np.abs(pose_difference(estimate.left_from_drogue, pose(time, 0.1))[3:]).max() < 0.002


def test_invalid_times_and_empty_sequences(measure: Measure, covariance: np.ndarray) -> None:
    two = [measure(_swinging(0), covariance)] * 2
    for times in ([0.0], [1.0, 0.0], [1.0, 1.0], [0.0, np.nan]):
        with pytest.raises(ValueError, match="times_s"):
            smooth(times, two, FilterSettings(), 8)
    assert smooth([], [], FilterSettings(), 8) == []
    only = smooth([0.0], [_no_fix(7)], FilterSettings(), 8)
    assert isinstance(only[0], NoFix) and only[0].frame_index == 7 and only[0].method == "drawn+smoother"
