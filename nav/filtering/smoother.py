"""Smoother: motion from all measurements of a finished sequence, those after a time as well as those before it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from datasets_manifest.types.estimates import Estimate, NoFix, PoseEstimate
from nav.filtering.hypotheses import Bank, Hypothesis, correct_bank, initial_bank, propagate_bank
from nav.filtering.measurement_update import PoseMeasurement, measurement_from_estimate
from nav.filtering.motion_model import SIZE, FilterSettings, MotionState, PredictionStep
from nav.filtering.pose_filter import TrackerState, summarize_bank, update
from nav.pose.pose_method import NoFixReason

SMOOTHER_SUFFIX = "+smoother"
Times = np.ndarray[tuple[int], np.dtype[np.float64]]


def smooth(
    times_s: Sequence[float], estimates: Sequence[Estimate], settings: FilterSettings, symmetry_order: int
) -> list[Estimate]:
    """Smoothed estimates of one sequence.

    A pair without a measurement gets a pose where there are measurements on both sides, no more than `max_coast_s`
    apart. Measurements that the filter rejects are ignored.

    Args:
        times_s: (N,) of the pairs, ascending. [s]
        estimates: (N,) of one method.
        settings: those of the filter.
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
    measurements = [_measurement(estimate, settings, symmetry_order) for estimate in estimates]
    smoothed: list[Estimate] = [_no_fix(*each) for each in zip(estimates, measurements, strict=True)]
    for members in _segments(times, measurements, settings, symmetry_order):
        first, last = members[0], members[-1]
        accepted = {
            index - first: measurement
            for index in members
            if isinstance(measurement := measurements[index], PoseMeasurement)
        }
        banks, used = _forward_pass(times[first : last + 1], accepted, settings, symmetry_order)
        for index, bank in enumerate(_backward_pass(banks), start=first):
            state = summarize_bank(bank, float(times[index]), len(members))
            estimate = estimates[index] if index - first in used else _without_use(estimates[index])
            smoothed[index] = state.to_estimate(estimate.frame_index, _name(estimate), estimate)
    return smoothed


def _without_use(estimate: Estimate) -> Estimate:
    """A rejected estimate, whose image points the smoothed pose is not computed from."""
    features = tuple(feature.model_copy(update={"used": False}) for feature in estimate.features)
    return estimate.model_copy(update={"features": features})


def _name(estimate: Estimate) -> str:
    return estimate.method + SMOOTHER_SUFFIX


def _measurement(estimate: Estimate, settings: FilterSettings, symmetry_order: int) -> PoseMeasurement | NoFixReason:
    if isinstance(estimate, PoseEstimate):
        return measurement_from_estimate(estimate, symmetry_order, settings.least_weight)
    return NoFixReason(estimate.reason)


def _no_fix(estimate: Estimate, measurement: PoseMeasurement | NoFixReason) -> NoFix:
    """The estimate of a pair outside all segments."""
    rejected = "outside the gate of the motion before and after"
    return NoFix(
        frame_index=estimate.frame_index,
        method=_name(estimate),
        reason=measurement.reason if isinstance(measurement, NoFixReason) else rejected,
        features=estimate.features,
        stage_s=estimate.stage_s,
        regions=estimate.regions,
        latency_s=estimate.latency_s,
    )


def _segments(
    times: Times, measurements: Sequence[PoseMeasurement | NoFixReason], settings: FilterSettings, symmetry_order: int
) -> list[list[int]]:
    """Indices of the accepted measurements of each motion that the filter reports, one motion after the other."""
    tracker_state, segments, processed = TrackerState(), list[list[int]](), list[int]()
    for index, measurement in enumerate(measurements):
        if isinstance(measurement, NoFixReason):
            continue
        processed.append(index)
        result = update(tracker_state, float(times[index]), measurement, settings, symmetry_order)
        tracker_state = result.tracker_state
        if result.starts and tracker_state.track is not None:
            segments.append(processed[-tracker_state.track.measurements :])
        elif result.accepted:
            segments[-1].append(index)
    return segments


def _forward_pass(
    times: Times, measurements: Mapping[int, PoseMeasurement], settings: FilterSettings, symmetry_order: int
) -> tuple[list[Bank], set[int]]:
    """Filter one segment: the bank at each time, after its measurement if any, and the indices of those that it took.

    There is one at the first time.
    """
    banks, used, measured_times = [initial_bank(measurements[0], settings)], {0}, times[sorted(measurements)]
    branches = True
    for index in range(1, len(times)):
        later = int(np.searchsorted(measured_times, times[index]))
        span_s = float(measured_times[later] - measured_times[later - 1])
        # As in the filter, turns of the receiver branch once after each measurement.
        bank = propagate_bank(banks[-1], float(times[index] - times[index - 1]), settings, span_s, branches)
        corrected = None
        if index in measurements:
            corrected = correct_bank(bank, measurements[index], settings, symmetry_order).bank
        branches = corrected is not None
        if branches:
            used.add(index)
        banks.append(corrected or bank)
    return banks, used


def _backward_pass(banks: Sequence[Bank]) -> list[Bank]:
    """Smoothed banks: every hypothesis at the end, followed back through its parents."""
    last = banks[-1]
    smoothed_banks, hypotheses, states = [last], list(last), [hypothesis.state for hypothesis in last]
    for earlier in reversed(banks[:-1]):
        parents = [earlier[hypothesis.parent] for hypothesis in hypotheses]
        states = [
            _smooth_step(parent.state, hypothesis.step, state)
            for parent, hypothesis, state in zip(parents, hypotheses, states, strict=True)
            if hypothesis.step is not None
        ]
        hypotheses = parents
        smoothed_banks.append(tuple(Hypothesis(state, end.weight) for state, end in zip(states, last, strict=True)))
    return smoothed_banks[::-1]


def _smooth_step(filtered: MotionState, step: PredictionStep, later: MotionState) -> MotionState:
    """Correct a filtered state by the smoothed state after the next step.

    The covariance is computed as a sum of squares, which rounding leaves positive definite.
    """
    predicted = step.state.covariance
    scale = np.sqrt(np.diag(predicted))
    factor = cho_factor(predicted / np.outer(scale, scale), lower=True)
    gain = cho_solve(factor, step.transition @ filtered.covariance / scale[:, None]).T / scale
    error_factor = np.eye(SIZE) - gain @ step.transition
    covariance = error_factor @ filtered.covariance @ error_factor.T + gain @ (step.noise + later.covariance) @ gain.T
    return filtered.with_error(gain @ step.state.error_to(later), covariance)
