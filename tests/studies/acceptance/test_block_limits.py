"""Limits for pairs that come in sequences: coverage where sequences differ, and what independent pairs would give."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from studies.acceptance.acceptance_table import (
    _counted_percentile,
    block_mean_limit,
    block_percentile_limit,
    block_rms_limit,
    block_share_limit,
)

FLIGHTS, PAIRS = 8, 30
BLOCKS = np.repeat(np.arange(FLIGHTS), PAIRS).tolist()


def flights(stream: int, count: int) -> np.ndarray:
    """(count, FLIGHTS * PAIRS) of mean 5: pairs of a flight share an error of 1, and have one of 0.5 of their own."""
    rng = np.random.default_rng(stream)
    shared = rng.normal(size=(count, FLIGHTS, 1))
    return (5 + shared + 0.5 * rng.normal(size=(count, FLIGHTS, PAIRS))).reshape(count, -1)


def test_the_limit_of_a_mean_covers_it_in_19_of_20_flights() -> None:
    limits = np.array([block_mean_limit(values, BLOCKS)[1] for values in flights(1, 4000)])
    # Equal blocks of normal numbers: exact, with four standard errors of 4000 trials: 1.4 %.
    assert np.mean(limits >= 5.0) == pytest.approx(0.95, abs=0.014)
    # Taken for independent, the limits would cover it in far fewer.
    alone = [v.mean() + stats.t.ppf(0.95, v.size - 1) * stats.sem(v) for v in flights(1, 400)]
    assert np.mean(np.array(alone) >= 5.0) < 0.8


def test_equal_blocks_have_students_limit_of_their_means() -> None:
    values = flights(2, 1)[0]
    means = values.reshape(FLIGHTS, PAIRS).mean(axis=1)
    mean, limit = block_mean_limit(values, BLOCKS)
    assert mean == pytest.approx(values.mean())
    assert limit == pytest.approx(stats.ttest_1samp(means, 0.0, alternative="less").confidence_interval(0.95).high)


def test_blocks_of_unequal_length_are_weighted_by_it() -> None:
    mean, limit = block_mean_limit([1.0, 1.0, 1.0, 3.0], [0, 0, 0, 1])
    assert mean == pytest.approx(1.5)
    # Shares 2 (3 - 4.5) / 4 and 2 (3 - 1.5) / 4 by hand: a spread of 0.75 sqrt 2 over sqrt 2.
    assert limit == pytest.approx(1.5 + stats.t.ppf(0.95, 1) * 0.75)


def test_flights_that_happen_to_agree_promise_no_more_than_their_pairs() -> None:
    values = np.tile(np.random.default_rng(5).normal(size=PAIRS), FLIGHTS)
    expected = stats.ttest_1samp(values, 0.0, alternative="less").confidence_interval(0.95).high
    assert block_mean_limit(values, BLOCKS)[1] == pytest.approx(expected)
    assert block_rms_limit(values, BLOCKS)[1] > np.sqrt(np.mean(values**2))


def test_a_share_is_never_surer_than_independent_pairs_would_be() -> None:
    none = block_share_limit(np.zeros(240), BLOCKS)
    assert none == (0.0, pytest.approx(1 - 0.05 ** (1 / 240)))
    one_flight = np.zeros(240)
    one_flight[:PAIRS] = 1
    share, limit = block_share_limit(one_flight, BLOCKS)
    exact = stats.binomtest(PAIRS, 240, alternative="less").proportion_ci(0.95, method="exact").high
    assert share == 1 / FLIGHTS and limit > 1.5 * exact
    assert block_share_limit(np.ones(3), [0, 1, 2]) == (1.0, 1.0)


def test_a_root_mean_square_is_that_of_the_mean_square() -> None:
    values = flights(3, 1)[0]
    rms, limit = block_rms_limit(values, BLOCKS)
    assert (rms**2, limit**2) == pytest.approx(block_mean_limit(values**2, BLOCKS))


def test_the_limit_of_a_percentile_grows_with_a_bad_flight() -> None:
    rng = np.random.default_rng(4)
    alike = np.abs(rng.normal(size=240))
    bad = alike.copy()
    bad[:PAIRS] *= 10
    value, limit = block_percentile_limit(bad, BLOCKS, 95.0, "bad")
    assert value == pytest.approx(np.percentile(bad, 95.0))
    assert limit > value > block_percentile_limit(alike, BLOCKS, 95.0, "alike")[1]
    # The same draws for the same key.
    assert block_percentile_limit(bad, BLOCKS, 95.0, "bad") == (value, limit)
    # 240 values are too few for a 99th percentile, whatever the blocks.
    assert block_percentile_limit(bad, BLOCKS, 99.0, "bad")[1] == np.inf


def test_a_percentile_of_counted_values_is_that_of_the_repeated_ones() -> None:
    rng = np.random.default_rng(5)
    for percent in (0.0, 12.5, 50.0, 99.0, 100.0):
        values, counts = np.sort(rng.normal(size=30)), rng.integers(0, 4, 30)
        want = np.percentile(np.repeat(values, counts), percent)
        assert _counted_percentile(values, counts, percent) == pytest.approx(want, abs=1e-15)


@pytest.mark.parametrize("count", [1, 2, 50])
def test_a_single_flight_counts_its_pairs(count: int) -> None:
    values = np.arange(count, dtype=float)
    mean, limit = block_mean_limit(values, [7] * count)
    assert mean == values.mean()
    assert limit == (np.inf if count == 1 else pytest.approx(mean + stats.t.ppf(0.95, count - 1) * stats.sem(values)))
