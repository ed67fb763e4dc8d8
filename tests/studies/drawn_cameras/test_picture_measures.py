"""Measures of pictures against pictures of known noise, edges and blocks."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.stats import norm

from studies.drawn_cameras.__main__ import blockiness, calm_noise, edge_width_px, measure_pictures


def test_white_noise_has_no_correlation_and_blurred_noise_that_of_its_blur() -> None:
    noise = np.random.default_rng(1).normal(0, 6, (320, 320))
    sd, lag_one = calm_noise(np.rint(128 + noise).astype(np.uint8))
    # The calmest twentieth of the patches is calmer than the mean.
    assert sd == pytest.approx(6, rel=0.15)
    # The calmest patches, from which a plane is taken, lack the slow part of their noise.
    assert lag_one == pytest.approx(-0.03, abs=0.03)
    blurred = 4 * cv2.GaussianBlur(noise, (0, 0), 1.0)
    _, lag_one = calm_noise(np.rint(128 + blurred).astype(np.uint8))
    # Gaussian blur of 1 px correlates neighbours by exp(-1 / 4); choice and fit take some.
    assert lag_one == pytest.approx(np.exp(-0.25) - 0.06, abs=0.04)


@pytest.mark.parametrize("sigma_px", [1.0, 2.0])
def test_the_width_of_an_edge_is_that_of_its_blur(sigma_px: float) -> None:
    places = np.arange(64)[:, None] * 0.01 + 100.3
    edges = 40 + 150 * norm.cdf((np.arange(200) - places) / sigma_px)
    wanted_px = 2 * norm.ppf(0.9) * sigma_px
    # Lines between samples a pixel apart cut the bends of the edge.
    assert edge_width_px(np.rint(edges).astype(np.uint8)) == pytest.approx(wanted_px, abs=0.2)


def test_coarse_jpeg_has_blocks() -> None:
    picture = cv2.GaussianBlur(np.random.default_rng(2).normal(128, 200, (256, 256)), (0, 0), 4.0)
    clean = np.clip(picture, 0, 255).astype(np.uint8)
    _, data = cv2.imencode(".jpg", clean, [cv2.IMWRITE_JPEG_QUALITY, 5])
    assert blockiness(clean) == pytest.approx(1.0, abs=0.05)
    assert blockiness(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)) > 1.5


def test_levels_are_means_over_pictures() -> None:
    dark, bright = np.zeros((64, 64, 3), np.uint8), np.full((64, 64, 3), 254, np.uint8)
    found = measure_pictures([dark, bright])
    assert (found.pictures, found.mean, found.dark_share, found.bright_share) == (2, 127.0, 0.5, 0.5)
    assert np.isnan(found.lag_one) and np.isnan(found.edge_px)
    with pytest.raises(ValueError, match="pictures: there are none"):
        measure_pictures([])
