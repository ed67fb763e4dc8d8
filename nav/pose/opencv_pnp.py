"""Methods `mono-ippe` and `mono-sqpnp`: OpenCV's solvers on the markers of one eye.

They take image points for the images of points. The markers are discs, so the pose of a first pass tells how far each
ellipse centre lies from the image of its disc's centre, and a second pass works on the corrected points.
Sources: T. Collins and A. Bartoli, IJCV 109 (2014), doi:10.1007/s11263-014-0725-5 (IPPE); G. Terzakis and M. Lourakis,
ECCV 2020, doi:10.1007/978-3-030-58452-8_28 (SQPnP).
"""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np

from geometry.se3 import Array, RigidTransform
from nav.pose.adjustment import information_at, inverse_information
from nav.pose.features import left_features
from nav.pose.joint import misfit
from nav.pose.mono import LEAST_MARKERS
from nav.pose.mono_eye import solve_with_one_eye
from nav.pose.pose_method import NoFixReason, Observation, PoseMode, Solution
from nav.pose.prediction import predict_px, used_left
from nav.pose.reprojection import State, linearise


def mono_ippe(observation: Observation) -> Solution | NoFixReason:
    """Both poses of IPPE, each refined by Levenberg-Marquardt; without that it misses the bound by 2 below 5 m."""
    return solve_with_one_eye(observation, LEAST_MARKERS, partial(_solve, flag=cv2.SOLVEPNP_IPPE, refine=True))


def mono_sqpnp(observation: Observation) -> Solution | NoFixReason:
    """The minima that SQPnP knows of, as they are."""
    return solve_with_one_eye(observation, LEAST_MARKERS, partial(_solve, flag=cv2.SOLVEPNP_SQPNP, refine=False))


def _solve(observation: Observation, flag: int, refine: bool) -> Solution | NoFixReason:
    measured = observation.pixels_px[0, observation.seen[0]]
    poses = _poses(observation, measured, flag, refine)
    if not poses:
        return NoFixReason("the solver found no pose in front of the camera")
    corrected = [_poses(observation, measured - _disc_shift_px(observation, pose), flag, refine) for pose in poses]
    # The pose that belongs to a correction is the one nearest to that which made it.
    poses = [
        min(found, key=lambda other: float(np.linalg.norm(other.rotation - pose.rotation))) if found else pose
        for pose, found in zip(poses, corrected, strict=True)
    ]
    return _best_of(observation, poses)


def _poses(observation: Observation, pixels_px: Array, flag: int, refine: bool) -> list[RigidTransform]:
    """Poses in front of the camera that OpenCV finds, the best first."""
    points = np.ascontiguousarray(observation.layout.centers_m[observation.seen[0]])
    camera, pixels = observation.rig.camera.matrix(), np.ascontiguousarray(pixels_px)
    poses = []
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(points, pixels, camera, None, flags=flag)
        for turn, shift in zip(turns, shifts, strict=True):
            if refine:
                turn, shift = cv2.solvePnPRefineLM(points, pixels, camera, None, turn, shift)
            rotation, place = cv2.Rodrigues(turn)[0], np.asarray(shift, dtype=np.float64).ravel()
            if np.isfinite(rotation).all() and np.isfinite(place).all() and place[2] > 0 and rotation[2, 2] > 0:
                poses.append(RigidTransform(rotation, place))
    except cv2.error:
        # OpenCV asserts on layouts that it cannot solve, such as points of one pose twice.
        return []
    return poses


def _disc_shift_px(observation: Observation, pose: RigidTransform) -> Array:
    """(K, 2) from the images of the seen discs' centres to the centres of their images. [px]"""
    rotation, translation = pose.rotation[None], pose.translation_m[None]
    ellipses = predict_px(observation.rig, observation.layout, rotation, translation)[0, 0]
    points = observation.rig.project(pose.apply(observation.layout.centers_m), "left")
    shift: Array = (ellipses - points)[observation.seen[0]]
    return shift


def _best_of(observation: Observation, poses: list[RigidTransform]) -> Solution | NoFixReason:
    """The pose with the lowest reprojection cost, its covariance, and all as modes with Laplace weights."""
    features = left_features(observation).take(np.zeros(len(poses), dtype=np.int64))
    rotations = np.stack([pose.rotation for pose in poses])
    translations = np.stack([pose.translation_m for pose in poses])
    costs = linearise(features, State.nominal(features, rotations, translations)).costs
    order = np.flatnonzero(np.isfinite(costs))
    order = order[np.argsort(costs[order], kind="stable")]
    if not len(order):
        return NoFixReason("the solver found no pose in front of the camera")
    best = int(order[0])
    reason = misfit(features.take(slice(0, 1)), rotations[best], translations[best])
    if reason is not None:
        return reason
    information = information_at(features, rotations, translations)
    covariances, determined = inverse_information(information)
    log_weights = -costs - np.linalg.slogdet(information)[1] / 2
    weights = np.exp(log_weights[order] - log_weights[order].max())
    weights /= weights.sum()
    modes = tuple(PoseMode(poses[i], float(costs[i]), float(weight)) for i, weight in zip(order, weights, strict=True))
    covariance = covariances[best] if determined[best] else None
    return Solution(poses[best], used_left(observation), covariance, modes)
