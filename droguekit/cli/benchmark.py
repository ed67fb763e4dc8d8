"""`droguekit benchmark`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from datasets_manifest.layout import BLIND_FILE
from droguekit.cli.arguments import DatasetArgument
from droguekit.cli.pipelines import benchmark_dataset, check_blind_dataset

if TYPE_CHECKING:
    from droguekit.benchmark.benchmark import BenchmarkResult
    from droguekit.benchmark.blind_check import BlindCheck

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
    """Compare pose estimates with the truth of a dataset, by method and distance.

    An imported dataset has none: there, estimates are compared with their own measurements, and with boxes if any.
    """
    if (dataset / BLIND_FILE).exists():
        lines = _blind_lines(check_blind_dataset(dataset, estimates, json_, html))
    else:
        lines = _error_lines(benchmark_dataset(dataset, estimates, json_, html))
    for line in lines:
        typer.echo(line)
    for path in (json_, html):
        if path is not None:
            typer.echo(f"wrote {path}")


def _error_lines(result: BenchmarkResult) -> Iterator[str]:
    yield f"{'method':<16} {'fixes':>7} {'mean':>9} {'rmse':>9} {'p95':>9}   position error [mm]"
    for name, scores in result.methods.items():
        row = scores.overall
        errors = (row.position_mean_m, row.position_rmse_m, row.position_p95_m)
        shown = " ".join(f"{'-':>9}" if error is None else f"{1e3 * error:9.1f}" for error in errors)
        yield f"{name:<16} {100 * row.fix_fraction:6.1f}% {shown}"


def _blind_lines(check: BlindCheck) -> Iterator[str]:
    from droguekit.benchmark.blind_report import COLUMNS, row_cells

    yield f"{check.dataset.name} has no true poses: estimates are compared with their own measurements and with boxes"
    yield " ".join([f"{'method':<16}", *(f"{column:>16}" for column in COLUMNS)])
    for name in check.methods:
        yield " ".join([f"{name:<16}", *(f"{cell:>16}" for cell in row_cells(check, name))])
