"""A bounded bank of hypotheses, each a Gaussian with a weight.

They differ in the modes of the measured poses that they follow, and in when the receiver turned: between two
measurements each may go on as before, and begin or end a turn. Each also estimates how rough the air is: a factor on
the acceleration densities. No single setting suits calm and severe air, whose densities differ by a factor of sixteen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from scipy.special import chdtri

from geometry.se3 import Array
from nav.filtering.measurement_update import (
    Innovation,
    PoseMeasurement,
    compute_innovation,
    correct_state,
    initial_state,
    nearest_roll,
    pose_difference,
)
from nav.filtering.motion_model import SIZE, FilterSettings, MotionState, PredictionStep, propagate, symmetric

# Variance of the factor's logarithm before the first measurement: the density of severe air is four times that of
# moderate air.
_INITIAL_VARIANCE = 1.0
# The logarithm stays within the first, and no single measurement moves it by more than the second: factors of 100, 3.
_LARGEST_LOG, _LARGEST_STEP = 4.6, 1.0
_POSE_DEGREES = 6
# Hypotheses whose motions differ by less than this many standard deviations, all axes together, are merged.
_SAME_MOTION_SIGMAS = 1.0


@dataclass(frozen=True, eq=False)
class ProcessNoiseScale:
    """Estimated factor on the acceleration densities of the settings.

    The logarithm of the factor is a random walk. Each innovation moves it along the gradient of the innovation's
    likelihood, by as much as the innovation is informative.

    Attributes:
        log_factor: logarithm of the factor.
        variance: of the logarithm.
        sensitivity: (18, 18) derivative of the state's covariance by the logarithm.
    """

    log_factor: float = 0.0
    variance: float = _INITIAL_VARIANCE
    sensitivity: Array = field(default_factory=lambda: np.zeros((SIZE, SIZE)))

    @property
    def factor(self) -> float:
        """Factor on the densities of the settings."""
        return float(np.exp(self.log_factor))

    def propagated(self, step: PredictionStep, duration_s: float, settings: FilterSettings) -> ProcessNoiseScale:
        """The estimate after a prediction step; vibration and turns of the receiver do not scale with the air. [s]"""
        return ProcessNoiseScale(
            log_factor=self.log_factor,
            variance=self.variance + duration_s * settings.noise_scale_variance_per_s,
            sensitivity=symmetric(step.transition @ self.sensitivity @ step.transition.T) + step.air_noise,
        )

    def updated(self, innovation: Innovation, error_factor: Array, settings: FilterSettings) -> ProcessNoiseScale:
        """The estimate after an accepted measurement.

        Args:
            innovation: of the measurement.
            error_factor: (18, 18) `F = I - K H` of the correction.
            settings: the factor is not estimated where its variance does not grow.

        Source: score and Fisher information of a zero-mean Gaussian's covariance. The gain is optimal, so that the
        derivative of the corrected covariance is `F D F^T` with the sensitivity `D`.
        """
        sensitivity = symmetric(error_factor @ self.sensitivity @ error_factor.T)
        if settings.noise_scale_variance_per_s == 0:
            return ProcessNoiseScale(self.log_factor, self.variance, sensitivity)
        by_log = innovation.jacobian @ self.sensitivity @ innovation.jacobian.T
        whitened = innovation.whitener @ by_log @ innovation.whitener.T
        score = float(innovation.whitened @ whitened @ innovation.whitened - np.trace(whitened)) / 2
        variance = 1 / (1 / self.variance + float((whitened * whitened).sum()) / 2)
        log_factor = self.log_factor + float(np.clip(variance * score, -_LARGEST_STEP, _LARGEST_STEP))
        return ProcessNoiseScale(float(np.clip(log_factor, -_LARGEST_LOG, _LARGEST_LOG)), variance, sensitivity)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One explanation of the measurements so far.

    Attributes:
        state: the motion under this hypothesis.
        weight: its probability; the weights of a bank sum to 1.
        parent: index of its parent in the bank before, -1 for an initial one.
        process_noise_scale: how rough the air is.
        is_turning: whether the receiver begins or ends a turn.
        step: from its parent to here; None for an initial one.
        mode: index of the mode that it takes of the last measurement.
    """

    state: MotionState
    weight: float
    parent: int = -1
    process_noise_scale: ProcessNoiseScale = field(default_factory=ProcessNoiseScale)
    is_turning: bool = False
    step: PredictionStep | None = None
    mode: int = 0


Bank = tuple[Hypothesis, ...]


@dataclass(frozen=True, eq=False)
class BankUpdate:
    """Result of correcting a bank by a measurement.

    Attributes:
        bank: afterwards, the most likely first; None where no hypothesis passed the gate.
        nis: normalised innovation squared of the most likely hypothesis; where none passed the gate, the smallest.
    """

    bank: Bank | None
    nis: float


@dataclass(frozen=True, eq=False)
class _Association:
    """A hypothesis with one mode of a measurement, before the correction."""

    log_weight: float
    hypothesis: Hypothesis
    innovation: Innovation


def initial_bank(measurement: PoseMeasurement, settings: FilterSettings) -> Bank:
    """One hypothesis for each mode of a first measurement, up to the number of the settings."""
    modes = list(zip(measurement.poses, measurement.weights, strict=True))[: settings.most_hypotheses]
    total = sum(weight for _, weight in modes)
    return tuple(
        Hypothesis(initial_state(pose, measurement.covariance, settings), weight / total, mode=mode)
        for mode, (pose, weight) in enumerate(modes)
    )


