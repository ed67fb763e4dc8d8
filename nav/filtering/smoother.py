"""Motion from all fixes of a sequence that is over, those after a time as well as those before it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from datasets_manifest.types.estimates import Estimate, NoFix, PoseEstimate
from nav.filtering.hypotheses import Bank, Hypothesis, advance_bank, correct_bank, first_bank
from nav.filtering.measurement_update import Fix, fix_of
from nav.filtering.motion_model import SIZE, FilterSettings, MotionState, Step
from nav.filtering.pose_filter import Memory, state_of, take
from nav.pose.pose_method import NoFixReason

SMOOTHER_SUFFIX = "+smoother"
Times = np.ndarray[tuple[int], np.dtype[np.float64]]


def smooth(
    times_s: Sequence[float], estimates: Sequence[Estimate], settings: FilterSettings, symmetry_order: int
) -> list[Estimate]:
    """Smoothed estimates of one sequence.

    Pairs without a fix get one where fixes stand on both sides, no more than `max_coast_s` apart; fixes that the filter
    rejects count as none.

    Args:
        times_s: (N,) of the pairs, each later than the one before. [s]
        estimates: (N,) of one method.
        settings: as of the filter.
        symmetry_order: of the drogue's markers.

    Returns:
        One estimate for each, of a method with `+smoother` after its name.

    Raises:
        ValueError: times that are not as many, not finite, or do not ascend.

    Source: H. E. Rauch, F. Tung, C. T. Striebel, AIAA Journal 3(8), 1965, doi:10.2514/3.3166, on errors.
    """
    times = np.asarray(times_s, dtype=np.float64)
    if times.shape != (len(estimates),):
        raise ValueError(f"times_s: must be one for each of {len(estimates)} estimates, got shape {times.shape}")
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise ValueError("times_s: must be finite and ascend")
    fixes = [_usable(estimate, settings, symmetry_order) for estimate in estimates]
    answers: list[Estimate] = [_without(estimate, fix) for estimate, fix in zip(estimates, fixes, strict=True)]
    for members in _motions(times, fixes, settings, symmetry_order):
        first, last = members[0], members[-1]
        taken = {place - first: fix for place in members if isinstance(fix := fixes[place], Fix)}
        banks = _forward(times[first : last + 1], taken, settings, symmetry_order)
        for place, bank in enumerate(_backward(banks), start=first):
            coasted_s = float(np.abs(times[members] - times[place]).min())
            state, measured = state_of(bank, float(times[place]), coasted_s), estimates[place]
            answers[place] = state.to_estimate(measured.frame_index, _name(measured), measured)
    return answers


def _name(estimate: Estimate) -> str:
    return estimate.method + SMOOTHER_SUFFIX


def _usable(estimate: Estimate, settings: FilterSettings, symmetry_order: int) -> Fix | NoFixReason:
    if isinstance(estimate, PoseEstimate):
        return fix_of(estimate, symmetry_order, settings.least_weight)
    return NoFixReason(estimate.reason)


def _without(estimate: Estimate, fix: Fix | NoFixReason) -> NoFix:
    """The answer where no motion reaches."""
    reason = fix.reason if isinstance(fix, NoFixReason) else "outside the gate of the motion before and after"
    return NoFix(
        frame_index=estimate.frame_index,
        method=_name(estimate),
        reason=reason,
        features=estimate.features,
        stage_s=estimate.stage_s,
        regions=estimate.regions,
        latency_s=estimate.latency_s,
    )


def _motions(
    times: Times, fixes: Sequence[Fix | NoFixReason], settings: FilterSettings, symmetry_order: int
) -> list[list[int]]:
    """Places of the fixes that belong to each of the motions which the filter tells one after the other."""
    memory, motions, tried = Memory(), list[list[int]](), list[int]()
    for place, fix in enumerate(fixes):
        if isinstance(fix, NoFixReason):
            continue
        tried.append(place)
        taken = take(memory, float(times[place]), fix, settings, symmetry_order)
        memory = taken.memory
        if taken.starts and memory.track is not None:
            motions.append(tried[-memory.track.fixes :])
        elif taken.accepted:
            motions[-1].append(place)
    return motions


def _forward(times: Times, fixes: Mapping[int, Fix], settings: FilterSettings, symmetry_order: int) -> list[Bank]:
    """The filter over one motion: the bank at each time, after its fix if any; the first place has one."""
    banks, with_fix = [first_bank(fixes[0], settings)], times[sorted(fixes)]
    branches = True
    for place in range(1, len(times)):
        later = int(np.searchsorted(with_fix, times[place]))
        span_s = float(with_fix[later] - with_fix[later - 1])
        # Whether the receiver turns is settled anew after each fix, as in the filter.
        bank = advance_bank(banks[-1], float(times[place] - times[place - 1]), settings, span_s, branches)
        corrected = correct_bank(bank, fixes[place], settings, symmetry_order).bank if place in fixes else None
        branches = corrected is not None
        banks.append(corrected or bank)
    return banks


def _backward(banks: Sequence[Bank]) -> list[Bank]:
    """Smoothed banks: every explanation that lives at the end, each followed back through its parents."""
    last = banks[-1]
    told, lines, smoothed = [last], list(last), [one.state for one in last]
    for before in reversed(banks[:-1]):
        parents = [before[one.parent] for one in lines]
        smoothed = [
            _smoothed(parent.state, one.step, state)
            for parent, one, state in zip(parents, lines, smoothed, strict=True)
            if one.step is not None
        ]
        lines = parents
        told.append(tuple(Hypothesis(state, one.weight) for state, one in zip(smoothed, last, strict=True)))
    return told[::-1]


def _smoothed(filtered: MotionState, step: Step, later: MotionState) -> MotionState:
    """A filtered state with what a smoothed one after the next step tells.

    The covariance is in the form that is a sum of squares, so that rounding leaves it positive definite.
    """
    predicted = step.state.covariance
    scale = np.sqrt(np.diag(predicted))
    factor = cho_factor(predicted / np.outer(scale, scale), lower=True)
    gain = cho_solve(factor, step.transition @ filtered.covariance / scale[:, None]).T / scale
    kept = np.eye(SIZE) - gain @ step.transition
    covariance = kept @ filtered.covariance @ kept.T + gain @ (step.noise + later.covariance) @ gain.T
    return filtered.moved(gain @ step.state.error_of(later), covariance)
