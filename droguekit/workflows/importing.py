"""Make a dataset without truth from real stereo images."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

from datasets_manifest.calibration.baseline_units import BASELINE_UNITS_M

if TYPE_CHECKING:
    from datasets_manifest.calibration.calibration_reader import StereoCalibration
    from datasets_manifest.importers.imported_dataset import ImportedPairs
    from droguekit.batch.progress import ProgressReport

_BAG_SUFFIXES = (".bag", ".mcap", ".db3")
_ROS2_SUFFIXES = {".mcap", ".db3"}
# The key of all that rosbag2 writes into metadata.yaml, which begins with it.
_METADATA_KEY, _METADATA_BEGIN_BYTES = b"rosbag2_bagfile_information", 2**16
_IMAGE_SIZE = re.compile("([1-9][0-9]{0,4})x([1-9][0-9]{0,4})")


@dataclass(frozen=True)
class ImportOptions:
    """How images become a dataset.

    Attributes:
        calibration: file of the stereo calibration, or two that belong together; a bag's own when empty.
        calibration_unit: `m`, `cm` or `mm`, of its translation.
        image_size: `WIDTHxHEIGHT` of one view, where OpenCV's files do not hold it.
        drogue: preset or TOML file.
        boxes: COCO file of boxes of the drogue by image name, or None.
        box_category: name of their category; the one named drogue when None.
        topics: `LEFT,RIGHT` image topics of a bag, or None where it has one pair of them.
        camera_info: `LEFT,RIGHT` CameraInfo topics of a bag; those beside the images when None.
        folders: `LEFT,RIGHT` folders in a folder of images, or None where it has one pair of them.
        rate_hz: pairs a second in a folder; when None the times that its files say, else 25. [Hz]
        stamp_tolerance_ms: by how much the time stamps of a pair may differ. [ms]
        encoding: `linear` or `gamma`; what the source says, else by depth, when None.
        black_level_dn: pixel value without light; what the source says, else 0, when None. [DN]
        bits: that 16-bit images use; what the source says, else as in the first pair, when None.
    """

    calibration: tuple[Path, ...] = ()
    calibration_unit: str = "m"
    image_size: str | None = None
    drogue: str = "red-8"
    boxes: Path | None = None
    box_category: str | None = None
    topics: str | None = None
    camera_info: str | None = None
    folders: str | None = None
    rate_hz: float | None = None
    stamp_tolerance_ms: float = 0.0
    encoding: str | None = None
    black_level_dn: float | None = None
    bits: int | None = None

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: one is out of its range; names the command's option.
        """
        if self.encoding not in (None, "linear", "gamma"):
            raise ValueError(f"--encoding: must be linear or gamma, got {self.encoding!r}")
        if self.calibration_unit not in BASELINE_UNITS_M:
            raise ValueError(
                f"--calibration-unit: must be one of {', '.join(BASELINE_UNITS_M)}, got {self.calibration_unit!r}"
            )
        if self.image_size is not None and _IMAGE_SIZE.fullmatch(self.image_size) is None:
            raise ValueError(f"--image-size: must be WIDTHxHEIGHT such as 1280x960, got {self.image_size!r}")
        if self.image_size is not None and not self.calibration:
            raise ValueError("--image-size: belongs to --calibration, which is missing")
        for name, value, low, high in (
            ("rate", self.rate_hz, 1e-3, 1e4),
            ("stamp-tolerance-ms", self.stamp_tolerance_ms, 0, 1000),
            ("black-level", self.black_level_dn, 0, 65535),
            ("bits", self.bits, 9, 16),
        ):
            if value is not None and not low <= value <= high:
                raise ValueError(f"--{name}: must be from {low:g} to {high:g}, got {value:g}")

    @property
    def image_size_px(self) -> tuple[int, int] | None:
        """(width, height) of one view, or None where it is not given. [px]"""
        found = _IMAGE_SIZE.fullmatch(self.image_size or "")
        return None if found is None else (int(found[1]), int(found[2]))

    @property
    def stamp_tolerance_ns(self) -> int:
        """By how much the time stamps of a pair may differ. [ns]"""
        return round(self.stamp_tolerance_ms * 1e6)

    def pair_of(self, name: Literal["topics", "camera_info", "folders"]) -> tuple[str, str] | None:
        """The two names of an option, or None where it is not given.

        Raises:
            ValueError: it has not two names.
        """
        text = getattr(self, name)
        if text is None:
            return None
        names = [part.strip() for part in text.split(",")]
        if len(names) != 2 or not all(names) or names[0] == names[1]:
            raise ValueError(f"--{name.replace('_', '-')}: must be LEFT,RIGHT, got {text!r}")
        return names[0], names[1]


