"""`droguekit detect`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import DatasetArgument, DetectorOption, output_option
from droguekit.cli.main import FAULT
from droguekit.workflows.detection import detect_dataset

EXAMPLES = (
    "droguekit detect data/demo --out detections.json",
    "droguekit detect data/demo --detector color-blob --out color-blob.json",
    "droguekit detect data/flight --detector my-network.onnx --out detections.json",
    "droguekit detect data/docking-10m --tracker bernoulli --out tracked.json",
)


def detect(
    dataset: DatasetArgument,
    out: Annotated[Path, output_option("--out", "FILE.json", "Write the boxes as COCO results.")],
    detector: DetectorOption = None,
    least_score: Annotated[float, typer.Option("--least-score", help="Omit boxes with a lower score.")] = 0.001,
    tracker: Annotated[
        str | None,
        typer.Option(
            "--tracker",
            metavar="NAME",
            help="Follow the drogue from pair to pair with bernoulli, flow, mil or pose-predict; the detector runs "
            "when the drogue is lost, and on every 25th pair. docs/explanation/tracking.md.",
        ),
    ] = None,
) -> None:
    """Find the drogue in every image of a dataset, from images, rig and drogue dimensions alone.

    Image ids are those of the dataset's annotations/all.json, even where there is no such file: twice the pair's index,
    plus 1 for the left or 2 for the right image. Exits with 1 where a pair cannot be read or our own code fails in it;
    it then has no boxes.
    """
    counts = detect_dataset(dataset, detector, out, least_score, progress_report(), tracker)
    typer.echo(
        f"{counts.detector}: {counts.boxes} boxes in {counts.images_with_boxes} of {2 * counts.pairs} images, "
        f"median {counts.times.wall_ms:.1f} ms a pair ({counts.times.cpu_ms:.1f} ms CPU)"
    )
    typer.echo(f"wrote {out}")
    if counts.fault is not None:
        typer.echo(f"droguekit: error: {counts.fault}", err=True)
        raise typer.Exit(FAULT)
