"""`droguekit reproduce`."""

from __future__ import annotations

from typing import Annotated

import typer

from droguekit.cli.arguments import DatasetArgument, DeviceOption
from droguekit.cli.main import FAULT

EXAMPLES = ("droguekit reproduce data/demo --frame 12",)


def reproduce(
    dataset: DatasetArgument,
    frame: Annotated[int, typer.Option("--frame", metavar="N", help="Index of the frame.")],
    device: DeviceOption = "cpu",
) -> None:
    """Render one frame of a dataset again, from its manifest alone, and compare record and images.

    On the same processor with the same packages, both must be identical bit for bit. Elsewhere the random draws must be
    equal and the labels agree within 1e-9. The command says which of the two holds, and exits with 1 when neither does.
    Give the --device that made the dataset.
    """
    from droguekit.batch.frame_task import reproduce_frame

    result = reproduce_frame(dataset, frame, device)
    for difference in result.build_differences:
        typer.echo(f"not the same machine: {difference}")
    for difference in result.differences:
        typer.echo(difference)
    if result.verdict == "different":
        typer.echo(f"frame {frame}: is not reproduced")
        raise typer.Exit(FAULT)
    proof = (
        "record and images are the same bit for bit"
        if result.verdict == "identical"
        else "made elsewhere: the draws are equal and the labels agree within 1e-9; pixels were not compared"
    )
    typer.echo(f"frame {frame}: {proof}")
