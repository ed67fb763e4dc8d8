"""Command-line options that the comparison and the ablations share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

CorpusOption = Annotated[Path, typer.Option("--corpus", metavar="DIR", help="Dataset to train on.")]
TestOption = Annotated[
    Path | None,
    typer.Option("--test", metavar="DIR", help="Dataset whose test split is scored, the corpus's own by default."),
]
PassesOption = Annotated[int, typer.Option("--image-passes", min=0, help="Images that go through each network.")]
SizeOption = Annotated[str, typer.Option("--size", metavar="HxW", help="Every network's input, multiples of 32.")]
ThreadsOption = Annotated[int, typer.Option("--threads", min=1, help="Of training and timing.")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Of training.")]
DeviceOption = Annotated[str, typer.Option("--device", help="To train on: cpu, or cuda.")]


def input_size_px(text: str) -> tuple[int, int]:
    """(width, height) from a text such as `480x640`, in which the height comes first.

    Raises:
        ValueError: the text is not of that form.
    """
    height, cross, width = text.partition("x")
    if not cross or not (height.isdecimal() and width.isdecimal()) or len(text) > 12:
        raise ValueError(f"--size: must be HEIGHTxWIDTH in pixels, such as 480x640, got {text!r}")
    return int(width), int(height)


def print_status(line: str) -> None:
    """Print a line about the progress to standard error."""
    typer.echo(line, err=True)
