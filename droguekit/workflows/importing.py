"""Make a dataset without truth from real stereo images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

if TYPE_CHECKING:
    from datasets_manifest.importers.imported_dataset import ImportedPairs
    from droguekit.batch.progress import ProgressReport
    from geometry.stereo import StereoRig

_RATE_HZ = 25.0
_UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}


@dataclass(frozen=True)
class ImportOptions:
    """How images become a dataset.

    Attributes:
        calibration: file of OpenCV's stereo calibration; a bag's own when None.
        calibration_unit: `m`, `cm` or `mm`, of its translation.
        drogue: preset or TOML file.
        boxes: COCO file of boxes of the drogue by image name, or None.
        box_category: name of their category; the one named drogue when None.
        topics: `LEFT,RIGHT` of a bag, or None where it has one pair of them.
        rate_hz: pairs a second in a folder; 25 when None. [Hz]
        encoding: `linear` or `gamma`; by depth when None.
        black_level_dn: number that no light gives.
        bits: that 16-bit images use; as in the first pair when None.
    """

    calibration: Path | None = None
    calibration_unit: str = "m"
    drogue: str = "red-8"
    boxes: Path | None = None
    box_category: str | None = None
    topics: str | None = None
    rate_hz: float | None = None
    encoding: str | None = None
    black_level_dn: float = 0.0
    bits: int | None = None

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: one is out of its range; names the command's option.
        """
        if self.encoding not in (None, "linear", "gamma"):
            raise ValueError(f"--encoding: must be linear or gamma, got {self.encoding!r}")
        if self.calibration_unit not in _UNITS_M:
            raise ValueError(f"--calibration-unit: must be one of {', '.join(_UNITS_M)}, got {self.calibration_unit!r}")
        for name, value, low, high in (
            ("rate", _RATE_HZ if self.rate_hz is None else self.rate_hz, 1e-3, 1e4),
            ("black-level", self.black_level_dn, 0, 65535),
            ("bits", 12 if self.bits is None else self.bits, 9, 16),
        ):
            if not low <= value <= high:
                raise ValueError(f"--{name}: must be from {low:g} to {high:g}, got {value:g}")


def import_images(source: Path, out: Path, options: ImportOptions, report: ProgressReport) -> int:
    """Make a dataset without truth from a folder of images or a ROS bag.

    Returns:
        How many pairs it has.

    Raises:
        ValueError: images, calibration or boxes that cannot be used, or options that do not go with the source.
        OSError: the dataset cannot be written.
    """
    from datasets_manifest.importers.coco_boxes import read_boxes
    from datasets_manifest.importers.imported_dataset import ImportSettings, write_imported
    from drogue_models.presets import load_drogue

    if _is_bag(source) and (options.rate_hz is not None or options.boxes is not None):
        raise ValueError("--rate, --boxes: are for folders of images; a bag has stamps, and no names for its images")
    if options.box_category is not None and options.boxes is None:
        raise ValueError("--box-category: names the category of --boxes, which is missing")
    pairs, rig = _open_source(source, options)
    given = None if options.boxes is None else read_boxes(options.boxes, options.box_category)
    settings = ImportSettings(
        name=out.resolve().name,
        rig=rig,
        drogue=load_drogue(options.drogue),
        encoding=cast(Literal["linear", "gamma"] | None, options.encoding),
        black_level_dn=options.black_level_dn,
        bits=options.bits,
        boxes=given,
    )
    report.begin("pairs", pairs.count)
    try:
        used = write_imported(pairs, settings, out, report.advance)
    finally:
        report.end()
    for line in pairs.left_out:
        report.say(f"left out: {line}")
    if given is not None:
        report.say(f"boxes: {used} of {len(given.boxes)} belong to these images")
    return pairs.count


def _open_source(source: Path, options: ImportOptions) -> tuple[ImportedPairs, StereoRig]:
    """The pairs and the rig that took them."""
    from datasets_manifest.calibration.stereo_calibration import read_opencv_stereo
    from datasets_manifest.importers.image_folder import ImageFolder

    unit_m, topics = _UNITS_M[options.calibration_unit], options.topics
    given = None if options.calibration is None else read_opencv_stereo(options.calibration, unit_m)
    if not _is_bag(source):
        if topics is not None:
            raise ValueError(f"--topics: {source} is not a ROS bag")
        if given is None:
            raise ValueError("--calibration: images need one; see docs/how-to/calibrate.md for how to make it")
        return ImageFolder(source, given.camera.width_px, options.rate_hz or _RATE_HZ), given
    names = None if topics is None else tuple(topics.split(","))
    if names is not None and len(names) != 2:
        raise ValueError(f"--topics: must be LEFT,RIGHT, got {topics!r}")
    try:
        from datasets_manifest.importers.ros_bag import RosBag
    except ModuleNotFoundError as error:
        raise ValueError(f"{source}: {error.name} is missing: pip install 'droguekit[exports]'") from error
    bag = RosBag(source, names)
    return bag, given or bag.rig()


def _is_bag(source: Path) -> bool:
    return source.suffix == ".bag" or (source / "metadata.yaml").is_file()