def import_images(source: Path, out: Path, options: ImportOptions, report: ProgressReport) -> int:
    """Make a dataset without truth from a folder of images or a ROS bag.

    Returns:
        How many pairs it has.

    Raises:
        ValueError: images, calibration or boxes that cannot be used, or options that do not go with the source.
        OSError: the dataset cannot be written.
    """
    from datasets_manifest.calibration.rig_report import rig_report
    from datasets_manifest.importers.coco_boxes import read_boxes
    from datasets_manifest.importers.imported_dataset import ImportSettings, write_imported
    from drogue_models.presets import load_drogue

    if options.box_category is not None and options.boxes is None:
        raise ValueError("--box-category: names the category of --boxes, which is missing")
    pairs, calibration = _open_source(source, options)
    given = None if options.boxes is None else read_boxes(options.boxes, options.box_category)
    settings = ImportSettings(
        name=out.resolve().name,
        rig=calibration.rig,
        drogue=load_drogue(options.drogue),
        encoding=cast(Literal["linear", "gamma"] | None, options.encoding),
        black_level_dn=options.black_level_dn,
        bits=options.bits,
        boxes=given,
    )
    report.begin("pairs", pairs.count)
    try:
        written = write_imported(pairs, settings, out, report.advance)
    finally:
        report.end()
    for line in rig_report(calibration):
        report.say(line)
    for line in pairs.left_out:
        report.say(f"left out: {line}")
    for line in written.remarks:
        report.say(line)
    if given is not None:
        report.say(f"boxes: {written.box_count} of {len(given.boxes)} belong to these images")
    return pairs.count


def _open_source(source: Path, options: ImportOptions) -> tuple[ImportedPairs, StereoCalibration]:
    """The pairs and their rig's calibration; whether there are pairs is found out before the calibration is read."""
    bag_path = _bag_path(source)
    if bag_path is not None:
        return _open_bag(bag_path, options)
    for name in ("topics", "camera_info"):
        if getattr(options, name) is not None:
            raise ValueError(f"--{name.replace('_', '-')}: {source} is not a ROS bag")
    from datasets_manifest.importers.image_folder import ImageFolder, find_pairs

    found = find_pairs(source, options.rate_hz, options.pair_of("folders"), options.stamp_tolerance_ns)
    calibration = _given_calibration(options)
    if calibration is None:
        raise ValueError("--calibration: images need one; see docs/how-to/calibrate.md for how to make it")
    return ImageFolder(source, found, calibration.rig.camera.width_px), calibration


def _open_bag(path: Path, options: ImportOptions) -> tuple[ImportedPairs, StereoCalibration]:
    if any(given is not None for given in (options.rate_hz, options.boxes, options.folders)):
        raise ValueError(
            "--rate, --boxes, --folders: are for folders of images; a bag has time stamps, and no names for its images"
        )
    from datasets_manifest.calibration.calibration_reader import StereoCalibration

    try:
        from datasets_manifest.importers.ros_bag import RosBag
    except ModuleNotFoundError as error:
        raise ValueError(f"{path}: {error.name} is missing: pip install 'droguekit[exports]'") from error
    if options.calibration and options.camera_info is not None:
        raise ValueError("--calibration, --camera-info: give one of the two")
    bag = RosBag(path, options.pair_of("topics"), options.stamp_tolerance_ns)
    given = _given_calibration(options)
    if given is None:
        rig = bag.rig(options.pair_of("camera_info"), BASELINE_UNITS_M[options.calibration_unit])
        given = StereoCalibration(rig, "CameraInfo of the bag", is_rectification_given=True)
    return bag, given


def _given_calibration(options: ImportOptions) -> StereoCalibration | None:
    from datasets_manifest.calibration.calibration_reader import read_calibration

    if not options.calibration:
        return None
    return read_calibration(options.calibration, BASELINE_UNITS_M[options.calibration_unit], options.image_size_px)


def _bag_path(source: Path) -> Path | None:
    """The bag that SOURCE is or has in it, or None where it is a folder without one.

    Raises:
        ValueError: there is no such place, it is another kind of file, or it has several bags, or images beside one.
    """
    if not source.exists():
        raise ValueError(f"{source}: there is no such file or folder")
    if not source.is_dir():
        if source.suffix.lower() in _BAG_SUFFIXES:
            return source
        raise ValueError(
            f"{source}: must be a folder of images, or a ROS bag: a folder with metadata.yaml, or a .bag, .mcap or "
            ".db3 file"
        )
    if _is_bag_folder(source):
        return source
    from datasets_manifest.importers.image_folder import has_images

    visible = sorted(path for path in source.iterdir() if not path.name.startswith("."))
    bags = [path for path in visible if path.suffix.lower() in _BAG_SUFFIXES or _is_bag_folder(path)]
    if not bags:
        return None
    if len(bags) > 1:
        raise ValueError(f"{source}: holds several bags, such as {bags[0]} and {bags[1]}; import them one by one")
    if has_images(source):
        raise ValueError(f"{source}: holds images and the bag {bags[0]}; name the bag, or move it elsewhere")
    return bags[0]


def _is_bag_folder(folder: Path) -> bool:
    """Whether a folder is a bag of ROS 2: other programs write a metadata.yaml too, without its key or a recording.

    Raises:
        OSError: the metadata cannot be read.
    """
    metadata = folder / "metadata.yaml"
    if not metadata.is_file():
        return False
    # `ros2 bag record --compression-mode file` adds the suffix of the compression.
    if any(not _ROS2_SUFFIXES.isdisjoint(path.suffixes) for path in folder.iterdir()):
        return True
    from drogue_models.untrusted_files import open_regular

    with open_regular(metadata) as stream:
        return _METADATA_KEY in stream.read(_METADATA_BEGIN_BYTES)
