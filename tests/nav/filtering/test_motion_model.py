"""The motion model against finite differences, geometry and a simulation in small steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geometry.se3 import RigidTransform, exp_rotation, exp_twist, left_jacobian, log_rotation
from nav.filtering.measurement_update import compute_innovation, initial_state, pose_difference
from nav.filtering.motion_model import (
    SIZE,
    FilterSettings,
    MotionState,
    apparent_pose_covariance,
    propagate,
    vibration_covariance,
)

# Central differences of smooth functions of order one: their own error is of the square of the step.
STEP = 1e-5
DERIVATIVE = 1e-8


def _state(rng: np.random.Generator) -> MotionState:
    velocity, rate, shift, vibration_turn = rng.normal(size=(4, 3)) * [[1.0], [0.7], [0.01], [0.02]]
    position, rotation = np.array([0.4, -0.3, 5.0]), Rotation.random(random_state=3).as_matrix()
    return MotionState(position, rotation, velocity, rate, shift, vibration_turn, np.eye(SIZE) * 1e-4)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-7, 0.99e-4, 1.01e-4, 0.3, 3.0])
def test_left_jacobian_is_the_derivative_of_the_exponential(angle_rad: float) -> None:
    vector = angle_rad * np.array([0.6, -0.48, 0.64])
    # Rounding of products of a few numbers of order one.
    np.testing.assert_allclose(exp_rotation(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)
    columns = []
    for axis in np.eye(3):
        ends = [exp_rotation(vector + sign * STEP * axis) for sign in (1, -1)]
        columns.append(log_rotation(ends[0] @ ends[1].T) / (2 * STEP))
    np.testing.assert_allclose(left_jacobian(vector), np.stack(columns, axis=1), atol=DERIVATIVE)


@pytest.mark.parametrize("turn_rad2_s3", [0.0, 1.0])
@pytest.mark.parametrize("duration_s", [0.0, 0.003, 0.04, 0.8])
def test_the_transition_is_the_derivative_of_the_step(
    rng: np.random.Generator, duration_s: float, turn_rad2_s3: float
) -> None:
    state, settings = _state(rng), FilterSettings()
    columns = []
    for axis in np.eye(SIZE):
        moved = [state.with_error(sign * STEP * axis, state.covariance) for sign in (1, -1)]
        ends = [propagate(each, duration_s, settings, 1.0, turn_rad2_s3).state for each in moved]
        columns.append(ends[1].error_to(ends[0]) / (2 * STEP))
    transition = propagate(state, duration_s, settings, 1.0, turn_rad2_s3).transition
    np.testing.assert_allclose(transition, np.stack(columns, axis=1), atol=DERIVATIVE)


def test_the_measurement_jacobian_is_the_derivative_of_the_apparent_pose(
    rng: np.random.Generator, covariance: np.ndarray
) -> None:
    state = _state(rng)
    columns = []
    for axis in np.eye(SIZE):
        ends = [state.with_error(sign * STEP * axis, state.covariance).pose for sign in (1, -1)]
        columns.append(pose_difference(ends[1], ends[0]) / (2 * STEP))
    jacobian = compute_innovation(state, state.pose, covariance).jacobian
    np.testing.assert_allclose(jacobian, np.stack(columns, axis=1), atol=DERIVATIVE)


def test_two_steps_are_one(rng: np.random.Generator) -> None:
    # The lever of the camera's turn changes with the place, so the drogue stands still for this.
    state = replace(_state(rng), velocity_m_s=np.zeros(3), rate_rad_s=np.zeros(3))
    settings = FilterSettings()
    once = propagate(state, 0.05, settings).state
    twice = propagate(propagate(state, 0.02, settings).state, 0.03, settings).state
    np.testing.assert_allclose(twice.covariance, once.covariance, rtol=1e-9, atol=1e-16)
    np.testing.assert_allclose(once.error_to(twice), 0, atol=1e-14)


def test_vibration_moves_the_drogue_as_geometry_says() -> None:
    pose = RigidTransform(Rotation.random(random_state=1).as_matrix(), np.array([2.0, -1.0, 10.0]))
    settings = FilterSettings(vibration_m=0.003, vibration_rad=0.002)
    step, columns = 1e-6, []
    for axis in np.eye(6):
        vibrated = [exp_twist(sign * step * axis).inverse() @ pose for sign in (1, -1)]
        columns.append(pose_difference(vibrated[1], vibrated[0]) / (2 * step))
    jacobian = np.stack(columns, axis=1)
    expected = jacobian @ np.diag(np.repeat([0.003**2, 0.002**2], 3)) @ jacobian.T
    np.testing.assert_allclose(vibration_covariance(pose.translation_m, settings), expected, rtol=1e-6, atol=1e-12)


def test_the_noise_is_that_of_accelerations_in_small_steps(rng: np.random.Generator) -> None:
    settings = FilterSettings(acceleration_m2_s3=0.2, swing_rad2_s3=0.05, camera_rad2_s3=0.02)
    position, duration_s, steps, runs = np.array([1.0, -0.5, 4.0]), 0.1, 50, 20000
    zero = np.zeros(3)
    start = MotionState(position, np.eye(3), zero, zero, zero, zero, np.zeros((SIZE, SIZE)))
    expected = propagate(start, duration_s, settings).noise[:12, :12]
    gone, speed, h = np.zeros((runs, 6)), np.zeros((runs, 6)), duration_s / steps
    for _ in range(steps):
        own = rng.normal(size=(runs, 6)) * np.sqrt(np.repeat([0.2, 0.05], 3) * h)
        camera = rng.normal(size=(runs, 3)) * np.sqrt(0.02 * h)
        kick = own + np.hstack([-np.cross(camera, position), -camera])
        gone += h * (speed + kick / 2)
        speed += kick
    drawn = np.cov(np.hstack([gone, speed]).T)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    # A sample correlation of 20000 draws has a deviation of at most 0.01 (variances), and 78 are compared.
    np.testing.assert_allclose(drawn / scale, expected / scale, atol=0.045)


def test_a_static_point_moves_on_a_circle_about_a_turning_camera(rng: np.random.Generator) -> None:
    rate, duration_s = np.array([0.1, -0.8, 0.2]), 0.04
    position = np.array([1.0, -0.5, 8.0])
    state = replace(_state(rng), translation_m=position, velocity_m_s=np.cross(rate, position), rate_rad_s=rate)
    turn = Rotation.from_rotvec(rate * duration_s).as_matrix()
    seen = propagate(state, duration_s, FilterSettings(), 1.0, 0.5).state
    np.testing.assert_allclose(seen.rotation, turn @ state.rotation, atol=1e-12)
    np.testing.assert_allclose(seen.velocity_m_s, turn @ state.velocity_m_s, atol=1e-12)
    # The place is to second order: the third is (0.83 x 0.04)^3 / 6 of 8 m.
    np.testing.assert_allclose(seen.translation_m, turn @ position, atol=6e-5)


def test_a_turn_adds_camera_noise_that_does_not_scale_with_the_air(rng: np.random.Generator) -> None:
    state = replace(_state(rng), rate_rad_s=np.zeros(3))
    calm, rough = propagate(state, 0.04, FilterSettings()), propagate(state, 0.04, FilterSettings(), 3.0)
    turned = propagate(state, 0.04, FilterSettings(), 1.0, 0.5)
    as_camera = propagate(state, 0.04, FilterSettings(camera_rad2_s3=FilterSettings().camera_rad2_s3 + 0.5))
    np.testing.assert_allclose(turned.noise, as_camera.noise, rtol=1e-12)
    np.testing.assert_allclose(turned.air_noise, calm.air_noise, rtol=1e-12)
    np.testing.assert_allclose(rough.air_noise, 3 * calm.air_noise, rtol=1e-12)
    np.testing.assert_allclose(rough.noise - calm.noise, 2 * calm.air_noise, atol=1e-18)


def test_the_initial_covariance_allows_for_a_turning_camera(covariance: np.ndarray) -> None:
    position, turn = np.array([0.2, 0.1, 6.0]), np.array([0.3, -0.5, 0.2])
    settings = FilterSettings(start_speed_m_s=1e-6, start_rate_rad_s=1e-6, start_turn_rad_s=0.7)
    speeds = initial_state(RigidTransform(np.eye(3), position), covariance, settings).reported_covariance[6:, 6:]
    # What the turn makes of velocity and rate is as likely as the turn itself.
    seen = np.concatenate([-np.cross(turn, position), -turn])
    assert seen @ np.linalg.solve(speeds, seen) == pytest.approx(turn @ turn / 0.7**2, rel=1e-6)


def test_the_initial_pose_covariance_is_that_of_the_measurement(covariance: np.ndarray) -> None:
    pose = RigidTransform(Rotation.random(random_state=2).as_matrix(), np.array([0.2, 0.1, 6.0]))
    state = initial_state(pose, covariance, FilterSettings())
    np.testing.assert_allclose(state.reported_covariance[:6, :6], covariance, atol=1e-15)
    np.linalg.cholesky(state.covariance)


def test_a_turn_of_the_camera_shifts_and_turns_what_it_sees() -> None:
    at_m, variances = np.array([0.4, -0.3, 5.0]), (0.01, 0.002, 0.03)
    turns = np.eye(3)
    by_turn = np.vstack([-np.cross(turns, at_m).T, -turns])
    own = np.diag(np.repeat(variances[:2], 3))
    # Rounding of a few products of numbers of order one.
    np.testing.assert_allclose(
        apparent_pose_covariance(at_m, *variances), own + variances[2] * by_turn @ by_turn.T, rtol=1e-14, atol=1e-16
    )
