from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from droguekit.scoring.poses.reference import distance_bins


def test_stations_get_a_bin_each(rng: np.random.Generator) -> None:
    stations = [40.0, 10.0, 1.7, 5.0]
    distances = [d * (1 + rng.uniform(-0.004, 0.004)) for d in stations for _ in range(5)]
    bins, labels = distance_bins(distances)
    assert len(bins) == 4
    assert [bins[label].low_m <= d <= bins[label].high_m for d, label in zip(distances, labels, strict=True)] == [
        True
    ] * 20
    assert [b.low_m for b in bins] == sorted(b.low_m for b in bins)


def test_exact_stations_have_equal_ends() -> None:
    bins, labels = distance_bins([5.0, 2.0, 5.0, 2.0])
    assert [(b.low_m, b.high_m) for b in bins] == [(2.0, 2.0), (5.0, 5.0)]
    assert labels == [1, 0, 1, 0]


def test_spread_distances_get_log_spaced_bins(rng: np.random.Generator) -> None:
    distances = np.exp(rng.uniform(np.log(1.7), np.log(40), 500)).tolist()
    bins, labels = distance_bins(distances)
    assert bins[0].low_m == min(distances)
    # The last edge is the next float above the largest distance.
    assert bins[-1].high_m == pytest.approx(max(distances), rel=1e-15)
    ratios = [b.high_m / b.low_m for b in bins]
    # Equal in the logarithm, up to rounding.
    assert max(ratios) == pytest.approx(min(ratios), rel=1e-9)
    for distance, label in zip(distances, labels, strict=True):
        assert bins[label].low_m <= distance < bins[label].high_m


def test_dense_distances_are_no_stations(rng: np.random.Generator) -> None:
    bins, _ = distance_bins(rng.uniform(1.7, 10, 3000).tolist())
    assert len(bins) == 6  # two to a doubling of log2(10 / 1.7) = 2.56


def test_bins_without_frames_are_left_out() -> None:
    distances = [*np.linspace(2, 2.5, 40), *np.linspace(30, 40, 40)]
    bins, labels = distance_bins(distances)
    assert set(labels) == set(range(len(bins)))
    assert any(after.low_m > before.high_m for before, after in pairwise(bins))


def test_few_frames_share_one_bin() -> None:
    bins, labels = distance_bins([2.0, 3.0, 9.0])
    assert len(bins) == 1
    assert labels == [0, 0, 0]
    assert distance_bins([]) == ([], [])
    assert distance_bins([7.0])[0][0].low_m == 7.0


def test_the_order_of_frames_does_not_matter(rng: np.random.Generator) -> None:
    distances = rng.uniform(2, 20, 90)
    order = rng.permutation(90)
    bins, labels = distance_bins(distances.tolist())
    bins_again, labels_again = distance_bins(distances[order].tolist())
    assert bins == bins_again
    assert np.array(labels)[order].tolist() == labels_again


def test_a_distance_behind_the_camera_is_refused() -> None:
    with pytest.raises(ValueError, match="distances_m: must be positive, got -1"):
        distance_bins([2.0, -1.0])
