"""The picture of a small disc against counted points, finite differences and its moments."""

from __future__ import annotations

import numpy as np
import pytest

from nav.centroids.disc_coverage import spread_discs

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
