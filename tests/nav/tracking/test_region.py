"""Resampled image regions: points must keep their positions."""

from __future__ import annotations

import numpy as np
import pytest

from nav.tracking.region import EyeImage, image_region


def spot(x: float, y: float, sigma: float, bits: int = 8) -> EyeImage:
    """A Gaussian spot on black, in a corner of which the middle of gravity is known exactly."""
    v, u = np.mgrid[:300, :400]
    light = np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * sigma**2))
    pixels = np.round(light * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    return EyeImage(np.stack([pixels] * 3, axis=-1), 0.0)


@pytest.mark.parametrize("step_px", [0.5, 1.0, 1.1, 1.4, 1.7, 4.0, 9.3])
def test_resampling_keeps_a_spot_in_place(step_px: float) -> None:
    region = image_region(spot(217.3, 140.8, 20), (100, 40, 230, 210), step_px)
    assert region is not None
    np.testing.assert_allclose(region.step_px, step_px, rtol=0.03)
    weights = region.pixels[:, :, 0].astype(np.float64)
    rows, columns = np.mgrid[: region.size[1], : region.size[0]]
    middle = np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()
    # Rounding to 8 bits, and the spot's tails beyond the window.
    np.testing.assert_allclose(region.to_image(middle), (217.3, 140.8), atol=0.06)
    np.testing.assert_allclose(region.to_grid(region.to_image(middle)), middle, atol=1e-9)


def test_twelve_bits_become_eight_by_a_square_root() -> None:
    light = image_region(spot(200, 150, 60, bits=12), (149.5, 99.5, 150, 100), 1.0)
    assert light is not None
    assert light.pixels.dtype == np.uint8
    # One sigma off, 60 px beside the middle, the light is exp(-1/2) and its root exp(-1/4); both are rounded.
    assert light.pixels[50, 110, 0] == pytest.approx(255 * np.exp(-0.25), abs=1)
    assert light.pixels.max() == 255


def test_there_is_no_region_outside_the_image() -> None:
    image = spot(200, 150, 20)
    assert image_region(image, (500, 10, 50, 50), 1.0) is None
    edge = image_region(image, (390, -20, 50, 50), 1.0)
    assert edge is not None and edge.size == (10, 31)
    np.testing.assert_allclose(edge.origin_px, (390, 0))
