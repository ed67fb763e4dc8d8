"""The picture of a small disc against counted points, finite differences and its moments."""

from __future__ import annotations

import numpy as np
import pytest

from nav.centroids.disc_coverage import spread_discs, spread_ring_shares

HALF = 4


def counted(center: tuple[float, float], radius: float) -> np.ndarray:
    """Area of a disc in each pixel, by counting points."""
    per = 200
    at = (np.arange((2 * HALF + 1) * per) + 0.5) / per - HALF - 0.5
    inside = (at - center[0]) ** 2 + (at[:, None] - center[1]) ** 2 < radius**2
    return inside.reshape(2 * HALF + 1, per, 2 * HALF + 1, per).mean(axis=(1, 3))


@pytest.mark.parametrize("radius", [0.3, 0.5, 1.0, 2.7])
@pytest.mark.parametrize("center", [(0.0, 0.0), (0.31, -0.44), (-0.5, 0.5)])
def test_without_spread_it_is_the_area_in_each_pixel(center: tuple[float, float], radius: float) -> None:
    drawn = spread_discs(np.array([center]), np.array([radius]), np.array([1e-9]), HALF, 1)
    # Points on the outline are counted right to half their distance: 2 pi r / 400 of an area of a pixel, at random.
    assert np.allclose(drawn.light[0], counted(center, radius), atol=1e-3)


def test_an_ellipse_is_the_area_in_each_pixel() -> None:
    center, radii = np.array([0.31, -0.44]), np.array([1.9, 1.6])
    drawn = spread_discs(center[None], radii[None], np.array([1e-9]), HALF, 1)
    at = (np.arange(400 * (2 * HALF + 1)) + 0.5) / 400 - HALF - 0.5
    fine = ((at - center[0]) / radii[0]) ** 2 + ((at[:, None] - center[1]) / radii[1]) ** 2 < 1
    side = 2 * HALF + 1
    assert np.allclose(drawn.light[0], fine.reshape(side, 400, side, 400).mean(axis=(1, 3)), atol=1e-3)
    step = 1e-6
    for axis, slope in enumerate((drawn.by_x, drawn.by_y)):
        moved = center[None] + step * np.eye(2)[axis]
        later = spread_discs(moved, radii[None], np.array([1e-9]), HALF, 1)
        assert np.allclose(slope, (later.light - drawn.light) / step, atol=1e-4)


@pytest.mark.parametrize("cells", [1, 4])
def test_no_light_is_lost_and_its_middle_is_the_discs(cells: int) -> None:
    centers, radii = np.array([[0.2, -0.3], [0.45, 0.1]]), np.array([0.8, 1.3])
    drawn = spread_discs(centers, radii, np.full(2, 0.6), 6, cells)
    assert np.allclose(drawn.light.sum(axis=(1, 2)), np.pi * radii**2, rtol=2e-4)  # 4 sigma of the spread
    if cells == 1:
        return  # light that is collected first has lost its place within the pixel
    at = np.arange(-6, 7)
    middles = np.stack([(drawn.light * at).sum(axis=(1, 2)), (drawn.light * at[:, None]).sum(axis=(1, 2))], axis=1)
    # A sum over pixels is an integral up to aliases, which a spread of 0.6 px leaves at thousandths.
    assert np.allclose(middles / drawn.light.sum(axis=(1, 2))[:, None], centers, atol=5e-3)


@pytest.mark.parametrize("cells", [1, 4])
def test_derivatives(cells: int) -> None:
    center, radius, sigma, step = np.array([[0.23, -0.37]]), np.array([0.8]), np.array([0.5]), 1e-5
    drawn = spread_discs(center, radius, sigma, HALF, cells)

    def slope(by_center: tuple[float, float], by_sigma: float) -> np.ndarray:
        ends = [
            spread_discs(
                center + sign * step * np.array(by_center), radius, sigma + sign * step * by_sigma, HALF, cells
            )
            for sign in (1, -1)
        ]
        return (ends[0].light - ends[1].light) / (2 * step)

    assert np.allclose(drawn.by_x, slope((1, 0), 0), atol=1e-5)
    assert np.allclose(drawn.by_y, slope((0, 1), 0), atol=1e-5)
    assert np.allclose(drawn.by_sigma, slope((0, 0), 1), atol=1e-4)  # by a difference of 0.001 px itself


@pytest.mark.parametrize("cells", [1, 4])
def test_a_rings_shares_are_those_of_many_points_in_each_pixel(cells: int) -> None:
    """Without a spread to speak of, each pixel's share is the covered area; 40 x 40 points know it to a hundredth."""
    half, middle, edges = 9, np.array([0.3, -0.2]), (0.25, 0.305)
    linear = np.array([[24.0, 3.0], [-2.0, 22.0]])
    shares = spread_ring_shares(middle[None], linear[None], edges, 0.0, half, cells)[0]
    at = (np.arange((2 * half + 1) * 40) + 0.5) / 40 - half - 0.5
    x, y = np.meshgrid(at, at)
    radius = np.hypot(*np.tensordot(np.linalg.inv(linear), np.stack([x - middle[0], y - middle[1]]), axes=1))
    for share, inside in zip(shares, (radius < edges[0], radius > edges[1]), strict=True):
        area = inside.reshape(2 * half + 1, 40, 2 * half + 1, 40).mean(axis=(1, 3))
        # The smallest spread that is drawn, 0.05 px, blurs by less than a hundredth beside the edges' own error.
        assert np.abs(share - area).max() < 0.03
        assert abs(share.sum() - area.sum()) < 0.1


def test_a_rings_shares_keep_their_light_under_a_spread() -> None:
    linear = 20.0 * np.eye(2)
    sharp, broad = (
        spread_ring_shares(np.zeros((1, 2)), linear[None], (0.25, 0.305), sigma, 12, 1)[0, 0].sum()
        for sigma in (0.1, 0.6)
    )
    assert broad == pytest.approx(sharp, rel=1e-3)
