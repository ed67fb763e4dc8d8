"""Criteria and measured values with one-sided 95 % limits, for people (bars.md, terminal) and programs (bars.json).

Too few values have an infinite limit: nothing that they show excludes a larger true value with 95 %.

Pairs of a sequence are not independent of their neighbours; sequences are independent of each other. The `block` limits
are those of the sequences' own means, by Student's law, or of resampled sequences. They are never less than those of
independent pairs: a few sequences that happen to agree would promise too much. Pairs of a single sequence count as
independent, as nothing shows how much sequences differ.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict
from scipy.stats import beta, binom, norm, t

from datasets_manifest.random_streams import named_generator
from droguekit.scoring.confidence_intervals import CONFIDENCE, RESAMPLES, rms_upper_limit
from geometry.se3 import Array

ValueWithLimit = tuple[float, float]
"""A value and its upper limit."""


def rms_limit(values: ArrayLike) -> ValueWithLimit:
    """Root mean square of normal errors about zero."""
    errors = np.asarray(values, dtype=np.float64)
    rms = float(np.sqrt(np.mean(np.square(errors))))
    return rms, rms_upper_limit(rms, errors.size)


def mean_limit(values: ArrayLike) -> ValueWithLimit:
    """Mean, by Student's law; a single number has no scatter, and so an infinite limit."""
    numbers = np.asarray(values, dtype=np.float64)
    mean, count = float(numbers.mean()), numbers.size
    if count < 2:
        return mean, float("inf")
    return mean, mean + float(t.ppf(CONFIDENCE, count - 1) * numbers.std(ddof=1) / np.sqrt(count))


def absolute_mean_limit(blocks: Array) -> ValueWithLimit:
    """Absolute value of a mean, from one mean for each independent block."""
    mean = float(blocks.mean())
    _, high = mean_limit(blocks)
    return abs(mean), abs(mean) + (high - mean)


def share_limit(hits: int, count: int) -> ValueWithLimit:
    """A share, by the binomial law (C. Clopper, E. Pearson, Biometrika 26 (1934) 404, doi:10.1093/biomet/26.4.404)."""
    return hits / count, 1.0 if hits == count else float(beta.ppf(CONFIDENCE, hits + 1, count - hits))


def partial_share_limit(parts: ArrayLike) -> ValueWithLimit:
    """Mean of what is missing of each of several independent wholes, such as the markers of a pair.

    The limit is that of a share with as many wholes missing as the parts make up, rounded up: no other law on [0, 1]
    with that mean scatters more.

    Args:
        parts: (n,) shares missing, from 0 to 1.
    """
    shares = np.asarray(parts, dtype=np.float64)
    # The rounding of sixteenths and the like must not add a whole.
    return float(shares.mean()), share_limit(int(np.ceil(shares.sum() - 1e-9)), shares.size)[1]


def percentile_limit(values: ArrayLike, percent: float) -> ValueWithLimit:
    """Percentile of absolute values, and the smallest order statistic that covers the true one with 95 %.

    Of fewer than `log 0.05 / log(percent / 100)` values (299 for the 99th percentile) none does.
    """
    ordered = np.sort(np.abs(np.asarray(values, dtype=np.float64)))
    rank = int(binom.ppf(CONFIDENCE, ordered.size, percent / 100))
    limit = float(ordered[rank]) if rank < ordered.size else float("inf")
    return float(np.percentile(ordered, percent)), limit


def paired_ratio_limit(above: ArrayLike, below: ArrayLike) -> ValueWithLimit:
    """Ratio of two positive means over the same frames, by Student's law of its logarithm to first order.

    The ratio is NaN where a mean is zero, for then nothing is known of its logarithm.

    Args:
        above, below: sums over the same independent blocks of frames, two or more.
    """
    first, second = (np.asarray(values, dtype=np.float64) for values in (above, below))
    if not (first.any() and second.any()):
        return float("nan"), float("inf")
    ratio, blocks = float(first.sum() / second.sum()), len(first)
    shares = blocks * (first / first.sum() - second / second.sum())
    error = shares.std(ddof=1) / np.sqrt(blocks)
    return ratio, ratio * float(np.exp(t.ppf(CONFIDENCE, blocks - 1) * error))


