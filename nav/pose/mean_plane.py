"""Method `mean-plane`: the triangulated markers' mean, and the plane through them."""

from __future__ import annotations

from geometry.se3 import Array, RigidTransform
from nav.pose.faults import fault
from nav.pose.pose_method import NoFixReason, Observation, Solution
from nav.pose.prediction import plane_normal, rotations_with_axis, triangulate_pairs, used_pairs, with_best_roll


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
