"""Sampling between pixels against the formula, at positions rounded to 1/32 of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from geometry.bilinear_sampling import sample_bilinear


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_it_weighs_four_neighbours_at_a_position_of_32nds_of_a_pixel(dtype: type) -> None:
    rng = np.random.default_rng(3)
    image = (rng.random((16, 20, 3)) * 255).astype(dtype)
    column, row = (rng.uniform(0.0, size - 1.02, (7, 9)).astype(np.float32) for size in (20, 16))
    u, v = (np.rint(position.astype(np.float64) * 32) / 32 for position in (column, row))
    left, top = u.astype(int), v.astype(int)
    right, down = (u - left)[..., None], (v - top)[..., None]
    corners = [image[top + dy, left + dx].astype(np.float64) for dy in (0, 1) for dx in (0, 1)]
    upper, lower = (corners[k] * (1 - right) + corners[k + 1] * right for k in (0, 2))
    expected = upper * (1 - down) + lower * down
    # Half a level where whole numbers are stored; else the float32 of a sum of four.
    tolerance = 0.5 if dtype is np.uint8 else 255 * 2.0**-22
    np.testing.assert_allclose(sample_bilinear(image, column, row), expected, rtol=0, atol=tolerance)


def test_outside_it_is_zero_or_as_the_border_says() -> None:
    image = np.arange(1, 5, dtype=np.float32).reshape(2, 2)
    column, row = np.float32([[5.0]]), np.float32([[1.0]])
    assert sample_bilinear(image, column, row).item() == 0
    assert sample_bilinear(image, column, row, cv2.BORDER_REPLICATE).item() == 4
    assert sample_bilinear(image, column, row, cv2.BORDER_WRAP).item() == 4  # column 5 repeats column 1
