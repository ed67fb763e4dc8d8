"""Root mean squares, percentiles and fractions with their 95 % confidence intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import gammaincinv, ndtri

from datasets_manifest.random_streams import named_generator
from geometry.se3 import Array

CONFIDENCE = 0.95
RESAMPLES = 1000
RATIO_RESAMPLES = 2000

# Numbers drawn in one go by the bootstrap: bounds its memory to some tens of megabytes.
_DRAWS_AT_ONCE = 2_000_000

Interval = tuple[float, float]
"""The two ends of a confidence interval."""


def root_mean_square(values: Array) -> float:
    """Root mean square over all values."""
    return float(np.sqrt(np.mean(np.square(values))))


def rms_interval(values: Array) -> Interval:
    """Confidence interval of the root mean square of independent errors about zero, by the chi-square law.

    The mean square of errors that do not follow one normal law, such as a mixture of distances or errors with outliers,
    is less certain than their number suggests. The degrees of freedom match the measured variance of the squares, and
    never exceed the number of errors.

    Args:
        values: (n,) errors.

    Source: n s^2 / sigma^2 ~ chi-square(n); degrees of freedom 2 n m2^2 / (m4 - m2^2), matching the second moment.
    """
    squares = np.square(values)
    mean = float(squares.mean())
    if mean == 0.0:
        return 0.0, 0.0
    spread = float(squares.var())
    freedom = len(values) if spread == 0.0 else min(float(len(values)), 2 * len(values) * mean**2 / spread)
    low, high = (freedom * mean / _chi2_quantile(p, freedom) for p in ((1 + CONFIDENCE) / 2, (1 - CONFIDENCE) / 2))
    return float(np.sqrt(low)), float(np.sqrt(high))


def _chi2_quantile(share: float, freedom: float) -> float:
    """Limit below which a share of the sums of `freedom` squared standard normal numbers lies."""
    # As in scipy.stats, which takes half a second to load.
    return 2.0 * float(gammaincinv(freedom / 2, share))


def rms_upper_limit(rms: float, count: int) -> float:
    """One-sided 95 % upper limit of the root mean square of `count` independent normal errors about zero."""
    return rms * float(np.sqrt(count / _chi2_quantile(1 - CONFIDENCE, count)))


def mean_square_region(freedom: int) -> Interval:
    """Interval that holds the mean of `freedom` squared standard normal numbers with 95 % probability."""
    low, high = (_chi2_quantile(p, freedom) / freedom for p in ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
    return float(low), float(high)


def fraction_interval(hits: int, count: int) -> Interval:
    """Wilson's score interval of a fraction.

    scipy's `binomtest` agrees but for the last bits, which published results hold, so the formula stays here.

    Source: E. B. Wilson, J. Am. Stat. Assoc. 22 (1927) 209, doi:10.1080/01621459.1927.10502953.
    """
    z = float(ndtri((1 + CONFIDENCE) / 2))
    share = hits / count
    middle = (share + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * np.sqrt(share * (1 - share) / count + z**2 / (4 * count**2))
    # With no hits or only hits an end is exactly 0 or 1, which rounding would miss.
    return (float(middle - half) if hits else 0.0), (float(middle + half) if hits < count else 1.0)


def bootstrap_intervals(columns: Array, percentiles: tuple[float, ...], key: str) -> tuple[Array, Array]:
    """Percentile-bootstrap intervals of means and percentiles, all from the same resampled frames.

    With few frames the upper end of a high percentile cannot pass the largest error that was seen.

    Args:
        columns: (n, C) one row a frame; the result does not depend on the rows' order.
        percentiles: which, in percent.
        key: of the random stream.

    Returns:
        (C, 2) intervals of the means of `columns`, (C, P, 2) intervals of the percentiles of their absolute values.

    Source: B. Efron, Ann. Statist. 7 (1979) 1, doi:10.1214/aos/1176344552.
    """
    ordered = columns[np.lexsort(columns.T)]
    size = len(ordered)
    rng = named_generator(key)
    means, ranks = [], []
    step = max(1, _DRAWS_AT_ONCE // (size * columns.shape[1]))
    for start in range(0, RESAMPLES, step):
        drawn = ordered[rng.integers(0, size, (min(step, RESAMPLES - start), size))]
        means.append(drawn.mean(axis=1))
        ranks.append(np.percentile(np.abs(drawn), percentiles, axis=1))
    ends = (50 * (1 - CONFIDENCE), 50 * (1 + CONFIDENCE))
    mean_ends = np.percentile(np.concatenate(means), ends, axis=0)
    rank_ends = np.percentile(np.concatenate(ranks, axis=1), ends, axis=1)
    return mean_ends.T, rank_ends.transpose(2, 1, 0)


def ratio_intervals(numerators: Array, denominators: Array, blocks: Sequence[int], key: str) -> list[Interval | None]:
    """Percentile-bootstrap intervals of ratios of paired means.

    Args:
        numerators, denominators: (n, C) errors of two methods, one row a frame.
        blocks: (n,) number of each frame's block; frames of a block are not independent and are drawn together.
        key: of the random stream.

    Returns:
        For each of the C columns; None with fewer than two blocks, or where a resampled denominator is zero.

    Source: as `bootstrap_intervals`; 2000 resamples.
    """
    _, place = np.unique(np.asarray(blocks), return_inverse=True)
    count = int(place.max(initial=-1)) + 1
    columns = numerators.shape[1]
    if count < 2:
        return [None] * columns
    sums = np.zeros((count, 2 * columns))
    np.add.at(sums, place, np.hstack([numerators, denominators]))
    rng = named_generator(key)
    totals = []
    step = max(1, _DRAWS_AT_ONCE // sums.size)
    for start in range(0, RATIO_RESAMPLES, step):
        drawn = rng.integers(0, count, (min(step, RATIO_RESAMPLES - start), count))
        totals.append(sums[drawn].sum(axis=1))
    total = np.concatenate(totals)
    return [_ratio_ends(total[:, c], total[:, columns + c]) for c in range(columns)]


def _ratio_ends(above: Array, below: Array) -> Interval | None:
    if not below.all():
        return None
    low, high = np.percentile(above / below, (50 * (1 - CONFIDENCE), 50 * (1 + CONFIDENCE)))
    return float(low), float(high)


def rate_interval(count: int, exposure: float) -> Interval:
    """Confidence interval of a rate from a number of events, which may be zero.

    Source: F. Garwood, Biometrika 28 (1936) 437, doi:10.1093/biomet/28.3-4.437.
    """
    low = float(_chi2_quantile((1 - CONFIDENCE) / 2, 2 * count)) / 2 if count else 0.0
    return low / exposure, float(_chi2_quantile((1 + CONFIDENCE) / 2, 2 * count + 2)) / 2 / exposure


def mean_interval(values: Array, blocks: Sequence[int], key: str) -> Interval | None:
    """Bootstrap interval of a mean; values of a block are drawn together.

    Args:
        values: (n,).
        blocks: (n,) number of each value's block.
        key: of the random stream.

    Returns:
        None with fewer than two blocks, whose scatter cannot be estimated.
    """
    return ratio_intervals(values[:, None], np.ones((len(values), 1)), blocks, key)[0]
