"""Commands that read and write what other programs use: import and export."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated, Literal, cast

import typer

from datasets_manifest.storage.pair_faults import PairFaults
from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import DatasetArgument, exit_with_fault
from droguekit.cli.outputs import output_option
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import FORMATS, write_export

EXAMPLES = {
    "import": (
        "droguekit import flight7/ --calibration stereo.yaml --out data/flight7   (left/ and right/, or side by side)",
        "droguekit import flight7-bag/ --drogue my-drogue.toml --out data/flight7   (calibration from its CameraInfo)",
        "droguekit navigate data/flight7 --method joint-hub --out estimates.jsonl",
    ),
    "export": (
        "droguekit export data/demo --format coco --out data/demo-coco",
        "droguekit export data/demo --format coco --images --out data/demo-coco   (annotations/ and images/)",
        "droguekit export data/demo --format tum --estimates out/estimates.jsonl --out data/demo-tum   (for evo)",
        "droguekit export data/demo --format blind --out data/demo-blind",
    ),
}


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
            help="Pairs per second in a folder; by default the time stamps in file names, else a list timestamps.txt "
            "or times.txt, else 25.",
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
    from droguekit.workflows.importing import ImportOptions, import_images

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


def export(
    dataset: DatasetArgument,
    format_: Annotated[str, typer.Option("--format", metavar="NAME", help="One of the formats above.")],
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

    The command counts and prints what the format cannot represent. Exits with 1 where a pair is damaged, and leaves it
    out.
    """
    if image_bits is not None and not images:
        raise ValueError("--image-bits: is for copies; add --images")
    if image_bits not in (None, 8, 16):
        raise ValueError(f"--image-bits: must be 8 or 16, got {image_bits}")
    faults = PairFaults()
    log = ExportLog(progress_report(), faults)
    bits = cast(Literal[8, 16], image_bits or 8) if images else None
    for path in write_export(format_, dataset, out, log, image_bits=bits, estimates=estimates):
        typer.echo(f"wrote {path}")
    for what, count in log.losses.items():
        typer.echo(f"{format_}: {count} x {what}")
    for remark in log.remarks:
        typer.echo(f"{format_}: {remark}")
    exit_with_fault(faults.line())


_FORMAT_LINES = "\n".join(f"  {name:<17} {format_.description}" for name, format_ in FORMATS.items())

# The backspace keeps the help's line breaks.
export.__doc__ = f"{inspect.cleandoc(export.__doc__ or '')}\n\n\b\nFormats:\n{_FORMAT_LINES}"
