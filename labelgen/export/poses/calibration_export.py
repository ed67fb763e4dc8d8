"""Exports of the rig's calibration, for OpenCV, Kalibr or ROS."""

from __future__ import annotations

from pathlib import Path

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.calibration.calibration_files import (
    KALIBR_FILE,
    OPENCV_STEREO_FILE,
    camera_info,
    camera_info_file,
    kalibr_camchain,
    kalibr_fault,
    opencv_stereo,
)
from datasets_manifest.storage.manifest import read_manifest
from datasets_manifest.storage.storage import Location
from geometry.stereo import EYES
from labelgen.export.export_log import ExportLog


def write_opencv(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """OpenCV's stereo YAML; arguments and errors as in `labelgen.export.formats`."""
    return _write(out, {OPENCV_STEREO_FILE: opencv_stereo(read_manifest(dataset).recipe.rig)})


def write_kalibr(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Kalibr's camera chain; arguments and errors as in `labelgen.export.formats`.

    Raises:
        ValueError: also for lenses with a k3, which Kalibr cannot describe.
    """
    rig = read_manifest(dataset).recipe.rig
    fault = kalibr_fault(rig)
    if fault is not None:
        raise ValueError(f"rig: {fault}; use opencv or ros-camera-info")
    return _write(out, {KALIBR_FILE: kalibr_camchain(rig)})


def write_camera_info(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """ROS's `camera_info`, one file for each eye; arguments and errors as in `labelgen.export.formats`."""
    rig = read_manifest(dataset).recipe.rig
    return _write(out, {camera_info_file(eye): camera_info(rig, eye) for eye in EYES})


def _write(out: Path, files: dict[str, str]) -> list[Path]:
    for name, text in files.items():
        write_text_atomic(out / name, text)
    return [out / name for name in files]
