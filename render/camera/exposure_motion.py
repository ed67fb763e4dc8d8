"""Motion of the eyes during the exposure, and the image window that holds an object meanwhile."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from drogue_models.parts import RECEIVER_PARTS
from geometry.se3 import RigidTransform, exp_twist
from geometry.stereo import Eye, StereoRig

NEAREST_M = 0.05
"""If a corner is nearer than this, its projection is useless and the window is the whole image. [m]"""
# Margin beyond the corners, for rounding and for the pixel that holds them.
_MARGIN_PX = 2


def pose_polynomial(frame: FrameSpec, eye: Eye) -> NDArray[np.float64]:
    """Pose of an eye in the stage's axes (`FrameSpec.left_from_stage_at`) over the exposure.

    Returns:
        (3, 3, 4) coefficients c of `stage_from_eye(s) = c[0] + c[1] s + c[2] s^2`, s from -1 (shutter opens) to 1
        (it closes); exact at both ends and the middle, with an error of third order in the motion elsewhere.
    """
    half_s = frame.exposure.time_s / 2
    eye_from_left = exp_twist(np.concatenate([-frame.rig.eye_offset_m(eye), np.zeros(3)]))
    opened, middle, closed = (
        (eye_from_left @ frame.left_from_stage_at(offset_s)).inverse().as_matrix()[:3]
        for offset_s in (-half_s, 0.0, half_s)
    )
    return np.stack([middle, (closed - opened) / 2, (closed + opened) / 2 - middle])


def motion_blur_px(frame: FrameSpec) -> float:
    """Largest motion of the image from mid-exposure to either end of the exposure. [px]"""
    half_s = frame.exposure.time_s / 2
    if frame.drogue is not None:
        places_m = frame.drogue.rim_radius_m * np.array(
            [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=np.float64
        )
    else:
        places_m = np.array([obstacle.left_from_object.translation_m for obstacle in frame.bystanders])
    seen = [frame.rig.camera.project(frame.left_from_stage_at(s).apply(places_m)) for s in (-half_s, 0.0, half_s)]
    return float(max(np.abs(seen[0] - seen[1]).max(), np.abs(seen[2] - seen[1]).max()))


def receiver_pixels(
    frame: FrameSpec, eye: Eye, part_id: NDArray[np.uint8], distance_m: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Where parts of the receiver would be seen during the exposure if they stood in the stage's axes, as drawn.

    They fly with the cameras and stay sharp: what is seen here is that of mid-exposure.

    Args:
        frame: rig, exposure and motion.
        eye: which image.
        part_id: (H, W) part ids at mid-exposure.
        distance_m: (H, W) distances along the rays there. [m]

    Returns:
        (H, W) pixels of the receiver's parts, and those around them as far as their image would move.
    """
    held = np.zeros(part_id.shape, dtype=np.bool_)
    pose = pose_polynomial(frame, eye)
    for part in RECEIVER_PARTS:
        rows, columns = np.nonzero((part_id == part) & np.isfinite(distance_m))
        if not len(rows):
            continue
        rays = frame.rig.rays(np.stack([columns, rows], axis=-1).astype(np.float64), eye)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        in_stage_m = rays * distance_m[rows, columns, None] @ pose[0, :, :3].T + pose[0, :, 3]
        reach_px = 0.0
        for s in (-1.0, 1.0):
            moved = RigidTransform.from_matrix(np.vstack([pose[0] + s * pose[1] + pose[2], [0.0, 0.0, 0.0, 1.0]]))
            seen_m = moved.inverse().apply(in_stage_m)
            seen_m[:, 2] = np.maximum(seen_m[:, 2], NEAREST_M)
            shift_px = frame.rig.camera.project(seen_m) - frame.rig.camera.project(rays)
            reach_px = max(reach_px, float(np.abs(shift_px).max()))
        side = 2 * (1 + int(np.ceil(min(reach_px, float(max(part_id.shape)))))) + 1
        near = cv2.dilate((part_id == part).astype(np.uint8), np.ones((side, side), dtype=np.uint8))
        held |= near > 0
    return held


def image_window(
    rig: StereoRig, poses: Iterable[RigidTransform], corners_m: NDArray[np.float64] | NDArray[np.float32]
) -> tuple[NDArray[np.int_], NDArray[np.int_]] | None:
    """The part of an eye's image that holds an object while the shutter is open.

    Args:
        rig: gives camera and lenses.
        poses: `stage_from_eye` at some moments of the exposure.
        corners_m: (V, 3) in the stage's axes; the object lies within their convex hull. [m]

    Returns:
        First column and row, and those after the last ones; None when the object is outside the image. [px]
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
    # So far from its place in the ideal image a lens shows what it sees; a barrel also sees what is outside that image.
    shift_px = max((lens.largest_shift_px(camera) for lens in rig.lenses or ()), default=0.0)
    margin = _MARGIN_PX + np.ceil(shift_px)
    first = np.clip(np.floor(low) - margin, 0, size)
    end = np.clip(np.ceil(high) + margin + 1, 0, size)
    return None if (first >= end).any() else (first.astype(int), end.astype(int))
