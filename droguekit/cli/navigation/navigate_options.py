"""Options of `droguekit navigate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from datasets_manifest.storage.storage import as_location
from droguekit.cli.arguments import Place, output_option

DatasetOrNone = Annotated[
    Place | None,
    typer.Argument(
        metavar="DIR",
        parser=str,
        callback=lambda text: None if text is None else as_location(text),
        help="The dataset's folder, or a URL such as s3://BUCKET/NAME; none with --live.",
    ),
]
EstimatesOption = Annotated[Path, output_option("--out", "FILE.jsonl", "Write one estimate a line.")]
MethodOption = Annotated[
    list[str] | None, typer.Option("--method", metavar="NAME", help="Repeatable; all methods by default.")
]
CentroidsOption = Annotated[
    str,
    typer.Option(
        "--centroids",
        metavar="own|binary|edge",
        help="How to measure centres: each method's own way (as the paper, or edge fits), or one for all.",
    ),
]
TrackerOption = Annotated[
    str | None,
    typer.Option(
        "--tracker",
        metavar="NAME",
        help="Follow the drogue; the detector only starts, checks, and searches again after a loss.",
    ),
]
RedetectOption = Annotated[
    int | None,
    typer.Option(metavar="N", help="The detector checks the tracker on every N-th pair; 25 by default."),
]
FilterOption = Annotated[
    bool, typer.Option("--filter", help="Add filtered estimates as METHOD+filter, with docking quantities.")
]
SmoothOption = Annotated[
    bool, typer.Option("--smooth", help="Add estimates smoothed over each sequence as METHOD+smoother.")
]
CaptureRadiusOption = Annotated[
    float | None,
    typer.Option(metavar="M", help="Largest miss that is a capture; by default from the drogue's opening."),
]
RateOption = Annotated[
    float | None,
    typer.Option(metavar="HZ", help="Real time: pairs arrive at this rate; late ones are skipped and counted."),
]
LatencyOption = Annotated[
    Path | None, output_option("--latency", "FILE.json", "Write the latencies of --rate or --live by stage.")
]
LiveOption = Annotated[
    str | None,
    typer.Option(
        "--live",
        metavar="SOURCE",
        help="A running camera: device 0 (views side by side) or 0,1; a video file or an address such as rtsp://...; "
        "or ros:/LEFT,/RIGHT. Until Ctrl-C.",
    ),
]
CalibrationOption = Annotated[
    list[Path] | None,
    typer.Option(metavar="FILE", help="With --live: stereo calibration of the cameras, one file or two as for import."),
]
CalibrationUnitOption = Annotated[
    str | None, typer.Option(metavar="m|cm|mm", help="With --live: unit of the calibration's baseline; m by default.")
]
ImageSizeOption = Annotated[
    str | None, typer.Option(metavar="WIDTHxHEIGHT", help="With --live: of one view, where the calibration lacks it.")
]
DrogueOption = Annotated[
    str | None, typer.Option(metavar="NAME|FILE", help="With --live: preset or .toml file; red-8 by default.")
]
EncodingOption = Annotated[
    str | None,
    typer.Option(metavar="linear|gamma", help="With --live: of pixel values; by default gamma for 8 bit, else linear."),
]
BlackLevelOption = Annotated[
    float | None, typer.Option(metavar="DN", help="With --live: pixel value without light; 0 by default.")
]
BitsOption = Annotated[int | None, typer.Option(help="With --live: bits that the camera uses of 16-bit numbers.")]
TimeoutOption = Annotated[
    float | None, typer.Option(metavar="S", help="With --live: end when no pair comes for so long; 5 by default.")
]
StampToleranceOption = Annotated[
    float | None,
    typer.Option(metavar="MS", help="With --live: largest difference of the time stamps of left and right; 1."),
]
CameraFormatOption = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="With --live 0: ask the device for this format, such as mjpeg or gray."),
]
