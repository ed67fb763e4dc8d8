"""Method `constant`: the triangulated markers' mean and no tilt at all, the guess that every attitude has to beat."""

from __future__ import annotations

import numpy as np

from nav.pose.faults import fault
from nav.pose.mean_plane import pose_about_mean
from nav.pose.pose_method import NoFixReason, Observation, Solution
from nav.pose.prediction import triangulate_pairs, used_pairs


def constant(observation: Observation) -> Solution | NoFixReason:
    """Position from the mean of the triangulated markers, pitch and yaw zero."""
    reason = fault(observation)
    if reason is not None:
        return reason
    index, points = triangulate_pairs(observation)
    pose = pose_about_mean(points, observation.layout.centers_m[index], np.array([0.0, 0.0, 1.0]))
    return Solution(pose, used_pairs(observation))
