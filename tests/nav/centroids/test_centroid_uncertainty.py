"""Sums over sectors and zones of the pixels against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from nav.centroids.centroid_uncertainty import sector_sums, zone_sums


def float32(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("count", [8, 16])
def test_sectors_are_those_of_the_arc_tangent(count: int) -> None:
    rng = np.random.default_rng(3)
    x, y, ones = float32(rng, 3, 4000), float32(rng, 3, 4000), np.ones((3, 4000), np.float32)
    turn = np.arctan2(y, x) / (2 * np.pi) * count
    sectors = np.floor(turn).astype(int) % count
    # Places within the polynomial's error of a limit may lie on either side.
    clear = np.abs(turn - np.rint(turn)) > 1e-5 * count
    residuals, weights = float32(rng, 3, 4000), (clear & (rng.random((3, 4000)) > 0.3)).astype(np.float32)
    sums = sector_sums(x, y, residuals, weights, count)
    for patch in range(3):
        for place, values in enumerate((ones, residuals, residuals**2)):
            expected = np.bincount(sectors[patch], (weights * values)[patch].astype(np.float64), count)
            np.testing.assert_allclose(sums[patch, :, place], expected, rtol=1e-6, atol=1e-6)
    axes = np.array([[0, 1, 0, -1, 0, 1]], np.float32), np.array([[0, 0, 1, 0, -1, -1e-9]], np.float32)
    on_axes = sector_sums(*axes, np.ones((1, 6), np.float32), np.ones((1, 6), np.float32), 8)[0, :, 0]
    assert on_axes.tolist() == [2, 0, 1, 0, 1, 0, 1, 1]


def test_zones_are_open_intervals_of_present_pixels() -> None:
    inside = np.array([[0.0, 0.2, 0.5, 0.8, 1.0, 0.5]], np.float32)
    present = np.array([[1, 1, 1, 1, 1, 0]], np.float32)
    sums = zone_sums(
        np.arange(1, 7, dtype=np.float32)[None], present, inside, np.array([[0.2, 0.8], [0.7, 9]], np.float32)
    )
    assert sums[0].tolist() == [[15, 5], [3, 1], [9, 2]]
