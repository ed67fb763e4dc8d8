"""Closed-form stereo methods on triangulated markers: `constant`, `mean-plane`, `disparity-plane` and `circle-fit`.

`circle-fit` is a reconstruction of what the literature on spatial circle fitting is known for (Xie and Wang 2011,
binocular; Wang et al. 2020), whose full texts were not available.
"""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array, RigidTransform
from nav.pose.marker_geometry import plane_normal, rotations_with_axis, triangulate_pairs, used_pairs, with_best_roll
from nav.pose.observation_checks import fault
from nav.pose.pose_method import NoFixReason, Observation, Solution


def mean_plane(observation: Observation) -> Solution | NoFixReason:
    """Position from the mean of the triangulated markers, attitude from their plane."""
    reason = fault(observation)
    if reason is not None:
        return reason
    index, points = triangulate_pairs(observation)
    pose = pose_about_mean(points, observation.layout.centers_m[index], plane_normal(points))
    return Solution(pose, used_pairs(observation))


def pose_about_mean(points_m: Array, centers_m: Array, axis: Array) -> RigidTransform:
    """Pose with a given axis that carries the mean of (K, 3) markers onto the mean of (K, 3) points.

    The roll is the one that turns the markers towards the points; with missing markers the means lie off the origin.
    """
    mean_m = points_m.mean(axis=0)
    unrolled = rotations_with_axis(axis[None])
    rotation = with_best_roll(unrolled, points_m, mean_m[None], centers_m - centers_m.mean(axis=0))[0]
    return RigidTransform(rotation, mean_m - rotation @ centers_m.mean(axis=0))


def constant(observation: Observation) -> Solution | NoFixReason:
    """Position from the mean of the triangulated markers, pitch and yaw zero."""
    reason = fault(observation)
    if reason is not None:
        return reason
    index, points = triangulate_pairs(observation)
    pose = pose_about_mean(points, observation.layout.centers_m[index], np.array([0.0, 0.0, 1.0]))
    return Solution(pose, used_pairs(observation))


def disparity_plane(observation: Observation) -> Solution | NoFixReason:
    """Disparities are linear in the rays' slopes over a plane; the coefficients are its normal up to scale.

    The markers are then put where their rays meet the plane, and the drogue about their mean.
    """
    reason = fault(observation)
    if reason is not None:
        return reason
    rig, paired = observation.rig, observation.paired
    left, right = observation.pixels_px[:, paired]
    rays = rig.camera.rays(np.column_stack([left[:, 0], (left[:, 1] + right[:, 1]) / 2]))
    coefficients = np.linalg.lstsq(rays, left[:, 0] - right[:, 0], rcond=None)[0]
    disparity_px = rays @ coefficients
    if not (disparity_px.min() > 0 and coefficients[2] > 0):
        return NoFixReason("the plane through the disparities passes behind the cameras")
    points = rays * (rig.camera.fx_px * rig.baseline_m / disparity_px)[:, None]
    axis = coefficients / np.linalg.norm(coefficients)
    return Solution(pose_about_mean(points, observation.layout.centers_m[paired], axis), used_pairs(observation))


# Three points lie on a circle whatever their error.
_LEAST_PAIRS = 4
_REFINEMENTS = 10


def circle_fit(observation: Observation) -> Solution | NoFixReason:
    """Plane of total least squares, and in it the circle with the smallest distances to the points."""
    reason = fault(observation)
    if reason is not None:
        return reason
    if observation.layout.ring_radius_m is None:
        return NoFixReason("a circle fit needs all markers on one circle about the drogue's origin")
    index, points = triangulate_pairs(observation)
    if len(index) < _LEAST_PAIRS:
        return NoFixReason(f"{len(index)} markers in both eyes, a circle fit needs {_LEAST_PAIRS}")
    unrolled = rotations_with_axis(plane_normal(points)[None])
    mean = points.mean(axis=0)
    center = circle_center((points - mean) @ unrolled[0, :, :2])
    if center is None:
        return NoFixReason("the triangulated markers lie on no circle")
    origin = mean + unrolled[0, :, :2] @ center
    if origin[2] <= 0:
        return NoFixReason("the circle's centre lies behind the cameras")
    rotation = with_best_roll(unrolled, points, origin[None], observation.layout.centers_m[index])[0]
    return Solution(RigidTransform(rotation, origin), used_pairs(observation))


def circle_center(points_m: Array) -> Array | None:
    """(2,) centre of the circle through (K, 2) points, or None where they lie on a line.

    Kasa's algebraic circle, refined by Gauss-Newton on the distances; the refined one is taken if it is nearer.
    """
    design = np.column_stack([2 * points_m, np.ones(len(points_m))])
    squares = (points_m**2).sum(axis=1)
    solution, _, rank, _ = np.linalg.lstsq(design, squares, rcond=None)
    if rank < 3:
        return None
    start: Array = solution[:2]
    center: Array = start.copy()
    for _ in range(_REFINEMENTS):
        away = points_m - center
        distance = np.linalg.norm(away, axis=1)
        if not distance.min() > 0:
            break
        direction = away / distance[:, None]
        # The free radius is the mean distance; what remains is each point's own share.
        slopes = direction - direction.mean(axis=0)
        center = center + np.linalg.lstsq(slopes, distance - distance.mean(), rcond=None)[0]
    refined = np.isfinite(center).all() and _spread(points_m, center) <= _spread(points_m, start)
    return center if refined else start


def _spread(points_m: Array, center: Array) -> float:
    return float(np.linalg.norm(points_m - center, axis=1).std())
