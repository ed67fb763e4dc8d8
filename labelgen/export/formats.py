"""The export formats; a format's module is imported when it is used.

A writer takes the dataset's location, the folder to write into, a log and the options that its format has. It iterates
over `log.records(...)`, holds one pair at a time, logs what its format cannot hold, and makes files appear
whole or not at all: single files by `open_text_atomic`, folders by `new_folder`, both of `datasets_manifest.atomic`.
The same dataset gives the same bytes.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from datasets_manifest.storage.storage import Location, open_storage
from labelgen.export.export_log import ExportLog

if TYPE_CHECKING:
    from labelgen.export.frame_files import ImageBits

Writer = Callable[..., list[Path]]


@dataclass(frozen=True)
class ExportFormat:
    """One format.

    Attributes:
        description: one line for the command's help.
        writer: `module:function` of its `Writer`, which returns the main files or folders that it wrote.
        extra: the extra of pyproject.toml with its dependencies, or None.
        images_are_optional: whether the writer takes `image_bits`, and writes images where it is given.
        takes_estimates: whether the writer takes `estimates`, and writes them where they are given.
    """

    description: str
    writer: str
    extra: str | None = None
    images_are_optional: bool = False
    takes_estimates: bool = False


FORMATS: dict[str, ExportFormat] = {
    "coco": ExportFormat(
        "drogue, markers and hub: boxes, run-length masks, keypoints; a file a split",
        "labelgen.export.annotations.coco:write_coco",
        images_are_optional=True,
    ),
    "yolo": ExportFormat(
        "ultralytics pose: box and keypoints in the drogue's order", "labelgen.export.annotations.yolo:write_yolo"
    ),
    "yolo-image-order": ExportFormat(
        "ultralytics pose with keypoints as they stand in the image, for training on even rings",
        "labelgen.export.annotations.yolo:write_yolo_image_order",
    ),
    "yolo-detect": ExportFormat(
        "ultralytics boxes of drogue, markers and hub", "labelgen.export.annotations.yolo:write_yolo_detect"
    ),
    "cvat": ExportFormat(
        "CVAT for images 1.1: boxes, masks and points", "labelgen.export.annotations.annotation_tools:write_cvat"
    ),
    "label-studio": ExportFormat(
        "Label Studio tasks: boxes, polygons and keypoints",
        "labelgen.export.annotations.annotation_tools:write_label_studio",
    ),
    "fiftyone": ExportFormat(
        "FiftyOne stereo groups: detections with masks, keypoints",
        "labelgen.export.annotations.annotation_tools:write_fiftyone",
    ),
    "speed": ExportFormat(
        "SPEED+ pose lists and camera, a folder an eye", "labelgen.export.poses.pose_files:write_speed"
    ),
    "kitti": ExportFormat("KITTI calibration, boxes and images", "labelgen.export.poses.kitti:write_kitti"),
    "webdataset": ExportFormat(
        "tar shards of images, part ids and records", "labelgen.export.packages.tar_shards:write_webdataset"
    ),
    "huggingface": ExportFormat(
        "Parquet with images, for load_dataset and the Hub, and its card",
        "labelgen.export.packages.huggingface:write_huggingface",
        "exports",
    ),
    "parquet": ExportFormat("one table, a row a view", "labelgen.export.packages.parquet:write_parquet", "exports"),
    "rosbag": ExportFormat(
        "ROS 2 bags (MCAP): images, CameraInfo, TF, true pose", "labelgen.export.poses.rosbag:write_rosbag", "exports"
    ),
    "tum": ExportFormat(
        "trajectories as TUM text: the truth, and estimates beside it for evo",
        "labelgen.export.poses.pose_files:write_tum",
        takes_estimates=True,
    ),
    "bop": ExportFormat(
        "BOP: two sensors, poses in mm, masks, models with symmetries", "labelgen.export.poses.bop:write_bop"
    ),
    "masks": ExportFormat("a PNG mask a part, seen and amodal", "labelgen.export.annotations.part_masks:write_masks"),
    "middlebury": ExportFormat(
        "stereo pairs with the disparity of every pixel (PFM) and what the other eye does not see",
        "labelgen.export.annotations.dense_matching:write_middlebury",
    ),
    "sintel": ExportFormat(
        "sequences with forward optical flow (.flo) of both eyes and what is hidden in the next picture",
        "labelgen.export.annotations.dense_matching:write_sintel",
    ),
    "opencv": ExportFormat("the rig as OpenCV's stereo YAML", "labelgen.export.poses.calibration_export:write_opencv"),
    "kalibr": ExportFormat("the rig as Kalibr's camera chain", "labelgen.export.poses.calibration_export:write_kalibr"),
    "ros-camera-info": ExportFormat(
        "the rig as ROS camera_info, a file an eye", "labelgen.export.poses.calibration_export:write_camera_info"
    ),
    "blind": ExportFormat(
        "images, rig and drogue without any truth", "labelgen.export.packages.blind_export:write_blind"
    ),
}


def write_export(
    name: str,
    dataset: Location,
    out: Path,
    log: ExportLog,
    *,
    image_bits: ImageBits | None = None,
    estimates: Path | None = None,
) -> list[Path]:
    """Write a dataset in a format.

    Args:
        name: of the format.
        dataset: the dataset's folder.
        out: folder to write into.
        log: receives the progress and what the format cannot hold.
        image_bits: copies images too, of at most so many bits, in a format that otherwise names the dataset's.
        estimates: writes these poses too, in a format that has trajectories.

    Returns:
        The main files or folders that were written.

    Raises:
        ValueError: no such format, a package that it needs is missing, a dataset that cannot be read or has no
            pairs, or a place that cannot be written into.
        OSError: the disk is full or cannot be written; nothing incomplete is left.
    """
    if name not in FORMATS:
        raise ValueError(f"--format: no format named {name!r}; there are {', '.join(FORMATS)}")
    chosen = FORMATS[name]
    if image_bits is not None and not chosen.images_are_optional:
        names = ", ".join(other for other, format_ in FORMATS.items() if format_.images_are_optional)
        raise ValueError(f"--images: is for {names}; {name} has images without it, or cannot have any")
    if estimates is not None and not chosen.takes_estimates:
        names = ", ".join(other for other, format_ in FORMATS.items() if format_.takes_estimates)
        raise ValueError(f"--estimates: is for {names}; {name} has true poses alone, or none")
    module, function = chosen.writer.split(":")
    try:
        writer: Writer = getattr(importlib.import_module(module), function)
    except ModuleNotFoundError as error:
        if chosen.extra is None:
            raise
        raise ValueError(f"{name}: {error.name} is missing: pip install 'droguekit[{chosen.extra}]'") from error
    folder = open_storage(dataset).path("")
    if folder is not None and out.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"--out: must lie outside the dataset's folder, got {out}")
    # Imported here, as the list of formats is also the command's help, which loads nothing that reads a dataset.
    from datasets_manifest.storage.layout import BLIND_FILE
    from datasets_manifest.storage.manifest import read_manifest

    # Estimates need no truth, and a dataset without it has no manifest.
    is_blind = estimates is not None and open_storage(dataset).exists(BLIND_FILE)
    if not is_blind and not read_manifest(dataset).frames:
        raise ValueError(f"{dataset}: its manifest lists no pairs yet; let `render` finish first")
    given = {"image_bits": image_bits, "estimates": estimates}
    try:
        return writer(dataset, out, log, **{option: value for option, value in given.items() if value is not None})
    finally:
        log.end()
