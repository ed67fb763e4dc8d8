"""One-sided 95 % limits of what the bars measure."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import beta, binom, norm, t

from droguekit.benchmark.statistics import CONFIDENCE, rms_upper_limit
from geometry.se3 import Array

Limited = tuple[float, float]
"""A value and its upper limit."""


def rms_limit(values: ArrayLike) -> Limited:
    """Root mean square of normal errors about zero."""
    errors = np.asarray(values, dtype=np.float64)
    rms = float(np.sqrt(np.mean(np.square(errors))))
    return rms, rms_upper_limit(rms, errors.size)


def mean_limit(values: ArrayLike) -> Limited:
    """Mean, by Student's law; no limit but the value itself with a single number."""
    numbers = np.asarray(values, dtype=np.float64)
    mean, count = float(numbers.mean()), numbers.size
    if count < 2:
        return mean, mean
    return mean, mean + float(t.ppf(CONFIDENCE, count - 1) * numbers.std(ddof=1) / np.sqrt(count))


def size_of_mean_limit(blocks: Array) -> Limited:
    """Absolute value of a mean, from one mean for each independent block."""
    mean = float(blocks.mean())
    _, high = mean_limit(blocks)
    return abs(mean), abs(mean) + (high - mean)


def share_limit(hits: int, count: int) -> Limited:
    """A share, by the binomial law (C. Clopper, E. Pearson, Biometrika 26 (1934) 404, doi:10.1093/biomet/26.4.404)."""
    return hits / count, 1.0 if hits == count else float(beta.ppf(CONFIDENCE, hits + 1, count - hits))


def percentile_limit(values: ArrayLike, percent: float) -> Limited:
    """Percentile of absolute values, and the smallest order statistic that covers the true one with 95 %.

    With too few values none does, and the largest stands in.
    """
    ordered = np.sort(np.abs(np.asarray(values, dtype=np.float64)))
    rank = int(binom.ppf(CONFIDENCE, ordered.size, percent / 100))
    return float(np.percentile(ordered, percent)), float(ordered[min(rank, ordered.size - 1)])


def paired_ratio_limit(above: ArrayLike, below: ArrayLike) -> Limited:
    """Ratio of two positive means over the same frames, by Student's law of its logarithm to first order.

    Args:
        above, below: sums over the same independent blocks of frames, two or more.
    """
    first, second = (np.asarray(values, dtype=np.float64) for values in (above, below))
    ratio, blocks = float(first.sum() / second.sum()), len(first)
    shares = blocks * (first / first.sum() - second / second.sum())
    error = shares.std(ddof=1) / np.sqrt(blocks)
    return ratio, ratio * float(np.exp(t.ppf(CONFIDENCE, blocks - 1) * error))


def rms_ratio_limit(above: tuple[float, int], below: tuple[float, int]) -> Limited:
    """Ratio of two root mean squares of normal errors, each given with the number of values."""
    ratio = above[0] / below[0]
    variance = sum(1 / (2 * count) for _, count in (above, below))
    return ratio, ratio * float(np.exp(norm.ppf(CONFIDENCE) * np.sqrt(variance)))


def paired_rms_ratio_limit(above: float, below: float, correlation: float, count: int) -> Limited:
    """Ratio of root mean squares of two normal errors in the same frames.

    The logarithms of two such root mean squares have a difference of variance `(1 - correlation^2) / count`.

    Args:
        above, below: the root mean squares.
        correlation: of the errors, about zero.
        count: of frames.
    """
    ratio = above / below
    return ratio, ratio * float(np.exp(norm.ppf(CONFIDENCE) * np.sqrt(max(0.0, 1 - correlation**2) / count)))


def nees_limits(per_freedom: float, freedom: int) -> tuple[float, float, float]:
    """Mean normalised square error over its degrees of freedom, with lower and upper limit by the normal law.

    Args:
        per_freedom: the mean.
        freedom: of all poses together.
    """
    reach = float(norm.ppf(CONFIDENCE)) * per_freedom * np.sqrt(2 / freedom)
    return per_freedom, per_freedom - float(reach), per_freedom + float(reach)
