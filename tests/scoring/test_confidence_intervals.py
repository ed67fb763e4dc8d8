from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, binomtest

from datasets_manifest.random_streams import named_generator
from droguekit.scoring.confidence_intervals import (
    CONFIDENCE,
    bootstrap_intervals,
    fraction_interval,
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
        low, high = rms_interval(rng.normal(0, 2, n))
        hits += low <= 2 <= high
    # Never too narrow; wider by what the measured fourth moment costs, 4 % at most.
    assert CONFIDENCE - SAMPLING <= hits / TRIALS <= CONFIDENCE + 0.04


def test_rms_interval_allows_for_a_mixture_of_scales(rng: np.random.Generator) -> None:
    scales = np.repeat([0.1, 1.0, 10.0], 40)
    truth = root_mean_square(scales)
    hits = plain = 0
    for _ in range(TRIALS):
        errors = rng.normal(0, scales)
        low, high = rms_interval(errors)
        hits += low <= truth <= high
        # What the chi-square law with as many degrees of freedom as errors would say: 8 % to either side.
        plain += abs(root_mean_square(errors) / truth - 1) < 2 / np.sqrt(2 * len(scales))
    assert plain / TRIALS < 0.85
    # The fourth moment of a sample falls short of the true one: a few percent of coverage.
    assert hits / TRIALS > 0.91


def test_rms_interval_of_a_known_sample() -> None:
    # chi-square quantiles of 4 degrees of freedom: 0.48442 and 11.1433.
    low, high = rms_interval(np.array([1.0, -1.0, 1.0, -1.0]))
    assert low == pytest.approx(np.sqrt(4 / 11.1433), rel=1e-5)
    assert high == pytest.approx(np.sqrt(4 / 0.48442), rel=1e-5)
    assert rms_interval(np.zeros(3)) == (0.0, 0.0)


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


def test_bootstrap_covers_mean_and_percentile(rng: np.random.Generator) -> None:
    mean_hits = rank_hits = 0
    trials = 300
    for trial in range(trials):
        means, ranks = bootstrap_intervals(rng.normal(1, 2, (60, 1)), (50.0,), f"trial {trial}")
        mean_hits += means[0, 0] <= 1 <= means[0, 1]
        # Median of |N(1, 2)|, by its distribution function.
        rank_hits += ranks[0, 0, 0] <= 1.5170 <= ranks[0, 0, 1]
    # The percentile bootstrap of 60 values covers 93 to 95 %; four standard errors of 300 trials are 5 %.
    assert mean_hits / trials > 0.88
    assert rank_hits / trials > 0.88


def test_bootstrap_does_not_depend_on_the_order_of_frames(rng: np.random.Generator) -> None:
    columns = rng.normal(0, 1, (30, 3))
    first = bootstrap_intervals(columns, (95.0, 99.0), "key")
    second = bootstrap_intervals(columns[rng.permutation(30)], (95.0, 99.0), "key")
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


def test_bootstrap_in_pieces_has_the_right_spread(rng: np.random.Generator) -> None:
    columns = rng.normal(0, 1, (5000, 2))
    means, _ = bootstrap_intervals(columns, (95.0,), "pieces")
    # 1000 resamples know the width of a normal interval to about 4 %; four times that.
    np.testing.assert_allclose(means[:, 1] - means[:, 0], 2 * 1.96 / np.sqrt(5000), rtol=0.16)


def test_streams_differ_by_key_and_repeat() -> None:
    assert named_generator("a").integers(2**60) == named_generator("a").integers(2**60)
    assert named_generator("a").integers(2**60) != named_generator("b").integers(2**60)
