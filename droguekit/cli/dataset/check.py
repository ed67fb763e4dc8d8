"""`droguekit check`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.cli.arguments import EngineOption, RecipeArgument, SeedOption, output_option
from droguekit.workflows.checking import checked_lines

EXAMPLES = (
    "droguekit check demo",
    "droguekit check my-recipe.toml --html check.html --json check.json",
    "droguekit check my-recipe.toml --engine analytic --html check.html   (pictures without a path tracer)",
)


def check(
    recipe: RecipeArgument,
    seed: SeedOption = None,
    engine: EngineOption = None,
    json_: Annotated[Path | None, output_option("--json", "FILE", "Write the numbers.")] = None,
    html: Annotated[
        Path | None, output_option("--html", "FILE", "Write one page with plots and three rendered pictures.")
    ] = None,
) -> None:
    """Predict how well a recipe's markers can be measured, before anything is rendered at length.

    By day, at dusk and at night, and against distance: size, contrast and signal to noise of a marker, the error of its
    centre, the bound of the pose, and what will fail and what to change.
    """
    for line in checked_lines(recipe, seed, engine, json_, html):
        typer.echo(line)
