"""Gains against a Riccati solver, errors against their covariance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from datasets_manifest.types.estimates import PoseEstimate
from geometry.se3 import RigidTransform
from nav.filtering.measurement_update import pose_difference
from nav.filtering.motion_model import FilterSettings
from nav.filtering.pose_filter import FilterState, PoseFilter

Measure = Callable[..., PoseEstimate]
PERIOD_S = 0.04
STEADY_AIR = FilterSettings(noise_scale_variance_per_s=0)


def test_the_steady_state_is_that_of_the_riccati_equation(measure: Measure) -> None:
    settings = FilterSettings(
        acceleration_m2_s3=0.3, long_term_excess=0, vibration_m=0.004, vibration_s=0.001, noise_scale_variance_per_s=0
    )
    sd_m = 0.01
    pose = RigidTransform(np.eye(3), np.array([0.0, 0.0, 5.0]))
    fixes = PoseFilter(settings, 1)
    for index in range(300):
        fixes.update(index * PERIOD_S, measure(pose, np.diag([sd_m**2] * 3 + [1e-6] * 3)))
    predicted = fixes.predict(300 * PERIOD_S)
    assert predicted is not None
    h, density = PERIOD_S, 0.3
    transition = np.array([[1, h], [0, 1]])
    noise = density * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
    seen = np.array([[sd_m**2 + 0.004**2]])
    expected = solve_discrete_are(transition.T, np.array([[1.0], [0.0]]), noise, seen)
    expected[0, 0] += 0.004**2  # the pose that the camera sees shakes
    along_axis = np.ix_([2, 8], [2, 8])
    # The vibration is forgotten to exp(-40) from pair to pair; what remains is the solver's rounding.
    np.testing.assert_allclose(predicted.covariance[along_axis], expected, rtol=1e-8)


def _flown(
    rng: np.random.Generator, settings: FilterSettings, runs: int, pairs: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses (runs, pairs, 4, 4) as seen, and smooth velocities and rates, of white accelerations in small steps."""
    sub, h = 10, PERIOD_S / 10
    t = np.tile([0.3, -0.2, 6.0], (runs, 1)) + rng.normal(size=(runs, 3)) * 0.2
    turn = Rotation.from_rotvec(rng.normal(size=(runs, 3)) * 0.1)
    v, w = rng.normal(size=(runs, 3)) * settings.start_speed_m_s, rng.normal(size=(runs, 3)) * settings.start_rate_rad_s
    seen, speeds = np.tile(np.eye(4), (runs, pairs, 1, 1)), np.zeros((runs, pairs, 6))
    for pair in range(pairs):
        shake = rng.normal(size=(runs, 3)) * settings.vibration_rad
        shift = rng.normal(size=(runs, 3)) * settings.vibration_m - np.cross(shake, t)
        seen[:, pair, :3, :3] = (Rotation.from_rotvec(-shake) * turn).as_matrix()
        seen[:, pair, :3, 3] = t + shift
        speeds[:, pair] = np.hstack([v, w])
        for _ in range(sub):
            camera = rng.normal(size=(runs, 3)) * np.sqrt(settings.camera_rad2_s3 * h)
            dv = rng.normal(size=(runs, 3)) * np.sqrt(settings.acceleration_m2_s3 * h) - np.cross(camera, t)
            dw = rng.normal(size=(runs, 3)) * np.sqrt(settings.swing_rad2_s3 * h) - camera
            t, v = t + h * (v + dv / 2), v + dv
            turn, w = Rotation.from_rotvec(h * (w + dw / 2)) * turn, w + dw
    return seen, speeds[..., :3], speeds[..., 3:]


def _error(state: FilterState, pose: RigidTransform, velocity: np.ndarray, rate: np.ndarray) -> np.ndarray:
    return np.concatenate(
        [pose_difference(state.left_from_drogue, pose), velocity - state.velocity_m_s, rate - state.rate_rad_s]
    )


