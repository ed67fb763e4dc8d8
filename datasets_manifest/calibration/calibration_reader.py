"""Reads the stereo calibrations of other programs: OpenCV, ROS, Kalibr, ORB-SLAM, and EuRoC's layout."""

from __future__ import annotations

import errno
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from datasets_manifest.calibration.camera_chain import (
    is_camera_chain,
    is_sensor_file,
    rig_of_camera_chain,
    rig_of_sensor_files,
)
from datasets_manifest.calibration.camera_info import camera_info_of_table, is_camera_info, rig_of_camera_info
from datasets_manifest.calibration.opencv_storage import (
    is_table_of_matrices,
    read_calibration_text,
    read_opencv_storage,
    rig_of_tables,
)
from geometry.stereo import StereoRig

_KNOWN = (
    "OpenCV's stereo calibration (M1, D1, M2, D2, R, T), Kalibr's camchain, ROS's camera_info of both cameras, EuRoC's "
    "sensor.yaml of both cameras, or ORB-SLAM's settings"
)
# A calibration has a few kilobytes. Its reader takes a kilobyte of memory for every value.
_LARGEST_YAML = 2**18
_MOST_VALUES = 100_000
_OPENCV_BEGINNINGS = ("<?xml", "{")
_MATRIX_TAG = "!!opencv-matrix"


@dataclass(frozen=True, eq=False)
class StereoCalibration:
    """A rig, and what its calibration said.

    Attributes:
        rig: the cameras.
        layout: whose files they were.
        is_rectification_given: whether they hold a rectification, whose left camera then is the rig's left frame;
            otherwise it is that of OpenCV's `stereoRectify`.
    """

    rig: StereoRig
    layout: str
    is_rectification_given: bool


def read_calibration(
    paths: Sequence[Path], unit_m: float = 1.0, size_px: tuple[int, int] | None = None
) -> StereoCalibration:
    """The calibration in one file, or in two that belong together: left and right, or intrinsics and extrinsics.

    Args:
        paths: the files; of a file for each camera the left one first.
        unit_m: the unit of the baseline. [m]
        size_px: (width, height) of the images, where files of OpenCV do not hold it.

    Raises:
        ValueError: not a calibration, an incomplete or an impossible one; names file and key.
    """
    texts = [_text(path) for path in paths]
    if all(_is_opencv_storage(text) for text in texts):
        rig, is_given = read_opencv_storage(paths, unit_m, size_px)
        return StereoCalibration(rig, "OpenCV", is_given)
    tables = [_table(text, path) for text, path in zip(texts, paths, strict=True)]
    names = [str(path) for path in paths]
    if all(is_table_of_matrices(table) and not is_camera_info(table) for table in tables):
        rig, is_given = rig_of_tables(tables, paths, unit_m, size_px)
        return StereoCalibration(rig, "OpenCV's names", is_given)
    if size_px is not None:
        raise ValueError(f"--image-size: {names[0]} holds the size of its images")
    if any(is_camera_chain(table) for table in tables):
        _check_count(paths, 1, "Kalibr's camchain is one file with both cameras")
        return StereoCalibration(rig_of_camera_chain(tables[0], names[0], unit_m), "Kalibr", False)
    if all(is_camera_info(table) for table in tables):
        _check_count(paths, 2, "ROS's camera_info is a file for each camera, the left one first")
        left, right = map(camera_info_of_table, tables, names)
        return StereoCalibration(rig_of_camera_info(left, right, unit_m), "ROS", True)
    if all(is_sensor_file(table) for table in tables):
        _check_count(paths, 2, "EuRoC's sensor.yaml is a file for each camera, the left one first")
        rig = rig_of_sensor_files(tables[0], tables[1], (names[0], names[1]), unit_m)
        return StereoCalibration(rig, "EuRoC", False)
    raise ValueError(f"{' and '.join(names)}: is not a calibration that can be read; give {_KNOWN}")


def _check_count(paths: Sequence[Path], count: int, rule: str) -> None:
    if len(paths) != count:
        raise ValueError(f"--calibration: {rule}, got {len(paths)} ({', '.join(map(str, paths))})")


def _text(path: Path) -> str:
    try:
        return read_calibration_text(path)
    except OSError as error:
        if isinstance(error, FileNotFoundError | IsADirectoryError):
            raise ValueError(f"{path}: there is no such calibration file") from error
        if error.errno == errno.EFBIG:
            raise ValueError(f"{path}: is too large for a calibration; give {_KNOWN}") from error
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is not a text file; give {_KNOWN}") from error


def _check_value_count(table: object) -> None:
    """Refuse a table whose references stand for more values than it holds, or for itself.

    Raises:
        ValueError: it stands for too many.
    """
    waiting, count = [table], 0
    while waiting:
        value = waiting.pop()
        inner = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple | set) else ()
        waiting += inner
        count += 1
        if count > _MOST_VALUES or len(waiting) > _MOST_VALUES:
            raise ValueError(f"stands for more than {_MOST_VALUES} values")


def _is_opencv_storage(text: str) -> bool:
    """Whether a text is OpenCV's storage; other programs put its header before plain YAML."""
    return text.lstrip().startswith(_OPENCV_BEGINNINGS) or _MATRIX_TAG in text


def _table(text: str, path: Path) -> Mapping[str, Any]:
    """The first document of a YAML file."""
    if len(text) > _LARGEST_YAML:
        raise ValueError(f"{path}: is too large for a calibration; give {_KNOWN}")
    # OpenCV's header is no directive of YAML.
    lines = [line for line in text.splitlines() if not line.startswith("%YAML")]
    try:
        table = next(iter(yaml.safe_load_all("\n".join(lines))), None)
        _check_value_count(table)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: is not YAML: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(table, Mapping):
        raise ValueError(f"{path}: is not a calibration that can be read; give {_KNOWN}")
    return table
