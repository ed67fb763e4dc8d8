from __future__ import annotations

import pickle
from collections.abc import Callable
from copy import deepcopy

import numpy as np
import pytest
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from geometry.se3 import (
    RigidTransform,
    angles_from_axis,
    angles_from_rotation,
    exp_rotation,
    exp_twist,
    left_jacobian,
    log_rotation,
    log_twist,
    rotation_from_angles,
    skew,
)

# Coordinates are of order 1, and every compared product is a handful of 3x3 multiplications in float64.
ROUNDING = 1e-13
# From far below the square root of the float64 epsilon, over the range where series take over, to nearly half a turn.
ANGLES_RAD = (0.0, 1e-12, 1e-8, 1e-7, 1e-4, 1e-2, 1.0, 3.0, np.pi - 1e-3)


def sample_twist(rng: Generator, angle_rad: float) -> np.ndarray:
    axis = rng.normal(size=3)
    return np.concatenate([rng.normal(size=3), axis / np.linalg.norm(axis) * angle_rad])


def transforms() -> list[RigidTransform]:
    rng = np.random.default_rng(7)
    return [exp_twist(sample_twist(rng, angle)) for angle in ANGLES_RAD for _ in range(4)]


def assert_same(a: RigidTransform, b: RigidTransform, tolerance: float = ROUNDING) -> None:
    np.testing.assert_allclose(a.as_matrix(), b.as_matrix(), rtol=0, atol=tolerance)


def test_identity_is_neutral() -> None:
    for a in transforms():
        assert_same(a @ RigidTransform.identity(), a, 0)
        assert_same(RigidTransform.identity() @ a, a, 0)


@pytest.mark.parametrize("copy", [deepcopy, lambda value: pickle.loads(pickle.dumps(value))])
def test_copies_are_as_frozen_as_their_originals(copy: Callable[[RigidTransform], RigidTransform]) -> None:
    for a in transforms():
        again = copy(a)
        assert_same(again, a, 0)
        assert not again.rotation.flags.writeable and not again.translation_m.flags.writeable


def test_inverse_undoes_from_both_sides() -> None:
    for a in transforms():
        assert_same(a @ a.inverse(), RigidTransform.identity())
        assert_same(a.inverse() @ a, RigidTransform.identity())


def test_composition_is_associative_and_acts_on_points() -> None:
    rng = np.random.default_rng(8)
    points = rng.normal(size=(5, 3))
    samples = transforms()
    for a, b, c in zip(samples, samples[5:], samples[11:], strict=False):
        assert_same((a @ b) @ c, a @ (b @ c))
        np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), rtol=0, atol=ROUNDING)
        np.testing.assert_allclose(a.rotate(points), a.apply(points) - a.translation_m, rtol=0, atol=ROUNDING)


def test_matrix_round_trip() -> None:
    for a in transforms():
        assert_same(RigidTransform.from_matrix(a.as_matrix()), a, 0)
        np.testing.assert_allclose(a.as_matrix() @ a.inverse().as_matrix(), np.eye(4), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_log_is_the_inverse_of_exp(angle_rad: float) -> None:
    rng = np.random.default_rng(9)
    for _ in range(20):
        twist = sample_twist(rng, angle_rad)
        # Near half a turn the logarithm is ill-conditioned by 1 / (pi - angle), here 1e3.
        np.testing.assert_allclose(log_twist(exp_twist(twist)), twist, rtol=0, atol=1e-11)


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_rotations_of_vectors_are_those_of_scipy(angle_rad: float) -> None:
    rng = np.random.default_rng(12)
    for _ in range(20):
        vector = sample_twist(rng, angle_rad)[3:]
        rotation = exp_rotation(vector)
        np.testing.assert_allclose(rotation, Rotation.from_rotvec(vector).as_matrix(), rtol=0, atol=ROUNDING)
        np.testing.assert_allclose(log_rotation(rotation), vector, rtol=0, atol=1e-11)


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_the_left_jacobian_is_the_derivative_of_the_rotation(angle_rad: float) -> None:
    rng = np.random.default_rng(13)
    step_rad = 1e-5
    for _ in range(20):
        vector, along = sample_twist(rng, angle_rad)[3:], rng.normal(size=3)
        ends = (Rotation.from_rotvec(vector + sign * step_rad * along) for sign in (1, -1))
        ahead, behind = (end * Rotation.from_rotvec(vector).inv() for end in ends)
        slope = (ahead.as_rotvec() - behind.as_rotvec()) / (2 * step_rad)
        # Central differences err by the third derivative, of order one, times the square of the step, and by rounding.
        np.testing.assert_allclose(left_jacobian(vector) @ along, slope, rtol=0, atol=1e-8)


def test_exp_follows_the_twist_to_second_order() -> None:
    rng = np.random.default_rng(10)
    twist = sample_twist(rng, 1.0)
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = skew(twist[3:]), twist[:3]
    steps = np.array([1e-1, 1e-2, 1e-3])
    errors = [np.abs(exp_twist(step * twist).as_matrix() - np.eye(4) - step * generator).max() for step in steps]
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    # The remainder is step^2/2 G^2; its next order bends the slope by a few thousandths at a step of 0.1.
    assert slope == pytest.approx(2.0, abs=0.02)


def test_half_a_motion_twice_is_the_motion() -> None:
    rng = np.random.default_rng(11)
    for angle in ANGLES_RAD:
        twist = sample_twist(rng, angle)
        assert_same(exp_twist(twist / 2) @ exp_twist(twist / 2), exp_twist(twist))


def test_rotation_of_the_specification() -> None:
    rotation = rotation_from_angles(0.1, 0.2, 0.3)
    assert rotation[0, 0] == pytest.approx(0.9421547, abs=5e-8)  # printed to seven digits
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-15)


