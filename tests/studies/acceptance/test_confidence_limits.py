"""Limits of the criteria against scipy's own tests and against what they promise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from studies.acceptance import acceptance_table
from studies.acceptance.acceptance_table import AcceptanceTable, at_most, between, not_measured


def rng(stream: int) -> np.random.Generator:
    return np.random.default_rng(stream)


def test_the_limit_of_a_root_mean_square_is_the_chi_square_one() -> None:
    values = rng(1).normal(size=400)
    rms, limit = acceptance_table.rms_limit(values)
    assert rms == pytest.approx(np.sqrt(np.mean(values**2)))
    # At the limit, so small a sum of squares has just the probability of 5 %.
    assert stats.chi2.cdf(400 * rms**2 / limit**2, 400) == pytest.approx(0.05)


def test_the_limit_of_a_mean_is_students() -> None:
    values = rng(2).normal(3.0, 2.0, size=30)
    _, limit = acceptance_table.mean_limit(values)
    assert limit == pytest.approx(stats.ttest_1samp(values, 0.0, alternative="less").confidence_interval(0.95).high)


@pytest.mark.parametrize(("hits", "count"), [(0, 400), (7, 400), (399, 400), (400, 400)])
def test_the_limit_of_a_share_is_the_exact_one(hits: int, count: int) -> None:
    share, limit = acceptance_table.share_limit(hits, count)
    test = stats.binomtest(hits, count, alternative="less")
    assert share == hits / count
    assert limit == pytest.approx(test.proportion_ci(0.95, method="exact").high)


def test_the_limit_of_a_percentile_covers_it_in_19_of_20_samples() -> None:
    true = stats.halfnorm.ppf(0.99)
    samples = rng(3).normal(size=(2000, 600))
    covered = np.mean([acceptance_table.percentile_limit(sample, 99.0)[1] >= true for sample in samples])
    # The order statistic is the first that reaches 95 %; four standard errors of 2000 trials are 2 %.
    assert covered >= 0.95 - 0.02


@pytest.mark.parametrize(("percent", "fewest"), [(99.0, 299), (50.0, 5)])
def test_too_few_values_give_a_percentile_no_limit(percent: float, fewest: int) -> None:
    # As many values all lie below the percentile with (percent / 100)^n, which must not exceed 5 %.
    assert (percent / 100) ** fewest <= 0.05 < (percent / 100) ** (fewest - 1)
    values = rng(8).normal(size=fewest)
    assert acceptance_table.percentile_limit(values, percent)[1] == np.abs(values).max()
    assert acceptance_table.percentile_limit(values[1:], percent)[1] == np.inf


def test_a_single_number_gives_a_mean_no_limit() -> None:
    assert acceptance_table.mean_limit([3.0]) == (3.0, np.inf)


def test_what_is_missing_of_pairs_counts_as_whole_pairs() -> None:
    for missing, whole in ((0, 0), (1, 1), (16, 1), (17, 2)):
        parts = np.zeros(100)
        parts[: -(-missing // 8)] = [8 / 16] * (missing // 8) + [missing % 8 / 16] * (missing % 8 > 0)
        share, limit = acceptance_table.partial_share_limit(parts)
        assert share == pytest.approx(missing / 1600)
        assert limit == acceptance_table.share_limit(whole, 100)[1]


def test_the_limit_of_a_ratio_in_the_same_frames_covers_it_in_19_of_20_samples() -> None:
    draws = rng(4)
    place = draws.exponential(1.0, (4000, 40, 10))
    above, below = (size * (place * draws.exponential(1.0, place.shape)).sum(axis=2) for size in (2.0, 1.0))
    limits = np.array([acceptance_table.paired_ratio_limit(a, b)[1] for a, b in zip(above, below, strict=True)])
    # First order in the number of blocks, and four standard errors of 4000 trials: 1.4 %.
    assert np.mean(limits >= 2.0) == pytest.approx(0.95, abs=0.025)


@pytest.mark.parametrize(("above", "below"), [([0, 0], [1, 2]), ([1, 2], [0, 0]), ([0, 0], [0, 0])])
def test_errors_that_are_all_zero_have_no_ratio(above: list[float], below: list[float]) -> None:
    row = at_most("4", "x", 1.0, acceptance_table.paired_ratio_limit(above, below), 2)
    assert (row.measured, row.met, row.note) == (None, False, "errors that are all zero have no ratio")


def test_what_two_errors_share_does_not_widen_the_limit_of_their_ratio() -> None:
    draws = rng(7)
    below = draws.normal(0, 1.0, (4000, 300))
    # Uncorrelated with `below - above`, as an optimal estimate is with what another adds; of variance 0.9.
    above = 0.9 * below + np.sqrt(0.9 * 0.1) * draws.normal(0, 1.0, below.shape)
    limits = []
    for a, b in zip(above, below, strict=True):
        sizes = np.sqrt(np.mean(a**2)), np.sqrt(np.mean(b**2))
        correlation = np.mean(a * b) / (sizes[0] * sizes[1])
        limits.append(acceptance_table.paired_rms_ratio_limit(*sizes, correlation, a.size)[1])
    # As above.
    assert np.mean(np.array(limits) >= np.sqrt(0.9)) == pytest.approx(0.95, abs=0.02)
    # Taken as independent the limit would be 7 % above the ratio.
    assert np.mean(limits) < 1.035 * np.sqrt(0.9)


def test_the_limits_of_nees_hold_the_chi_square_quantiles() -> None:
    freedom = 2000
    value, low, high = acceptance_table.nees_limits(1.0, freedom)
    quantiles = stats.chi2.ppf([0.05, 0.95], freedom) / freedom
    # The normal law departs from chi-square by the order of 1/freedom.
    assert (value, low, high) == pytest.approx((1.0, *quantiles), abs=2 / freedom)


def test_a_bar_is_met_when_its_limit_is_and_not_when_only_its_value_is() -> None:
    assert at_most("5", "x", 1.2, (1.1, 1.19), 10).met
    assert not at_most("5", "x", 1.2, (1.1, 1.21), 10).met
    assert between("9", "x", (0.85, 1.2), (1.0, 0.9, 1.1), 10).met
    assert not between("9", "x", (0.85, 1.2), (1.0, 0.8, 1.1), 10).met
    assert not not_measured("4", "x", 1.0, "why").met


def test_a_bar_without_a_limit_is_not_met_and_says_so() -> None:
    row = at_most("14", "x", 1.0, (0.1, np.inf), 20, "1 of 20 pairs without a pose")
    assert (row.measured, row.limit_high, row.met) == (0.1, None, False)
    assert row.note == "too few values for a 95 % limit; 1 of 20 pairs without a pose"
    row = between("goal", "x", (0.85, 1.2), (1.0, -np.inf, np.inf), 20)
    assert (row.limit_low, row.limit_high, row.met, row.note) == (None, None, False, "too few values for a 95 % limit")


def test_the_table_counts_numbered_bars_and_shows_all() -> None:
    rows = (at_most("5", "five", 1, (2, 3), 4), at_most("goal", "aim", 1, (2, 3), 4), at_most("6", "six", 1, (0, 0), 4))
    table = AcceptanceTable(tier="a", seed=1, code_version="0", rows=rows)
    assert table.missed == 1
    assert "1 of 2 bars are met" in table.to_markdown()
    assert [line.split()[0] for line in table.to_lines()] == ["bar", "5", "goal", "6"]
    assert AcceptanceTable.model_validate_json(table.to_json()) == table
