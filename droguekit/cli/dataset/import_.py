"""`droguekit import`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

import typer

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import output_option

if TYPE_CHECKING:
    from datasets_manifest.importers.imported_dataset import ImportedPairs
    from geometry.stereo import StereoRig

EXAMPLES = (
    "droguekit import flight7/ --calibration stereo.yaml --out data/flight7   (left/ and right/, or side by side)",
    "droguekit import flight7-bag/ --drogue my-drogue.toml --out data/flight7   (calibration from its CameraInfo)",
    "droguekit navigate data/flight7 --method joint-hub --out estimates.jsonl",
)
_RATE_HZ = 25.0
_UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}


def import_(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="A folder of images, or a ROS bag.")],
    out: Annotated[Path, output_option("--out", "DIR", "The new dataset's folder.")],
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="FILE", help="OpenCV's M1, D1, M2, D2, R, T; a bag's own if left out."),
    ] = None,
    calibration_unit: Annotated[str, typer.Option(metavar="m|cm|mm", help="Unit of the calibration's T.")] = "m",
    drogue: Annotated[str, typer.Option("--drogue", metavar="NAME|FILE", help="Preset or .toml file.")] = "red-8",
    boxes: Annotated[
        Path | None, typer.Option("--boxes", metavar="FILE", help="COCO boxes of the drogue, by image name.")
    ] = None,
    topics: Annotated[
        str | None, typer.Option("--topics", metavar="LEFT,RIGHT", help="Image topics of a bag, where several are.")
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option("--rate", metavar="HZ", help="Pairs a second in a folder; 25 if left out.", show_default=False),
    ] = None,
    encoding: Annotated[
        str | None,
        typer.Option(metavar="linear|gamma", help="Of the numbers; by default gamma for 8 bit, linear for deeper."),
    ] = None,
    black_level: Annotated[float, typer.Option(metavar="DN", help="Number that no light gives.")] = 0.0,
    bits: Annotated[int | None, typer.Option(help="Bits that 16-bit images use; by default as the first pair.")] = None,
) -> None:
    """Make a dataset without truth from real stereo images, for `navigate`, `preview` and `benchmark`.

    Pixels stay as they are: the rig's eyes get the calibration's distortion and rotation, and navigation rectifies what
    it measures.
    """
    from datasets_manifest.importers.imported_dataset import ImportSettings, read_boxes, write_imported
    from drogue_models.presets import load_drogue

    if encoding not in (None, "linear", "gamma"):
        raise ValueError(f"--encoding: must be linear or gamma, got {encoding!r}")
    if calibration_unit not in _UNITS_M:
        raise ValueError(f"--calibration-unit: must be one of {', '.join(_UNITS_M)}, got {calibration_unit!r}")
    for name, value, low, high in (
        ("rate", _RATE_HZ if rate is None else rate, 1e-3, 1e4),
        ("black-level", black_level, 0, 65535),
        ("bits", 12 if bits is None else bits, 9, 16),
    ):
        if not low <= value <= high:
            raise ValueError(f"--{name}: must be from {low:g} to {high:g}, got {value:g}")
    if _is_bag(source) and (rate is not None or boxes is not None):
        raise ValueError("--rate, --boxes: are for folders of images; a bag has stamps, and no names for its images")
    pairs, rig = _open_source(source, calibration, _UNITS_M[calibration_unit], topics, rate or _RATE_HZ)
    given = None if boxes is None else read_boxes(boxes)
    settings = ImportSettings(
        name=out.resolve().name,
        rig=rig,
        drogue=load_drogue(drogue),
        encoding=cast(Literal["linear", "gamma"] | None, encoding),
        black_level_dn=black_level,
        bits=bits,
        boxes=given,
    )
    report = progress_report()
    report.begin("pairs", pairs.count)
    try:
        used = write_imported(pairs, settings, out, report.advance)
    finally:
        report.end()
    for line in pairs.left_out:
        report.say(f"left out: {line}")
    if given is not None:
        report.say(f"boxes: {used} of {sum(map(len, given.values()))} belong to these images")
    typer.echo(f"wrote {out}: {pairs.count} pairs")


def _open_source(
    source: Path, calibration: Path | None, unit_m: float, topics: str | None, rate_hz: float
) -> tuple[ImportedPairs, StereoRig]:
    """The pairs and the rig that took them."""
    from datasets_manifest.calibration.stereo_calibration import read_opencv_stereo, rig_of_calibration
    from datasets_manifest.importers.image_folder import ImageFolder

    given = None if calibration is None else read_opencv_stereo(calibration, unit_m)
    if not _is_bag(source):
        if topics is not None:
            raise ValueError(f"--topics: {source} is no bag")
        if given is None:
            raise ValueError("--calibration: images need one; see docs/how-to/calibrate.md for how to make it")
        rig = rig_of_calibration(given)
        return ImageFolder(source, rig.camera.width_px, rate_hz), rig
    names = None if topics is None else tuple(topics.split(","))
    if names is not None and len(names) != 2:
        raise ValueError(f"--topics: must be LEFT,RIGHT, got {topics!r}")
    try:
        from datasets_manifest.importers.ros_bag import RosBag
    except ModuleNotFoundError as error:
        raise ValueError(f"{source}: {error.name} is missing: pip install 'droguekit[exports]'") from error
    bag = RosBag(source, names)
    return bag, rig_of_calibration(given or bag.calibration())


def _is_bag(source: Path) -> bool:
    return source.suffix == ".bag" or (source / "metadata.yaml").is_file()
