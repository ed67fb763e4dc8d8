from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, binomtest

from datasets_manifest.random_streams import named_generator
from droguekit.scoring.confidence_intervals import (
    CONFIDENCE,
    RESAMPLES,
    fraction_interval,
    mean_interval,
    percentile_intervals,
    rms_interval,
    root_mean_square,
)

TRIALS = 2000
# Three standard errors of a share of 0.95 in 2000 trials.
SAMPLING = 3 * np.sqrt(0.95 * 0.05 / TRIALS)


@pytest.mark.parametrize("n", [5, 20, 100])
def test_rms_interval_covers_normal_errors(n: int, rng: np.random.Generator) -> None:
    hits = 0
    for _ in range(TRIALS):
        low, high = rms_interval(rng.normal(0, 2, n), range(n))
        hits += low <= 2 <= high
    # Never too narrow; wider by what the measured fourth moment costs, 4 % at most.
    assert CONFIDENCE - SAMPLING <= hits / TRIALS <= CONFIDENCE + 0.04


def test_rms_interval_allows_for_a_mixture_of_scales(rng: np.random.Generator) -> None:
    scales = np.repeat([0.1, 1.0, 10.0], 40)
    truth = root_mean_square(scales)
    hits = plain = 0
    for _ in range(TRIALS):
        errors = rng.normal(0, scales)
        low, high = rms_interval(errors, range(len(errors)))
        hits += low <= truth <= high
        # What the chi-square law with as many degrees of freedom as errors would say: 8 % to either side.
        plain += abs(root_mean_square(errors) / truth - 1) < 2 / np.sqrt(2 * len(scales))
    assert plain / TRIALS < 0.85
    # The fourth moment of a sample falls short of the true one: a few percent of coverage.
    assert hits / TRIALS > 0.91


def test_rms_interval_of_a_known_sample() -> None:
    # chi-square quantiles of 4 degrees of freedom: 0.48442 and 11.1433.
    low, high = rms_interval(np.array([1.0, -1.0, 1.0, -1.0]), range(4))
    assert low == pytest.approx(np.sqrt(4 / 11.1433), rel=1e-5)
    assert high == pytest.approx(np.sqrt(4 / 0.48442), rel=1e-5)
    assert rms_interval(np.zeros(3), range(3)) == (0.0, 0.0)


def test_fraction_interval_of_known_cases() -> None:
    # By hand from Wilson's formula with z = 1.95996: none of 10 reaches up to z^2 / (10 + z^2).
    assert fraction_interval(0, 10) == pytest.approx((0.0, 0.27753), abs=1e-5)
    assert fraction_interval(5, 10) == pytest.approx((0.23659, 0.76341), abs=1e-5)


