"""`droguekit export`."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated, Literal, cast

import typer

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import DatasetArgument, output_option
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import FORMATS, write_export

EXAMPLES = (
    "droguekit export data/demo --format coco --out data/demo-coco",
    "droguekit export data/demo --format coco --images --out data/demo-coco   (annotations/ and images/)",
    "droguekit export data/demo --format tum --estimates out/estimates.jsonl --out data/demo-tum   (for evo)",
    "droguekit export data/demo --format blind --out data/demo-blind",
)


def export(
    dataset: DatasetArgument,
    format_: Annotated[str, typer.Option("--format", metavar="NAME", help="One of the formats below.")],
    out: Annotated[Path, output_option("--out", "DIR2", "Folder for the files; made if missing.")],
    images: Annotated[
        bool, typer.Option("--images", help="With coco: copy the images too, so that the folder can be moved.")
    ] = False,
    image_bits: Annotated[
        int | None,
        typer.Option(
            metavar="8|16",
            help="With --images: 8, the default, for copies that viewers show right; 16 keeps the sensor's values.",
            show_default=False,
        ),
    ] = None,
    estimates: Annotated[
        Path | None,
        typer.Option("--estimates", metavar="FILE.jsonl", help="With tum: write these poses too, for evo."),
    ] = None,
) -> None:
    """Write a dataset's labels in another format, with the images where the format has them.

    The command counts and prints what the format cannot represent.
    """
    if image_bits is not None and not images:
        raise ValueError("--image-bits: is for copies; add --images")
    if image_bits not in (None, 8, 16):
        raise ValueError(f"--image-bits: must be 8 or 16, got {image_bits}")
    log = ExportLog(progress_report())
    bits = cast(Literal[8, 16], image_bits or 8) if images else None
    for path in write_export(format_, dataset, out, log, image_bits=bits, estimates=estimates):
        typer.echo(f"wrote {path}")
    for what, count in log.losses.items():
        typer.echo(f"{format_}: {count} x {what}")
    for remark in log.remarks:
        typer.echo(f"{format_}: {remark}")


_FORMAT_LINES = "\n".join(f"  {name:<17} {format_.description}" for name, format_ in FORMATS.items())
# The backspace keeps the help's line breaks.
export.__doc__ = f"{inspect.cleandoc(export.__doc__ or '')}\n\n\b\nFormats:\n{_FORMAT_LINES}"
