"""Poses from the markers of one eye: SQPNP with refinement, and CPnP.

CPnP removes the bias that measured pixels bring into linear equations, and then makes one Gauss-Newton step. Its
equations have eleven unknowns; the markers of a flat ring leave three of them open, the third column of the rotation.
Here they are left out, and the rotation's first two columns are made orthonormal instead of all three.

Sources: G. Terzakis and M. Lourakis, ECCV 2020, doi:10.1007/978-3-030-58452-8_28 (SQPNP); G. Zeng, S. Chen, B. Mu,
G. Shi and J. Wu, ICRA 2023, doi:10.48550/arXiv.2209.05824 (CPnP).
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from scipy.linalg import LinAlgError, eigh

from geometry.pinhole import PinholeCamera
from geometry.se3 import Array, RigidTransform, exp_rotation, skew
from geometry.stereo import EYES
from nav.pose.marker_geometry import project_markers
from nav.pose.pose_method import Observation, eye_fault

PointPose = Callable[[Array, Array, PinholeCamera], RigidTransform | None]
"""Pose `camera_from_drogue` from (K, 3) points [m] and their (K, 2) images [px]; None where there is none."""

# Eight unknowns of CPnP for points in a plane; each point gives two equations.
_LEAST_MARKERS = 4
_FLAT_M = 1e-6
_LEAST_SCALE = 1e-12


def pose_of_eye(observation: Observation, eye: int, solve: PointPose) -> RigidTransform | None:
    """Pose from one eye's markers by a solver for images of points.

    The markers are discs. A first pass gives the distance from the image of each disc's centre to the centre of its
    ellipse, and a second pass solves with corrected points.

    Args:
        observation: of the pair.
        eye: 0 for the left eye, 1 for the right one.
        solve: the solver.

    Returns:
        `left_from_drogue` modulo the ring's symmetry, or None without a pose.
    """
    if eye_fault(observation, eye, _LEAST_MARKERS) is not None:
        return None
    rig, layout, seen = observation.rig, observation.layout, observation.seen[eye]
    points, pixels = layout.centers_m[seen], observation.pixels_px[eye, seen]
    offset_m = rig.eye_offset_m(EYES[eye])
    pose = solve(points, pixels, rig.camera)
    if pose is None:
        return None
    left_from_drogue = RigidTransform(pose.rotation, pose.translation_m + offset_m)
    ellipses = project_markers(rig, layout, pose.rotation[None], left_from_drogue.translation_m[None])[0, eye, seen]
    shift = ellipses - rig.camera.project(pose.apply(points))
    corrected = solve(points, pixels - shift, rig.camera)
    pose = pose if corrected is None else corrected
    return RigidTransform(pose.rotation, pose.translation_m + offset_m)


def refined_sqpnp(points_m: Array, pixels_px: Array, camera: PinholeCamera) -> RigidTransform | None:
    """OpenCV's SQPNP, every minimum refined by Levenberg-Marquardt; the one with the smallest reprojection error."""
    points, pixels, matrix = np.ascontiguousarray(points_m), np.ascontiguousarray(pixels_px), camera.matrix()
    poses = []
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(points, pixels, matrix, None, flags=cv2.SOLVEPNP_SQPNP)
        for turn, shift in zip(turns, shifts, strict=True):
            turn, shift = cv2.solvePnPRefineLM(points, pixels, matrix, None, turn, shift)
            if np.isfinite(turn).all() and np.isfinite(shift).all():
                poses.append(RigidTransform(exp_rotation(turn.ravel()), shift.ravel()))
    except cv2.error:
        # OpenCV raises on points that it cannot solve, such as collinear ones.
        return None
    poses = [pose for pose in poses if _faces_camera(pose)]
    return min(poses, key=lambda pose: _squares_px2(pose, points, pixels, camera), default=None)


def consistent_pnp(points_m: Array, pixels_px: Array, camera: PinholeCamera) -> RigidTransform | None:
    """CPnP for points in a plane of constant depth, with exactly one Gauss-Newton step.

    Raises:
        ValueError: points that lie at several depths.
    """
    if np.ptp(points_m[:, 2]) > _FLAT_M:
        raise ValueError("points_m: must lie in a plane across the drogue's axis")
    # About the points' mean the depth of the mean is the unit of the unknowns, and errors of rows add up to nothing.
    middle = points_m.mean(axis=0)
    start = bias_eliminated_pose(points_m - middle, pixels_px, camera)
    if start is None:
        return None
    pose = gauss_newton_step(start, points_m - middle, pixels_px, camera)
    if pose is None:
        return None
    pose = RigidTransform(pose.rotation, pose.translation_m - pose.rotation @ middle)
    return pose if _faces_camera(pose) else None


