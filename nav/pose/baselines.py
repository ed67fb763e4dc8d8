"""Closed-form stereo methods on triangulated markers: `constant`, `mean-plane`, `disparity-plane` and `circle-fit`.

`circle-fit` is a reconstruction of what the literature on spatial circle fitting is known for (Xie and Wang 2011,
binocular; Wang et al. 2020), whose full texts were not available.
"""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array, RigidTransform
from nav.pose.marker_geometry import align_roll, paired_mask, plane_normal, rotations_from_axes, triangulate_markers
from nav.pose.observation_checks import stereo_fault
from nav.pose.pose_method import NoFixReason, Observation, Solution

# Any three points lie on a circle, whatever their error.
_LEAST_FOR_CIRCLE = 4
_REFINEMENTS = 10


def constant(observation: Observation) -> Solution | NoFixReason:
    """Method `constant`: position from the mean of the triangulated markers, pitch and yaw zero."""
    reason = stereo_fault(observation)
    if reason is not None:
        return reason
    index, points = triangulate_markers(observation)
    pose = pose_from_axis(points, observation.layout.centers_m[index], np.array([0.0, 0.0, 1.0]))
    return Solution(pose, paired_mask(observation))


def mean_plane(observation: Observation) -> Solution | NoFixReason:
    """Method `mean-plane`: position from the mean of the triangulated markers, attitude from their plane."""
    reason = stereo_fault(observation)
    if reason is not None:
        return reason
    index, points = triangulate_markers(observation)
    pose = pose_from_axis(points, observation.layout.centers_m[index], plane_normal(points))
    return Solution(pose, paired_mask(observation))


def disparity_plane(observation: Observation) -> Solution | NoFixReason:
    """Method `disparity-plane`: a plane fitted to the disparities, whose noise is uniform.

    On a plane, disparities are linear in the rays' slopes, and the coefficients are its normal up to scale. The markers
    are the intersections of their rays with the plane; the position is that of their mean.
    """
    reason = stereo_fault(observation)
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
    return Solution(pose_from_axis(points, observation.layout.centers_m[paired], axis), paired_mask(observation))


def pose_from_axis(points_m: Array, centers_m: Array, axis: Array) -> RigidTransform:
    """Pose with a given axis that maps the mean of (K, 3) markers to the mean of (K, 3) points.

    The roll aligns the markers with the points. With missing markers the means differ from the drogue's origin.
    """
    mean_m = points_m.mean(axis=0)
    unrolled = rotations_from_axes(axis[None])
    rotation = align_roll(unrolled, points_m, mean_m[None], centers_m - centers_m.mean(axis=0))[0]
    return RigidTransform(rotation, mean_m - rotation @ centers_m.mean(axis=0))


def circle_fit(observation: Observation) -> Solution | NoFixReason:
    """Method `circle-fit`: total-least-squares plane of the triangulated markers, and a circle of free radius in it."""
    reason = stereo_fault(observation)
    if reason is not None:
        return reason
    if observation.layout.ring_radius_m is None:
        return NoFixReason("a circle fit needs all markers on one circle about the drogue's origin")
    index, points = triangulate_markers(observation)
    if len(index) < _LEAST_FOR_CIRCLE:
        return NoFixReason(f"{len(index)} markers in both eyes, a circle fit needs {_LEAST_FOR_CIRCLE}")
    unrolled = rotations_from_axes(plane_normal(points)[None])
    mean = points.mean(axis=0)
    center = fit_circle_center((points - mean) @ unrolled[0, :, :2])
    if center is None:
        return NoFixReason("the triangulated markers lie on no circle")
    origin = mean + unrolled[0, :, :2] @ center
    if origin[2] <= 0:
        return NoFixReason("the circle's centre lies behind the cameras")
    rotation = align_roll(unrolled, points, origin[None], observation.layout.centers_m[index])[0]
    return Solution(RigidTransform(rotation, origin), paired_mask(observation))


def fit_circle_center(points_m: Array) -> Array | None:
    """(2,) centre of the circle through (K, 2) points, or None where they lie on a line.

    Kasa's algebraic circle, refined by Gauss-Newton on the distances; the refinement is used if it fits better.
    """
    design = np.column_stack([2 * points_m, np.ones(len(points_m))])
    squares = (points_m**2).sum(axis=1)
    solution, _, rank, _ = np.linalg.lstsq(design, squares, rcond=None)
    if rank < 3:
        return None
    initial: Array = solution[:2]
    center: Array = initial.copy()
    for _ in range(_REFINEMENTS):
        offsets = points_m - center
        distance = np.linalg.norm(offsets, axis=1)
        if not distance.min() > 0:
            break
        direction = offsets / distance[:, None]
        # The best radius is the mean distance, which is eliminated from residuals and derivatives.
        slopes = direction - direction.mean(axis=0)
        center = center + np.linalg.lstsq(slopes, distance - distance.mean(), rcond=None)[0]
    refined = np.isfinite(center).all() and _distance_deviation(points_m, center) <= _distance_deviation(
        points_m, initial
    )
    return center if refined else initial


def _distance_deviation(points_m: Array, center: Array) -> float:
    return float(np.linalg.norm(points_m - center, axis=1).std())