def propagate_bank(
    bank: Bank, duration_s: float, settings: FilterSettings, span_s: float | None = None, branches: bool = False
) -> Bank:
    """Predict a bank over a time.

    Args:
        bank: before.
        duration_s: of the step. [s]
        settings: densities.
        span_s: time between the measurements before and after, where that is longer than the step. [s]
        branches: whether each hypothesis goes on both with and without a turn of the receiver; else as it is.
    """
    span_s = duration_s if span_s is None else span_s
    density_factor = 1 + settings.long_term_excess * -float(np.expm1(-span_s / settings.correlation_s))
    propagated = []
    for index, parent in enumerate(bank):
        turns = _turn_branches(parent.is_turning, span_s, settings) if branches else [(parent.is_turning, 1.0)]
        for is_turning, probability in turns:
            turn_rad2_s3 = density_factor * settings.turn_rad2_s3 if is_turning else 0.0
            factor = density_factor * parent.process_noise_scale.factor
            step = propagate(parent.state, duration_s, settings, factor, turn_rad2_s3)
            propagated.append(
                Hypothesis(
                    state=step.state,
                    weight=probability * parent.weight,
                    parent=index,
                    process_noise_scale=parent.process_noise_scale.propagated(step, duration_s, settings),
                    is_turning=is_turning,
                    step=step,
                    mode=parent.mode,
                )
            )
    return tuple(propagated)


def _turn_branches(is_turning: bool, span_s: float, settings: FilterSettings) -> list[tuple[bool, float]]:
    """Whether the receiver turns after a time, each with its probability; impossible branches are left out."""
    changes_per_s = 1 / settings.turn_s if is_turning else settings.turns_per_s
    change_probability = -float(np.expm1(-changes_per_s * span_s))
    branches = ((is_turning, 1 - change_probability), (not is_turning, change_probability))
    return [(turns, probability) for turns, probability in branches if probability > 0]


def correct_bank(bank: Bank, measurement: PoseMeasurement, settings: FilterSettings, symmetry_order: int) -> BankUpdate:
    """Correct every hypothesis by every mode of a measurement, and keep the likely ones.

    Args:
        bank: at the time of the measurement.
        measurement: the measured modes.
        settings: gate and bounds.
        symmetry_order: of the drogue's markers.
    """
    gate = _chi2_gate(settings.gate_probability)
    smallest_nis, associations = np.inf, list[_Association]()
    for hypothesis in bank:
        for mode, (pose, weight) in enumerate(zip(measurement.poses, measurement.weights, strict=True)):
            rolled = nearest_roll(pose, hypothesis.state.pose.rotation, symmetry_order)
            innovation = compute_innovation(hypothesis.state, rolled, measurement.covariance)
            smallest_nis = min(smallest_nis, innovation.nis)
            if innovation.nis <= gate:
                log_weight = np.log(hypothesis.weight) + np.log(weight) + innovation.log_likelihood
                associations.append(_Association(float(log_weight), replace(hypothesis, mode=mode), innovation))
    if not associations:
        return BankUpdate(None, smallest_nis)
    likeliest = max(associations, key=lambda association: association.log_weight)
    return BankUpdate(_merge_and_prune(associations, measurement.covariance, settings), likeliest.innovation.nis)


@lru_cache(maxsize=16)
def _chi2_gate(probability: float) -> float:
    """Chi-square of a pose that a good measurement stays below with a probability."""
    return float(chdtri(_POSE_DEGREES, 1 - probability))


def _merge_and_prune(associations: Sequence[_Association], covariance: Array, settings: FilterSettings) -> Bank:
    """The most likely associations, corrected; those of the same motion as a more likely one are merged into it."""
    ordered = sorted(associations, key=lambda association: -association.log_weight)
    kept: list[Hypothesis] = []
    for association in ordered:
        prior = association.hypothesis
        weight = float(np.exp(association.log_weight - ordered[0].log_weight))
        if weight < settings.least_weight or len(kept) == settings.most_hypotheses:
            break
        correction = correct_state(prior.state, association.innovation, covariance)
        same = next(
            (i for i, other in enumerate(kept) if _is_same_motion(other, prior.is_turning, correction.state)), None
        )
        if same is None:
            scale = prior.process_noise_scale.updated(association.innovation, correction.error_factor, settings)
            kept.append(replace(prior, state=correction.state, weight=weight, process_noise_scale=scale))
        else:
            kept[same] = replace(kept[same], weight=kept[same].weight + weight)
    total = sum(hypothesis.weight for hypothesis in kept)
    normalized = [replace(hypothesis, weight=hypothesis.weight / total) for hypothesis in kept]
    return tuple(sorted(normalized, key=lambda hypothesis: -hypothesis.weight))


def _is_same_motion(hypothesis: Hypothesis, is_turning: bool, state: MotionState) -> bool:
    """Whether a hypothesis and another state agree within their covariances, and both turn or neither does."""
    if hypothesis.is_turning != is_turning:
        return False
    covariance = symmetric(hypothesis.state.reported_covariance + state.reported_covariance)
    difference = reported_difference(hypothesis.state, state)
    return float(difference @ np.linalg.solve(covariance, difference)) < _SAME_MOTION_SIGMAS**2


def reported_difference(start: MotionState, end: MotionState) -> Array:
    """(12,) difference of pose, velocity and rate from one state to another."""
    return np.concatenate(
        [
            pose_difference(start.pose, end.pose),
            end.velocity_m_s - start.velocity_m_s,
            end.rate_rad_s - start.rate_rad_s,
        ]
    )


def bank_covariance(bank: Bank) -> Array:
    """(12, 12) second moment of the mixture's pose, velocity and rate about the most likely hypothesis."""
    best = bank[0].state
    moment = bank[0].weight * best.reported_covariance
    for hypothesis in bank[1:]:
        difference = reported_difference(best, hypothesis.state)
        moment += hypothesis.weight * (hypothesis.state.reported_covariance + np.outer(difference, difference))
    return symmetric(moment)
