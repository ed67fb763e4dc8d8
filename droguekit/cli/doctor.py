"""`droguekit doctor`."""

from __future__ import annotations

import typer

from droguekit.cli.main import FAULT
from droguekit.workflows.installation import installation_lines

EXAMPLES = ("droguekit doctor",)


def doctor() -> None:
    """Show what is installed here, which engines work, and what is missing.

    Exits with 1 when the path tracer does not work; labels, navigation and benchmark work without any.
    """
    lines = installation_lines()
    while True:
        try:
            typer.echo(next(lines))
        except StopIteration as end:
            if not end.value:
                raise typer.Exit(FAULT) from None
            return
