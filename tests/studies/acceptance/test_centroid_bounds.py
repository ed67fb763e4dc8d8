"""The bound of a disc's centre against a published table, scaling laws and supersampled pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from studies.acceptance.rendered.scored_frames import PixelLight, center_bound_px, disc_outline_px, outline_coverage

DAY = PixelLight(2300, 4700, 4.8, 11_700 / 255, 0.5, 0.01)
DUSK = PixelLight(60, 240, 4.8, 11_700 / 255 / 16, 0.5, 0.01)
RADII_PX = [2133.333 * 0.05 / z_m for z_m in (1.5, 2, 5, 10, 15, 20, 30, 40)]


@pytest.mark.parametrize(
    ("light", "table_px"),
    [
        (DAY, (0.0017, 0.0019, 0.0030, 0.0043, 0.0052, 0.0060, 0.0073, 0.0084)),
        (PixelLight(900, 1500, 4.8, 11.5, 0.5, 0.01), (0.0028, 0.0032, 0.0051, 0.0073, 0.0088, 0.0102, 0.0125, 0.0144)),
        (DUSK, (0.0056, 0.0064, 0.0102, 0.0144, 0.0174, 0.0202, 0.0247, 0.0285)),
        (PixelLight(10, 50, 4.8, 0.7, 0.5, 0.01), (0.0145, 0.0168, 0.0266, 0.0378, 0.0455, 0.0528, 0.0648, 0.0750)),
    ],
)
def test_bound_agrees_with_the_independent_table(light: PixelLight, table_px: tuple[float, ...]) -> None:
    bounds = [center_bound_px(radius, light) for radius in RADII_PX]
    # The table has two to three digits and read noise from rounded data sheets.
    np.testing.assert_allclose(bounds, table_px, rtol=0.045)


def test_coverage_is_that_of_a_supersampled_disc() -> None:
    samples, center, radius, sigma = 41, np.array([0.3, -0.2]), 3.3, 0.5
    grid = np.arange(-8.0, 9)
    exact = outline_coverage(*disc_outline_px(center, radius), grid, grid, sigma)
    fine = (np.arange(17 * samples) + 0.5) / samples - 8.5
    inside = ((fine[None, :] - center[0]) ** 2 + (fine[:, None] - center[1]) ** 2 <= radius**2).astype(float)
    reach = np.arange(-3 * samples, 3 * samples + 1) / samples
    kernel = np.convolve(np.exp(-(reach**2) / (2 * sigma**2)), np.ones(samples))
    kernel /= kernel.sum()
    smooth = np.apply_along_axis(np.convolve, 0, inside, kernel, "same")
    smooth = np.apply_along_axis(np.convolve, 1, smooth, kernel, "same")
    sampled = smooth[samples // 2 :: samples, samples // 2 :: samples]
    # Counting samples errs by their size times the length of the outline in a pixel, averaged down by the blur.
    np.testing.assert_allclose(sampled, exact, atol=2e-3)
    assert exact.sum() == pytest.approx(np.pi * radius**2, rel=1e-6)


def test_bound_falls_with_the_root_of_the_radius_and_with_contrast() -> None:
    dark = PixelLight(1000, 10, 0, 0, 0.5)
    near, far = center_bound_px(40, dark), center_bound_px(10, dark)
    # Curvature of the edge over its blur changes the law by (0.58 / 10)^2 / 2.
    assert far / near == pytest.approx(2, rel=5e-3)
    assert center_bound_px(10, replace(dark, contrast_e=5)) / far == pytest.approx(2, rel=5e-3)


def test_bound_depends_on_the_pixels_phase_little() -> None:
    bounds = [center_bound_px(5, DAY, (shift, 0.3)) for shift in (0, 0.25, 0.5)]
    # The blur is wider than a pixel's Nyquist limit allows aliasing beyond a few percent.
    assert max(bounds) / min(bounds) < 1.05
