"""Method `mono-lm`: the adjustment to the left eye alone."""

from __future__ import annotations

from nav.pose.faults import left_fault
from nav.pose.features import left_features
from nav.pose.interface import NoFixReason, Observation, Solution
from nav.pose.joint import solve_one
from nav.pose.prediction import used_left

# Three image points have up to four poses.
LEAST_MARKERS = 4


def mono_lm(observation: Observation) -> Solution | NoFixReason:
    """As `joint`, of the markers in the left eye; depth comes from the ring's known radius."""
    return left_fault(observation, LEAST_MARKERS) or solve_one(left_features(observation), used_left(observation))
