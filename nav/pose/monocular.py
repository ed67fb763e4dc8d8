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
from nav.pose.adjustment import AdjustedPoses, AdjustmentState, adjust, information_at, inverse_information, linearise
from nav.pose.features import Features, left_features, stack_features
from nav.pose.joint import misfit_reason, solve_one
from nav.pose.marker_geometry import align_roll, left_mask, project_markers, rotations_from_axes
from nav.pose.pose_method import NoFixReason, Observation, PoseMethod, PoseMode, Solution, eye_fault, hub_fault
from nav.pose.tilt_pairs import SAME_TURN_RAD

_LEFT, _RIGHT = range(2)
# Three image points have up to four poses.
_LEAST_FOR_PNP = 4
# Five points determine a conic.
_LEAST_FOR_CONIC = 5
# The ellipse has no information on positions along it. Standard deviations are this many times larger along it, which
# leaves the markers enough weight to determine the roll and nothing else.
_ALONG_SIGMAS = 100.0
# The shift of the discs' ellipse centres depends on the pose, but only weakly on its errors.
_PASSES = 3


def solve_with_one_eye(observation: Observation, least: int, solve: PoseMethod) -> Solution | NoFixReason:
    """Apply a method for the left eye to the left eye, or to the right one where the left shows too few markers.

    Args:
        observation: measurements of both eyes, or of one.
        least: number of markers that the method needs.
        solve: the method; it gets the chosen eye's measurements as the left eye's, and returns a pose in that eye's
            frame.

    Returns:
        The pose in the left camera frame. There is none where an eye with enough markers has invalid numbers, even if
        the other eye has not: its measurements may be wrong too.
    """
    counts = observation.seen.sum(axis=1)
    eye = _RIGHT if counts[_LEFT] < least <= counts[_RIGHT] else _LEFT
    if counts.max() < least and counts[_RIGHT]:
        left, right = counts.tolist()
        return NoFixReason(f"{left} markers in the left eye and {right} in the right one, {least} are needed in one")
    reason = eye_fault(observation, eye, least)
    if reason is not None:
        return reason
    answer = solve(_as_left_eye(observation, eye))
    if isinstance(answer, NoFixReason) or eye == _LEFT:
        return answer
    return _to_left_frame(answer, observation)


def _as_left_eye(observation: Observation, eye: int) -> Observation:
    """The observation with one eye's measurements as the left eye's, and none in the right eye."""
    assert observation.hub_px is not None
    assert observation.hub_cov_px2 is not None

    def as_left(values: Array) -> Array:
        return np.stack([values[eye], np.full_like(values[eye], np.nan)])

    return replace(
        observation,
        pixels_px=as_left(observation.pixels_px),
        cov_px2=as_left(observation.cov_px2),
        hub_px=as_left(observation.hub_px),
        hub_cov_px2=as_left(observation.hub_cov_px2),
    )


def _to_left_frame(solution: Solution, observation: Observation) -> Solution:
    """Transform a solution from the right camera frame to the left one.

    The axes of both frames are parallel, so the covariance stays the same, except for the stated tolerance of the
    disparity.
    """
    offset_m = observation.rig.eye_offset_m(EYES[_RIGHT])

    def in_left_frame(pose: RigidTransform) -> RigidTransform:
        return RigidTransform(pose.rotation, pose.translation_m + offset_m)

    covariance = solution.covariance
    if covariance is not None:
        covariance = covariance.copy()
        x_per_px_m = solution.left_from_drogue.translation_m[2] / observation.rig.camera.fx_px
        covariance[0, 0] += (observation.tolerances.disparity_px * x_per_px_m) ** 2
    return replace(
        solution,
        covariance=covariance,
        left_from_drogue=in_left_frame(solution.left_from_drogue),
        used=solution.used[::-1].copy(),
        modes=tuple(replace(mode, left_from_drogue=in_left_frame(mode.left_from_drogue)) for mode in solution.modes),
        used_hub=None if solution.used_hub is None else solution.used_hub[::-1].copy(),
    )


def mono_lm(observation: Observation) -> Solution | NoFixReason:
    """Method `mono-lm`: as `joint`, from the markers in one eye; depth comes from the known radius of the ring."""
    return solve_with_one_eye(observation, _LEAST_FOR_PNP, _solve_by_adjustment)


def _solve_by_adjustment(observation: Observation) -> Solution | NoFixReason:
    return solve_one(left_features(observation), left_mask(observation))


def mono_ippe(observation: Observation) -> Solution | NoFixReason:
    """Method `mono-ippe`: both poses of IPPE, refined by Levenberg-Marquardt.

    Without the refinement the errors are twice the Cramer-Rao bound below 5 m.
    """
    if not observation.layout.is_flat:
        return NoFixReason("IPPE needs all markers in one plane, and the drogue's lie at several depths")
    return solve_with_one_eye(
        observation, _LEAST_FOR_PNP, partial(_solve_by_opencv, flag=cv2.SOLVEPNP_IPPE, refine=True)
    )


