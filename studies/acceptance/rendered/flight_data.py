"""Which recipes the bars of whole flights are measured on, how much of each, and by which rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from datasets_manifest.recipe.recipe import FrameCounts, Recipe
from studies.acceptance.rendered.bench_rows import bench_rows
from studies.acceptance.rendered.flight_rows import approach_rows, condition_rows, lost_rows
from studies.acceptance.rendered.sequence_pairs import Scores
from studies.acceptance.table import BarRow

# Of recipes without sequences, the bench's: ten sets at each of its nine stations.
_BENCH_PART = 90

Rows = Callable[[str, Scores, bool], list[BarRow]]


@dataclass(frozen=True)
class FlightData:
    """One recipe that bars are measured on.

    Attributes:
        recipe: name of a shipped one, or a file.
        parts: how many sequences, or parts of 90 pairs of a bench, a full measurement takes.
        rows: which bars.
        follows: whether tracker and filter have something to follow.
        times: whether the run time of a pair is told.
        compares: whether all methods there are stand beside, on the same pairs.
    """

    recipe: str
    parts: int
    rows: Rows
    follows: bool = True
    times: bool = False
    compares: bool = False


FLIGHT_TIERS: dict[str, tuple[FlightData, ...]] = {
    "e": (FlightData("pose-tier-e", 20, approach_rows),),
    "docking": (
        FlightData("docking-10m", 4, approach_rows, times=True, compares=True),
        FlightData("docking-conditions", 12, condition_rows),
        FlightData("drogue-lost", 6, lost_rows),
        FlightData("semi-physical-5", 10, bench_rows, follows=False),
        FlightData("semi-physical-7", 10, bench_rows, follows=False),
    ),
}


def part_length(recipe: Recipe) -> int:
    """How many pairs one sequence, or one part of a bench, has."""
    return _BENCH_PART if recipe.sequence is None else recipe.sequence.frames_per_sequence


def with_parts(recipe: Recipe, parts: int) -> Recipe:
    """The recipe with at least so many sequences, each of those that it lacks in a scene of its own."""
    wanted = parts * part_length(recipe)
    if wanted <= recipe.frames.count:
        return recipe
    scenes = max(recipe.frames.scenes, parts)
    frames = FrameCounts.model_validate({**recipe.frames.model_dump(), "count": wanted, "scenes": scenes})
    return recipe.model_copy(update={"frames": frames})
