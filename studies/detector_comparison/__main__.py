"""`python -m studies.detector_comparison`: our detectors beside YOLOv8 on the same corpus."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.detector_comparison.comparison import ComparisonOptions, compare_peers, comparison_lines
from studies.detector_comparison.options import (
    CorpusOption,
    DeviceOption,
    PassesOption,
    SeedOption,
    SizeOption,
    TestOption,
    ThreadsOption,
    input_size_px,
    print_status,
)

_EXAMPLES = """Examples:

  python -m studies.detector_comparison --corpus data/detector-small --ours out/detector/detector.onnx

  python -m studies.detector_comparison --corpus data/detector-train --test data/detector-test --image-passes 8000

  python -m studies.detector_comparison --corpus data/demo --image-passes 0"""


def main(
    corpus: CorpusOption,
    out: Annotated[Path, typer.Option("--out", help="Folder; stages found there stand.")] = Path("out/detector-peers"),
    test: TestOption = None,
    ours: Annotated[
        list[Path] | None, typer.Option("--ours", metavar="FILE.onnx", help="Of our own detectors. Repeatable.")
    ] = None,
    image_passes: PassesOption = 40_000,
    size: SizeOption = "480x640",
    batch: Annotated[int, typer.Option("--batch", min=1, help="Images in a step of the peers' training.")] = 16,
    threads: ThreadsOption = 2,
    rounds: Annotated[int, typer.Option("--rounds", min=1, help="Of timing.")] = 50,
    device: DeviceOption = "cpu",
    seed: SeedOption = 0,
    environment: Annotated[
        Path | None, typer.Option("--environment", help="Of ultralytics; OUT/environment, made if missing.")
    ] = None,
) -> None:
    """Train YOLOv8s and YOLOv8n from scratch, time them in turns with ours, and score all by our benchmark.

    With 0 image passes nothing is trained or scored: only parameters, operations and times are told.
    """
    try:
        order = ComparisonOptions(
            corpus=corpus,
            test=test or corpus,
            ours=tuple(ours or ()),
            image_passes=image_passes,
            size_px=input_size_px(size),
            batch=batch,
            threads=threads,
            rounds=rounds,
            device="0" if device == "cuda" else device,
            seed=seed,
            environment=environment or out / "environment",
        )
        rows = compare_peers(order, out, print_status)
    except (ValueError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error
    typer.echo("\n".join(comparison_lines(rows)))
    typer.echo(f"numbers are in {out / 'comparison.json'}")


if __name__ == "__main__":
    app = typer.Typer(add_completion=False)
    app.command(epilog=_EXAMPLES)(main)
    app()