def mono_sqpnp(observation: Observation) -> Solution | NoFixReason:
    """Method `mono-sqpnp`: the minima that SQPnP finds, without refinement."""
    return solve_with_one_eye(
        observation, _LEAST_FOR_PNP, partial(_solve_by_opencv, flag=cv2.SOLVEPNP_SQPNP, refine=False)
    )


def _solve_by_opencv(observation: Observation, flag: int, refine: bool) -> Solution | NoFixReason:
    measured = observation.pixels_px[0, observation.seen[0]]
    poses = _pnp_poses(observation, measured, flag, refine)
    if not poses:
        return NoFixReason("the solver found no pose in front of the camera")
    corrected = [_pnp_poses(observation, measured - _disc_shift_px(observation, pose), flag, refine) for pose in poses]
    # Of the poses from corrected points, take the one nearest to the pose that the correction was computed from.
    poses = [
        min(found, key=lambda other: float(np.linalg.norm(other.rotation - pose.rotation))) if found else pose
        for pose, found in zip(poses, corrected, strict=True)
    ]
    return _best_pose(observation, poses)


def _pnp_poses(observation: Observation, pixels_px: Array, flag: int, refine: bool) -> list[RigidTransform]:
    """OpenCV's poses in front of the camera, the best first."""
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
        # OpenCV raises on layouts that it cannot solve, such as points that occur twice.
        return []
    return poses


def _disc_shift_px(observation: Observation, pose: RigidTransform) -> Array:
    """(K, 2) offsets from the images of the measured discs' centres to the centres of their ellipses. [px]"""
    rotation, translation = pose.rotation[None], pose.translation_m[None]
    ellipses = project_markers(observation.rig, observation.layout, rotation, translation)[0, 0]
    points = observation.rig.project(pose.apply(observation.layout.centers_m), "left")
    shift: Array = (ellipses - points)[observation.seen[0]]
    return shift


def _best_pose(observation: Observation, poses: list[RigidTransform]) -> Solution | NoFixReason:
    """The pose with the lowest reprojection cost, its covariance, and all distinct poses as modes with Laplace weights.

    Both starts of IPPE may be refined to one minimum.
    """
    features = left_features(observation).take(np.zeros(len(poses), dtype=np.int64))
    rotations = np.stack([pose.rotation for pose in poses])
    translations = np.stack([pose.translation_m for pose in poses])
    costs = linearise(features, AdjustmentState.nominal(features, rotations, translations)).costs
    order = np.flatnonzero(np.isfinite(costs))
    order = order[np.argsort(costs[order], kind="stable")]
    if not len(order):
        return NoFixReason("the solver found no pose in front of the camera")
    axes = rotations[order, :, 2]
    is_near = np.linalg.norm(axes[:, None] - axes, axis=2) < SAME_TURN_RAD
    order = order[~np.tril(is_near, -1).any(axis=1)]
    best = int(order[0])
    reason = misfit_reason(features.take(slice(0, 1)), rotations[best], translations[best])
    if reason is not None:
        return reason
    information = information_at(features, rotations, translations)
    log_weights = -costs - np.linalg.slogdet(information)[1] / 2
    weights = np.exp(log_weights[order] - log_weights[order].max())
    weights /= weights.sum()
    modes = tuple(PoseMode(poses[i], float(costs[i]), float(weight)) for i, weight in zip(order, weights, strict=True))
    return Solution(poses[best], left_mask(observation), _unweighted_covariance(observation, poses[best]), modes)


def _unweighted_covariance(observation: Observation, pose: RigidTransform) -> Array | None:
    """(6, 6) covariance of OpenCV's pose, which weighs all pixels alike; None where they do not determine a pose.

    Source: `G C G^T` with `G = (J J^T)^-1 J`, J the unweighted derivatives and C the covariance of the pixels, to which
    the tolerances of the drogue add.
    """
    weighted = left_features(observation)
    seen = weighted.seen[0, 0]
    u, v, a, b, c = weighted.measured
    alike = replace(weighted, measured=np.stack([u, v, np.sign(a), np.zeros_like(b), np.sign(c)]))
    state = AdjustmentState.nominal(alike, pose.rotation[None], pose.translation_m[None])
    jacobian = linearise(alike, state).jacobian[0, :, : 2 * len(seen)].reshape(-1, 2, len(seen))[..., seen]
    by_pose, by_departures = np.split(jacobian.reshape(len(jacobian), -1), [6])
    inverse, determined = inverse_information((by_pose @ by_pose.T)[None])
    if not determined[0]:
        return None
    gain = inverse[0] @ by_pose
    gain_u, gain_v = np.split(gain, 2, axis=1)
    # The inverse of a whitening matrix [[a, 0], [b, c]] is a root of its pixel's covariance.
    a, b, c = (each[0, 0, seen] for each in (a, b, c))
    roots = np.concatenate([(gain_u - gain_v * b / c) / a, gain_v / c, gain @ by_departures.T], axis=1)
    covariance: Array = roots @ roots.T
    return covariance


