"""`droguekit benchmark`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import DatasetArgument, output_option
from droguekit.cli.main import FAULT
from droguekit.workflows.benchmarking import DetectionOptions, run_benchmarks

EXAMPLES = (
    "droguekit benchmark data/demo --estimates estimates.jsonl --json benchmark.json --html report.html",
    "droguekit benchmark data/demo --estimates somebody-elses.jsonl",
    "droguekit benchmark data/corpus --detections ours.json --detections theirs.json --html detectors.html",
    "droguekit benchmark data/corpus --detector color-blob --json detectors.json",
)


def benchmark(
    dataset: DatasetArgument,
    estimates: Annotated[
        Path | None,
        typer.Option("--estimates", metavar="FILE.jsonl", help="Written by `navigate`, or any in that format."),
    ] = None,
    detections: Annotated[
        list[Path] | None,
        typer.Option("--detections", metavar="FILE.json", help="Written by `detect`, or any COCO results. Repeatable."),
    ] = None,
    detector: Annotated[
        list[str] | None,
        typer.Option("--detector", metavar="NAME|FILE.onnx", help="Run a detector and score it. Repeatable."),
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(
            "--split", metavar="NAME", help="For detections: train, val, test or all; by default test, if there is one."
        ),
    ] = None,
    threshold: Annotated[
        float | None,
        typer.Option("--threshold", help="For detections: lowest score that counts in recall and false alarms."),
    ] = None,
    json_: Annotated[Path | None, output_option("--json", "FILE", "Write the numbers.")] = None,
    html: Annotated[Path | None, output_option("--html", "FILE", "Write the report as one page.")] = None,
) -> None:
    """Compare pose estimates, or a detector's boxes, with the truth of a dataset.

    An imported dataset has no truth: its estimates are compared with their own measurements, and with boxes if any.
    Exits with 1 where a detector fails in a pair, which then counts as without boxes.
    """
    options = DetectionOptions(detections or (), detector or (), split, threshold)
    outcome = run_benchmarks(dataset, estimates, options, (json_, html), progress_report())
    for line in outcome.lines:
        typer.echo(line)
    for path in (json_, html):
        if path is not None:
            typer.echo(f"wrote {path}")
    if outcome.fault is not None:
        typer.echo(f"droguekit: error: {outcome.fault}", err=True)
        raise typer.Exit(FAULT)
