"""`python -m studies.acceptance`."""

from __future__ import annotations

import typer

from studies.acceptance.command import EXAMPLES, bars

if __name__ == "__main__":
    app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    app.command(epilog="\n".join(["\b", "Examples:", *(f"  {line}" for line in EXAMPLES)]))(bars)
    app()