def conic_through(points: Array) -> Array | None:
    """(3, 3) symmetric matrix of the conic with the smallest algebraic distances to (K, 2) points, K >= 5.

    Returns:
        The conic with eigenvalues of signs + + -, or None where it is no ellipse.
    """
    mean = points.mean(axis=0)
    size = np.sqrt(((points - mean) ** 2).mean())
    if not size > 0:
        return None
    # Points are centred and scaled, so that the six columns have similar norms.
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
    """Both circles of a known radius that have an ellipse as their image.

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


def mono_circle(observation: Observation) -> Solution | NoFixReason:
    """Method `mono-circle`: pose from the ellipse through one eye's markers and the ring's radius."""
    return solve_with_one_eye(observation, _LEAST_FOR_CONIC, _solve_by_ellipse)


def _solve_by_ellipse(observation: Observation) -> Solution | NoFixReason:
    reason = hub_fault(observation)
    if reason is not None:
        return reason
    radius_m = observation.layout.ring_radius_m
    if radius_m is None:
        return NoFixReason("an ellipse needs all markers on one circle about the drogue's origin")
    starts = _poses_from_ellipse(observation, radius_m)
    if starts is None:
        return NoFixReason("the markers lie on no ellipse")
    rotations, translations = starts
    adjusted = adjust(_features_across_ellipse(observation, rotations, translations), rotations, translations)
    best = int(np.argmin(_branch_costs(observation, adjusted)))
    covariance, determined = inverse_information(adjusted.information[best : best + 1])
    rotation, translation = adjusted.rotations[best], adjusted.translations_m[best]
    if not (determined[0] and translation[2] > 0 and rotation[2, 2] > 0):
        return NoFixReason("the ellipse gives no pose in front of the camera")
    reason = misfit_reason(left_features(observation), rotation, translation)
    if reason is not None:
        return reason
    used_hub = np.stack([observation.hub_seen[0], [False, False]])
    return Solution(RigidTransform(rotation, translation), left_mask(observation), covariance[0], used_hub=used_hub)


def _poses_from_ellipse(observation: Observation, radius_m: float) -> tuple[Array, Array] | None:
    """(2, 3, 3) rotations and (2, 3) translations of both circles in closed form, or None without an ellipse. [m]"""
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
            # The two solutions swap when the ellipse's axes do; take the one whose normal is nearest to the last one.
            side = branch if not shifts.any() else int(np.argmax(normals @ rotations[branch, :, 2]))
            center, normal = both_centers[side], normals[side]
            depth = (center @ normal) / (rays @ normal)
            unrolled = rotations_from_axes(normal[None])
            rotations[branch] = align_roll(unrolled, rays * depth[:, None], center[None], places)[0]
            centers[branch] = center
        if not (np.isfinite(rotations).all() and np.isfinite(centers).all()):
            return None
        ellipses = project_markers(observation.rig, observation.layout, rotations, centers)[:, 0, seen]
        points = observation.rig.camera.project(np.einsum("sij,nj->sni", rotations, places) + centers[:, None])
        shifts = ellipses - points
    return rotations, centers


def _features_across_ellipse(observation: Observation, rotations: Array, translations_m: Array) -> Features:
    """The left eye's markers for two frames, one for each pose, with little weight along the ellipse."""
    layout, camera = observation.layout, observation.rig.camera
    along_ring = np.cross([0.0, 0.0, 1.0], layout.centers_m)
    points = np.einsum("sij,nj->sni", rotations, layout.centers_m) + translations_m[:, None]
    motion = np.einsum("sij,nj->sni", rotations, along_ring)
    tangent = motion[..., :2] - points[..., :2] / points[..., 2:] * motion[..., 2:]
    tangent *= [camera.fx_px, camera.fy_px]
    tangent /= np.maximum(np.linalg.norm(tangent, axis=-1, keepdims=True), np.finfo(np.float64).tiny)
    variance = np.einsum("sni,nij,snj->sn", tangent, observation.cov_px2[0], tangent)
    wide = (_ALONG_SIGMAS**2 * variance)[..., None, None] * tangent[..., :, None] * tangent[..., None, :]
    pixels = np.stack([observation.pixels_px[:1]] * 2)
    cov = observation.cov_px2[0] + wide
    return stack_features(observation.rig, layout, pixels, cov[:, None], observation.tolerances)


def _branch_costs(observation: Observation, adjusted: AdjustedPoses) -> Array:
    """(2,) costs of the hub's edges in the left eye where they were measured, else of the markers."""
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
    return linearise(features, AdjustmentState.nominal(features, adjusted.rotations, adjusted.translations_m)).costs
