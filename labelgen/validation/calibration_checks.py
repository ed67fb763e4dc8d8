"""A dataset's calibration files against the rig of its manifest."""

from __future__ import annotations

import cv2
import numpy as np

from datasets_manifest.calibration.calibration import OPENCV_STEREO_FILE, calibration_files, opencv_stereo_matrices
from datasets_manifest.storage.layout import CALIBRATION_FOLDER
from datasets_manifest.storage.storage import Location, open_storage
from geometry.stereo import StereoRig

# The files hold 16 digits.
_TOLERANCE = 1e-14


def calibration_faults(dataset: Location, rig: StereoRig) -> list[str]:
    """What is wrong with the files that are there; OpenCV's must be."""
    storage, faults = open_storage(dataset), []
    for name, text in calibration_files(rig).items():
        path = storage.where(f"{CALIBRATION_FOLDER}/{name}")
        try:
            found = storage.read(f"{CALIBRATION_FOLDER}/{name}")
        except FileNotFoundError:
            if name == OPENCV_STEREO_FILE:
                faults.append(f"{path}: is missing")
            continue
        except OSError as error:
            faults.append(f"{path}: cannot be read: {error.strerror}")
            continue
        if found != text.encode():
            faults.append(f"{path}: is not that of the manifest's rig")
        elif name == OPENCV_STEREO_FILE:
            # Only what is known not to be damaged is given to OpenCV's parser.
            faults += _opencv_faults(path, text, rig)
    return faults


def _opencv_faults(path: str, text: str, rig: StereoRig) -> list[str]:
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    faults = []
    for name, want in opencv_stereo_matrices(rig).items():
        found = storage.getNode(name).mat()
        if found is None or found.shape != want.shape or not np.allclose(found, want, rtol=_TOLERANCE, atol=1e-300):
            faults.append(f"{path}: {name}: OpenCV reads {None if found is None else found.tolist()}")
    return faults
