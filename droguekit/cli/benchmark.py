"""`droguekit benchmark`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.cli.arguments import DatasetArgument
from droguekit.cli.pipelines import benchmark_dataset

EXAMPLES = (
    "droguekit benchmark data/demo --estimates estimates.jsonl --json benchmark.json --html report.html",
    "droguekit benchmark data/demo --estimates somebody-elses.jsonl",
)


def benchmark(
    dataset: DatasetArgument,
    estimates: Annotated[
        Path, typer.Option("--estimates", metavar="FILE.jsonl", help="Of `navigate`, or anybody's in that format.")
    ],
    json_: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Gets the numbers.")] = None,
    html: Annotated[Path | None, typer.Option("--html", metavar="FILE", help="Gets the report, one page.")] = None,
) -> None:
    """Compare pose estimates with the truth of a dataset, by method and distance."""
    result = benchmark_dataset(dataset, estimates, json_, html)
    typer.echo(f"{'method':<16} {'fixes':>7} {'mean':>9} {'rmse':>9} {'p95':>9}   position error [mm]")
    for name, scores in result.methods.items():
        row = scores.overall
        errors = (row.position_mean_m, row.position_rmse_m, row.position_p95_m)
        shown = " ".join(f"{'-':>9}" if error is None else f"{1e3 * error:9.1f}" for error in errors)
        typer.echo(f"{name:<16} {100 * row.fix_fraction:6.1f}% {shown}")
    for path in (json_, html):
        if path is not None:
            typer.echo(f"wrote {path}")
