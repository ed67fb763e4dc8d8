"""`droguekit plan`."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Annotated

import typer

from droguekit.batch.progress import duration
from droguekit.cli.arguments import EngineOption, RecipeArgument, SeedOption, WorkersOption, human_size
from droguekit.cli.pipelines import open_recipe

if TYPE_CHECKING:
    from datasets_manifest.recipe import Recipe
    from droguekit.batch.plan import Cost, Plan

EXAMPLES = (
    "droguekit plan demo",
    "droguekit plan my-recipe.toml --no-probe   (without rendering: no time and size)",
)
_BAR_LENGTH = 40
_HISTOGRAM_BINS = 10
_MOST_LINES = 20


def plan(
    recipe: RecipeArgument,
    seed: SeedOption = None,
    probe: Annotated[
        bool, typer.Option(help="Render up to three frames into a temporary folder to reckon time and size.")
    ] = True,
    workers: WorkersOption = None,
    engine: EngineOption = None,
) -> None:
    """Show what a recipe will make, how long it will take and how large it will get, without making it."""
    from droguekit.batch.machine import default_workers
    from droguekit.batch.plan import frame_timeout_s, plan_recipe, probe_cost

    chosen, _ = open_recipe(recipe, seed, engine)
    planned = plan_recipe(chosen)
    _show_counts(chosen, planned)
    _show_distances(chosen, planned)
    typer.echo(f"a frame that is at work for {duration(frame_timeout_s(chosen))} counts as hung and is tried again")
    if probe:
        _show_cost(probe_cost(chosen, planned), default_workers() if workers is None else max(1, workers))


def _show_counts(recipe: Recipe, planned: Plan) -> None:
    camera = recipe.rig.camera
    typer.echo(
        f"{recipe.name}: {recipe.frames.count} pairs of 2 x {camera.width_px} x {camera.height_px}, "
        f"seed {recipe.seed}, drogue {recipe.drogue.name}, sensor {recipe.sensor.name}, engine {recipe.render.engine}"
    )
    splits = ", ".join(f"{name} {planned.by_split.get(name, 0)}" for name in ("train", "val", "test"))
    typer.echo(f"by split: {splits}")
    for name, (family_scenes, pairs) in planned.by_family.items():
        typer.echo(f"  {name:<16} {family_scenes:4d} scenes {pairs:7d} pairs")
    scenes = list(planned.by_scene.items())
    shown = ", ".join(f"{scene_id}: {pairs}" for scene_id, pairs in scenes[:_MOST_LINES])
    more = f" and {len(scenes) - _MOST_LINES} more" if len(scenes) > _MOST_LINES else ""
    typer.echo(f"by scene: {shown}{more}")
    typer.echo(f"without a drogue: {100 * planned.empty_fraction:.1f} %")


def _show_distances(recipe: Recipe, planned: Plan) -> None:
    import numpy as np

    distances = planned.distances_m[np.isfinite(planned.distances_m)]
    if len(distances) == 0:
        return
    if recipe.distance.stations_m is not None:
        stations = sorted(set(recipe.distance.stations_m))
        near = np.abs(distances[:, None] - np.array(stations)).argmin(axis=1)
        counts = np.bincount(near, minlength=len(stations))
        names = [f"{station:8.2f} m       " for station in stations]
    else:
        edges = np.geomspace(distances.min(), max(distances.max(), distances.min() * 1.001), _HISTOGRAM_BINS + 1)
        counts = np.histogram(distances, edges)[0]
        names = [f"{low:6.2f} - {high:6.2f} m" for low, high in pairwise(edges)]
    drawn = "" if len(planned.sampled) == recipe.frames.count else f", of {len(planned.sampled)} drawn frames"
    typer.echo(f"distance of the rim centre{drawn}:")
    for name, pairs in zip(names, counts, strict=True):
        typer.echo(f"  {name} {pairs:6d} {'#' * round(_BAR_LENGTH * pairs / max(counts.max(), 1))}".rstrip())


def _show_cost(cost: Cost, workers: int) -> None:
    typer.echo("measured, with one worker:")
    for frame_index, report in cost.probed.items():
        where = "no drogue" if report.distance_m is None else f"{report.distance_m:.2f} m"
        typer.echo(f"  frame {frame_index} ({where}): {report.wall_s:.2f} s, {human_size(report.size_bytes)}")
    typer.echo(f"all: about {duration(cost.worker_s / workers)} with {workers} workers, {human_size(cost.size_bytes)}")
