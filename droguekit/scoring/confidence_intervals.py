"""Root mean squares, percentiles and fractions with their 95 % confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv, ndtri, stdtrit

from datasets_manifest.random_streams import named_generator
from geometry.se3 import Array

CONFIDENCE = 0.95
RESAMPLES = 1000
RATIO_RESAMPLES = 2000
FEWEST_RANKED = 6
"""Blocks that a percentile's interval needs: all of six or more lie above a median, or below, in 2.5 % or less."""
# Percentiles of resamples between which the interval lies.
_ENDS = (50 * (1 - CONFIDENCE), 50 * (1 + CONFIDENCE))

# Numbers drawn in one go by the bootstrap: bounds its memory to some tens of megabytes.
_DRAWS_AT_ONCE = 2_000_000

Interval = tuple[float, float]
"""The two ends of a confidence interval."""


def root_mean_square(values: Array) -> float:
    """Root mean square over all values."""
    return float(np.sqrt(np.mean(np.square(values))))


def rms_interval(values: Array, blocks: Sequence[int]) -> Interval:
    """Confidence interval of the root mean square of errors about zero, by the chi-square law.

    The mean square of errors that do not follow one normal law, such as a mixture of distances, errors with outliers,
    or errors that a sequence shares, is less certain than their number suggests. The degrees of freedom match the
    measured variance of the mean square between blocks, and never exceed the number of blocks.

    Args:
        values: (n,) errors.
        blocks: (n,) number of each error's block; errors of a block are not independent.

    Source: n s^2 / sigma^2 ~ chi-square(n); degrees of freedom 2 m2^2 / var(m2), matching the second moment.
    """
    squares = np.square(values)
    mean = float(squares.mean())
    if mean == 0.0:
        return 0.0, 0.0
    place, count = _places(blocks)
    variance = float(np.square(np.bincount(place, squares - mean)).sum()) / len(values) ** 2
    freedom = float(count) if variance == 0.0 else min(float(count), 2 * mean**2 / variance)
    low, high = (freedom * mean / _chi2_quantile(p, freedom) for p in ((1 + CONFIDENCE) / 2, (1 - CONFIDENCE) / 2))
    return float(np.sqrt(low)), float(np.sqrt(high))


def mean_interval(values: Array, blocks: Sequence[int], limits: Interval = (-math.inf, math.inf)) -> Interval | None:
    """Confidence interval of a mean by the jackknife over blocks and Student's law.

    Args:
        values: (n,).
        blocks: (n,) number of each value's block; values of a block are not independent.
        limits: that no mean can pass, such as 0 and 1 of shares.

    Returns:
        None with fewer than two blocks, whose scatter cannot be estimated.

    Source: R. G. Miller, Biometrika 61 (1974) 1, doi:10.1093/biomet/61.1.1; one degree of freedom less than there are
    blocks. With single values as blocks it is Student's interval.
    """
    place, count = _places(blocks)
    if count < 2:
        return None
    mean, sizes = float(values.mean()), np.bincount(place)
    # How far the mean moves without each block.
    moves = np.bincount(place, values - mean) / (len(values) - sizes)
    deviation = np.sqrt(float(np.square(moves).sum()) * (count - 1) / count)
    half = float(stdtrit(count - 1, (1 + CONFIDENCE) / 2) * deviation)
    return max(mean - half, limits[0]), min(mean + half, limits[1])


def _places(blocks: Sequence[int]) -> tuple[NDArray[np.intp], int]:
    """The place of each block among all different ones, and how many those are."""
    _, place = np.unique(np.asarray(blocks, dtype=np.int64), return_inverse=True)
    return place, int(place.max(initial=-1)) + 1


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


def percentile_intervals(
    columns: Array, percentiles: tuple[float, ...], blocks: Sequence[int], key: str
) -> Array | None:
    """Percentile-bootstrap intervals of percentiles of absolute values.

    The upper end cannot pass the largest error that was seen, so that intervals of high percentiles are too narrow over
    few blocks: with 2.5 % or more all of n blocks lie below percentile p where (p / 100)^n >= 0.025, that is over fewer
    than 72 blocks for the 95th and 368 for the 99th.

    Args:
        columns: (n, C) one row a frame; the result does not depend on the rows' order.
        percentiles: which, in percent.
        blocks: (n,) number of each frame's block; frames of a block are not independent and are drawn together.
        key: of the random stream.

    Returns:
        (C, P, 2), or None with fewer than `FEWEST_RANKED` blocks.

    Source: B. Efron, Ann. Statist. 7 (1979) 1, doi:10.1214/aos/1176344552.
    """
    place, count = _places(blocks)
    if count < FEWEST_RANKED:
        return None
    sizes, rng, found = np.abs(columns), named_generator(key), []
    step = max(1, _DRAWS_AT_ONCE // len(sizes))
    for start in range(0, RESAMPLES, step):
        drawn = rng.integers(0, count, (min(step, RESAMPLES - start), count))
        of_row = drawn + count * np.arange(len(drawn))[:, None]
        times = np.bincount(of_row.ravel(), minlength=drawn.size).reshape(drawn.shape)
        found.append([_weighted_percentiles(column, times[:, place], percentiles) for column in sizes.T])
    ends: Array = np.percentile(np.concatenate(found, axis=2), _ENDS, axis=2).transpose(1, 2, 0)
    return ends


def _weighted_percentiles(values: Array, times: NDArray[np.int64], percentiles: tuple[float, ...]) -> Array:
    """(P, R) percentiles, as numpy's, of R samples that hold each of (n,) values as often as (R, n) `times` says."""
    order = np.argsort(values)
    values, reached = values[order], np.cumsum(times[:, order], axis=1)

    def at(rank: Array) -> Array:
        """(R,) value of a rank in each sample."""
        found: Array = values[(reached <= rank[:, None]).sum(axis=1)]
        return found

    rows = []
    for percent in percentiles:
        rank = (reached[:, -1] - 1) * percent / 100
        low, high = at(np.floor(rank)), at(np.ceil(rank))
        rows.append(low + (high - low) * (rank - np.floor(rank)))
    return np.array(rows)


def ratio_intervals(numerators: Array, denominators: Array, blocks: Sequence[int], key: str) -> list[Interval | None]:
    """Percentile-bootstrap intervals of ratios of paired means.

    Args:
        numerators, denominators: (n, C) errors of two methods, one row a frame.
        blocks: (n,) number of each frame's block; frames of a block are not independent and are drawn together.
        key: of the random stream.

    Returns:
        For each of the C columns; None with fewer than two blocks, or where a resampled denominator is zero.

    Source: as `percentile_intervals`; 2000 resamples.
    """
    place, count = _places(blocks)
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
    low, high = np.percentile(above / below, _ENDS)
    return float(low), float(high)


def rate_interval(count: int, exposure: float) -> Interval:
    """Confidence interval of a rate from a number of events, which may be zero.

    Source: F. Garwood, Biometrika 28 (1936) 437, doi:10.1093/biomet/28.3-4.437.
    """
    low = float(_chi2_quantile((1 - CONFIDENCE) / 2, 2 * count)) / 2 if count else 0.0
    return low / exposure, float(_chi2_quantile((1 + CONFIDENCE) / 2, 2 * count + 2)) / 2 / exposure