def bias_eliminated_pose(points_m: Array, pixels_px: Array, camera: PinholeCamera) -> RigidTransform | None:
    """The closed form of CPnP for points in the plane z = 0 about their mean.

    With the depth of the mean as unit, `q = -(r3 . s) q + f (r_xy . s + t_xy) + noise` is linear in eight unknowns: the
    first two entries of each row of the rotation and the translation across. The noise of q in the matrix adds
    `sigma^2 M' M` to the normal equations, M being the derivative of the matrix by q; it is subtracted. sigma^2 is the
    smallest generalised eigenvalue of the equations' second moments and those of `[M 1]`.

    Args:
        points_m: (K, 3) with mean 0 and z = 0. [m]
        pixels_px: (K, 2).
        camera: of the eye.
    """
    places = points_m[:, :2]
    measured = (pixels_px - (camera.cx_px, camera.cy_px)).ravel()
    focal = np.array([camera.fx_px, camera.fy_px])
    twice = np.repeat(places, 2, axis=0)
    matrix = np.zeros((len(measured), 8))
    matrix[:, :2] = -twice * measured[:, None]
    for axis in range(2):
        rows, columns = slice(axis, None, 2), slice(2 + 3 * axis, 5 + 3 * axis)
        matrix[rows, columns] = focal[axis] * np.column_stack([places, np.ones(len(places))])
    noisy = np.zeros_like(matrix)
    noisy[:, :2] = -twice
    try:
        variance = _noise_variance(matrix, noisy, measured)
        normal = matrix.T @ matrix - variance * noisy.T @ noisy
        # The noise of the right-hand side meets that of the matrix in M' 1, which is 0 about the mean.
        solution = np.linalg.solve(normal, matrix.T @ measured)
    except LinAlgError:
        return None
    columns = np.stack([solution[[2, 5, 0]], solution[[3, 6, 1]]], axis=-1)
    left, sizes, right = np.linalg.svd(columns, full_matrices=False)
    scale = float(np.sqrt(sizes.prod()))
    if not scale > _LEAST_SCALE:
        return None
    first, second = (left @ right).T
    rotation = np.column_stack([first, second, np.cross(first, second)])
    return RigidTransform(rotation, np.array([solution[4], solution[7], 1.0]) / scale)


def _noise_variance(matrix: Array, noisy: Array, measured: Array) -> float:
    """Variance of a coordinate by CPnP's smallest generalised eigenvalue. [px^2]

    Only the columns that noise enters count; the others are projected out first, which leaves the eigenvalue as it is.
    """
    exact = matrix[:, 2:]
    entered = np.column_stack([matrix[:, :2], measured])
    entered = entered - exact @ np.linalg.lstsq(exact, entered, rcond=None)[0]
    weights = np.column_stack([noisy[:, :2], np.ones(len(measured))])
    return max(0.0, float(eigh(entered.T @ entered, weights.T @ weights, eigvals_only=True)[0]))


def gauss_newton_step(
    pose: RigidTransform, points_m: Array, pixels_px: Array, camera: PinholeCamera
) -> RigidTransform | None:
    """One step on the squared reprojection errors, `R' = exp([w]x) R`; None behind the camera or without one."""
    arms = pose.rotate(points_m)
    seen = arms + pose.translation_m
    if not (seen[:, 2] > 0).all():
        return None
    by_pose = np.concatenate([np.broadcast_to(np.eye(3), (len(seen), 3, 3)), -skew(arms)], axis=2)
    by_point = np.zeros((len(seen), 2, 3))
    x, y, z = seen.T
    by_point[:, 0, 0], by_point[:, 0, 2] = camera.fx_px / z, -camera.fx_px * x / z**2
    by_point[:, 1, 1], by_point[:, 1, 2] = camera.fy_px / z, -camera.fy_px * y / z**2
    residuals = pixels_px - camera.project(seen)
    step, _, rank, _ = np.linalg.lstsq((by_point @ by_pose).reshape(-1, 6), residuals.ravel(), rcond=None)
    if rank < len(step) or not np.isfinite(step).all():
        return None
    return RigidTransform(exp_rotation(step[3:]) @ pose.rotation, pose.translation_m + step[:3])


def _faces_camera(pose: RigidTransform) -> bool:
    return bool(pose.translation_m[2] > 0 and pose.rotation[2, 2] > 0)


def _squares_px2(pose: RigidTransform, points_m: Array, pixels_px: Array, camera: PinholeCamera) -> float:
    return float(((camera.project(pose.apply(points_m)) - pixels_px) ** 2).sum())