def test_rotation_is_yaw_after_pitch_after_roll() -> None:
    def about(axis: int, angle: float) -> np.ndarray:
        c, s = np.cos(angle), np.sin(angle)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        matrix = np.eye(3)
        matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
        return matrix

    rng = np.random.default_rng(12)
    for pitch, yaw, roll in rng.uniform(-1.5, 1.5, size=(20, 3)):
        expected = about(1, yaw) @ about(0, pitch) @ about(2, roll)
        np.testing.assert_allclose(rotation_from_angles(pitch, yaw, roll), expected, rtol=0, atol=1e-15)


def test_angles_round_trip() -> None:
    rng = np.random.default_rng(13)
    for angles in rng.uniform([-1.5, -3.1, -3.1], [1.5, 3.1, 3.1], size=(200, 3)):
        # Pitch within 0.07 of the pole costs a factor of 14.
        np.testing.assert_allclose(angles_from_rotation(rotation_from_angles(*angles)), angles, rtol=0, atol=1e-14)


def test_signs_of_the_angles() -> None:
    hose_end_m = np.array([0.0, 0.0, 1.0])
    assert (rotation_from_angles(0.1, 0.0, 0.0) @ hose_end_m)[1] < 0, "positive pitch lifts the hose end (y is down)"
    assert (rotation_from_angles(0.0, 0.1, 0.0) @ hose_end_m)[0] > 0, "positive yaw turns the hose end right"
    first_marker = rotation_from_angles(0.0, 0.0, 0.1) @ [1.0, 0.0, 0.0]
    assert first_marker[1] > 0, "positive roll turns from x towards y"


def test_angles_of_many_axes() -> None:
    rng = np.random.default_rng(14)
    angles = rng.uniform(-1.4, 1.4, size=(4, 5, 2))
    axes = np.array([[rotation_from_angles(p, y, 0.7)[:, 2] for p, y in row] for row in angles])
    pitch, yaw = angles_from_axis(axes)
    np.testing.assert_allclose(np.stack([pitch, yaw], axis=-1), angles, rtol=0, atol=1e-14)


def test_skew_is_the_cross_product() -> None:
    rng = np.random.default_rng(15)
    a, b = rng.normal(size=(2, 3, 4, 3))
    np.testing.assert_allclose((skew(a) @ b[..., None])[..., 0], np.cross(a, b), rtol=0, atol=1e-15)


def test_arrays_are_copies_and_read_only() -> None:
    translation = np.zeros(3)
    a = RigidTransform(np.eye(3), translation)
    translation[0] = 1.0
    assert a.translation_m[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        a.rotation[0, 0] = 2.0


@pytest.mark.parametrize(
    ("rotation", "translation", "message"),
    [
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3), "rotation: must be orthonormal"),
        (np.eye(3) * 1.01, np.zeros(3), "rotation: must be orthonormal"),
        (np.array([[1, 2e-6, 0], [0, 1, 0], [0, 0, 1]]), np.zeros(3), "rotation: must be orthonormal"),
        (np.full((3, 3), 1e200), np.zeros(3), "rotation: must be orthonormal"),
        (np.zeros((3, 3)), np.zeros(3), "rotation: must be orthonormal"),
        (np.eye(2), np.zeros(3), "rotation: must have shape"),
        (np.eye(3), np.zeros(2), "translation_m: must have shape"),
        (np.eye(3), [0.0, np.nan, 0.0], "translation_m: must be finite"),
    ],
)
def test_wrong_transforms_are_refused(rotation: np.ndarray, translation: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RigidTransform(rotation, translation)


def test_wrong_last_row_is_refused() -> None:
    matrix = np.eye(4)
    matrix[3, 0] = 0.1
    with pytest.raises(ValueError, match="matrix: last row"):
        RigidTransform.from_matrix(matrix)


@pytest.mark.parametrize("value", [{"left": 1}, [[{}] * 4] * 4])
def test_what_is_no_number_is_a_value_error(value: object) -> None:
    """As it stands in a file that somebody edited; pydantic reports a ValueError alone."""
    with pytest.raises(ValueError, match="matrix: must hold numbers only"):
        RigidTransform.from_matrix(value)  # type: ignore[arg-type]
