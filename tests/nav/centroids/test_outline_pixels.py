"""Which pixels are gathered around outlines."""

from __future__ import annotations

import numpy as np
import pytest

from nav.centroids.ellipses import Ellipses
from nav.centroids.marker_signal import MarkerSignal
from nav.centroids.outline_pixels import annulus_pixels, disc_pixels


def float32(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.normal(size=shape).astype(np.float32)


def outlines(rng: np.random.Generator, count: int, radius_px: float, side_px: int) -> Ellipses:
    shape = np.array([[1.0, 0.1], [0.1, 0.9]])
    centers = rng.uniform(0.45 * side_px, 0.55 * side_px, (count, 2))
    eyes = np.arange(count) % 2
    return Ellipses(eyes, centers, np.tile(radius_px * shape, (count, 1, 1)))


def inwards(outline: Ellipses, index: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Inward distances of all pixels from one outline; docs/explanation/centroids.md has the formula for circles."""
    arms = np.linalg.solve(
        outline.shapes_px[index], np.stack([x, y]).reshape(2, -1) - outline.centers_px[index][:, None]
    )
    return (outline.radii_px[index] * (1 - np.hypot(*arms))).reshape(x.shape)


@pytest.mark.parametrize("radius_px", [6.0, 40.0])
@pytest.mark.parametrize("kind", ["disc", "annulus"])
def test_chosen_pixels_are_those_near_edges_and_few_of_the_others(kind: str, radius_px: float) -> None:
    rng = np.random.default_rng([4, int(radius_px)])
    side = int(3 * radius_px + 20)
    signals = [
        MarkerSignal(float32(rng, side, side), rng.random((side, side)) > 0.9, (0.0, 0.0), 1, True) for _ in "lr"
    ]
    outer = outlines(rng, 4, radius_px, side)
    inner = Ellipses(outer.eyes, outer.centers_px + 0.3, outer.shapes_px / 1.5)
    pixels = disc_pixels(signals, outer) if kind == "disc" else annulus_pixels(signals, outer, inner)
    y, x = np.mgrid[:side, :side].astype(np.float64)
    assert not pixels.truncated.any()
    for index in range(4):
        here = pixels.present[index] > 0
        columns = np.rint(pixels.x_px[index, here] + outer.centers_px[index, 0]).astype(int)
        rows = np.rint(pixels.y_px[index, here] + outer.centers_px[index, 1]).astype(int)
        taken = np.zeros((side, side), bool)
        taken[rows, columns] = True
        assert taken.sum() == here.sum()
        signal = signals[outer.eyes[index]]
        np.testing.assert_array_equal(pixels.values[index, here], signal.values[rows, columns])
        np.testing.assert_array_equal(pixels.clipped[index, here], signal.clipped[rows, columns])
        assert not pixels.values[index, ~here].any() and not pixels.clipped[index, ~here].any()
        to_outer, to_inner = inwards(outer, index, x, y), inwards(inner, index, x, y)
        at_edge = np.abs(to_outer) < 2.499
        within = to_outer > 2.501
        if kind == "annulus":
            at_edge |= np.abs(to_inner) < 2.499
            within &= to_inner < -2.501
            assert not (taken & (to_inner > 2.501)).any()
        assert taken[at_edge].all()
        assert not taken[to_outer < -2.501].any()
        if kind == "disc" and radius_px < 24:
            assert taken[within].all()
        else:
            step = np.flatnonzero((taken & within).any(axis=0))
            assert set(np.diff(step)) <= {4}
            assert (taken & within).sum() <= within.sum() / 16 + 4 * radius_px / 4


def test_an_outline_over_the_edge_of_the_image_is_cut() -> None:
    rng = np.random.default_rng(5)
    signals = [MarkerSignal(float32(rng, 60, 60), np.zeros((60, 60), bool), (0.0, 0.0), 1, True) for _ in "lr"]
    centers = np.array([[30.0, 30.0], [9.0, 30.0], [30.0, 51.0], [13.6, 30.0]])
    discs = Ellipses(np.array([0, 1, 0, 1]), centers, np.tile(10.0 * np.eye(2), (4, 1, 1)))
    # 10 px and 2.5 px beyond them.
    assert disc_pixels(signals, discs).truncated.tolist() == [False, True, True, False]
