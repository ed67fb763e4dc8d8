"""`droguekit navigate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import DatasetArgument, DetectorOption, local_path
from droguekit.cli.pipelines import navigate_dataset

EXAMPLES = (
    "droguekit navigate data/demo --out estimates.jsonl",
    "droguekit navigate data/demo --method paper --method joint --out estimates.jsonl",
    "droguekit navigate data/demo --centroids binary --out estimates.jsonl",
    "droguekit navigate data/demo --detector my-network.onnx --out estimates.jsonl",
)


def navigate(
    dataset: DatasetArgument,
    out: Annotated[
        Path,
        typer.Option("--out", metavar="FILE.jsonl", parser=str, callback=local_path, help="Gets one estimate a line."),
    ],
    method: Annotated[
        list[str] | None, typer.Option("--method", metavar="NAME", help="May be repeated; all methods unless given.")
    ] = None,
    centroids: Annotated[
        str,
        typer.Option(
            "--centroids",
            metavar="own|binary|edge",
            help="Measured points: each method's own (the paper's chain, or edge fits), or one kind for all.",
        ),
    ] = "own",
    detector: DetectorOption = None,
) -> None:
    """Estimate the drogue's pose in every pair of a dataset, from images, rig and drogue alone."""
    for fixes in navigate_dataset(dataset, method or (), out, progress_report(), centroids, detector):
        typer.echo(f"{fixes.method:<16} {fixes.fixes} fixes in {fixes.pairs} pairs")
    typer.echo(f"wrote {out}")