def paired_rms_ratio_limit(above: float, below: float, correlation: float, count: int) -> ValueWithLimit:
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


def block_mean_limit(values: ArrayLike, blocks: Sequence[int]) -> ValueWithLimit:
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


def block_share_limit(hits: ArrayLike, blocks: Sequence[int]) -> ValueWithLimit:
    """A share, with the larger of the limits by blocks and by the binomial law; of a single block by the latter."""
    numbers = np.asarray(hits, dtype=np.float64)
    share, limit = share_limit(int(numbers.sum()), numbers.size)
    if len(set(blocks)) < 2:
        return share, limit
    return share, min(1.0, max(limit, block_mean_limit(numbers, blocks)[1]))


def block_rms_limit(errors: ArrayLike, blocks: Sequence[int]) -> ValueWithLimit:
    """Root mean square, from the limit of the mean square."""
    mean, limit = block_mean_limit(np.square(np.asarray(errors, dtype=np.float64)), blocks)
    return float(np.sqrt(mean)), float(np.sqrt(limit))


def block_percentile_limit(values: ArrayLike, blocks: Sequence[int], percent: float, key: str) -> ValueWithLimit:
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
    chosen = named_generator(key).integers(0, len(names), (RESAMPLES, len(names)))
    order = np.argsort(sizes)
    place = np.unique(np.asarray(blocks), return_inverse=True)[1][order]
    drawn = [
        _counted_percentile(sizes[order], np.bincount(row, minlength=len(names))[place], percent) for row in chosen
    ]
    return value, max(limit, float(np.percentile(drawn, 100 * CONFIDENCE)))


def _counted_percentile(ascending: Array, counts: NDArray[np.int64], percent: float) -> float:
    """Percentile of values (n,) that each come as often as `counts` (n,) says, as `np.percentile` gives it."""
    behind = np.cumsum(counts)
    rank = (behind[-1] - 1) * percent / 100
    low, high = ascending[np.searchsorted(behind, [np.floor(rank), np.ceil(rank)], side="right")]
    return float(low + (rank - np.floor(rank)) * (high - low))


def _by_block(values: Array, blocks: Sequence[int]) -> tuple[Array, Array]:
    """Sum and number of the values of each block."""
    _, place = np.unique(np.asarray(blocks), return_inverse=True)
    return np.bincount(place, values).astype(np.float64), np.bincount(place).astype(np.float64)


GOAL, COMPARISON = "goal", "beside"


class AcceptanceRow(BaseModel):
    """One criterion.

    Attributes:
        bar: its number in docs/explanation/acceptance.md, `goal` for an aim that is not required, or `beside` for a
            figure given for comparison.
        quantity: what is measured, with its unit.
        low, high: required range; None means no lower end.
        measured: None where nothing could be measured.
        limit_low, limit_high: one-sided 95 % limits of what is measured; None where there are too few values for one.
        n: sample size.
        met: whether the limits lie within `low` and `high`; False where nothing could be measured.
        note: a remark for the reader, may be empty.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    bar: str
    quantity: str
    low: float | None = None
    high: float
    measured: float | None
    limit_low: float | None = None
    limit_high: float | None = None
    n: int
    met: bool
    note: str = ""


class AcceptanceTable(BaseModel):
    """All criteria of one tier.

    Attributes:
        tier: its name.
        seed: of everything drawn.
        code_version: of this package.
        rows: the criteria.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    tier: str
    seed: int
    code_version: str
    rows: tuple[AcceptanceRow, ...]

    @property
    def missed(self) -> int:
        """How many numbered criteria are not met."""
        return sum(not row.met for row in self.rows if row.bar not in _WITHOUT_NUMBER)

    def to_json(self) -> str:
        """The text of bars.json."""
        return json.dumps(self.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"

    def to_markdown(self) -> str:
        """The text of bars.md."""
        head = f"# Bars of tier {self.tier}, seed {self.seed}, droguekit {self.code_version}\n\n"
        numbered = sum(row.bar not in _WITHOUT_NUMBER for row in self.rows)
        met = f"{numbered - self.missed} of {numbered} bars are met."
        count = f"{met} Limits are one-sided, 95 %, unless a note says otherwise.\n\n"
        lines = ["| " + " | ".join(cells) + " |" for cells in (_HEADINGS, ["---"] * len(_HEADINGS), *self._cells())]
        return head + count + "\n".join(lines) + "\n"

    def to_lines(self) -> list[str]:
        """The table for a terminal, a line a row."""
        rows = [_HEADINGS, *self._cells()]
        widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADINGS))]
        return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]

    def _cells(self) -> list[list[str]]:
        return [_row_cells(row) for row in self.rows]


