"""The two attitudes that a flat pattern far away allows: tilted one way, or the other."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.pose.features import Features

# Keeps the fit of markers on a line solvable; no share of any that are not.
_RIDGE_FRACTION = 1e-12


def two_fold_start(features: Features) -> tuple[Array, Array]:
    """Both weak-perspective poses of the ring's markers that every eye measured.

    The affine map from the rim plane to the image, averaged over the eyes, is scale times the first two columns of the
    attitude without their third components, whose common sign it leaves open.

    Args:
        features: B frames with at least three markers that all eyes measured, not on a line.

    Returns:
        rotations (B, 2, 3, 3) `left_from_drogue`, translations (B, 2, 3). [m]
    """
    camera = features.camera
    linear_px, center_px = _affine(features)
    # Rays with z = 1: the affine map in units of the focal length.
    linear = linear_px / np.array([camera.fx_px, camera.fy_px])[:, None]
    direction = camera.rays(center_px)
    scale = _largest_stretches(linear)
    # Markers in one point have no scale; any will do, the adjustment's cost then tells.
    scale = np.maximum(scale, np.finfo(np.float64).tiny ** 0.5)
    translation = direction / scale[:, None]
    translation[:, 0] += features.eye_x_m.mean()

    both = np.empty((len(scale), 2, 3, 2))
    both[:, :, :2] = (linear / scale[:, None, None])[:, None]
    flat = both[:, 0, :2]
    third = np.sqrt(np.maximum(0.0, 1 - (flat**2).sum(axis=1)))
    third[:, 1] = -np.copysign(third[:, 1], flat[:, 0, 0] * flat[:, 0, 1] + flat[:, 1, 0] * flat[:, 1, 1])
    both[:, 0, 2], both[:, 1, 2] = third, -third
    rotations = sight_rotations(direction)[:, None] @ _orthonormal(both)
    return rotations, np.repeat(translation[:, None], 2, axis=1)


def sight_rotations(directions: Array) -> Array:
    """(B, 3, 3) smallest rotations that carry the optical axis onto (B, 3) directions with positive z."""
    sight = directions / np.sqrt((directions**2).sum(axis=1, keepdims=True))
    x, y, z = sight.T
    rotations = np.empty((len(sight), 3, 3))
    rotations[:, :, 2] = sight
    rotations[:, 2, 0], rotations[:, 2, 1] = -x, -y
    rotations[:, 0, 0], rotations[:, 1, 1] = 1 - x * x / (1 + z), 1 - y * y / (1 + z)
    rotations[:, 0, 1] = rotations[:, 1, 0] = -x * y / (1 + z)
    return rotations


def _affine(features: Features) -> tuple[Array, Array]:
    """(B, 2, 2) linear parts and (B, 2) images of the drogue's origin, of the maps from rim plane to mean image."""
    paired = (features.seen.all(axis=1) & features.is_marker).astype(np.float64)
    cyclopean = features.measured[:2].mean(axis=2).transpose(1, 2, 0)
    total = np.maximum(paired.sum(axis=1), 1)[:, None]
    places = features.points_m[:, :2]
    mean_place = paired @ places / total
    mean_px = (paired[..., None] * cyclopean).sum(axis=1) / total
    centred = (places - mean_place[:, None]) * paired[..., None]
    normal = centred.transpose(0, 2, 1) @ centred
    ridge = _RIDGE_FRACTION * (normal[:, 0, 0] + normal[:, 1, 1]) + np.finfo(np.float64).tiny
    normal += ridge[:, None, None] * np.eye(2)
    moments = centred.transpose(0, 2, 1) @ (cyclopean - mean_px[:, None])
    linear = np.linalg.solve(normal, moments).transpose(0, 2, 1)
    return linear, mean_px - (linear @ mean_place[..., None])[..., 0]


def _orthonormal(columns: Array) -> Array:
    """(..., 3, 3) rotations whose first two columns are nearest to two nearly orthonormal ones (..., 3, 2)."""
    rotations = np.empty((*columns.shape[:-1], 3))
    u, _, vt = np.linalg.svd(columns, full_matrices=False)
    np.matmul(u, vt, out=rotations[..., :2])
    rotations[..., 2] = cross(rotations[..., 0], rotations[..., 1])
    return rotations


def cross(first: Array, second: Array) -> Array:
    """(..., 3) cross products; numpy's function takes several times as long for a few."""
    ax, ay, az, bx, by, bz = (vectors[..., axis] for vectors in (first, second) for axis in range(3))
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def _largest_stretches(linear: Array) -> Array:
    """(B,) largest singular values of (B, 2, 2) maps."""
    (a, b), (c, d) = linear.transpose(1, 2, 0)
    stretches: Array = (np.hypot(a + d, b - c) + np.hypot(a - d, b + c)) / 2
    return stretches
