"""Rotations near each other: exponential, logarithm and the left Jacobian between them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geometry.se3 import Array, skew

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
