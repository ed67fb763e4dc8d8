"""How rough the air is: a factor on the densities of acceleration, learned from what the predictions miss.

One setting cannot suit calm and severe air, where densities differ by a factor of sixteen. The logarithm of the factor
walks at random; each innovation moves it along the gradient of its likelihood, by as much as it tells.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from geometry.se3 import Array
from nav.filtering.correction import Innovation
from nav.filtering.error_state import SIZE, symmetric
from nav.filtering.filter_settings import FilterSettings
from nav.filtering.motion_model import Step

# Variance of the factor's logarithm before the first fix: severe air has four times the density of moderate air.
_START_VARIANCE = 1.0
# The logarithm stays within this, and no single fix moves it by more than one: factors of 100 and 3.
_LARGEST_LOG, _LARGEST_STEP = 4.6, 1.0


@dataclass(frozen=True, eq=False)
class Agitation:
    """What is known of the factor.

    Attributes:
        log_factor: its logarithm.
        variance: of the logarithm.
        sensitivity: (18, 18) derivative of the state's covariance by the logarithm.
    """

    log_factor: float = 0.0
    variance: float = _START_VARIANCE
    sensitivity: Array = field(default_factory=lambda: np.zeros((SIZE, SIZE)))

    @property
    def factor(self) -> float:
        """On the densities of the settings."""
        return float(np.exp(self.log_factor))

    def advanced(self, step: Step, duration_s: float, settings: FilterSettings) -> Agitation:
        """After a step in time; neither vibration nor a turn of the receiver's scales with the air. [s]"""
        return Agitation(
            self.log_factor,
            self.variance + duration_s * settings.agitation_per_s,
            symmetric(step.transition @ self.sensitivity @ step.transition.T) + step.rough,
        )

    def learned(self, innovation: Innovation, kept: Array, settings: FilterSettings) -> Agitation:
        """After a fix that was taken.

        Args:
            innovation: of the fix.
            kept: (18, 18) `I - K H` of the correction.
            settings: whether to learn at all.

        Source: score and Fisher information of a zero-mean Gaussian's covariance; that the gain is stationary makes the
        derivative of the corrected covariance `kept D kept^T`.
        """
        sensitivity = symmetric(kept @ self.sensitivity @ kept.T)
        if settings.agitation_per_s == 0:
            return Agitation(self.log_factor, self.variance, sensitivity)
        by_log = innovation.jacobian @ self.sensitivity @ innovation.jacobian.T
        white = innovation.whitener @ by_log @ innovation.whitener.T
        score = float(innovation.white @ white @ innovation.white - np.trace(white)) / 2
        variance = 1 / (1 / self.variance + float((white * white).sum()) / 2)
        moved = self.log_factor + float(np.clip(variance * score, -_LARGEST_STEP, _LARGEST_STEP))
        return Agitation(float(np.clip(moved, -_LARGEST_LOG, _LARGEST_LOG)), variance, sensitivity)
