"""The Cramer-Rao bound: the smallest error that any unbiased estimator can have with centroids of a given noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array, RigidTransform, skew
from geometry.stereo import EYES, Eye, StereoRig

# Three points fix six unknowns; fewer leave a pose open.
_FEWEST_FEATURES = 3

# Of the information matrix with unit diagonal. One eye's view of a ring at 1000 m is at 1e9; beyond this, what is left
# of float64's 16 digits no longer tells an open pose from a determined one.
_LARGEST_CONDITION = 1e12


def feature_points(layout: MarkerLayout) -> tuple[Array, Array]:
    """Centres and radii of a drogue's features: the markers, then the hub's outer edge.

    Returns:
        (M, 3) centres in the drogue frame, (M,) radii. [m]
    """
    radii = np.full(layout.count, layout.radius_m)
    if layout.hub_center_m is None:
        return layout.centers_m, radii
    return np.vstack([layout.centers_m, layout.hub_center_m]), np.append(radii, layout.hub_outer_radius_m)


def center_jacobian(rig: StereoRig, left_from_drogue: RigidTransform, layout: MarkerLayout, eye: Eye) -> Array:
    """Derivative of the features' ellipse centres with respect to the pose.

    Args:
        rig: the cameras.
        left_from_drogue: pose of the drogue.
        layout: its features.
        eye: which image.

    Returns:
        (M, 2, 6) derivative with respect to (dt [m], w [rad]) with t' = t + dt, R' = exp([w]x) R. [px/m, px/rad]

    Source: derivative of the ellipse centre `pi(t - (r^2 / t_z) (e_z - n_z n))` (see `geometry.circles`).
    """
    centers, radii = feature_points(layout)
    arms = left_from_drogue.rotate(centers)
    t = arms + left_from_drogue.translation_m - rig.eye_offset_m(eye)
    n = left_from_drogue.rotation[:, 2]
    forward = np.array([0.0, 0.0, 1.0])
    d_center = np.concatenate([np.broadcast_to(np.eye(3), (len(t), 3, 3)), -skew(arms)], axis=2)
    d_normal = np.concatenate([np.zeros((3, 3)), -skew(n)], axis=1)
    shift = forward - n[2] * n
    d_shift = -(np.outer(n, d_normal[2]) + n[2] * d_normal)
    scale = (radii**2 / t[:, 2])[:, None]
    virtual = t - scale * shift
    d_scale = -(scale / t[:, 2:]) * d_center[:, 2]
    d_virtual = d_center - shift[:, None] * d_scale[:, None, :] - scale[:, None] * d_shift
    x, y, z = virtual[:, 0], virtual[:, 1], virtual[:, 2]
    d_project = np.zeros((len(t), 2, 3))
    d_project[:, 0, 0], d_project[:, 0, 2] = rig.camera.fx_px / z, -rig.camera.fx_px * x / z**2
    d_project[:, 1, 1], d_project[:, 1, 2] = rig.camera.fy_px / z, -rig.camera.fy_px * y / z**2
    jacobian: Array = d_project @ d_virtual
    return jacobian


def stereo_jacobian(rig: StereoRig, left_from_drogue: RigidTransform, layout: MarkerLayout) -> Array:
    """(2, M, 2, 6) `center_jacobian` of both eyes, left before right."""
    return np.stack([center_jacobian(rig, left_from_drogue, layout, eye) for eye in EYES])


def angles_jacobian(left_from_drogue: RigidTransform) -> Array:
    """(2, 3) derivative of pitch and yaw with respect to the rotation increment w. [rad/rad]"""
    nx, ny, nz = left_from_drogue.rotation[:, 2]
    across2 = nx**2 + nz**2
    d_pitch = np.array([nx * ny / np.sqrt(across2), -np.sqrt(across2), nz * ny / np.sqrt(across2)])
    d_yaw = np.array([nz, 0.0, -nx]) / across2
    jacobian: Array = np.stack([d_pitch, d_yaw]) @ -skew([nx, ny, nz])
    return jacobian


def pose_covariance(jacobian: Array) -> Array | None:
    """Covariance of the pose from image points of unit noise.

    Args:
        jacobian: (K, 2, 6) of the points that are seen.

    Returns:
        (6, 6) inverse of the Fisher information [m, rad, per px], or None where the points leave the pose open.
    """
    if len(jacobian) < _FEWEST_FEATURES:
        return None
    rows = jacobian.reshape(-1, 6)
    information = rows.T @ rows
    scale = np.sqrt(np.diag(information))
    if not scale.all():
        return None
    scaled = information / np.outer(scale, scale)
    if np.linalg.cond(scaled) > _LARGEST_CONDITION:
        return None
    covariance: Array = np.linalg.inv(scaled) / np.outer(scale, scale)
    return covariance


def pose_bound(
    rig: StereoRig, left_from_drogue: RigidTransform, layout: MarkerLayout, visible: NDArray[np.bool_]
) -> Array | None:
    """Cramer-Rao bound of position and attitude at a centroid noise of 1 px; it is proportional to the noise.

    Args:
        rig: the cameras.
        left_from_drogue: true pose.
        layout: the drogue's features.
        visible: (2, M) which features the left and the right eye see.

    Returns:
        (5,) standard deviations of X, Y, Z [m] and of pitch and yaw [deg], or None where the pose is open.
    """
    covariance = pose_covariance(stereo_jacobian(rig, left_from_drogue, layout)[visible])
    if covariance is None:
        return None
    angles = angles_jacobian(left_from_drogue)
    position = np.sqrt(np.diag(covariance)[:3])
    attitude = np.rad2deg(np.sqrt(np.diag(angles @ covariance[3:, 3:] @ angles.T)))
    bound: Array = np.concatenate([position, attitude])
    return bound
