"""`python -m studies.detector_comparison`: compares our detectors with YOLOv8 on the same corpus."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
from studies.detector_comparison.yolo_comparison import ComparisonOptions, compare_peers, comparison_lines

_EXAMPLES = """Examples:

  python -m studies.detector_comparison --corpus data/detector-small --ours out/detector/detector.onnx

  python -m studies.detector_comparison --corpus data/detector-train --test data/detector-test --image-passes 8000

  python -m studies.detector_comparison --corpus data/demo --image-passes 0"""


def main(
    corpus: CorpusOption,
    out: Annotated[Path, typer.Option("--out", help="Folder; stages that are complete there are skipped.")] = Path(
        "out/detector-peers"
    ),
    test: TestOption = None,
    ours: Annotated[
        list[Path] | None, typer.Option("--ours", metavar="FILE.onnx", help="One of our detectors. Repeatable.")
    ] = None,
    image_passes: PassesOption = 40_000,
    size: SizeOption = "480x640",
    batch: Annotated[int, typer.Option("--batch", min=1, help="Images in a step of the peers' training.")] = 16,
    threads: ThreadsOption = 2,
    rounds: Annotated[int, typer.Option("--rounds", min=1, help="Number of timing rounds.")] = 50,
    device: DeviceOption = "cpu",
    seed: SeedOption = 0,
    environment: Annotated[
        Path | None,
        typer.Option(
            "--environment", help="Virtual environment of ultralytics, made if missing; OUT/environment by default."
        ),
    ] = None,
) -> None:
    """Train YOLOv8s and YOLOv8n from scratch, time them in turns with our detectors, and score all by our benchmark.

    With 0 image passes nothing is trained or scored: only parameters, operations and times are measured.
    """
    try:
        options = ComparisonOptions(
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
        rows = compare_peers(options, out, print_status)
    except (ValueError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error
    typer.echo("\n".join(comparison_lines(rows)))
    typer.echo(f"the numbers are in {out / 'comparison.json'}")


if __name__ == "__main__":
    app = typer.Typer(add_completion=False)
    app.command(epilog=_EXAMPLES)(main)
    app()
