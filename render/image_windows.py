"""Which part of an image holds what stands before an eye."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import RigidTransform
from geometry.stereo import StereoRig

NEAREST_M = 0.05
"""Nearer than this a corner's projection means nothing and the whole image is taken. [m]"""
# Beyond what the corners reach: their own rounding, and the pixel that holds them.
_MARGIN_PX = 2


def window_of(
    rig: StereoRig, poses: Iterable[RigidTransform], corners_m: NDArray[np.float64] | NDArray[np.float32]
) -> tuple[NDArray[np.int_], NDArray[np.int_]] | None:
    """What of the image holds a thing while the shutter is open.

    Args:
        rig: whose eye it is.
        poses: `stage_from_eye` at some moments.
        corners_m: (V, 3) in the stage's axes; the thing lies within their convex hull. [m]

    Returns:
        Its first column and row, and those behind its last; None when the image holds nothing of it. [px]
    """
    camera = rig.camera
    size = np.array([camera.width_px, camera.height_px])
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for pose in poses:
        points = pose.inverse().apply(corners_m)
        if not len(points) or points[:, 2].max() < NEAREST_M:
            continue
        if points[:, 2].min() < NEAREST_M:
            low, high = np.zeros(2), size.astype(np.float64)
            break
        seen = camera.project(points)
        low, high = np.minimum(low, seen.min(axis=0)), np.maximum(high, seen.max(axis=0))
    # Where a lens moves what stands in the ideal image.
    margin = _MARGIN_PX + np.ceil(rig.largest_shift_px())
    first = np.clip(np.floor(low) - margin, 0, size)
    end = np.clip(np.ceil(high) + margin + 1, 0, size)
    return None if (first >= end).any() else (first.astype(int), end.astype(int))
