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
)


def plan(
    recipe: RecipeArgument,
    seed: SeedOption = None,
    probe: Annotated[
        bool, typer.Option(help="Render a few frames into a temporary folder to estimate time and size.")
    ] = True,
    workers: WorkersOption = None,
    engine: EngineOption = None,
    device: DeviceOption = "cpu",
    html: Annotated[Path | None, output_option("--html", "FILE", "Write the plan with its plots as one page.")] = None,
) -> None:
    """Show what a recipe will make, how long it will take and how large it will get, without making it."""
    for line in plan_lines(recipe, seed, engine, probe, ExecutionOptions(workers, device=device), html):
        typer.echo(line)
