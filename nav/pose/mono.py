"""Method `mono-lm`: the adjustment to one eye alone."""

from __future__ import annotations

from nav.pose.features import left_features
from nav.pose.joint import solve_one
from nav.pose.mono_eye import solve_with_one_eye
from nav.pose.pose_method import NoFixReason, Observation, Solution
from nav.pose.prediction import used_left

# Three image points have up to four poses.
LEAST_MARKERS = 4


def mono_lm(observation: Observation) -> Solution | NoFixReason:
    """As `joint`, of the markers in one eye; depth comes from the ring's known radius."""
    return solve_with_one_eye(observation, LEAST_MARKERS, _solve)


def _solve(observation: Observation) -> Solution | NoFixReason:
    return solve_one(left_features(observation), used_left(observation))
