"""`droguekit import`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import output_option
from droguekit.workflows.importing import ImportOptions, import_images

EXAMPLES = (
    "droguekit import flight7/ --calibration stereo.yaml --out data/flight7   (left/ and right/, or side by side)",
    "droguekit import flight7-bag/ --drogue my-drogue.toml --out data/flight7   (calibration from its CameraInfo)",
    "droguekit navigate data/flight7 --method joint-hub --out estimates.jsonl",
)


def import_(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="A folder of images, or a ROS bag.")],
    out: Annotated[Path, output_option("--out", "DIR", "The new dataset's folder.")],
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration",
            metavar="FILE",
            help="OpenCV stereo calibration (M1, D1, M2, D2, R, T); by default the bag's.",
        ),
    ] = None,
    calibration_unit: Annotated[str, typer.Option(metavar="m|cm|mm", help="Unit of the calibration's T.")] = "m",
    drogue: Annotated[str, typer.Option("--drogue", metavar="NAME|FILE", help="Preset or .toml file.")] = "red-8",
    boxes: Annotated[
        Path | None, typer.Option("--boxes", metavar="FILE", help="COCO boxes of the drogue, by image name.")
    ] = None,
    box_category: Annotated[
        str | None, typer.Option(metavar="NAME", help="Category of the boxes; by default the one named drogue.")
    ] = None,
    topics: Annotated[
        str | None, typer.Option("--topics", metavar="LEFT,RIGHT", help="Image topics, where a bag has several.")
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option("--rate", metavar="HZ", help="Pairs per second in a folder; 25 by default.", show_default=False),
    ] = None,
    encoding: Annotated[
        str | None,
        typer.Option(metavar="linear|gamma", help="Encoding of pixel values; by default gamma for 8 bit, else linear."),
    ] = None,
    black_level: Annotated[float, typer.Option(metavar="DN", help="Pixel value without light.")] = 0.0,
    bits: Annotated[
        int | None, typer.Option(help="Bits used in 16-bit images; by default as in the first pair.")
    ] = None,
) -> None:
    """Make a dataset without truth from real stereo images, for `navigate`, `preview` and `benchmark`.

    Pixels stay as they are: the rig stores the calibration's distortion and rotation, and navigation rectifies the
    points that it measures.
    """
    options = ImportOptions(
        calibration, calibration_unit, drogue, boxes, box_category, topics, rate, encoding, black_level, bits
    )
    count = import_images(source, out, options, progress_report())
    typer.echo(f"wrote {out}: {count} pairs")
