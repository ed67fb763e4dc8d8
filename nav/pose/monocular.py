"""Methods that need the markers of one eye only: `mono-lm`, `mono-ippe`, `mono-sqpnp` and `mono-circle`.

The left eye is preferred; the right one, an equal camera at a known place, is used where the left one shows too few
markers. Every method is written for the left eye: `solve_with_one_eye` passes it the right eye's measurements as the
left one's, and moves its pose back into the left camera frame.

`mono-ippe` and `mono-sqpnp` are OpenCV's solvers, which assume images of points. The markers are discs: a first pass
gives the distance from the image of each disc's centre to the centre of its ellipse, and a second pass solves with the
corrected points. Sources: T. Collins and A. Bartoli, IJCV 109 (2014), doi:10.1007/s11263-014-0725-5 (IPPE);
G. Terzakis and M. Lourakis, ECCV 2020, doi:10.1007/978-3-030-58452-8_28 (SQPnP).

`mono-circle` is a reconstruction of monocular work on the drogue's circular edges (Ma et al. 2019), whose full text
was not available. The ellipse through the markers' centres gives two poses in closed form. Both are refined, and the
hub, as a second circle about the same axis, or the positions of the markers choose between them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES
from nav.pose.adjustment import Adjusted, State, adjust, information_at, inverse_information, linearise
from nav.pose.features import Features, left_features, stack_features
from nav.pose.joint import misfit, solve_one
from nav.pose.marker_geometry import predict_px, rotations_with_axis, used_left, with_best_roll
from nav.pose.observation_checks import eye_fault, hub_fault
from nav.pose.pose_method import NoFixReason, Observation, PoseMethod, PoseMode, Solution

_LEFT, _RIGHT = range(2)


def solve_with_one_eye(observation: Observation, least: int, solve: PoseMethod) -> Solution | NoFixReason:
    """The answer of a method that looks at the left eye alone, from the left or else from the right eye.

    Args:
        observation: what both eyes measured, or one of them.
        least: how many markers the method needs.
        solve: is given the chosen eye's measurements as the left eye's, and answers in that eye's frame.

    Returns:
        The pose in the left camera frame. Bad numbers in an eye that shows enough are a reason for none: they say that
        something is wrong with what was measured, and the other eye's may be wrong too.
    """
    counts = observation.seen.sum(axis=1)
    eye = _RIGHT if counts[_LEFT] < least <= counts[_RIGHT] else _LEFT
    if counts.max() < least and counts[_RIGHT]:
        left, right = counts.tolist()
        return NoFixReason(f"{left} markers in the left eye and {right} in the right one, {least} are needed in one")
    reason = eye_fault(observation, eye, least)
    if reason is not None:
        return reason
    answer = solve(_alone(observation, eye))
    if isinstance(answer, NoFixReason) or eye == _LEFT:
        return answer
    return _from_right(answer, observation)


def _alone(observation: Observation, eye: int) -> Observation:
    """One eye's measurements in the left eye's place, and nothing in the right one's."""
    assert observation.hub_px is not None
    assert observation.hub_cov_px2 is not None

    def first(values: Array) -> Array:
        return np.stack([values[eye], np.full_like(values[eye], np.nan)])

    return replace(
        observation,
        pixels_px=first(observation.pixels_px),
        cov_px2=first(observation.cov_px2),
        hub_px=first(observation.hub_px),
        hub_cov_px2=first(observation.hub_cov_px2),
    )


def _from_right(solution: Solution, observation: Observation) -> Solution:
    """A solution in the right eye's frame as one in the left eye's.

    Both eyes look along the same axes, so that the covariance of small turns and shifts stays as it is, but for what is
    not known of the right eye against the left one.
    """
    offset_m = observation.rig.eye_offset_m(EYES[_RIGHT])

    def moved(pose: RigidTransform) -> RigidTransform:
        return RigidTransform(pose.rotation, pose.translation_m + offset_m)

    covariance = solution.covariance
    if covariance is not None:
        covariance = covariance.copy()
        x_per_px_m = solution.left_from_drogue.translation_m[2] / observation.rig.camera.fx_px
        covariance[0, 0] += (observation.tolerances.disparity_px * x_per_px_m) ** 2
    return replace(
        solution,
        covariance=covariance,
        left_from_drogue=moved(solution.left_from_drogue),
        used=solution.used[::-1].copy(),
        modes=tuple(replace(mode, left_from_drogue=moved(mode.left_from_drogue)) for mode in solution.modes),
        used_hub=None if solution.used_hub is None else solution.used_hub[::-1].copy(),
    )


# Three image points have up to four poses.
LEAST_MARKERS = 4


