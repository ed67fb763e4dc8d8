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
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="A folder of images, or a ROS bag (folder, .mcap, .db3, .bag).")
    ],
    out: Annotated[Path, output_option("--out", "DIR", "The new dataset's folder.")],
    calibration: Annotated[
        list[Path] | None,
        typer.Option(
            "--calibration",
            metavar="FILE",
            help="Stereo calibration of OpenCV, Kalibr, ROS, EuRoC or ORB-SLAM; given twice for two files: left and "
            "right, or intrinsics and extrinsics. By default the bag's.",
        ),
    ] = None,
    calibration_unit: Annotated[str, typer.Option(metavar="m|cm|mm", help="Unit of the calibration's baseline.")] = "m",
    image_size: Annotated[
        str | None,
        typer.Option(metavar="WIDTHxHEIGHT", help="Of one view, in pixels, where OpenCV's files do not hold it."),
    ] = None,
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
    camera_info: Annotated[
        str | None,
        typer.Option(
            "--camera-info", metavar="LEFT,RIGHT", help="A bag's CameraInfo topics; by default beside the images'."
        ),
    ] = None,
    folders: Annotated[
        str | None,
        typer.Option("--folders", metavar="LEFT,RIGHT", help="The views' folders in SOURCE, where it has several."),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate",
            metavar="HZ",
            help="Pairs per second in a folder; by default the time stamps in file names, else 25.",
            show_default=False,
        ),
    ] = None,
    stamp_tolerance_ms: Annotated[
        float, typer.Option(metavar="MS", help="By how much time stamps of left and right may differ.")
    ] = 0.0,
    encoding: Annotated[
        str | None,
        typer.Option(
            metavar="linear|gamma",
            help="Encoding of pixel values; by default what a bag says, else gamma for 8 bits and linear for more.",
        ),
    ] = None,
    black_level: Annotated[
        float | None, typer.Option(metavar="DN", help="Pixel value without light; by default what a bag says, else 0.")
    ] = None,
    bits: Annotated[
        int | None,
        typer.Option(help="Bits used in 16-bit images; by default what a bag says, else as many as the first pair's."),
    ] = None,
) -> None:
    """Make a dataset without truth from real stereo images, for `navigate`, `preview` and `benchmark`.

    Pixels stay as they are: the rig stores the calibration's distortion and rotation, and navigation rectifies the
    points that it measures.
    """
    options = ImportOptions(
        calibration=tuple(calibration or ()),
        calibration_unit=calibration_unit,
        image_size=image_size,
        drogue=drogue,
        boxes=boxes,
        box_category=box_category,
        topics=topics,
        camera_info=camera_info,
        folders=folders,
        rate_hz=rate,
        stamp_tolerance_ms=stamp_tolerance_ms,
        encoding=encoding,
        black_level_dn=black_level,
        bits=bits,
    )
    count = import_images(source, out, options, progress_report())
    typer.echo(f"wrote {out}: {count} pair{'' if count == 1 else 's'}")
