"""A bounded bank of hypotheses, each a Gaussian with a weight.

They differ in the modes of the measured poses that they follow, and in when the receiver turned: between two
measurements each may go on as before, and begin or end a turn. Each also learns how rough the air is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from scipy.special import chdtri

from geometry.se3 import Array
from nav.filtering.measurement_update import (
    Fix,
    Innovation,
    correct,
    first_state,
    innovation_of,
    nearest_roll,
    pose_difference,
)
from nav.filtering.motion_model import SIZE, FilterSettings, MotionState, Step, advance, symmetric

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


_POSE_DEGREES = 6
# Hypotheses whose poses are nearer than this in their deviations say the same. (One deviation, all axes together.)
_SAME_SIGMAS = 1.0


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One explanation of the fixes so far.

    Attributes:
        state: the motion that it tells.
        weight: its share; shares of a bank sum to 1.
        parent: its place in the bank before, -1 for a first one.
        agitation: how rough it takes the air to be.
        turning: whether the receiver turns aside or back.
        step: from its parent to here; None for a first one.
        mode: place of its mode in the last fix.
    """

    state: MotionState
    weight: float
    parent: int = -1
    agitation: Agitation = field(default_factory=Agitation)
    turning: bool = False
    step: Step | None = None
    mode: int = 0


Bank = tuple[Hypothesis, ...]


@dataclass(frozen=True, eq=False)
class BankUpdate:
    """A fix in a bank.

    Attributes:
        bank: afterwards, the best first; None where no explanation passed the gate.
        nis: chi-square of the fix in the best explanation; where none passed the gate, in the nearest.
    """

    bank: Bank | None
    nis: float


def first_bank(fix: Fix, settings: FilterSettings) -> Bank:
    """One hypothesis for each mode of a first fix, as many as are allowed."""
    modes = list(zip(fix.poses, fix.weights, strict=True))[: settings.most_hypotheses]
    total = sum(weight for _, weight in modes)
    return tuple(
        Hypothesis(first_state(pose, fix.covariance, settings), weight / total, mode=mode)
        for mode, (pose, weight) in enumerate(modes)
    )


def advance_bank(
    bank: Bank, duration_s: float, settings: FilterSettings, span_s: float | None = None, branches: bool = False
) -> Bank:
    """The bank after a time.

    Args:
        bank: before.
        duration_s: of the step. [s]
        settings: densities.
        span_s: between the fixes before and after it, where that is longer than the step. [s]
        branches: whether each hypothesis goes on both with and without a turn of the receiver; else as it is.
    """
    span_s = duration_s if span_s is None else span_s
    grown = 1 + settings.lasting * -float(np.expm1(-span_s / settings.lasting_s))
    moved = []
    for place, one in enumerate(bank):
        for turning, share in _branches(one.turning, span_s, settings) if branches else ((one.turning, 1.0),):
            turn_rad2_s3 = grown * settings.turn_rad2_s3 if turning else 0.0
            step = advance(one.state, duration_s, settings, grown * one.agitation.factor, turn_rad2_s3)
            agitation = one.agitation.advanced(step, duration_s, settings)
            moved.append(Hypothesis(step.state, share * one.weight, place, agitation, turning, step, one.mode))
    return tuple(moved)


def _branches(turning: bool, span_s: float, settings: FilterSettings) -> list[tuple[bool, float]]:
    """Whether the receiver turns after a time, and how likely that is: both ways, where both can be."""
    changes_per_s = 1 / settings.turn_s if turning else settings.turns_per_s
    changes = -float(np.expm1(-changes_per_s * span_s))
    return [(each, share) for each, share in ((turning, 1 - changes), (not turning, changes)) if share > 0]


def correct_bank(bank: Bank, fix: Fix, settings: FilterSettings, symmetry_order: int) -> BankUpdate:
    """Every hypothesis with every mode of a fix; the likely ones are kept.

    Args:
        bank: at the time of the fix.
        fix: the measured modes.
        settings: gate and bounds.
        symmetry_order: of the drogue's markers.
    """
    gate = _gate(settings.gate_probability)
    nearest, pairs = np.inf, []
    for hypothesis in bank:
        for mode, (pose, weight) in enumerate(zip(fix.poses, fix.weights, strict=True)):
            rolled = nearest_roll(pose, hypothesis.state.pose.rotation, symmetry_order)
            innovation = innovation_of(hypothesis.state, rolled, fix.covariance)
            nearest = min(nearest, innovation.nis)
            if innovation.nis <= gate:
                log_weight = np.log(hypothesis.weight) + np.log(weight) + innovation.log_likelihood
                pairs.append((float(log_weight), replace(hypothesis, mode=mode), innovation))
    if not pairs:
        return BankUpdate(None, nearest)
    likeliest = max(pairs, key=lambda pair: pair[0])
    return BankUpdate(_survivors(pairs, fix.covariance, settings), likeliest[2].nis)


@lru_cache(maxsize=16)
def _gate(probability: float) -> float:
    """What the chi-square of a good fix exceeds with one less the probability."""
    return float(chdtri(_POSE_DEGREES, 1 - probability))


def _survivors(
    pairs: Sequence[tuple[float, Hypothesis, Innovation]], covariance: Array, settings: FilterSettings
) -> Bank:
    """The likeliest pairs, corrected, without those that say what a likelier one says."""
    ordered = sorted(pairs, key=lambda pair: -pair[0])
    kept: list[Hypothesis] = []
    for log_weight, parent, innovation in ordered:
        weight = float(np.exp(log_weight - ordered[0][0]))
        if weight < settings.least_weight or len(kept) == settings.most_hypotheses:
            break
        correction = correct(parent.state, innovation, covariance)
        same = next((at for at, other in enumerate(kept) if _same(other, parent.turning, correction.state)), None)
        if same is None:
            agitation = parent.agitation.learned(innovation, correction.kept, settings)
            kept.append(replace(parent, state=correction.state, weight=weight, agitation=agitation))
        else:
            kept[same] = replace(kept[same], weight=kept[same].weight + weight)
    total = sum(hypothesis.weight for hypothesis in kept)
    shares = [replace(hypothesis, weight=hypothesis.weight / total) for hypothesis in kept]
    return tuple(sorted(shares, key=lambda hypothesis: -hypothesis.weight))


def _same(one: Hypothesis, turning: bool, state: MotionState) -> bool:
    """Whether the pose and motion of a hypothesis and another cannot be told apart, and both turn or neither."""
    if one.turning != turning:
        return False
    covariance = symmetric(one.state.told_covariance + state.told_covariance)
    away = told_difference(one.state, state)
    return float(away @ np.linalg.solve(covariance, away)) < _SAME_SIGMAS**2


def told_difference(one: MotionState, other: MotionState) -> Array:
    """(12,) difference of pose, velocity and rate from one state to another."""
    return np.concatenate(
        [
            pose_difference(one.pose, other.pose),
            other.velocity_m_s - one.velocity_m_s,
            other.rate_rad_s - one.rate_rad_s,
        ]
    )


def bank_covariance(bank: Bank) -> Array:
    """(12, 12) second moment of pose, velocity and rate about the best hypothesis: it covers the others too."""
    best = bank[0].state
    moment = bank[0].weight * best.told_covariance
    for hypothesis in bank[1:]:
        away = told_difference(best, hypothesis.state)
        moment += hypothesis.weight * (hypothesis.state.told_covariance + np.outer(away, away))
    return symmetric(moment)
