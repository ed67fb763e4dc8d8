"""Pixel centres in which a marker or the hub lies behind another one, for their amodal counts."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from geometry.compiled_loops import compiled
from geometry.se3 import Array
from geometry.stereo import Eye
from render.surfaces import Surface

# Features nearer to the eye's plane are not seen whole.
_NEAREST_M = 1e-3


def feature_triangles(fixed: dict[str, Surface], fronts: dict[str, trimesh.Trimesh]) -> dict[int, Array]:
    """(F, 3, 3) corners of the triangles of each marker's and the hub's front, by part id, in the stage's axes. [m]

    Args:
        fixed: the drogue's surfaces, by name.
        fronts: of them, from `feature_surfaces`.
    """
    return {fixed[name].part_id: np.asarray(mesh.triangles, dtype=np.float64) for name, mesh in fronts.items()}


def add_hidden_centers(
    counts: dict[int, int],
    frame: FrameSpec,
    eye: Eye,
    triangles_m: dict[int, Array],
    alone: tuple[NDArray[np.int64], NDArray[np.uint8]],
) -> dict[int, int]:
    """Counts of `amodal_counts` with the pixel centres in which one feature hides another.

    Only features whose images' frames overlap are looked at: mostly there are none.

    Args:
        counts: by part id.
        frame: gives rig and pose at mid-exposure.
        eye: which eye.
        triangles_m: as `feature_triangles` gives them.
        alone: (P,) flat indices of pixels, and (P,) what their centres see of markers and hub alone.
    """
    camera, pose, total = frame.rig.camera, frame.left_from_stage_at(0.0), dict(counts)
    in_eye, low_px, high_px = {}, {}, {}
    for part, corners_m in triangles_m.items():
        corners = pose.apply(corners_m) - frame.rig.eye_offset_m(eye)
        if len(corners) and corners[..., 2].min() >= _NEAREST_M:
            image_px = frame.rig.image_px(camera.project(corners), eye).reshape(-1, 2)
            in_eye[part], low_px[part], high_px[part] = corners, image_px.min(axis=0), image_px.max(axis=0)
    overlapping = [
        part
        for part in in_eye
        if any(
            (low_px[part] <= high_px[other]).all() and (low_px[other] <= high_px[part]).all()
            for other in in_eye
            if other != part
        )
    ]
    if not overlapping:
        return total
    seen = np.flatnonzero(alone[1])
    rows, columns = np.divmod(alone[0][seen], camera.width_px)
    px, ids = np.stack([columns, rows], axis=-1).astype(np.float64), alone[1][seen]
    for part in overlapping:
        near = ((px >= low_px[part]) & (px <= high_px[part])).all(axis=1) & (ids != part)
        if near.any():
            rays = np.ascontiguousarray(frame.rig.rays(px[near], eye)[:, :2])
            hidden = _count_inside(rays, in_eye[part][..., :2] / in_eye[part][..., 2:])
            if hidden:
                total[part] = total.get(part, 0) + int(hidden)
    return total


@compiled
def _count_inside(points: Array, triangles: Array) -> int:
    """How many of (N, 2) points lie in any of (F, 3, 2) triangles."""
    inside = 0
    for n in range(points.shape[0]):
        x, y = points[n, 0], points[n, 1]
        for f in range(triangles.shape[0]):
            is_left, is_right = True, True
            for first in range(3):
                u, v = triangles[f, first, 0], triangles[f, first, 1]
                other = (first + 1) % 3
                side = (triangles[f, other, 0] - u) * (y - v) - (triangles[f, other, 1] - v) * (x - u)
                is_left, is_right = is_left and side >= 0.0, is_right and side <= 0.0
            if is_left or is_right:
                inside += 1
                break
    return inside
