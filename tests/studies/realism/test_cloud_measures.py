"""The measures of clouds give what pictures of known spread, roughness and blur have."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from studies.realism.cloud_measures import CASES, bimodality, edge_blur_px, photographed, spectrum_slope

RESULTS = Path(__file__).parents[3] / "studies" / "realism" / "RESULTS.md"


def test_bimodality_of_known_spreads() -> None:
    rng = np.random.default_rng(2)
    # A hundred thousand samples: a standard deviation of the kurtosis of 0.015, half a percent.
    assert bimodality(rng.random(100_000)) == pytest.approx(5 / 9, rel=0.02)
    assert bimodality(rng.standard_normal(100_000)) == pytest.approx(1 / 3, rel=0.02)
    assert bimodality(np.repeat([0.0, 1.0], 50_000)) == pytest.approx(1.0)


@pytest.mark.parametrize("slope", [-2.0, -3.5])
def test_slope_of_a_power_law(slope: float) -> None:
    rng = np.random.default_rng(3)
    radius = np.hypot(*np.meshgrid(np.fft.fftfreq(256), np.fft.fftfreq(256)))
    radius[0, 0] = 1.0
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((256, 256))) * radius ** (slope / 2)).real
    # A dozen rings with tens of waves in the smallest: a tenth of the slope's size.
    assert spectrum_slope(field[:128, :128]) == pytest.approx(slope, abs=0.25)


@pytest.mark.parametrize("sigma_px", [0.8, 2.0])
def test_blur_of_a_step(sigma_px: float) -> None:
    step = np.where(np.arange(96) < 48, 1.0, 5.0) * np.ones((40, 1))
    blurred = cv2.GaussianBlur(step, (0, 0), sigma_px)
    # Differences of whole pixels take the slope for less than it is.
    assert edge_blur_px(blurred) == pytest.approx(sigma_px, rel=0.12)


def test_photographs_are_read_as_linear_light(tmp_path: Path) -> None:
    file = tmp_path / "grey.png"
    cv2.imwrite(str(file), np.full((4, 4, 3), 128, dtype=np.uint8))
    np.testing.assert_allclose(photographed(file), 0.2159, atol=1e-3)  # IEC 61966-2-1
    with pytest.raises(ValueError, match=r"none\.png: cannot be read"):
        photographed(tmp_path / "none.png")


def test_the_table_shows_softer_spread_and_sharper_edges_than_before() -> None:
    # The comparison has six figures a row; later tables of the same kinds have three.
    rows = re.findall(
        r"^\| `(cirrus|cumulus|stratus)`[^|]*\| ((?:[-\d.]+ \| ){5}[-\d.]+) \|$",
        RESULTS.read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    assert len(rows) == len(CASES)
    for kind, cells in rows:
        spread_before, spread, slope_before, slope, blur_before, blur = map(float, cells.split(" | "))
        assert abs(slope + 3.5) < abs(slope_before + 3.5) and blur < blur_before
        assert kind != "cirrus" or spread < spread_before
