"""`python -m studies.detector_comparison.run_ablation`: ablations of our network."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.detector_comparison.ablation import AblationOptions, ablate
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

  python -m studies.detector_comparison.run_ablation --corpus data/detector-small --image-passes 5000
  python -m studies.detector_comparison.run_ablation --corpus data/detector-train --test data/detector-test"""


def main(
    corpus: CorpusOption,
    out: Annotated[Path, typer.Option("--out", help="Folder; trainings that are found there are resumed.")] = Path(
        "out/ablation"
    ),
    test: TestOption = None,
    variant: Annotated[str, typer.Option("--variant", help="Of the network: l or s.")] = "s",
    image_passes: PassesOption = 5_000,
    size: SizeOption = "320x416",
    threads: ThreadsOption = 2,
    seed: SeedOption = 0,
    device: DeviceOption = "cpu",
    rounds: Annotated[int, typer.Option("--rounds", min=1, help="Number of timing rounds.")] = 30,
) -> None:
    """Train variants of our network that differ in one thing, for the same image passes; measure scores and times."""
    try:
        options = AblationOptions(
            corpus, test or corpus, variant, image_passes, input_size_px(size), threads, seed, device, rounds
        )
        lines = ablate(options, out, print_status)
    except (ValueError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error
    typer.echo("\n".join(lines))


if __name__ == "__main__":
    app = typer.Typer(add_completion=False)
    app.command(epilog=_EXAMPLES)(main)
    app()
