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
    scale = np.linalg.svd(linear, compute_uv=False)[:, 0]
    # Markers in one point have no scale; any will do, the adjustment's cost then tells.
    scale = np.maximum(scale, np.finfo(np.float64).tiny ** 0.5)
    translation = direction / scale[:, None]
    translation[:, 0] += features.eye_x_m.mean()

    columns = linear / scale[:, None, None]
    x_axis, y_axis = columns[..., 0], columns[..., 1]
    product = (x_axis * y_axis).sum(axis=1)
    third_x = np.sqrt(np.maximum(0.0, 1 - (x_axis**2).sum(axis=1)))
    third_y = -np.copysign(np.sqrt(np.maximum(0.0, 1 - (y_axis**2).sum(axis=1))), product)
    third = np.stack([third_x, third_y], axis=-1)
    both = np.stack([third, -third], axis=1)
    flat = np.broadcast_to(columns[:, None], (len(scale), 2, 2, 2))
    rotations = sight_rotations(direction)[:, None] @ _orthonormal(np.concatenate([flat, both[:, :, None]], axis=2))
    return rotations, np.repeat(translation[:, None], 2, axis=1)


def sight_rotations(directions: Array) -> Array:
    """(B, 3, 3) smallest rotations that carry the optical axis onto (B, 3) directions with positive z."""
    x, y, z = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).T
    rows = [[1 - x * x / (1 + z), -x * y / (1 + z), x], [-x * y / (1 + z), 1 - y * y / (1 + z), y], [-x, -y, z]]
    return np.moveaxis(np.array(rows), 2, 0)


def _affine(features: Features) -> tuple[Array, Array]:
    """(B, 2, 2) linear parts and (B, 2) images of the drogue's origin, of the maps from rim plane to mean image."""
    paired = (features.seen.all(axis=1) & features.is_marker).astype(np.float64)
    cyclopean = np.moveaxis(features.measured[:2].mean(axis=2), 0, -1)
    total = np.maximum(paired.sum(axis=1), 1)[:, None]
    places = features.points_m[:, :2]
    mean_place = paired @ places / total
    mean_px = (paired[..., None] * cyclopean).sum(axis=1) / total
    centred = (places - mean_place[:, None]) * paired[..., None]
    normal = np.swapaxes(centred, 1, 2) @ centred
    ridge = _RIDGE_FRACTION * np.trace(normal, axis1=1, axis2=2) + np.finfo(np.float64).tiny
    normal += ridge[:, None, None] * np.eye(2)
    moments = np.swapaxes(centred, 1, 2) @ (cyclopean - mean_px[:, None])
    linear = np.swapaxes(np.linalg.solve(normal, moments), 1, 2)
    return linear, mean_px - (linear @ mean_place[..., None])[..., 0]


def _orthonormal(columns: Array) -> Array:
    """(..., 3, 3) rotations whose first two columns are nearest to two nearly orthonormal ones (..., 3, 2)."""
    u, _, vt = np.linalg.svd(columns, full_matrices=False)
    nearest = u @ vt
    third = np.cross(nearest[..., 0], nearest[..., 1])
    return np.concatenate([nearest, third[..., None]], axis=-1)
