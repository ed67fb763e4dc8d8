"""`droguekit bench`."""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Annotated

import typer

from droguekit.cli.arguments import EngineOption, WorkersOption
from droguekit.workflows.render_timing import BENCH_QUALITIES, open_bench_recipe, open_uniform_bench_recipe

if TYPE_CHECKING:
    from droguekit.batch.frame_task import FrameReport
    from droguekit.batch.frame_timing import MeasuredFrame

EXAMPLES = ("droguekit bench", "droguekit bench --repeat 5 --workers 8", "droguekit bench --pairs 500")


def bench(
    repeat: Annotated[int, typer.Option("--repeat", help="Pairs at each distance.")] = 2,
    pairs: Annotated[int, typer.Option("--pairs", help="Pairs over the uniform law, for each quality.")] = 40,
    workers: WorkersOption = None,
    engine: EngineOption = None,
) -> None:
    """Measure the CPU time of a full-size pair by distance and stage, everything included.

    One process with one thread, 16 samples a pixel, after one pair that is not counted. Then the mean over distances
    uniform from 2 to 40 m in eight scenes, with 16 and with 64 samples, the renderer's noise on the drogue against the
    sensor's (root mean square over pairs), and how much more memory the process holds after the last pair than after
    the first fifth. Last, how many pairs a second all workers make of these, by the clock.
    """
    from droguekit.batch.execution import default_workers
    from droguekit.batch.frame_timing import frames_per_second, measure_closely, measure_frames, warm_up

    workers = default_workers() if workers is None else workers
    if workers < 1:
        raise ValueError(f"--workers: must be at least 1, got {workers}")
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
    typer.echo(f"\n{'2 to 40 m':>9} {'CPU s/pair':>11} {'noise/sensor':>13} {'memory [MB]':>12} {'growth':>8}")
    for quality in BENCH_QUALITIES:
        uniform = open_uniform_bench_recipe(pairs, quality, engine)
        typer.echo(_mean_row(quality, measure_closely(uniform, tuple(range(pairs)))))
    typer.echo(f"\n{'2 to 40 m':>9} {'pairs/s by the clock':>20} {'workers':>8}")
    for quality in BENCH_QUALITIES:
        uniform = open_uniform_bench_recipe(pairs + warm_up(workers), quality, engine)
        typer.echo(f"{quality:>9} {frames_per_second(uniform, workers):20.2f} {workers:8d}")


def _is_at(distance_m: float, station_m: float) -> bool:
    return abs(distance_m - station_m) < 1e-6 * station_m


def _row(station_m: float, reports: list[FrameReport], stages: list[str]) -> str:
    total = Counter[str]()
    for report in reports:
        total.update(report.stage_s)
    cpu_s = sum(total.values())
    shares = " ".join(f"{100 * total[stage] / cpu_s:9.1f}" for stage in stages)
    return f"{station_m:7g} m {cpu_s / len(reports):11.2f}  {shares}"


def _mean_row(quality: str, frames: tuple[MeasuredFrame, ...]) -> str:
    cpu_s = sum(sum(frame.report.stage_s.values()) for frame in frames) / len(frames)
    noise = [frame.noise_over_sensor for frame in frames if frame.noise_over_sensor is not None]
    over_sensor = f"{math.sqrt(sum(value**2 for value in noise) / len(noise)):.2f}" if noise else "-"
    early, late = frames[(len(frames) - 1) // 5].memory_bytes, frames[-1].memory_bytes
    memory = f"{late / 1e6:12.0f} {late / early - 1:8.1%}" if early and late else f"{'-':>12} {'-':>8}"
    return f"{quality:>9} {cpu_s:11.2f} {over_sensor:>13} {memory}"
