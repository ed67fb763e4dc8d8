"""`droguekit plan`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.batch.execution import ExecutionOptions
from droguekit.cli.arguments import DeviceOption, EngineOption, RecipeArgument, SeedOption, WorkersOption, output_option
from droguekit.workflows.planning import plan_lines

EXAMPLES = (
    "droguekit plan demo",
    "droguekit plan paper-corpus --html plan.html   (with plots of distances, sizes and places)",
    "droguekit plan my-recipe.toml --no-probe   (without rendering: no time and size)",
    "droguekit plan world-real --probe 20   (a better estimate, for more time)",
)


def plan(
    recipe: RecipeArgument,
    seed: SeedOption = None,
    probe: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Frames with a drogue to render for the estimate of time and size (5)."),
    ] = None,
    no_probe: Annotated[bool, typer.Option("--no-probe", help="Render nothing: no time and size.")] = False,
    workers: WorkersOption = None,
    engine: EngineOption = None,
    device: DeviceOption = "cpu",
    html: Annotated[Path | None, output_option("--html", "FILE", "Write the plan with its plots as one page.")] = None,
) -> None:
    """Show what a recipe will make, how long it will take and how large it will get, without making it."""
    if no_probe and probe is not None:
        raise ValueError("--probe: renders frames, which --no-probe forbids; leave one out")
    probes = 0 if no_probe else probe
    for line in plan_lines(recipe, seed, engine, probes, ExecutionOptions(workers, device=device), html):
        typer.echo(line)