def _within(values: list[float], degrees: int) -> None:
    """Their sum lies within the two-sided 99.9 % bounds: the seed is fixed, but a change of the code draws anew."""
    low, high = chi2.ppf([0.0005, 0.9995], degrees * len(values))
    assert low < sum(values) < high, f"mean {np.mean(values) / degrees:.3f} of 1"


@pytest.mark.parametrize("learns", [False, True])
def test_errors_and_innovations_match_their_covariances(
    rng: np.random.Generator, measure: Measure, covariance: np.ndarray, learns: bool
) -> None:
    settings = FilterSettings(long_term_excess=0, start_speed_m_s=0.5, noise_scale_variance_per_s=0.05 if learns else 0)
    runs, pairs = 20, 30
    seen, velocities, rates = _flown(rng, settings, runs, pairs)
    nees, nis = [], []
    for run in range(runs):
        fixes = PoseFilter(settings, 1)
        for pair in range(pairs):
            pose = RigidTransform.from_matrix(seen[run, pair])
            update = fixes.update(pair * PERIOD_S, measure(pose, covariance, rng))
            if update.nis is not None:
                nis.append(update.nis)
        assert update.state is not None
        error = _error(update.state, pose, velocities[run, -1], rates[run, -1])
        nees.append(float(error @ np.linalg.solve(update.state.covariance, error)))
    if learns:
        # The factor is learned from the fixes that it judges, so they are up to a few percent nearer than by chance.
        assert 0.9 < np.mean(nis) / 6 < 1.06 and 0.8 < np.mean(nees) / 12 < 1.3
    else:
        _within(nis, 6)
        _within(nees, 12)


@pytest.mark.parametrize("factor", [0.1, 8.0])
def test_the_process_noise_scale_adapts_to_rough_and_calm_air(
    rng: np.random.Generator, measure: Measure, covariance: np.ndarray, factor: float
) -> None:
    assumed = FilterSettings(long_term_excess=0, start_speed_m_s=0.5)
    flown = FilterSettings(
        acceleration_m2_s3=factor * assumed.acceleration_m2_s3,
        swing_rad2_s3=factor * assumed.swing_rad2_s3,
        camera_rad2_s3=factor * assumed.camera_rad2_s3,
        long_term_excess=0,
        start_speed_m_s=0.5,
    )
    seen, _, _ = _flown(rng, flown, 6, 80)
    means = []
    for settings in (
        assumed,
        FilterSettings(
            long_term_excess=0, start_speed_m_s=0.5, noise_scale_variance_per_s=0, gate_probability=1 - 1e-15
        ),
    ):
        nis = []
        for run in range(6):
            fixes, draws = PoseFilter(settings, 1), np.random.default_rng(run)
            for pair in range(80):
                estimate = measure(RigidTransform.from_matrix(seen[run, pair]), covariance, draws)
                update = fixes.update(pair * PERIOD_S, estimate)
                if pair >= 20 and update.nis is not None:
                    nis.append(update.nis / 6)
        means.append(np.mean(nis))
    learned, fixed = means
    # 360 chi-squares of six degrees have a mean of 1 within 0.03 (one deviation); what was not learned is far outside.
    assert abs(learned - 1) < 0.12
    assert abs(fixed - 1) > 2 * abs(learned - 1)


def test_constant_velocity_has_no_lag(measure: Measure, covariance: np.ndarray) -> None:
    velocity, rate = np.array([0.1, -0.2, -0.8]), np.array([0.05, 0.02, 0.1])
    fixes = PoseFilter(STEADY_AIR, 1)
    for index in range(200):
        time_s = index * PERIOD_S
        turn = Rotation.from_rotvec(rate * time_s).as_matrix()
        pose = RigidTransform(turn, np.array([0.5, 0.2, 10.0]) + velocity * time_s)
        state = fixes.update(time_s, measure(pose, covariance)).state
    assert state is not None
    # The wrong first velocity is forgotten by the filter's own gain, to far below a micrometre after 8 s.
    np.testing.assert_allclose(_error(state, pose, velocity, rate), 0, atol=1e-7)
