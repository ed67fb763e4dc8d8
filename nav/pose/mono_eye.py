"""Which eye a method works on that needs no more than one, and its answer in the left eye's frame.

The left eye is preferred; the right one, an equal camera at a known place, takes over where the left one shows too
little. Methods are written for the left eye: they are shown the right one in its place.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES
from nav.pose.faults import eye_fault
from nav.pose.pose_method import NoFixReason, Observation, PoseMethod, Solution

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
