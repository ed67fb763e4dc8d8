"""Rigid transforms `a_from_b`, rotations, the drogue's attitude angles, constant-twist motion, and axes conventions.

Optical (OpenCV): x right, y down, z forward. FRD (aviation bodies): forward, right, down. FLU (bodies of ROS REP-103):
forward, left, up. ENU (the project's world): east, north, up. NED (aviation navigation): north, east, down.
"""

from __future__ import annotations

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
    if array.ndim != len(shape) or any(want not in (-1, got) for want, got in zip(shape, array.shape, strict=True)):
        raise ValueError(f"{name}: must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: must be finite, got {array.tolist()}")
    array.flags.writeable = False
    return array


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
        # Larger numbers are not cosines and could overflow in the product.
        fits = np.abs(rotation).max() < _MAX_COSINE
        fits = fits and np.abs(rotation @ rotation.T - np.eye(3)).max() <= _ORTHONORMAL_TOLERANCE
        if not fits or np.linalg.det(rotation) < 0:
            raise ValueError(f"rotation: must be orthonormal with determinant +1, got {rotation.tolist()}")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation_m", read_only(self.translation_m, (3,), "translation_m"))

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
    """(3, 3) rotation of a (3,) rotation vector, `I + [a]x J(a)` with the left Jacobian. [rad]"""
    matrix: Array = np.eye(3) + skew(vector_rad) @ left_jacobian(vector_rad)
    return matrix


def log_rotation(rotation: Array) -> Array:
    """(3,) rotation vector of a (3, 3) rotation, at most pi long. [rad]"""
    vector: Array = Rotation.from_matrix(rotation).as_rotvec()
    return vector


def left_jacobian(vector_rad: Array) -> Array:
    """(3, 3) `J` with `exp([a + d]x) = exp([J d]x) exp([a]x)` for small d.

    Source: T. D. Barfoot, State Estimation for Robotics, 2017, eq. 7.77, doi:10.1017/9781316671528.
    """
    angle = float(np.linalg.norm(vector_rad))
    cross = skew(vector_rad)
    if angle < _SMALL_RAD:
        first, second = 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    else:
        first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    jacobian: Array = np.eye(3) + first * cross + second * cross @ cross
    return jacobian


FRD_FROM_OPTICAL = RigidTransform(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.zeros(3))
FLU_FROM_FRD = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
NED_FROM_ENU = RigidTransform(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.zeros(3))