def mono_lm(observation: Observation) -> Solution | NoFixReason:
    """As `joint`, of the markers in one eye; depth comes from the ring's known radius."""
    return solve_with_one_eye(observation, LEAST_MARKERS, _solve_lm)


def _solve_lm(observation: Observation) -> Solution | NoFixReason:
    return solve_one(left_features(observation), used_left(observation))


def mono_ippe(observation: Observation) -> Solution | NoFixReason:
    """Both poses of IPPE, each refined by Levenberg-Marquardt; without that it misses the bound by 2 below 5 m."""
    return solve_with_one_eye(observation, LEAST_MARKERS, partial(_solve_pnp, flag=cv2.SOLVEPNP_IPPE, refine=True))


def mono_sqpnp(observation: Observation) -> Solution | NoFixReason:
    """The minima that SQPnP knows of, as they are."""
    return solve_with_one_eye(observation, LEAST_MARKERS, partial(_solve_pnp, flag=cv2.SOLVEPNP_SQPNP, refine=False))


def _solve_pnp(observation: Observation, flag: int, refine: bool) -> Solution | NoFixReason:
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


def conic_through(points: Array) -> Array | None:
    """(3, 3) symmetric matrix of the conic with the smallest algebraic distances to (K, 2) points, K >= 5.

    Returns:
        The conic with eigenvalues of signs + + -, or None where it is no ellipse.
    """
    mean = points.mean(axis=0)
    size = np.sqrt(((points - mean) ** 2).mean())
    if not size > 0:
        return None
    # Centred and scaled points keep the six columns of one size.
    x, y = ((points - mean) / size).T
    design = np.column_stack([x * x, 2 * x * y, y * y, 2 * x, 2 * y, np.ones_like(x)])
    a, b, c, d, e, f = np.linalg.svd(design)[2][5]
    to_unit = np.array([[1 / size, 0, -mean[0] / size], [0, 1 / size, -mean[1] / size], [0, 0, 1]])
    conic = to_unit.T @ np.array([[a, b, d], [b, c, e], [d, e, f]]) @ to_unit
    if a * c - b * b <= 0:
        return None
    values = np.linalg.eigvalsh(conic)
    if values[1] < 0:
        conic, values = -conic, -values[::-1]
    return conic if values[0] < 0 < values[1] else None


def circle_poses(conic: Array, radius_m: float) -> tuple[Array, Array]:
    """Both circles of a known radius whose image is an ellipse.

    Args:
        conic: (3, 3) in normalised image coordinates (rays with z = 1), with eigenvalues of signs + + -.
        radius_m: of the circle. [m]

    Returns:
        (2, 3) centres in front of the camera [m], (2, 3) unit normals with positive z.

    Source: eigenvalues l1 >= l2 > 0 > l3 with eigenvectors V; `a^2 = (l1 - l2) / (l1 - l3)`,
    `b^2 = (l2 - l3) / (l1 - l3)`; centre `z0 V (s a l3 / l2, 0, -b l1 / l2)`, normal `V (s a, 0, -b)`, s = +-1,
    `z0 = l2 r / sqrt(-l1 l3)`.
    """
    values, vectors = np.linalg.eigh(conic)
    (l3, l2, l1), v = values, vectors[:, ::-1]
    a, b = np.sqrt((l1 - l2) / (l1 - l3)), np.sqrt((l2 - l3) / (l1 - l3))
    z0 = l2 * radius_m / np.sqrt(-l1 * l3)
    sides = np.array([1.0, -1.0])
    zero = np.zeros(2)
    centers = z0 * np.stack([sides * a * l3 / l2, zero, np.full(2, -b * l1 / l2)], axis=-1) @ v.T
    normals = np.stack([sides * a, zero, np.full(2, -b)], axis=-1) @ v.T
    centers = np.where(centers[:, 2:] < 0, -centers, centers)
    return centers, np.where(normals[:, 2:] < 0, -normals, normals)


# Five points fix a conic.
_LEAST_FOR_CONIC = 5
# The ellipse says nothing about where along it a marker lies. Markers count by this many deviations less in that
# direction, which leaves them enough to fix the roll and nothing else.
_ALONG = 100.0
# The shift of the discs' ellipse centres needs the pose, and hardly depends on its errors.
_PASSES = 3


def mono_circle(observation: Observation) -> Solution | NoFixReason:
    """Pose from the ellipse through one eye's markers and the ring's radius."""
    return solve_with_one_eye(observation, _LEAST_FOR_CONIC, _solve_ellipse)


