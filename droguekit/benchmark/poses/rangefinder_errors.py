"""Depths against a rangefinder's readings, the reference of experiments that know no truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from droguekit.benchmark.results.result_parts import DepthErrors, RangefinderErrors
from droguekit.benchmark.statistics import root_mean_square


@dataclass(frozen=True)
class Depth:
    """One pair in three ways, all along the left camera's optical axis.

    Attributes:
        estimated_m, true_m: of the rim's centre. [m]
        reading_m: what the rangefinder says of it. [m]
    """

    estimated_m: float
    true_m: float
    reading_m: float


def rangefinder_errors(depths: Sequence[Depth]) -> RangefinderErrors | None:
    """What an experiment with a rangefinder would find, and what it would not; None without a depth."""
    if not depths:
        return None
    estimated, true, reading = np.array([[depth.estimated_m, depth.true_m, depth.reading_m] for depth in depths]).T
    return RangefinderErrors(
        n=len(depths),
        against_reading=_errors(estimated, reading),
        against_truth=_errors(estimated, true),
        reading=_errors(reading, true),
    )


def _errors(values_m: NDArray[np.float64], reference_m: NDArray[np.float64]) -> DepthErrors:
    errors = values_m - reference_m
    return DepthErrors(
        bias_m=float(errors.mean()),
        rmse_m=root_mean_square(errors),
        mean_absolute_m=float(np.abs(errors).mean()),
        mean_absolute_fraction=float((np.abs(errors) / reference_m).mean()),
    )
