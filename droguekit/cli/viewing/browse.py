"""`droguekit browse`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.cli.arguments import DatasetArgument, WorkersOption, output_option
from droguekit.cli.main import FAULT

EXAMPLES = (
    "droguekit browse data/demo --out demo-page",
    "droguekit browse data/demo --estimates estimates.jsonl --out demo-page",
    "droguekit browse s3://bucket/corpus --out corpus-page --workers 4",
)


def browse(
    dataset: DatasetArgument,
    out: Annotated[Path, output_option("--out", "DIR", "The page's folder; open index.html.")],
    estimates: Annotated[
        Path | None, typer.Option("--estimates", metavar="FILE.jsonl", help="Poses to show beside the truth.")
    ] = None,
    workers: WorkersOption = None,
) -> None:
    """Write a page to look through a dataset, with filters, and with labels and estimates drawn over both images.

    The page needs no server and no network. Run again, the command keeps the pictures that are still valid. It exits
    with 1 when some pairs could not be read; it names them, and the page shows the others.
    """
    from droguekit.batch.execution import default_workers
    from droguekit.batch.progress import progress_report
    from droguekit.visualization.browse.page import write_browse

    if workers is not None and workers < 0:
        raise ValueError(f"--workers: must not be negative, got {workers}")
    summary = write_browse(
        dataset, out, estimates, default_workers() if workers is None else workers, progress_report()
    )
    for one in summary.skipped:
        typer.echo(f"frame {one.frame_index} is left out: {one.reason}", err=True)
    kept = f", {summary.kept} of them with the pictures of an earlier run" if summary.kept else ""
    typer.echo(f"wrote {out / 'index.html'}: {summary.shown} pairs{kept}")
    if summary.skipped:
        raise typer.Exit(FAULT)