def _solve_ellipse(observation: Observation) -> Solution | NoFixReason:
    reason = hub_fault(observation)
    if reason is not None:
        return reason
    radius_m = observation.layout.ring_radius_m
    if radius_m is None:
        return NoFixReason("an ellipse needs all markers on one circle about the drogue's origin")
    starts = _closed_form(observation, radius_m)
    if starts is None:
        return NoFixReason("the markers lie on no ellipse")
    rotations, translations = starts
    adjusted = adjust(_across_only(observation, rotations, translations), rotations, translations)
    best = int(np.argmin(_branch_costs(observation, adjusted)))
    covariance, determined = inverse_information(adjusted.information[best : best + 1])
    rotation, translation = adjusted.rotations[best], adjusted.translations_m[best]
    if not (determined[0] and translation[2] > 0 and rotation[2, 2] > 0):
        return NoFixReason("the ellipse gives no pose in front of the camera")
    reason = misfit(left_features(observation), rotation, translation)
    if reason is not None:
        return reason
    used_hub = np.stack([observation.hub_seen[0], [False, False]])
    return Solution(RigidTransform(rotation, translation), used_left(observation), covariance[0], used_hub=used_hub)


def _closed_form(observation: Observation, radius_m: float) -> tuple[Array, Array] | None:
    """(2, 3, 3) rotations and (2, 3) translations of both circles, or None where there is no ellipse. [m]"""
    seen = observation.seen[0]
    places, measured = observation.layout.centers_m[seen], observation.pixels_px[0, seen]
    shifts = np.zeros((2, *measured.shape))
    rotations, centers = np.empty((2, 3, 3)), np.empty((2, 3))
    for _ in range(_PASSES):
        for branch in range(2):
            rays = observation.rig.camera.rays(measured - shifts[branch])
            conic = conic_through(rays[:, :2])
            if conic is None:
                return None
            both_centers, normals = circle_poses(conic, radius_m)
            # The two solutions swap when the ellipse's axes do; the branch is the one on the same side as before.
            side = branch if not shifts.any() else int(np.argmax(normals @ rotations[branch, :, 2]))
            center, normal = both_centers[side], normals[side]
            depth = (center @ normal) / (rays @ normal)
            unrolled = rotations_with_axis(normal[None])
            rotations[branch] = with_best_roll(unrolled, rays * depth[:, None], center[None], places)[0]
            centers[branch] = center
        if not (np.isfinite(rotations).all() and np.isfinite(centers).all()):
            return None
        ellipses = predict_px(observation.rig, observation.layout, rotations, centers)[:, 0, seen]
        points = observation.rig.camera.project(np.einsum("sij,nj->sni", rotations, places) + centers[:, None])
        shifts = ellipses - points
    return rotations, centers


def _across_only(observation: Observation, rotations: Array, translations_m: Array) -> Features:
    """Two frames, one a branch: the left eye's markers with little weight along the ellipse."""
    layout, camera = observation.layout, observation.rig.camera
    along_ring = np.cross([0.0, 0.0, 1.0], layout.centers_m)
    points = np.einsum("sij,nj->sni", rotations, layout.centers_m) + translations_m[:, None]
    motion = np.einsum("sij,nj->sni", rotations, along_ring)
    tangent = motion[..., :2] - points[..., :2] / points[..., 2:] * motion[..., 2:]
    tangent *= [camera.fx_px, camera.fy_px]
    tangent /= np.maximum(np.linalg.norm(tangent, axis=-1, keepdims=True), np.finfo(np.float64).tiny)
    variance = np.einsum("sni,nij,snj->sn", tangent, observation.cov_px2[0], tangent)
    wide = (_ALONG**2 * variance)[..., None, None] * tangent[..., :, None] * tangent[..., None, :]
    pixels = np.stack([observation.pixels_px[:1]] * 2)
    cov = observation.cov_px2[0] + wide
    return stack_features(observation.rig, layout, pixels, cov[:, None], observation.tolerances)


def _branch_costs(observation: Observation, adjusted: Adjusted) -> Array:
    """(2,) costs of the hub's edges in the left eye where they were measured, else of the markers' places."""
    assert observation.hub_px is not None
    assert observation.hub_cov_px2 is not None
    pixels = np.concatenate([observation.pixels_px[0], observation.hub_px[0]])
    cov = np.concatenate([observation.cov_px2[0], observation.hub_cov_px2[0]])
    count = observation.layout.count
    if observation.hub_seen[0].any():
        pixels[:count] = np.nan
    else:
        pixels, cov = pixels[:count], cov[:count]
    both = np.stack([pixels[None]] * 2)
    features = stack_features(observation.rig, observation.layout, both, np.stack([cov[None]] * 2))
    return linearise(features, State.nominal(features, adjusted.rotations, adjusted.translations_m)).costs
