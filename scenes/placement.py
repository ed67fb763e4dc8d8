"""Places and attitudes of things around a drogue."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from geometry.stereo import StereoRig


def sample_point_in_view(rng: np.random.Generator, rig: StereoRig, depth_m: float) -> Array:
    """(3,) a point in view of the left eye, or just outside. [m]"""
    camera = rig.camera
    u, v = rng.uniform(-0.05, 1.05, 2) * (camera.width_px, camera.height_px)
    return np.array([(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, 1.0]) * depth_m


def rotation_with_z(direction: Array) -> Array:
    """A rotation whose third column is a (3,) unit vector."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    x = np.cross(helper, direction)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(direction, x), direction], axis=-1)


def rotation_with_z_and_up(direction: Array, up: Array) -> Array:
    """A rotation whose third column is a (3,) unit vector and whose second is as near to a (3,) `up` as can be."""
    across = np.cross(up, direction)
    if np.linalg.norm(across) < 1e-6:
        return rotation_with_z(direction)
    x = across / np.linalg.norm(across)
    return np.stack([x, np.cross(direction, x), direction], axis=-1)
