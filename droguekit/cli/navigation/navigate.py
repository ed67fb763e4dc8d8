"""`droguekit navigate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import DatasetArgument, DetectorOption, output_option
from droguekit.workflows.navigation import NavigationOptions, navigate_dataset

EXAMPLES = (
    "droguekit navigate data/demo --out estimates.jsonl",
    "droguekit navigate data/demo --method paper --method joint --out estimates.jsonl",
    "droguekit navigate data/demo --centroids binary --out estimates.jsonl",
    "droguekit navigate data/demo --detector my-network.onnx --out estimates.jsonl",
    "droguekit navigate data/docking-10m --method joint-hub --tracker bernoulli --filter --out estimates.jsonl",
    "droguekit navigate data/docking-10m --method joint-hub --tracker bernoulli --rate 25 --out estimates.jsonl",
)


def navigate(
    dataset: DatasetArgument,
    out: Annotated[Path, output_option("--out", "FILE.jsonl", "Write one estimate a line.")],
    method: Annotated[
        list[str] | None, typer.Option("--method", metavar="NAME", help="Repeatable; all methods by default.")
    ] = None,
    centroids: Annotated[
        str,
        typer.Option(
            "--centroids",
            metavar="own|binary|edge",
            help="How to measure centres: each method's own way (as the paper, or edge fits), or one for all.",
        ),
    ] = "own",
    detector: DetectorOption = None,
    tracker: Annotated[
        str | None,
        typer.Option(
            "--tracker",
            metavar="NAME",
            help="Follow the drogue; the detector only starts, checks, and searches again after a loss.",
        ),
    ] = None,
    redetect_every: Annotated[
        int | None,
        typer.Option(metavar="N", help="The detector checks the tracker on every N-th pair; 25 by default."),
    ] = None,
    filtered: Annotated[
        bool, typer.Option("--filter", help="Add filtered estimates as METHOD+filter, with docking quantities.")
    ] = False,
    smoothed: Annotated[
        bool, typer.Option("--smooth", help="Add estimates smoothed over each sequence as METHOD+smoother.")
    ] = False,
    capture_radius: Annotated[
        float | None,
        typer.Option(metavar="M", help="Largest miss that is a capture; by default from the drogue's opening."),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(metavar="HZ", help="Real time: pairs arrive at this rate; late ones are skipped and counted."),
    ] = None,
    latency: Annotated[
        Path | None, output_option("--latency", "FILE.json", "Write the latencies of --rate by stage.")
    ] = None,
) -> None:
    """Estimate the drogue's pose in every pair of a dataset, from images, rig and drogue dimensions alone."""
    options = NavigationOptions(
        centroids=centroids,
        detector=detector,
        tracker=tracker,
        redetect_every=redetect_every,
        filtered=filtered,
        smoothed=smoothed,
        capture_radius_m=capture_radius,
        rate_hz=rate,
        latency_out=latency,
    )
    done = navigate_dataset(dataset, method or (), out, progress_report(), options)
    width = max(16, *(len(fixes.method) for fixes in done.fixes))
    for fixes in done.fixes:
        typer.echo(f"{fixes.method:<{width}} {fixes.fixes} fixes in {fixes.pairs} pairs")
    for line in [] if done.latency is None else done.latency.lines():
        typer.echo(line)
    typer.echo(f"wrote {out}")
