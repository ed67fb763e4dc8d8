"""Rigid transforms `a_from_b`, rotations, the drogue's attitude angles, constant-twist motion, and axes conventions.

Optical (OpenCV): x right, y down, z forward. FRD (aviation bodies): forward, right, down. FLU (bodies of ROS REP-103):
forward, left, up. ENU (the project's world): east, north, up. NED (aviation navigation): north, east, down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform as _ScipyRigidTransform
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# float64 products of a few rotations stay far within this; a typing error in a file does not.
_ORTHONORMAL_TOLERANCE = 1e-6
_MAX_COSINE = 2.0


def read_only(values: ArrayLike, shape: tuple[int, ...], name: str) -> Array:
    """A read-only float64 copy of `values`.

    Args:
        values: anything that numpy converts.
        shape: the shape it must have; -1 stands for any length.
        name: the field's name, for the error.

    Raises:
        ValueError: wrong shape, or a value that is no finite number.
    """
    try:
        array = np.array(values, dtype=np.float64)
    except TypeError as error:
        raise ValueError(f"{name}: must hold numbers only") from error
    if array.shape != shape and not _fits(array.shape, shape):
        raise ValueError(f"{name}: must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: must be finite, got {array.tolist()}")
    array.flags.writeable = False
    return array


def _fits(got: tuple[int, ...], wanted: tuple[int, ...]) -> bool:
    return len(got) == len(wanted) and all(want in (-1, have) for want, have in zip(wanted, got, strict=True))


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """`a_from_b`: takes coordinates in frame b to coordinates in frame a.

    Attributes:
        rotation: (3, 3) proper rotation.
        translation_m: (3,) origin of b in a. [m]
    """

    rotation: Array
    translation_m: Array

    def __post_init__(self) -> None:
        rotation = read_only(self.rotation, (3, 3), "rotation")
        if not _is_rotation(*rotation.tolist()):
            raise ValueError(f"rotation: must be orthonormal with determinant +1, got {rotation.tolist()}")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation_m", read_only(self.translation_m, (3,), "translation_m"))

    def __reduce__(self) -> tuple[type[RigidTransform], tuple[Array, Array]]:
        """Arrays would be writeable in a copy."""
        return type(self), (self.rotation, self.translation_m)

    @staticmethod
    def identity() -> RigidTransform:
        """The identity transform."""
        return RigidTransform(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> RigidTransform:
        """From a homogeneous (4, 4) matrix, row-major."""
        m = read_only(matrix, (4, 4), "matrix")
        if np.abs(m[3] - (0.0, 0.0, 0.0, 1.0)).max() > _ORTHONORMAL_TOLERANCE:
            raise ValueError(f"matrix: last row must be 0 0 0 1, got {m[3].tolist()}")
        return RigidTransform(m[:3, :3], m[:3, 3])

    def as_matrix(self) -> Array:
        """Homogeneous (4, 4) matrix."""
        m = np.eye(4)
        m[:3, :3] = self.rotation
        m[:3, 3] = self.translation_m
        return m

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        return RigidTransform(self.rotation @ other.rotation, self.rotation @ other.translation_m + self.translation_m)

    def inverse(self) -> RigidTransform:
        """`b_from_a`."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation_m)

    def apply(self, points: ArrayLike) -> Array:
        """Coordinates of (..., 3) points of b in a. [m]"""
        result: Array = self.rotate(points) + self.translation_m
        return result

    def rotate(self, vectors: ArrayLike) -> Array:
        """Components of (..., 3) directions of b in a."""
        # Not a BLAS product: its rounding would depend on how many rows and threads there are.
        result: Array = np.einsum("ij,...j->...i", self.rotation, np.asarray(vectors, dtype=np.float64))
        return result


def _is_rotation(first: list[float], second: list[float], third: list[float]) -> bool:
    """Whether three rows are orthonormal and right-handed: for nine numbers, numpy takes several times as long."""
    # Larger numbers are not cosines and could overflow in the products.
    if not max(map(abs, (*first, *second, *third))) < _MAX_COSINE:
        return False
    lengths = abs(_dot(first, first) - 1), abs(_dot(second, second) - 1), abs(_dot(third, third) - 1)
    slants = abs(_dot(first, second)), abs(_dot(first, third)), abs(_dot(second, third))
    if max(*lengths, *slants) > _ORTHONORMAL_TOLERANCE:
        return False
    (a, b, c), (d, e, f) = first, second
    return _dot([b * f - c * e, c * d - a * f, a * e - b * d], third) > 0


def _dot(one: list[float], other: list[float]) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def exp_twist(twist: ArrayLike) -> RigidTransform:
    """Exponential of a twist.

    Args:
        twist: (6,) translational part [m], then rotation vector [rad].

    Source: scipy.spatial.transform.RigidTransform (which orders rotation first).
    """
    t = read_only(twist, (6,), "twist")
    matrix = _ScipyRigidTransform.from_exp_coords(np.concatenate([t[3:], t[:3]])).as_matrix()
    return RigidTransform.from_matrix(matrix)


