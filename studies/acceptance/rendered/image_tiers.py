"""Tiers A and B: rendered pairs, navigated blind and benchmarked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from droguekit.benchmark.results.benchmark_result import BenchmarkResult
from studies.acceptance.rendered.image_rows import (
    Light,
    absolute_rows,
    centroid_bound_rows,
    centroid_rows,
    chain_rows,
    goal_rows,
    paper_rows,
)
from studies.acceptance.rendered.normalized_rows import tier_a_rows, tier_b_rows
from studies.acceptance.rendered.scored_frames import METHODS, score_frames
from studies.acceptance.table import BarRow


@dataclass(frozen=True)
class TierData:
    """What was made of one dataset of a tier."""

    light: Literal["day", "dusk"]
    dataset: Path
    estimates: Path
    result: BenchmarkResult


def recipe_of(tier: str, light: str) -> str:
    """Name of the recipe that a tier renders."""
    return f"pose-tier-{tier}" if light == "day" else f"pose-tier-{tier}-{light}"


def tier_a_bars(data: TierData) -> list[BarRow]:
    """Bars 1, 4, 5, 6 and 9 on one dataset.

    Raises:
        ValueError: estimates that cannot be read, or that lack a method.
    """
    light = _light(data)
    return [
        *centroid_bound_rows(light),
        *chain_rows(light, 1 / 5 if data.light == "day" else 1 / 2.5),
        *tier_a_rows(data.light, data.result),
    ]


def tier_b_bars(data: TierData) -> list[BarRow]:
    """Bars 2, 3, 4, 8, 13, 14 and 15 on one dataset, and in daylight what is aimed at by distance.

    Raises:
        ValueError: estimates that cannot be read, or that lack a method.
    """
    light, day = _light(data), data.light == "day"
    return [
        *centroid_rows(light),
        *chain_rows(light, 1 / 4 if day else 1 / 3),
        *tier_b_rows(data.light, data.result),
        *absolute_rows(light),
        *paper_rows(light),
        *(goal_rows(light) if day else []),
    ]


IMAGE_TIERS: dict[str, Callable[[TierData], list[BarRow]]] = {"a": tier_a_bars, "b": tier_b_bars}


def _light(data: TierData) -> Light:
    return Light(data.light, score_frames(data.dataset, data.estimates, METHODS))
