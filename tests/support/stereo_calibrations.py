"""A stereo calibration by OpenCV, files that hold it, and where its cameras see points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from geometry.stereo import EYES, StereoRig

SIZE_PX = (1280, 960)
M1 = np.array([[2140.0, 0, 650.0], [0, 2138.0, 470.0], [0, 0, 1]])
M2 = np.array([[2129.0, 0, 633.0], [0, 2131.0, 484.0], [0, 0, 1]])
D1, D2 = np.array([-0.06, 0.02, 1e-4, -2e-4, 0.01]), np.array([-0.05, 0.01, -1e-4, 1e-4, 0.0])
R = cv2.Rodrigues(np.array([0.003, -0.02, 0.004]))[0]
T = np.array([-0.1203, 0.0007, -0.0011])
R1, R2, P1, P2, Q, *_ = cv2.stereoRectify(
    M1, D1, M2, D2, SIZE_PX, R, T[:, None], flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1
)
INTRINSICS: dict[str, Any] = {"M1": M1, "D1": D1, "M2": M2, "D2": D2}
POSE: dict[str, Any] = {"R": R, "T": T[:, None]}
RECTIFICATION: dict[str, Any] = {"R1": R1, "R2": R2, "P1": P1, "P2": P2}
SIZE: dict[str, Any] = {"image_width": 1280, "image_height": 960}
EVERYTHING = SIZE | INTRINSICS | POSE | RECTIFICATION | {"Q": Q}

POINTS_M = np.random.default_rng(7).uniform([-0.2, -0.15, 1], [0.2, 0.15, 1], (40, 3)) * np.linspace(2, 40, 40)[:, None]


def storage(path: Path, values: dict[str, Any]) -> Path:
    """A file of `cv2.FileStorage`: YAML, XML or JSON by its name."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        file.write(name, value)
    file.release()
    return path


def check_rig(rig: StereoRig, turn: np.ndarray, D1: np.ndarray = D1, atol_px: float = 1e-8) -> None:
    """Points in the frame that `turn` takes the left camera's axes to are seen where OpenCV sees them."""
    left_px = cv2.projectPoints(POINTS_M, np.zeros(3), np.zeros(3), M1, D1)[0][:, 0]
    right_px = cv2.projectPoints(POINTS_M, cv2.Rodrigues(R)[0], T, M2, D2)[0][:, 0]
    for eye, px in zip(EYES, (left_px, right_px), strict=True):
        np.testing.assert_allclose(rig.image(POINTS_M @ turn.T, eye), px, atol=atol_px)


def opencv_ideal_px(
    seen_px: np.ndarray, matrix: np.ndarray, distortion: np.ndarray, rotation: np.ndarray, projection: np.ndarray
) -> np.ndarray:
    """(N, 2) rectified places of (N, 2) places in a distorted image, by OpenCV's own iteration to double precision."""
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    # OpenCV 5 has one function for both; that of OpenCV 4 stops after 5 steps.
    undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
    found = undistort(seen_px[:, None], matrix, distortion, R=rotation, P=projection, criteria=stop)
    return np.asarray(found).reshape(-1, 2)
