"""One-sided 95 % limits of what is measured on sequences, whose pairs are not independent of their neighbours.

What is independent is a sequence. Limits are therefore those of the sequences' own means, by Student's law, or of
resampled sequences; and never less than what independent pairs would give: a few sequences that happen to agree would
promise more. Pairs of a single sequence count as independent, as nothing tells how much sequences differ.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t

from datasets_manifest.random_streams import named_generator
from droguekit.benchmark.statistics import CONFIDENCE, RESAMPLES
from geometry.se3 import Array
from studies.acceptance.confidence import Limited, mean_limit, percentile_limit, share_limit


def block_mean_limit(values: ArrayLike, blocks: Sequence[int]) -> Limited:
    """Mean, with the larger of the limits by the scatter of the blocks about it and by that of the values.

    Args:
        values: (n,) one or more.
        blocks: (n,) which sequence each belongs to.

    Source: ratio estimator of cluster samples, W. Cochran, Sampling Techniques, 3rd ed., eq. 9A.1, with Student's law
    of as many degrees of freedom as there are blocks, less one.
    """
    numbers = np.asarray(values, dtype=np.float64)
    mean, limit = mean_limit(numbers)
    sums, counts = _by_block(numbers, blocks)
    if len(counts) < 2:
        return mean, limit
    shares = len(counts) * (sums - mean * counts) / counts.sum()
    error = float(shares.std(ddof=1) / np.sqrt(len(counts)))
    return mean, max(limit, mean + float(t.ppf(CONFIDENCE, len(counts) - 1)) * error)


def block_share_limit(hits: ArrayLike, blocks: Sequence[int]) -> Limited:
    """A share, with the larger of the limits by blocks and by the binomial law; of a single block by the latter."""
    numbers = np.asarray(hits, dtype=np.float64)
    share, limit = share_limit(int(numbers.sum()), numbers.size)
    if len(set(blocks)) < 2:
        return share, limit
    return share, min(1.0, max(limit, block_mean_limit(numbers, blocks)[1]))


def block_rms_limit(errors: ArrayLike, blocks: Sequence[int]) -> Limited:
    """Root mean square, from the limit of the mean square."""
    mean, limit = block_mean_limit(np.square(np.asarray(errors, dtype=np.float64)), blocks)
    return float(np.sqrt(mean)), float(np.sqrt(limit))


def block_percentile_limit(values: ArrayLike, blocks: Sequence[int], percent: float, key: str) -> Limited:
    """Percentile of absolute values, with the larger of the limits by resampled blocks and by order statistics.

    Args:
        values: (n,).
        blocks: (n,) which sequence each belongs to.
        percent: which.
        key: of the random stream.
    """
    sizes = np.abs(np.asarray(values, dtype=np.float64))
    value, limit = percentile_limit(sizes, percent)
    names = sorted(set(blocks))
    if len(names) < 2:
        return value, limit
    of_block = np.asarray(blocks)
    parts = [sizes[of_block == name] for name in names]
    rng = named_generator(key)
    drawn = [
        np.percentile(np.concatenate([parts[k] for k in rng.integers(0, len(parts), len(parts))]), percent)
        for _ in range(RESAMPLES)
    ]
    return value, max(limit, float(np.percentile(drawn, 100 * CONFIDENCE)))


def _by_block(values: Array, blocks: Sequence[int]) -> tuple[Array, Array]:
    """Sum and number of the values of each block."""
    _, place = np.unique(np.asarray(blocks), return_inverse=True)
    return np.bincount(place, values).astype(np.float64), np.bincount(place).astype(np.float64)