_WITHOUT_NUMBER = (GOAL, COMPARISON)
_TOO_FEW = "too few values for a 95 % limit"
_OF_ZEROS = "errors that are all zero have no ratio"
TWO_SIDED = "ends of a two-sided 95 % interval"
"""Note of limits that are one-sided at 97.5 %, as the benchmark gives them."""
_HEADINGS = ["bar", "quantity", "must be", "measured", "95 % limit", "n", "met", "note"]


def at_most(
    bar: str, quantity: str, high: float, measured: tuple[float, float], n: int, note: str = ""
) -> AcceptanceRow:
    """A quantity that must not exceed `high`; `measured` is its value and upper limit, infinite with too few values.

    A value of NaN is a ratio of errors of which some are all zero, and counts as not measured.
    """
    value, limit = measured
    if np.isnan(value):
        return not_measured(bar, quantity, high, "; ".join(part for part in (_OF_ZEROS, note) if part))
    return AcceptanceRow(
        bar=bar,
        quantity=quantity,
        high=high,
        measured=value,
        limit_high=_finite(limit),
        n=n,
        met=limit <= high,
        note=_with_reason(note, limit),
    )


def between(
    bar: str,
    quantity: str,
    wanted: tuple[float, float],
    measured: tuple[float, float, float],
    n: int,
    note: str = "",
) -> AcceptanceRow:
    """A quantity with a required range; `measured` is its value and limits, infinite with too few values."""
    (low, high), (value, limit_low, limit_high) = wanted, measured
    return AcceptanceRow(
        bar=bar,
        quantity=quantity,
        low=low,
        high=high,
        measured=value,
        limit_low=_finite(limit_low),
        limit_high=_finite(limit_high),
        n=n,
        met=low <= limit_low and limit_high <= high,
        note=_with_reason(note, limit_high),
    )


def _finite(limit: float) -> float | None:
    return limit if np.isfinite(limit) else None


def _with_reason(note: str, limit: float) -> str:
    """The note, or the reason why there is no limit."""
    return note if np.isfinite(limit) else "; ".join(part for part in (_TOO_FEW, note) if part)


def not_measured(bar: str, quantity: str, high: float, note: str) -> AcceptanceRow:
    """A criterion that could not be measured, and why; it counts as missed."""
    return AcceptanceRow(bar=bar, quantity=quantity, high=high, measured=None, n=0, met=False, note=note)


def _row_cells(row: AcceptanceRow) -> list[str]:
    wanted = f"<= {row.high:.4g}" if row.low is None else f"{row.low:.4g} to {row.high:.4g}"
    measured = "-" if row.measured is None else f"{row.measured:.4g}"
    limits = [f"{limit:.4g}" for limit in (row.limit_low, row.limit_high) if limit is not None]
    met = "yes" if row.met else "NO" if row.bar not in _WITHOUT_NUMBER else "no"
    return [row.bar, row.quantity, wanted, measured, " to ".join(limits) or "-", str(row.n), met, row.note]


def worst(rows: Sequence[tuple[str, float, float]]) -> tuple[str, float, float]:
    """Of (name, value, limit) the one with the largest limit."""
    return max(rows, key=lambda row: row[2])
