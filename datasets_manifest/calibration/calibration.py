"""The rig's calibration as other programs read it: OpenCV, Kalibr, ROS."""

from __future__ import annotations

import cv2

from datasets_manifest.calibration.kalibr import KALIBR_FILE, kalibr_camchain, kalibr_fault
from datasets_manifest.calibration.opencv_matrices import opencv_stereo_matrices
from datasets_manifest.calibration.ros import camera_info, camera_info_file
from datasets_manifest.storage.layout import CALIBRATION_FOLDER
from datasets_manifest.storage.storage import Location, join, open_storage
from geometry.stereo import EYES, StereoRig

__all__ = ["OPENCV_STEREO_FILE", "calibration_files", "opencv_stereo", "opencv_stereo_matrices", "write_calibration"]

OPENCV_STEREO_FILE = "opencv_stereo.yaml"


def opencv_stereo(rig: StereoRig) -> str:
    """The text of a YAML file for `cv2.FileStorage`: image size and `opencv_stereo_matrices`."""
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", rig.camera.width_px)
    storage.write("image_height", rig.camera.height_px)
    for name, matrix in opencv_stereo_matrices(rig).items():
        storage.write(name, matrix)
    text: str = storage.releaseAndGetString()
    return text


def calibration_files(rig: StereoRig) -> dict[str, str]:
    """Every calibration file of a rig by its name; without Kalibr's where that cannot describe the lenses."""
    files = {OPENCV_STEREO_FILE: opencv_stereo(rig)}
    if kalibr_fault(rig) is None:
        files[KALIBR_FILE] = kalibr_camchain(rig)
    return files | {camera_info_file(eye): camera_info(rig, eye) for eye in EYES}


def write_calibration(dataset: Location, rig: StereoRig) -> list[Location]:
    """Write the rig into the dataset's calibration folder.

    Returns:
        Where the files lie, OpenCV's first.

    Raises:
        OSError: they cannot be written.
    """
    storage, files = open_storage(dataset), calibration_files(rig)
    for name, text in files.items():
        storage.write(f"{CALIBRATION_FOLDER}/{name}", text.encode())
    return [join(dataset, f"{CALIBRATION_FOLDER}/{name}") for name in files]
