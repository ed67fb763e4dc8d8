"""How fast stereo pairs are rendered, by distance, quality and stage."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from importlib.resources import files
from typing import TYPE_CHECKING

from droguekit.workflows.rendering import open_recipe

if TYPE_CHECKING:
    from datasets_manifest.recipe.recipe import Recipe
    from droguekit.batch.frame_cost import MeasuredFrame
    from droguekit.batch.frame_task import FrameReport
    from render.device import Device

QUALITIES = ("corpus", "benchmark")


def render_timing_lines(
    repeat: int, pairs: int, workers: int | None, engine: str | None, device: Device = "cpu"
) -> Iterator[str]:
    """Measure, and give the lines of three tables as they are measured: by distance, by quality, and by the clock.

    Args:
        repeat: pairs at each distance.
        pairs: over the uniform law, for each quality.
        workers: processes of the measurement by the clock; as many as the machine can carry when None.
        engine: replaces the recipes'.
        device: that the engine renders on.

    Raises:
        ValueError: a wrong number, or an engine or device that cannot be used.
        OSError: a process died, or a temporary folder cannot be written.
    """
    from droguekit.batch.execution import default_workers
    from droguekit.batch.frame_cost import frames_per_second, measure_frames, warm_up_frames
    from render.engine import engine_notice

    workers = default_workers(device) if workers is None else workers
    if workers < 1:
        raise ValueError(f"--workers: must be at least 1, got {workers}")
    uniform = {quality: open_uniform_recipe(pairs, quality, engine) for quality in QUALITIES}
    recipe = open_stations_recipe(repeat, engine)
    engine_notice(recipe.render.engine, device)
    # The farthest first: the pair that is not counted is the cheapest.
    measured = measure_frames(recipe, tuple(reversed(range(recipe.frames.count))), device)
    yield from _stations_table(recipe, tuple(frame.report for frame in measured))
    yield f"\n{'2 to 40 m':>9} {'CPU s/pair':>11} {'noise/sensor':>13} {'memory [MB]':>12} {'growth':>8}"
    for quality in QUALITIES:
        yield _mean_row(quality, measure_frames(uniform[quality], tuple(range(pairs)), device))
    yield f"\n{'2 to 40 m':>9} {'pairs/s by the clock':>20} {'workers':>8}"
    for quality in QUALITIES:
        longer = open_uniform_recipe(pairs + warm_up_frames(workers), quality, engine)
        yield f"{quality:>9} {frames_per_second(longer, workers, device):20.2f} {workers:8d}"


def open_stations_recipe(repeat: int, engine: str | None) -> Recipe:
    """The recipe `bench-stations` with `repeat` pairs at each distance.

    Raises:
        ValueError: fewer than one pair, or no such engine.
    """
    if repeat < 1:
        raise ValueError(f"--repeat: must be at least 1, got {repeat}")
    recipe = _packaged_recipe("bench-stations", engine)
    return _with_frames(recipe, repeat * len(recipe.distance.stations_m or ()), recipe.frames.scenes)


def open_uniform_recipe(pairs: int, quality: str, engine: str | None) -> Recipe:
    """The recipe `bench-corpus` or `bench-benchmark` with `pairs` pairs in several scenes.

    Raises:
        ValueError: fewer than one pair, or no such engine.
    """
    if pairs < 1:
        raise ValueError(f"--pairs: must be at least 1, got {pairs}")
    recipe = _packaged_recipe(f"bench-{quality}", engine)
    return _with_frames(recipe, pairs, min(pairs, recipe.frames.scenes))


def _packaged_recipe(name: str, engine: str | None) -> Recipe:
    return open_recipe(str(files("droguekit.workflows") / "recipes" / f"{name}.toml"), None, engine).recipe


def _with_frames(recipe: Recipe, count: int, scenes: int) -> Recipe:
    frames = recipe.frames.model_copy(update={"count": count, "scenes": scenes})
    return type(recipe).model_validate(dict(recipe) | {"frames": frames})


def _stations_table(recipe: Recipe, reports: tuple[FrameReport, ...]) -> Iterator[str]:
    """CPU time of a pair at each distance, and the share of each stage; dashes where no pair was measured."""
    stages = list(dict.fromkeys(stage for report in reports for stage in report.stage_s))
    yield f"{'distance':>9} {'CPU s/pair':>11}  share of each stage [%]"
    yield f"{'':>21}  {' '.join(f'{stage:>9}' for stage in stages)}"
    for station_m in recipe.distance.stations_m or ():
        total, count = Counter[str](), 0
        for report in reports:
            if report.distance_m is not None and abs(report.distance_m - station_m) < 1e-6 * station_m:
                total.update(report.stage_s)
                count += 1
        cpu_s = sum(total.values())
        mean = f"{cpu_s / count:.2f}" if count else "-"
        shares = " ".join(f"{f'{100 * total[stage] / cpu_s:.1f}' if cpu_s else '-':>9}" for stage in stages)
        yield f"{station_m:7g} m {mean:>11}  {shares}"


def _mean_row(quality: str, frames: tuple[MeasuredFrame, ...]) -> str:
    """Mean CPU time of a pair, renderer's noise over the sensor's, and the process's memory and its growth."""
    cpu_s = sum(sum(frame.report.stage_s.values()) for frame in frames) / len(frames)
    noise = [frame.noise_over_sensor for frame in frames if frame.noise_over_sensor is not None]
    over_sensor = f"{math.sqrt(sum(value**2 for value in noise) / len(noise)):.2f}" if noise else "-"
    early, late = frames[(len(frames) - 1) // 5].memory_bytes, frames[-1].memory_bytes
    memory = f"{late / 1e6:12.0f} {late / early - 1:8.1%}" if early and late else f"{'-':>12} {'-':>8}"
    return f"{quality:>9} {cpu_s:11.2f} {over_sensor:>13} {memory}"
