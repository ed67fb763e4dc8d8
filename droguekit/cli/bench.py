"""`droguekit bench`."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Annotated

import typer

from droguekit.cli.arguments import EngineOption
from droguekit.cli.pipelines import open_bench_recipe

if TYPE_CHECKING:
    from droguekit.batch.frame_task import FrameReport

EXAMPLES = ("droguekit bench", "droguekit bench --repeat 5")


def bench(
    repeat: Annotated[int, typer.Option("--repeat", help="Pairs at each distance.")] = 2,
    engine: EngineOption = None,
) -> None:
    """Measure the CPU time of a full-size pair by distance and stage, everything included.

    One process with one thread, 16 samples a pixel, after one pair that is not counted.
    """
    from droguekit.batch.measure import measure_frames

    recipe = open_bench_recipe(repeat, engine)
    stations = recipe.distance.stations_m or ()
    # The farthest first: the pair that is not counted is the cheapest.
    reports = measure_frames(recipe, tuple(reversed(range(recipe.frames.count))))
    by_station = {
        station: [report for report in reports if report.distance_m is not None and _is_at(report.distance_m, station)]
        for station in stations
    }
    stages = list(dict.fromkeys(stage for report in reports for stage in report.stage_s))
    typer.echo(f"{'distance':>9} {'CPU s/pair':>11}  share of each stage [%]")
    typer.echo(f"{'':>21}  {' '.join(f'{stage:>9}' for stage in stages)}")
    for station, measured in by_station.items():
        typer.echo(_row(station, measured, stages))


def _is_at(distance_m: float, station_m: float) -> bool:
    return abs(distance_m - station_m) < 1e-6 * station_m


def _row(station_m: float, reports: list[FrameReport], stages: list[str]) -> str:
    total = Counter[str]()
    for report in reports:
        total.update(report.stage_s)
    cpu_s = sum(total.values())
    shares = " ".join(f"{100 * total[stage] / cpu_s:9.1f}" for stage in stages)
    return f"{station_m:7g} m {cpu_s / len(reports):11.2f}  {shares}"
