"""Method `mono-circle`: the ring as one ellipse in one image.

A reconstruction of what monocular work on the drogue's circular edges does (Ma et al. 2019); its full text was not
available. The ellipse through the markers' centres gives two poses in closed form, both are refined, and the hub, as a
second circle about the same axis, or the markers' own places choose between them.
"""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array, RigidTransform
from nav.pose.adjustment import Adjusted, adjust, inverse_information
from nav.pose.circle_pose import circle_poses, conic_through
from nav.pose.faults import hub_fault
from nav.pose.features import Features, left_features, stack_features
from nav.pose.joint import misfit
from nav.pose.mono_eye import solve_with_one_eye
from nav.pose.pose_method import NoFixReason, Observation, Solution
from nav.pose.prediction import predict_px, rotations_with_axis, used_left, with_best_roll
from nav.pose.reprojection import State, linearise

# Five points fix a conic.
_LEAST_MARKERS = 5
# The ellipse says nothing about where along it a marker lies. Markers count by this many deviations less in that
# direction, which leaves them enough to fix the roll and nothing else.
_ALONG = 100.0
# The shift of the discs' ellipse centres needs the pose, and hardly depends on its errors.
_PASSES = 3


def mono_circle(observation: Observation) -> Solution | NoFixReason:
    """Pose from the ellipse through one eye's markers and the ring's radius."""
    return solve_with_one_eye(observation, _LEAST_MARKERS, _solve)


def _solve(observation: Observation) -> Solution | NoFixReason:
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
