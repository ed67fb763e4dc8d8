"""The scattering sky meets what real skies show; the tables of the study hold the same numbers."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from studies.realism.__main__ import (
    SKY_MEASURES,
    day_blue_over_red,
    glow_8_over_horizon,
    glow_blue_over_red,
    whitening,
)

RESULTS = Path(__file__).parents[3] / "studies" / "realism" / "RESULTS.md"


def test_twilight_glows_lowest_and_reddest_only_where_light_is_scattered_through_the_air() -> None:
    assert glow_blue_over_red("scattering") < 0.5 < 2.0 < glow_blue_over_red("daylight")
    assert glow_8_over_horizon("scattering") < 1.0 < glow_8_over_horizon("daylight")


def test_the_horizon_is_whiter_than_the_sky_above_it() -> None:
    assert 0.45 < whitening("scattering") < 0.75
    assert 1.1 < day_blue_over_red("scattering") < 1.7


@pytest.mark.parametrize("index", [0, 1, 2, 3, 4, 5, 7, 8, 9])
def test_the_results_are_what_the_code_measures(index: int) -> None:
    """All but the setting sun, which takes a sky for each of 80 elevations."""
    item = SKY_MEASURES[index]
    row = next(line for line in RESULTS.read_text(encoding="utf-8").splitlines() if line.startswith(f"| {item.name} |"))
    before, after = (float(cell) for cell in re.split(r"\s*\|\s*", row)[3:5])
    assert item.measure("daylight") == pytest.approx(before, rel=0.02)
    assert item.measure("scattering") == pytest.approx(after, rel=0.02)
