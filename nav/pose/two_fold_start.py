"""The two attitudes that a flat pattern far away allows: tilted one way, or the other."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.pose.interface import Observation


def two_fold_start(observation: Observation) -> tuple[Array, Array]:
    """Both weak-perspective poses of the markers that both eyes measured.

    The affine map from the rim plane to the image, averaged over the eyes, is scale times the first two columns of the
    attitude without their third components, whose common sign it leaves open.

    Args:
        observation: at least three pairs of markers, not on a line.

    Returns:
        rotations (2, 3, 3) `left_from_drogue`, translations (2, 3). [m]
    """
    rig, paired = observation.rig, observation.paired
    places = np.column_stack([observation.layout.centers_m[paired, :2], np.ones(int(paired.sum()))])
    cyclopean_px = observation.pixels_px[:, paired].mean(axis=0)
    affine = np.linalg.lstsq(places, cyclopean_px, rcond=None)[0].T
    # Rays with z = 1: the affine map in units of the focal length.
    focal = np.array([rig.camera.fx_px, rig.camera.fy_px])
    linear = affine[:, :2] / focal[:, None]
    scale = np.linalg.svd(linear, compute_uv=False)[0]
    direction = rig.camera.rays(affine[:, 2])
    translation = direction / scale + np.array([rig.baseline_m / 2, 0.0, 0.0])
    sight = _rotation_onto(direction / np.linalg.norm(direction))

    x_axis, y_axis = (linear / scale).T
    third_x = np.sqrt(max(0.0, 1 - x_axis @ x_axis))
    third_y = -np.copysign(np.sqrt(max(0.0, 1 - y_axis @ y_axis)), x_axis @ y_axis)
    rotations = [
        sight @ _orthonormal(np.append(x_axis, sign * third_x), np.append(y_axis, sign * third_y))
        for sign in (1.0, -1.0)
    ]
    return np.stack(rotations), np.stack([translation, translation])


def _orthonormal(x_axis: Array, y_axis: Array) -> Array:
    """The rotation whose first two columns are nearest to two nearly orthonormal vectors."""
    u, _, vt = np.linalg.svd(np.column_stack([x_axis, y_axis]), full_matrices=False)
    nearest = u @ vt
    return np.column_stack([nearest, np.cross(nearest[:, 0], nearest[:, 1])])


def _rotation_onto(direction: Array) -> Array:
    """Smallest rotation that carries the optical axis onto a unit vector with positive z."""
    x, y, z = direction
    return np.array(
        [
            [1 - x * x / (1 + z), -x * y / (1 + z), x],
            [-x * y / (1 + z), 1 - y * y / (1 + z), y],
            [-x, -y, z],
        ]
    )