@pytest.mark.parametrize("count", [1, 2, 7, 64, 600, 4000])
def test_fraction_interval_is_wilsons(count: int) -> None:
    for hits in {0, 1, count // 3, count // 2, count - 1, count}:
        expected = binomtest(hits, count).proportion_ci(CONFIDENCE, method="wilson")
        # Rounding only: the formula in another order of operations.
        assert fraction_interval(hits, count) == pytest.approx((expected.low, expected.high), abs=1e-14)


@given(st.integers(1, 200), st.data())
def test_fraction_interval_holds_the_share_and_mirrors(count: int, data: st.DataObject) -> None:
    hits = data.draw(st.integers(0, count))
    low, high = fraction_interval(hits, count)
    assert 0 <= low <= hits / count <= high <= 1
    # Rounding only.
    assert fraction_interval(count - hits, count) == pytest.approx((1 - high, 1 - low), abs=1e-12)


@pytest.mark.parametrize("share", [0.5, 0.9, 0.98])
def test_fraction_interval_covers(share: float) -> None:
    n = 64
    covered = [low <= share <= high for low, high in (fraction_interval(k, n) for k in range(n + 1))]
    # Exact coverage; Wilson's intervals cover 0.95 on the average over shares, and dip by a few percent at single ones.
    assert binom.pmf(np.flatnonzero(covered), n, share).sum() > 0.92


@pytest.mark.parametrize("n", [2, 3, 6, 60])
def test_mean_interval_covers_however_few_values(n: int, rng: np.random.Generator) -> None:
    ends = np.array([mean_interval(values, range(n)) for values in rng.normal(1, 2, (TRIALS, n))])
    # Student's law is exact for normal values.
    assert np.mean((ends[:, 0] <= 1) & (ends[:, 1] >= 1)) == pytest.approx(CONFIDENCE, abs=SAMPLING)


@pytest.mark.parametrize("lengths", [(20, 20, 20, 20), (5, 10, 20, 40, 60, 80, 100, 120)])
def test_intervals_of_sequences_with_offsets_cover(lengths: tuple[int, ...], rng: np.random.Generator) -> None:
    """Errors of a sequence share an offset: many pairs of few sequences tell little more than the sequences."""
    blocks = np.repeat(np.arange(len(lengths)), lengths)
    mean_hits = rms_hits = alone = 0
    for _ in range(TRIALS):
        errors = rng.normal(0, 1, len(lengths))[blocks] + rng.normal(0, 0.3, len(blocks))
        low, high = mean_interval(errors, blocks.tolist()) or (0.0, 0.0)
        mean_hits += low <= 0 <= high
        low, high = rms_interval(errors, blocks.tolist())
        rms_hits += low <= np.sqrt(1.09) <= high
        low, high = mean_interval(errors, range(len(blocks))) or (0.0, 0.0)
        alone += low <= 0 <= high
    # Uneven lengths cost some coverage, as does the measured fourth moment.
    assert mean_hits / TRIALS > 0.90
    assert rms_hits / TRIALS > 0.88
    assert alone / TRIALS < 0.45


def test_a_single_block_has_no_interval_of_its_mean(rng: np.random.Generator) -> None:
    values = rng.normal(1, 2, (5, 1))
    assert mean_interval(values[:1, 0], [0]) is None
    assert mean_interval(values[:, 0], [3] * 5) is None


def test_mean_interval_stays_within_its_limits() -> None:
    assert mean_interval(np.array([1.0, 2.0]), [0, 1], (0.0, np.inf)) == (0.0, pytest.approx(1.5 + 12.7062 / 2))
    assert mean_interval(np.array([0.0, 1.0]), [0, 1], (0.0, 1.0)) == (0.0, 1.0)


def test_too_few_blocks_have_no_interval_of_a_percentile(rng: np.random.Generator) -> None:
    # All of five values lie on one side of their median in 2 / 2^5 = 6 %, which an interval of 95 % must not miss.
    values = rng.normal(1, 2, (60, 1))
    assert percentile_intervals(values[:5], (50.0,), range(5), "few") is None
    assert percentile_intervals(values, (95.0,), (np.arange(60) % 5).tolist(), "few") is None
    assert percentile_intervals(values[:6], (50.0,), range(6), "few") is not None


def test_percentile_intervals_cover(rng: np.random.Generator) -> None:
    hits, trials = 0, 150
    for trial in range(trials):
        ends = percentile_intervals(rng.normal(1, 2, (60, 1)), (50.0,), range(60), f"trial {trial}")
        assert ends is not None
        # Median of |N(1, 2)|, by its distribution function.
        hits += ends[0, 0, 0] <= 1.5170 <= ends[0, 0, 1]
    # The percentile bootstrap of 60 values covers 93 to 95 %; four standard errors of 150 trials are 7 %.
    assert hits / trials > 0.86


def test_percentiles_of_resamples_are_numpys(rng: np.random.Generator) -> None:
    names, percentiles = (1, 4, 9, 10, 11, 15), (50.0, 95.0)
    columns, blocks = rng.normal(0, 1, (18, 2)), np.repeat([4, 1, 9, 15, 10, 11], (3, 4, 5, 1, 2, 3))
    ends = percentile_intervals(columns, percentiles, blocks.tolist(), "key")
    members = [np.flatnonzero(blocks == block) for block in names]
    drawn = named_generator("key").integers(0, 6, (RESAMPLES, 6))
    ranks = [
        np.percentile(np.abs(columns[np.concatenate([members[k] for k in draw])]), percentiles, axis=0)
        for draw in drawn
    ]
    # Rounding only.
    np.testing.assert_allclose(ends, np.percentile(ranks, (2.5, 97.5), axis=0).transpose(2, 1, 0), rtol=1e-12)


def test_percentile_intervals_do_not_depend_on_the_order_of_frames(rng: np.random.Generator) -> None:
    columns, blocks = rng.normal(0, 1, (30, 3)), np.arange(30) // 3
    order = rng.permutation(30)
    first = percentile_intervals(columns, (95.0, 99.0), blocks.tolist(), "key")
    second = percentile_intervals(columns[order], (95.0, 99.0), blocks[order].tolist(), "key")
    np.testing.assert_array_equal(first, second)


def test_percentile_intervals_in_pieces_have_the_right_spread(rng: np.random.Generator) -> None:
    ends = percentile_intervals(rng.normal(0, 1, (5000, 2)), (50.0,), range(5000), "pieces")
    assert ends is not None
    # The median of |N(0, 1)| has a deviation of 0.5 / (density 0.6356 * sqrt n). 1000 resamples know the width to some
    # 4 %, the resamples' own density at the median to some 7 %; three times both.
    expected = 2 * 1.96 * 0.5 / 0.6356 / np.sqrt(5000)
    np.testing.assert_allclose(ends[:, 0, 1] - ends[:, 0, 0], expected, rtol=0.25)


def test_streams_differ_by_key_and_repeat() -> None:
    assert named_generator("a").integers(2**60) == named_generator("a").integers(2**60)
    assert named_generator("a").integers(2**60) != named_generator("b").integers(2**60)
