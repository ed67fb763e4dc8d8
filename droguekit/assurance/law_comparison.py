"""Whether two samples follow one law: numbers, words, and changes of the same pairs."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from drogue_models.frozen_model import FrozenModel

_PERMUTATIONS = 9_999
_PARTS = 24

Units = Literal["pairs", "scenes", "sequences", "pairs of the same frames"]


class LawDiff(FrozenModel):
    """One quantity of both datasets.

    Attributes:
        name: with its unit.
        units: what counts once.
        counts: of A and of B.
        typical: median of a number, commonest word.
        distance: largest difference of the cumulative shares of a number (Kolmogorov and Smirnov), half the sum of the
            differences of the shares of words; of the same frames the share of pairs in which B is larger, less a half.
        p: chance of such a distance, or a larger one, by draws alone.
        differs: whether that is too unlikely.
        can_differ: whether there are so many that laws without anything in common would differ.
        shares: of A and of B, in 24 equal parts of their common range, or for each word; for pictures.
        ends: of that range, or the words.
    """

    name: str
    units: Units
    counts: tuple[int, int]
    typical: tuple[str, str]
    distance: float
    p: float
    differs: bool
    can_differ: bool
    shares: tuple[tuple[float, ...], tuple[float, ...]]
    ends: tuple[str, ...]


class _Tested(NamedTuple):
    """Distance, its chance by draws alone, and the least chance that any distance could have."""

    distance: float
    p: float
    least_p: float


def _least_p(count: int, other: int) -> float:
    """Chance that one of two samples lies wholly apart from the other: 2 of all ways to choose it of both."""
    ways = math.lgamma(count + other + 1) - math.lgamma(count + 1) - math.lgamma(other + 1)
    return 2.0 * math.exp(-ways)


def compare_numbers(name: str, units: Units, values: tuple[NDArray[Any], NDArray[Any]], most_p: float) -> LawDiff:
    """Compare two samples of a number by the test of Kolmogorov and Smirnov.

    Args:
        name: of the quantity.
        units: what each value stands for.
        values: (N,) and (M,) independent draws.
        most_p: chance below which the laws differ.
    """
    count, other = map(len, values)
    tested = _Tested(0.0, 1.0, 1.0)
    if min(count, other):
        with warnings.catch_warnings():
            # Where its exact count rounds to more than 1, it takes the limit for many draws and says so.
            warnings.simplefilter("ignore", RuntimeWarning)
            result = stats.ks_2samp(*values)
        # All of one below all of the other, or above.
        tested = _Tested(float(result.statistic), float(result.pvalue), _least_p(count, other))
    return _number_law(name, units, values, tested, most_p)


def compare_changes(name: str, values: tuple[NDArray[Any], NDArray[Any]], most_p: float) -> LawDiff:
    """Compare (N,) and (N,) numbers of the same frames by the signed-rank test of Wilcoxon on their changes."""
    change = values[1] - values[0]
    moved = change[change != 0]
    distance = float((change > 0).mean() + 0.5 * (change == 0).mean() - 0.5) if len(change) else 0.0
    p = float(stats.wilcoxon(moved).pvalue) if len(moved) else 1.0
    tested = _Tested(distance, p, min(2.0 ** (1 - len(change)), 1.0))
    return _number_law(name, "pairs of the same frames", values, tested, most_p)


def _number_law(
    name: str, units: Units, values: tuple[NDArray[Any], NDArray[Any]], tested: _Tested, most_p: float
) -> LawDiff:
    both = np.concatenate(values)
    low, high = (float(both.min()), float(both.max())) if len(both) else (0.0, 1.0)
    edges = np.linspace(low, high if high > low else low + 1.0, _PARTS + 1)
    first, second = (np.histogram(side, edges)[0] / max(len(side), 1) for side in values)
    typical = [f"{float(np.median(side)):.4g}" if len(side) else "none" for side in values]
    return _law(name, units, values, typical, (first, second), tested, most_p, (f"{low:.4g}", f"{high:.4g}"))


def compare_words(name: str, units: Units, words: tuple[list[str], list[str]], most_p: float) -> LawDiff:
    """Compare two samples of words by how often shares differ as much when the words of both are dealt anew.

    Args:
        name: of the quantity.
        units: what each word stands for.
        words: independent draws.
        most_p: chance below which the laws differ.
    """
    vocabulary = sorted({*words[0], *words[1]})
    codes = [np.array([vocabulary.index(word) for word in side], dtype=int) for side in words]
    first, second = (np.bincount(side, minlength=len(vocabulary)) / max(len(side), 1) for side in codes)
    count, other = map(len, codes)
    tested = _Tested(0.5 * float(np.abs(first - second).sum()), 1.0, 1.0)
    if min(count, other):
        total, rng = np.bincount(np.concatenate(codes), minlength=len(vocabulary)), np.random.default_rng(1)
        dealt = rng.multivariate_hypergeometric(total, count, size=_PERMUTATIONS)
        distances = 0.5 * np.abs(dealt / count - (total - dealt) / other).sum(axis=1)
        p = float((1 + (distances >= tested.distance - 1e-12).sum()) / (1 + _PERMUTATIONS))
        least_p = _least_p(count, other) + 1.0 / (1 + _PERMUTATIONS)
        tested = _Tested(tested.distance, p, least_p)
    typical = [Counter(side).most_common(1)[0][0] if side else "none" for side in words]
    return _law(name, units, words, typical, (first, second), tested, most_p, tuple(vocabulary))


def _law(
    name: str,
    units: Units,
    samples: tuple[Any, Any],
    typical: list[str],
    shares: tuple[NDArray[Any], NDArray[Any]],
    tested: _Tested,
    most_p: float,
    ends: tuple[str, ...],
) -> LawDiff:
    return LawDiff(
        name=name,
        units=units,
        counts=(len(samples[0]), len(samples[1])),
        typical=(typical[0], typical[1]),
        distance=tested.distance,
        p=tested.p,
        differs=tested.p < most_p,
        can_differ=tested.least_p < most_p,
        shares=(tuple(shares[0].tolist()), tuple(shares[1].tolist())),
        ends=ends,
    )
