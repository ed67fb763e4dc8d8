"""`droguekit export`."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated

import typer

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import DatasetArgument, output_option
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import FORMATS, write_export

EXAMPLES = (
    "droguekit export data/demo --format coco --out data/demo-coco",
    "droguekit export data/demo --format blind --out data/demo-blind",
)


def export(
    dataset: DatasetArgument,
    format_: Annotated[str, typer.Option("--format", metavar="NAME", help="One of the formats below.")],
    out: Annotated[Path, output_option("--out", "DIR2", "Folder for the files; made if missing.")],
) -> None:
    """Write a dataset's labels in another format, with the images where the format has them.

    The command counts and prints what the format cannot represent.
    """
    log = ExportLog(progress_report())
    for path in write_export(format_, dataset, out, log):
        typer.echo(f"wrote {path}")
    for what, count in log.losses.items():
        typer.echo(f"{format_}: {count} x {what}")


_FORMAT_LINES = "\n".join(f"  {name:<17} {format_.description}" for name, format_ in FORMATS.items())
# The backspace keeps the help's line breaks.
export.__doc__ = f"{inspect.cleandoc(export.__doc__ or '')}\n\n\b\nFormats:\n{_FORMAT_LINES}"
