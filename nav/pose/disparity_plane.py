"""Method `disparity-plane`: the plane fitted where its noise is even, in disparity."""

from __future__ import annotations

import numpy as np

from nav.pose.faults import fault
from nav.pose.mean_plane import pose_about_mean
from nav.pose.pose_method import NoFixReason, Observation, Solution
from nav.pose.prediction import used_pairs


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