def log_twist(transform: RigidTransform) -> Array:
    """(6,) twist whose exponential is `transform`: translational part [m], then rotation vector [rad]."""
    coords = np.asarray(_ScipyRigidTransform.from_matrix(transform.as_matrix()).as_exp_coords())
    return np.concatenate([coords[3:], coords[:3]])


def rotation_from_angles(pitch_rad: float, yaw_rad: float, roll_rad: float) -> Array:
    """Attitude of the drogue in the camera, `R_y(yaw) R_x(pitch) R_z(roll)`.

    Positive pitch lifts the hose end, positive yaw turns the hose end to the right.

    Returns:
        (3, 3) rotation `camera_from_drogue`.

    Source: the seed paper's eq. 8 with its entry (1, 1) corrected.
    """
    matrix: Array = Rotation.from_euler("YXZ", [yaw_rad, pitch_rad, roll_rad]).as_matrix()
    return matrix


def angles_from_rotation(rotation: ArrayLike) -> tuple[float, float, float]:
    """(pitch, yaw, roll) in radians; the inverse of `rotation_from_angles` for |pitch| < 90 degrees."""
    r = np.asarray(rotation, dtype=np.float64)
    pitch, yaw = angles_from_axis(r[:, 2])
    roll = float(np.arctan2(r[1, 0], r[1, 1]))
    return float(pitch), float(yaw), roll


def angles_from_axis(axis: ArrayLike) -> tuple[Array, Array]:
    """Pitch and yaw of the drogue's axis.

    Args:
        axis: (..., 3) unit vectors in the camera frame, from the mouth to the hose.

    Returns:
        pitch (...), yaw (...). [rad]

    Source: the seed paper's eqs. 10 and 11 in arctangent form.
    """
    # On strided input, numpy's arctangent takes one of two code paths by memory address, and they differ in the last
    # bit; a copy is not strided.
    x, y, z = np.moveaxis(np.asarray(axis, dtype=np.float64), -1, 0).copy()
    return np.arctan2(-y, np.hypot(x, z)), np.arctan2(x, z)


def skew(vectors: ArrayLike) -> Array:
    """(..., 3, 3) cross-product matrices of (..., 3) vectors: `skew(a) @ b == cross(a, b)`."""
    v = np.asarray(vectors, dtype=np.float64)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


# Below this angle the series to third order is exact in float64.
_SMALL_RAD = 1e-4


def exp_rotation(vector_rad: Array) -> Array:
    """(3, 3) rotation of a (3,) rotation vector, by Rodrigues' formula. [rad]"""
    angle = math.hypot(*vector_rad.tolist())
    if angle < _SMALL_RAD:
        return _identity_and_cross(vector_rad, 1 - angle**2 / 6, 0.5 - angle**2 / 24)
    return _identity_and_cross(vector_rad, math.sin(angle) / angle, (1 - math.cos(angle)) / angle**2)


def log_rotation(rotation: Array) -> Array:
    """(3,) rotation vector of a (3, 3) rotation, which is not checked; at most pi long. [rad]"""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    x, y, z, cosine = (zy - yz) / 2, (xz - zx) / 2, (yx - xy) / 2, (xx + yy + zz - 1) / 2
    if cosine < 0:
        # Towards half a turn the sine vanishes, and with it what the closed form takes the axis from.
        vector: Array = Rotation.from_matrix(rotation, assume_valid=True).as_rotvec()
        return vector
    sine = math.hypot(x, y, z)
    stretch = math.atan2(sine, cosine) / sine if sine > 0 else 1.0
    return np.array([stretch * x, stretch * y, stretch * z])


def left_jacobian(vector_rad: Array) -> Array:
    """(3, 3) `J` with `exp([a + d]x) = exp([J d]x) exp([a]x)` for small d.

    Source: T. D. Barfoot, State Estimation for Robotics, 2017, eq. 7.77, doi:10.1017/9781316671528.
    """
    angle = math.hypot(*vector_rad.tolist())
    if angle < _SMALL_RAD:
        return _identity_and_cross(vector_rad, 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120)
    return _identity_and_cross(vector_rad, (1 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3)


def _identity_and_cross(vector: Array, first: float, second: float) -> Array:
    """(3, 3) `I + first [a]x + second [a]x [a]x` of a (3,) vector."""
    x, y, z = vector.tolist()
    xy, xz, yz = second * x * y, second * x * z, second * y * z
    xx, yy, zz = second * x * x, second * y * y, second * z * z
    x, y, z = first * x, first * y, first * z
    return np.array([[1 - yy - zz, xy - z, xz + y], [xy + z, 1 - xx - zz, yz - x], [xz - y, yz + x, 1 - xx - yy]])


FRD_FROM_OPTICAL = RigidTransform(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.zeros(3))
FLU_FROM_FRD = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
