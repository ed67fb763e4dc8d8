"""`droguekit render`."""

from __future__ import annotations

from typing import Annotated

import typer

from datasets_manifest.storage.storage import as_location
from droguekit.batch.execution import ExecutionOptions
from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import (
    DeviceOption,
    EngineOption,
    Place,
    RecipeArgument,
    SeedOption,
    TarOption,
    WorkersOption,
    parse_frames,
    parse_shard,
)
from droguekit.cli.main import FAULT
from droguekit.workflows.rendering import open_recipe, render_frames, run_lines

EXAMPLES = (
    "droguekit render demo --out data/demo",
    "droguekit render my-recipe.toml --out data/mine --seed 7 --workers 4",
    "droguekit render demo --out data/demo --frames 0:10   (a part now, the rest later)",
    "droguekit render my-recipe.toml --out s3://bucket/mine --tar 1000   (an object store, tar files of 1000 pairs)",
    "droguekit render demo --out data/demo-0 --shard 0/4   (a quarter here, the rest on other machines; see `merge`)",
)


def render(
    recipe: RecipeArgument,
    out: Annotated[
        Place,
        typer.Option(
            "--out",
            metavar="DIR",
            parser=str,
            callback=as_location,
            help="The dataset's folder, made if missing, or a URL such as s3://BUCKET/NAME.",
        ),
    ],
    seed: SeedOption = None,
    frames: Annotated[
        str | None, typer.Option("--frames", metavar="A:B", help="Only frames from A up to B - 1.")
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option("--shard", metavar="I/N", help="Only every N-th frame, starting with the I-th (counted from 0)."),
    ] = None,
    tar: TarOption = None,
    workers: WorkersOption = None,
    timeout: Annotated[
        float | None,
        typer.Option(
            "--timeout", metavar="S", help="Seconds allowed for one frame; by default what `droguekit plan` shows."
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="Render on the workers of this Dask scheduler, such as tcp://HOST:8786.",
        ),
    ] = None,
    engine: EngineOption = None,
    device: DeviceOption = "cpu",
) -> None:
    """Make a dataset from a recipe.

    Run again, the same command continues where it stopped: it keeps complete pairs and renders damaged ones again, and
    the result is the same as that of an uninterrupted run. Ctrl-C finishes the pairs being rendered and stops; a second
    Ctrl-C stops at once.
    """
    source = open_recipe(recipe, seed, engine)
    wanted = parse_shard(shard, parse_frames(frames, source.recipe.frames.count))
    options = ExecutionOptions(workers, timeout, scheduler, tar, device)
    summary = render_frames(source, out, wanted, options, progress_report())
    for line in run_lines(out, summary):
        typer.echo(line)
    for drop in summary.drops:
        typer.echo(f"frame {drop.frame_index} is missing: {drop.reason}", err=True)
    if summary.drops:
        raise typer.Exit(FAULT)
