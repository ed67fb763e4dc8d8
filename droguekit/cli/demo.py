"""`droguekit demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import RecipeArgument, WorkersOption, output_option
from droguekit.cli.main import FAULT
from droguekit.workflows.demonstration import run_demo

EXAMPLES = (
    "droguekit demo",
    "droguekit demo --out /tmp/look --workers 1",
    "droguekit demo smoke --out out/smoke   (another recipe: six small pairs, in seconds)",
)


def demo(
    recipe: RecipeArgument = "demo",
    out: Annotated[Path, output_option("--out", "DIR", "Where everything goes.")] = Path("out/demo"),
    workers: WorkersOption = None,
) -> None:
    """Render a small dataset of a drogue from 40 m down to 1.7 m, estimate poses without the truth, and write a report.

    Writes dataset/, estimates.jsonl, benchmark.json and report.html. Run again, it keeps pairs that exist.
    """
    files, summary = run_demo(recipe, out, workers, progress_report())
    typer.echo(f"{summary.pairs} pairs in {files.dataset}, dataset sha256 {summary.dataset_sha256}")
    typer.echo(f"numbers in {files.benchmark}")
    typer.echo(f"open {files.report} in a browser to see how accurate the pose is at each distance")
    if summary.drops:
        typer.echo(f"{len(summary.drops)} pairs could not be made; {files.dataset}/manifest.json says why", err=True)
        raise typer.Exit(FAULT)
