"""Method `circle-fit`: a circle of free radius through the triangulated markers.

What the literature on spatial circle fitting is known for; its full texts were not available, so this is a
reconstruction (Xie and Wang 2011, binocular; Wang et al. 2020).
"""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array, RigidTransform
from nav.pose.faults import fault
from nav.pose.pose_method import NoFixReason, Observation, Solution
from nav.pose.prediction import plane_normal, rotations_with_axis, triangulate_pairs, used_pairs, with_best_roll

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
