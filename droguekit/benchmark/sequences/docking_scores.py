"""Docking quantities of a method against the true ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from datasets_manifest.types.estimates import Docking, Estimate, PoseEstimate
from droguekit.benchmark.results.docking_result import (
    BodyAxes,
    Calibration,
    Captures,
    DockingBin,
    DockingErrors,
    DockingRow,
    MissRow,
)
from droguekit.benchmark.sequences.sequence_docking import Arrival, TrueDocking
from droguekit.benchmark.sequences.sequence_filtering import SequenceData
from droguekit.benchmark.statistics import mean_interval, root_mean_square
from geometry.se3 import Array

_AXES = ("forward", "right", "down")


class DockingPair(NamedTuple):
    """One pair with docking quantities, told and true."""

    frame_index: int
    told: Docking
    true: TrueDocking

    @property
    def capture_radius_m(self) -> float:
        """What captures are judged by: the radius that the answer tells, or the drogue's. [m]"""
        told_m = self.told.capture_radius_m
        return self.true.capture_radius_m if told_m is None else told_m


def docking_errors(
    data: SequenceData, truth: Mapping[int, TrueDocking], estimates: Mapping[int, Estimate], key: str
) -> DockingErrors | None:
    """The scores of a method; None where it reports no docking quantities.

    Args:
        data: the truth of the sequences.
        truth: of docking, by frame.
        estimates: of the method, by frame.
        key: of the bootstrap's random streams.
    """
    pairs = [
        DockingPair(index, estimate.docking, truth[index])
        for index, estimate in sorted(estimates.items())
        if isinstance(estimate, PoseEstimate) and estimate.docking is not None and index in truth
    ]
    if not pairs:
        return None
    bin_of, bins = data.groups.bin_of_frame, []
    for k, place in enumerate(data.groups.bins):
        inside = [pair for pair in pairs if bin_of[pair.frame_index] == k]
        if inside:
            row = _row(data, inside, sum(bin_of[index] == k for index in truth), f"{key}, bin {k}")
            bins.append(DockingBin(**dict(row), low_m=place.low_m, high_m=place.high_m))
    return DockingErrors(overall=_row(data, pairs, len(truth), key), bins=tuple(bins))


def calibration(errors: Array, deviations: Array) -> Calibration | None:
    """How often errors stay within once and twice their standard deviation; None where none is above 0."""
    told = deviations > 0
    if not told.any():
        return None
    ratios = np.abs(errors[told]) / deviations[told]
    return Calibration(n=int(told.sum()), within_1=float(np.mean(ratios <= 1)), within_2=float(np.mean(ratios <= 2)))


def _row(data: SequenceData, pairs: Sequence[DockingPair], of: int, key: str) -> DockingRow:
    errors = np.array([pair.told.mouth_from_tip_m - pair.true.mouth_from_tip_m for pair in pairs])
    deviations = np.array([pair.told.mouth_sd_m for pair in pairs])
    squares = np.square(errors).sum(axis=1)
    ends = mean_interval(squares, [data.sequence_of(pair.frame_index) for pair in pairs], f"{key}, mouth")
    closures = np.array(
        [
            pair.told.closure_m_s - pair.true.closure_m_s
            for pair in pairs
            if pair.told.closure_m_s is not None and pair.true.closure_m_s is not None
        ]
    )
    contacts = [
        pair.told.contact_s - pair.true.predicted.contact_s
        for pair in pairs
        if pair.told.contact_s is not None and pair.true.predicted is not None
    ]
    predicted = [(pair, pair.true.predicted) for pair in pairs]
    final = [(pair, pair.true.in_the_end) for pair in pairs]
    return DockingRow(
        n=len(pairs),
        of=of,
        mouth_rmse_m=_body_axes(np.sqrt(np.square(errors).mean(axis=0))),
        mouth_bias_m=_body_axes(errors.mean(axis=0)),
        mouth_rms_m=float(np.sqrt(squares.mean())),
        mouth_interval=None if ends is None else (float(np.sqrt(ends[0])), float(np.sqrt(ends[1]))),
        calibration={axis: calibration(errors[:, k], deviations[:, k]) for k, axis in enumerate(_AXES)},
        closure_n=len(closures),
        closure_rmse_m_s=root_mean_square(closures) if len(closures) else None,
        closure_bias_m_s=float(closures.mean()) if len(closures) else None,
        contact_median_absolute_s=float(np.median(np.abs(contacts))) if contacts else None,
        miss=_miss_row(predicted),
        miss_in_the_end=_miss_row(final),
        captures=_captures(predicted),
        captures_in_the_end=_captures(final),
    )


def _miss_row(pairs: Sequence[tuple[DockingPair, Arrival | None]]) -> MissRow | None:
    both = [
        (pair.told.miss_m - true.miss_m, pair.told.miss_sd_m or 0.0)
        for pair, true in pairs
        if pair.told.miss_m is not None and true is not None
    ]
    if not both:
        return None
    errors, deviations = (np.array(column) for column in zip(*both, strict=True))
    return MissRow(
        n=len(errors),
        bias_m=float(errors.mean()),
        rmse_m=root_mean_square(errors),
        median_absolute_m=float(np.median(np.abs(errors))),
        p95_m=float(np.percentile(np.abs(errors), 95)),
        calibration=calibration(errors, deviations),
    )


def _captures(pairs: Sequence[tuple[DockingPair, Arrival | None]]) -> Captures | None:
    """Told against true captures; None where either is nowhere known."""
    known = [(pair, true) for pair, true in pairs if pair.told.captured is not None and true is not None]
    if not known:
        return None
    cases = [(pair.told.captured, true.miss_m <= pair.capture_radius_m) for pair, true in known]
    radii = {pair.capture_radius_m for pair, _ in known}
    return Captures(
        radius_m=radii.pop() if len(radii) == 1 else None,
        true_yes=cases.count((True, True)),
        false_yes=cases.count((True, False)),
        false_no=cases.count((False, True)),
        true_no=cases.count((False, False)),
    )


def _body_axes(values: Array) -> BodyAxes:
    return BodyAxes(**dict(zip(_AXES, values.tolist(), strict=True)))
