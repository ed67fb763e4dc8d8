"""Errors of many poses against the truth, over the Cramer-Rao bound and over their own covariances."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array, angles_from_axis, skew
from geometry.stereo import StereoRig
from studies.acceptance.centroid_level.drawn_poses import Poses, ellipse_centers_px

# Central differences: their error goes with the square of the step, that of rounding with its inverse; both stay near
# 1e-8 of the derivative for steps of this size. [m and rad]
_STEP = 1e-5


def pose_errors(estimates: Poses, truth: Poses) -> Array:
    """(n, 5) X, Y, Z [m], pitch and yaw [deg], estimate minus truth."""
    found, true = (np.stack(angles_from_axis(poses.rotations[:, :, 2]), axis=-1) for poses in (estimates, truth))
    turns = np.rad2deg((found - true + np.pi) % (2 * np.pi) - np.pi)
    return np.concatenate([estimates.translations_m - truth.translations_m, turns], axis=1)


def component_slopes(rotations: Array) -> Array:
    """(n, 5, 6) derivatives of X, Y, Z [m], pitch and yaw [deg] by the tangent of estimates."""
    axes = rotations[:, :, 2]
    x, y, z = axes.T
    across2 = x**2 + z**2
    across = np.sqrt(across2)
    by_axis = np.zeros((len(axes), 2, 3))
    by_axis[:, 0] = np.stack([x * y / across, -across, z * y / across], axis=-1)
    by_axis[:, 1] = np.stack([z, np.zeros_like(z), -x], axis=-1) / across2[:, None]
    slopes = np.zeros((len(axes), 5, 6))
    slopes[:, :3, :3] = np.eye(3)
    slopes[:, 3:, 3:] = np.rad2deg(-by_axis @ skew(axes))
    return slopes


def bound_deviations(rig: StereoRig, truth: Poses, centers_m: Array, radii_m: Array, noise_px: Array) -> Array:
    """Cramer-Rao bound of many poses whose features both eyes see.

    Args:
        rig: the cameras.
        truth: n poses.
        centers_m, radii_m: (F, 3) and (F,) of the features.
        noise_px: (F,) standard deviation of each coordinate of a centre.

    Returns:
        (n, 5) standard deviations of X, Y, Z [m], pitch and yaw [deg].
    """
    count = len(truth.rotations)
    slopes = np.empty((count, 2, len(radii_m), 2, 6))
    for k in range(6):
        ends = []
        for sign in (1, -1):
            step = np.zeros(6)
            step[k] = sign * _STEP
            turned = (np.eye(3) + skew(step[3:]) + skew(step[3:]) @ skew(step[3:]) / 2) @ truth.rotations
            ends.append(ellipse_centers_px(rig, Poses(turned, truth.translations_m + step[:3]), centers_m, radii_m))
        slopes[..., k] = (ends[0] - ends[1]) / (2 * _STEP)
    rows = (slopes / noise_px[:, None, None]).reshape(count, -1, 6)
    covariance = np.linalg.inv(np.swapaxes(rows, 1, 2) @ rows)
    components = component_slopes(truth.rotations)
    scored = components @ covariance @ np.swapaxes(components, 1, 2)
    deviations: Array = np.sqrt(np.diagonal(scored, axis1=1, axis2=2))
    return deviations


def squared_errors(estimates: Poses, covariances: Array, errors: Array) -> Array:
    """(n,) normalised squares of the five errors, of mean 5 where covariances (n, 6, 6) tell the truth."""
    slopes = component_slopes(estimates.rotations)
    covariance = slopes @ covariances @ np.swapaxes(slopes, 1, 2)
    squares: Array = np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors[..., None])[..., 0])
    return squares


def sight_tilts(rig: StereoRig, poses: Poses, truth: Poses) -> Array:
    """(n, 2) tilt of the poses' axes about the line of sight to the true place, between the eyes. [rad]"""
    sight = truth.translations_m - np.array([rig.baseline_m / 2, 0.0, 0.0])
    sight = sight / np.linalg.norm(sight, axis=1, keepdims=True)
    across = np.cross(np.broadcast_to([0.0, 1.0, 0.0], sight.shape), sight)
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(sight, across)
    axis = poses.rotations[:, :, 2]
    parts = np.stack([np.einsum("ni,ni->n", axis, across), np.einsum("ni,ni->n", axis, up)], axis=-1)
    size = np.linalg.norm(parts, axis=1)
    angle = np.arctan2(size, np.einsum("ni,ni->n", axis, sight))
    tilts: Array = parts * (angle / np.maximum(size, np.finfo(np.float64).tiny))[:, None]
    return tilts


def flipped(tilts: Array, true_tilts: Array) -> NDArray[np.bool_]:
    """(n,) whether the tilt points away from the true one."""
    mirrored: NDArray[np.bool_] = np.einsum("ni,ni->n", tilts, true_tilts) < 0
    return mirrored
