"""`droguekit render`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.batch.progress import duration, progress_report
from droguekit.cli.arguments import (
    EngineOption,
    RecipeArgument,
    SeedOption,
    WorkersOption,
    human_size,
    parse_frames,
)
from droguekit.cli.main import FAULT
from droguekit.cli.pipelines import open_recipe, render_frames

EXAMPLES = (
    "droguekit render demo --out data/demo",
    "droguekit render my-recipe.toml --out data/mine --seed 7 --workers 4",
    "droguekit render demo --out data/demo --frames 0:10   (a part now, the rest later)",
)


def render(
    recipe: RecipeArgument,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="The dataset's folder; made if missing.")],
    seed: SeedOption = None,
    frames: Annotated[
        str | None, typer.Option("--frames", metavar="A:B", help="Only frames A up to but without B.")
    ] = None,
    workers: WorkersOption = None,
    engine: EngineOption = None,
) -> None:
    """Make a dataset from a recipe.

    The same command again goes on where the last one stopped: pairs that are whole stay, damaged ones are made again,
    and the result is the same as that of one undisturbed run.
    """
    chosen, text = open_recipe(recipe, seed, engine)
    wanted = parse_frames(frames, chosen.frames.count)
    summary = render_frames(chosen, text, out, wanted, workers, progress_report())
    cpu_s = sum(sum(cost.stage_s.values()) for cost in summary.made.values())
    size = human_size(sum(cost.size_bytes for cost in summary.made.values()))
    typer.echo(f"{out}: made {len(summary.made)} pairs ({duration(cpu_s)} of CPU time, {size}), kept {summary.kept}")
    typer.echo(f"{summary.pairs} of {summary.planned} pairs are there; dataset sha256 {summary.dataset_sha256}")
    for drop in summary.drops:
        typer.echo(f"frame {drop.frame_index} is missing: {drop.reason}", err=True)
    if summary.drops:
        raise typer.Exit(FAULT)
