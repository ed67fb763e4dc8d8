"""What a filter assumes of the motion, and when it gives up."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

_MOST_HYPOTHESES = 16
_MAY_BE_ZERO = (
    "lasting",
    "vibration_m",
    "vibration_rad",
    "agitation_per_s",
    "turns_per_s",
    "max_coast_s",
    "max_delay_s",
)


@dataclass(frozen=True)
class FilterSettings:
    """Densities of white acceleration, vibration, and the filter's limits; sources: docs/explanation/filtering.md.

    Attributes:
        acceleration_m2_s3: density of the drogue's acceleration against the receiver, along each axis. [m^2/s^3]
        swing_rad2_s3: density of the angular acceleration of the drogue's attitude. [rad^2/s^3]
        camera_rad2_s3: density of the camera's angular acceleration, which moves what is far away most. [rad^2/s^3]
        lasting: how much larger the densities are over a long time than over an instant, less one: accelerations that
            last add up, which white ones do not; 0 for white ones.
        lasting_s: how long they last. [s]
        vibration_m, vibration_rad: standard deviations of the camera's fast shaking along and about each axis.
        vibration_s: after this time the shaking is another one. [s]
        agitation_per_s: how fast the factor changes that rougher or calmer air puts on the three densities, as
            variance of its logarithm; 0 for air as the densities say. [1/s]
        turn_rad2_s3: density of the camera's angular acceleration while the receiver turns aside or back. [rad^2/s^3]
        turns_per_s: how often it begins to; 0 where it never does. [1/s]
        turn_s: how long it does. [s]
        start_speed_m_s, start_rate_rad_s, start_turn_rad_s: standard deviations along and about each axis at the first
            fix: of the drogue's speed and rate, and of the camera's rate, which moves what is far away most.
        gate_probability: share of good fixes that the chi-square gate lets pass.
        restart_fixes: after so many rejected fixes in a row that fit each other, these are believed.
        max_coast_s: how long after its last fix the filter still answers. [s]
        max_delay_s: how much later than a newer fix one may still arrive. [s]
        most_hypotheses: how many explanations of ambiguous fixes are followed.
        least_weight: share below which an explanation is dropped.
    """

    acceleration_m2_s3: float = 0.1
    swing_rad2_s3: float = 0.01
    camera_rad2_s3: float = 0.0003
    lasting: float = 3.0
    lasting_s: float = 0.2
    vibration_m: float = 0.0002
    vibration_rad: float = 0.00018
    vibration_s: float = 0.005
    agitation_per_s: float = 0.05
    turn_rad2_s3: float = 0.5
    turns_per_s: float = 0.001
    turn_s: float = 0.5
    start_speed_m_s: float = 3.0
    start_rate_rad_s: float = 0.5
    start_turn_rad_s: float = 1.0
    gate_probability: float = 0.999999
    restart_fixes: int = 5
    max_coast_s: float = 0.5
    max_delay_s: float = 1.0
    most_hypotheses: int = 4
    least_weight: float = 1e-3

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            # A motion without surprises would be a filter that stops listening.
            may_be_zero = field.name in _MAY_BE_ZERO
            if not np.isfinite(value) or value < 0 or (value == 0 and not may_be_zero):
                raise ValueError(f"{field.name}: must be positive and finite, got {value}")
        if not self.gate_probability < 1:
            raise ValueError(f"gate_probability: must be below 1, got {self.gate_probability}")
        if not self.least_weight < 1 / self.most_hypotheses:
            raise ValueError(f"least_weight: must be below 1 / most_hypotheses, got {self.least_weight}")
        if self.most_hypotheses > _MOST_HYPOTHESES:
            raise ValueError(f"most_hypotheses: must be at most {_MOST_HYPOTHESES}, got {self.most_hypotheses}")
