"""What a filter tells at one time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets_manifest.types.estimates import Estimate, Mode, Motion, PoseEstimate
from geometry.se3 import Array, RigidTransform, read_only
from nav.filtering.hypotheses import Bank, Hypothesis, bank_covariance
from nav.filtering.pose_measurement import pose_difference

_POSE = 6
# Chi-square below which two poses are one fix of the same mode; six degrees of freedom, beyond it one of a million.
_SAME_POSE = 38.3
# What of a measured estimate does not change when it is filtered.
_MEASURED = ("features", "stage_s", "regions", "latency_s")


@dataclass(frozen=True, eq=False)
class FilterState:
    """Pose and motion of the drogue against the left camera.

    Attributes:
        time_s: when. [s]
        left_from_drogue: pose as the camera sees it; of the equivalent rolls one that goes on from fix to fix.
        velocity_m_s: (3,) of the drogue's origin in the left camera's axes, without its vibration. [m/s]
        rate_rad_s: (3,) of its attitude, `R' = [rate]x R`, without its vibration. [rad/s]
        covariance: (12, 12) of pose, velocity and rate in this order, in the tangent of
            `datasets_manifest.types.estimates`. [m, rad, m/s, rad/s]
        modes: the poses of all explanations that live, the best first.
        coasted_s: since the last fix. [s]
    """

    time_s: float
    left_from_drogue: RigidTransform
    velocity_m_s: Array
    rate_rad_s: Array
    covariance: Array
    modes: tuple[Mode, ...] = ()
    coasted_s: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity_m_s", read_only(self.velocity_m_s, (3,), "velocity_m_s"))
        object.__setattr__(self, "rate_rad_s", read_only(self.rate_rad_s, (3,), "rate_rad_s"))
        object.__setattr__(self, "covariance", read_only(self.covariance, (12, 12), "covariance"))

    def to_estimate(self, frame_index: int, method: str, measured: Estimate | None = None) -> PoseEstimate:
        """As an ordinary estimate.

        Args:
            frame_index: of the pair that it is for.
            method: full name, such as `joint-hub+filter`.
            measured: what was measured in that pair; its features, regions and times go along.
        """
        estimate = PoseEstimate(
            frame_index=frame_index,
            method=method,
            left_from_drogue=self.left_from_drogue,
            covariance=self.covariance[:_POSE, :_POSE],
            modes=self.modes,
            motion=Motion(
                velocity_m_s=tuple(self.velocity_m_s.tolist()),
                rate_rad_s=tuple(self.rate_rad_s.tolist()),
                covariance=self.covariance[_POSE:, _POSE:],
            ),
        )
        if measured is None:
            return estimate
        return estimate.model_copy(update={name: getattr(measured, name) for name in _MEASURED})


def state_of(bank: Bank, time_s: float, coasted_s: float) -> FilterState:
    """The best hypothesis, with a covariance that covers all."""
    best = bank[0].state
    return FilterState(
        time_s=time_s,
        left_from_drogue=best.pose,
        velocity_m_s=best.velocity_m_s,
        rate_rad_s=best.rate_rad_s,
        covariance=bank_covariance(bank),
        modes=_modes(bank),
        coasted_s=coasted_s,
    )


def _modes(bank: Bank) -> tuple[Mode, ...]:
    """The poses of all explanations; those of one mode of the last fix that differ in their motion alone share one."""
    different: list[tuple[Hypothesis, float]] = []
    for one in bank:
        same = next((at for at, (other, _) in enumerate(different) if _is_same_pose(other, one)), None)
        if same is None:
            different.append((one, one.weight))
        else:
            different[same] = (different[same][0], different[same][1] + one.weight)
    ordered = [different[0], *sorted(different[1:], key=lambda each: -each[1])]
    return tuple(Mode(left_from_drogue=one.state.pose, weight=min(weight, 1.0)) for one, weight in ordered)


def _is_same_pose(one: Hypothesis, other: Hypothesis) -> bool:
    if one.mode != other.mode:
        return False
    covariance = sum(each.state.told_covariance[:_POSE, :_POSE] for each in (one, other))
    away = pose_difference(one.state.pose, other.state.pose)
    return float(away @ np.linalg.solve(covariance, away)) < _SAME_POSE
