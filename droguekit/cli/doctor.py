"""`droguekit doctor`."""

from __future__ import annotations

from typing import Annotated

import typer

from droguekit.cli.main import FAULT
from droguekit.workflows.installation import installation_lines

EXAMPLES = ("droguekit doctor", "droguekit doctor --make-blender")


def doctor(
    make_blender: Annotated[
        bool,
        typer.Option(
            "--make-blender",
            help="First make a virtual environment with Blender (350 MB), for a Python that Blender's package has no "
            "wheel for.",
        ),
    ] = False,
) -> None:
    """Show what is installed here, which engines work, and what is missing.

    Exits with 1 when the path tracer does not work; labels, navigation and benchmark work without any.
    """
    if make_blender:
        from droguekit.workflows.blender_environment import make_blender as steps

        for line in steps():
            typer.echo(line)
    lines = installation_lines()
    while True:
        try:
            typer.echo(next(lines))
        except StopIteration as end:
            if not end.value:
                raise typer.Exit(FAULT) from None
            return
