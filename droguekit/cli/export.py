"""`droguekit export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.cli.arguments import DatasetArgument

EXAMPLES = ("droguekit export data/demo --format coco --out data/demo-coco",)
FORMATS = ("coco",)


def export(
    dataset: DatasetArgument,
    format_: Annotated[str, typer.Option("--format", metavar="NAME", help=f"One of: {', '.join(FORMATS)}.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR2", help="Folder for the files; made if missing.")],
) -> None:
    """Write a dataset's labels in another format. Images stay where they are."""
    from labelgen.export.coco import write_coco

    if format_ not in FORMATS:
        raise ValueError(f"--format: no format named {format_!r}; there are {', '.join(FORMATS)}")
    for path in write_coco(dataset, out):
        typer.echo(f"wrote {path}")
