"""Amodal part masks of one eye: every part's silhouette, through an ideal or a real lens, as if nothing occluded it."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.records import PairRecord
from drogue_models.parts import DROGUE_PARTS, FIRST_MARKER_ID, Part, drogue_part_ids, part_name
from geometry.distortion import border_px
from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye, StereoRig
from render.analytic_engine.ring_passes import flat_part_masks
from render.surfaces import frame_surfaces, front_faces, is_feature

Mask = NDArray[np.bool_]

# Parts that may occlude a drogue.
OCCLUDERS = (int(Part.PROBE), int(Part.OBSTACLE))

# No part is closer to an eye. [m]
_NEAR_M = 0.01

# Field of view with a margin.
_FIELD_MARGIN = 1.05

# A strong lens bends an edge of this length by 3e-3 px (curvature 1e-4 / px), which changes no pixel in a hundred.
_STRAIGHT_PX = 16.0

_MAX_PIECES = 128


def named_parts(record: PairRecord) -> dict[str, tuple[int, ...]]:
    """Part ids by name of the mask, for all masks of a pair.

    `drogue` is everything inside its box, `neighbour_1` the same of the first drogue beside it, and `occluder` the
    receiver's probe and obstacles; all others are single parts.
    """
    drogue = record.frame.drogue
    parts: dict[str, tuple[int, ...]] = {}
    if drogue is not None:
        parts["drogue"] = tuple(drogue_part_ids(drogue.marker_count))
        parts |= {part_name(part): (int(part),) for part in DROGUE_PARTS}
        parts |= {
            part_name(FIRST_MARKER_ID + index): (FIRST_MARKER_ID + index,) for index in range(drogue.marker_count)
        }
        parts |= {part_name(part): (int(part),) for part in (Part.HOSE, Part.TANKER)}
    for index, other in enumerate(record.frame.neighbours):
        parts[f"neighbour_{index + 1}"] = tuple(drogue_part_ids(other.drogue.marker_count, index + 1))
    parts["occluder"] = OCCLUDERS
    parts[part_name(Part.DISTRACTOR)] = (int(Part.DISTRACTOR),)
    if record.frame.board is not None:
        parts[part_name(Part.BOARD)] = (int(Part.BOARD),)
    return parts


def amodal_masks(record: PairRecord, eye: Eye, part_id: NDArray[np.uint8]) -> dict[int, Mask]:
    """(H, W) by part id, the pixel centres that would see the part if nothing occluded it.

    Every part is projected by itself, as the engine draws it: as a mesh, or as flat rings by the analytic engine. The
    visible pixels are always included, even where rounding at an edge would decide otherwise.

    Args:
        record: of the pair.
        eye: which eye.
        part_id: (H, W) visible part ids.

    Raises:
        ValueError: a user's body mesh that is missing or was changed.
    """
    alone = flat_part_masks(record.frame, eye) if record.engine == "analytic" else _mesh_masks(record, eye)
    for part in np.flatnonzero(np.bincount(part_id.ravel(), minlength=256)):
        if part != Part.SKY:
            seen = part_id == part
            alone[int(part)] = alone[int(part)] | seen if int(part) in alone else seen
    return alone


def union_of_masks(masks: dict[int, Mask], parts: tuple[int, ...], shape: tuple[int, ...]) -> Mask:
    """(H, W) of `shape`, the union of the masks of the given parts; a part without a mask is empty."""
    union = np.zeros(shape, dtype=np.bool_)
    for part in parts:
        if part in masks:
            union |= masks[part]
    return union


def _mesh_masks(record: PairRecord, eye: Eye) -> dict[int, Mask]:
    frame = record.frame
    return {part: silhouette(corners, frame.rig, eye) for part, corners in part_triangles(frame, eye).items()}


def part_triangles(frame: FrameSpec, eye: Eye) -> dict[int, Array]:
    """(T, 3, 3) corners of the triangles of every part at mid-exposure, in the frame of an eye. [m]

    Markers and hub contribute only their front faces, as their other sides are inside the part around them.

    Raises:
        ValueError: a user's body mesh that is missing or was changed.
    """
    surfaces = frame_surfaces(frame, RigidTransform.identity())
    meshes: list[tuple[int, trimesh.Trimesh, RigidTransform]] = []
    for surface in surfaces.fixed.values():
        mesh = surface.painted.mesh
        assert frame.left_from_drogue is not None
        shown = front_faces(mesh) if is_feature(surface.part_id) else mesh
        meshes.append((surface.part_id, shown, frame.left_from_drogue))
    meshes += [(moved.part_id, moved.painted.mesh, moved.axes_from_mesh) for moved in surfaces.moved.values()]
    offset_m = frame.rig.eye_offset_m(eye)
    found: dict[int, list[Array]] = {}
    for part, mesh, left_from_mesh in meshes:
        found.setdefault(part, []).append(left_from_mesh.apply(np.asarray(mesh.triangles)) - offset_m)
    return {part: np.concatenate(triangles) for part, triangles in found.items()}


def silhouette(triangles_m: Array, rig: StereoRig, eye: Eye) -> NDArray[np.bool_]:
    """(H, W) whether the ray through a pixel centre meets a triangle.

    Args:
        triangles_m: (T, 3, 3) corners in the eye's frame, along the rig's axes. [m]
        rig: the cameras.
        eye: which eye.
    """
    camera = rig.camera
    shown = _clipped(triangles_m, _field_planes(rig, eye))
    change = np.zeros(camera.height_px * (camera.width_px + 1), dtype=np.int64)
    if len(shown):
        length_px = np.linalg.norm(np.diff(rig.camera.project(shown[:, [0, 1, 2, 0]]), axis=1), axis=-1).max(axis=1)
        wanted = np.ceil(length_px / _STRAIGHT_PX) if rig.lens(eye) is not None else np.ones(len(shown))
        pieces = np.minimum(2 ** np.ceil(np.log2(np.maximum(wanted, 1.0))), _MAX_PIECES).astype(int)
        for count in np.unique(pieces):
            outlines_m = _divided(shown[pieces == count], int(count))
            change += _span_ends(rig.real_px(camera.project(outlines_m), eye), camera.width_px, camera.height_px)
    layers = change.reshape(camera.height_px, camera.width_px + 1).cumsum(axis=1)[:, :-1]
    inside: NDArray[np.bool_] = layers > 0
    return inside


def _field_planes(rig: StereoRig, eye: Eye) -> Array:
    """(5, 4) planes around the field of view: a point p is inside where `plane[:3] @ p >= plane[3]`."""
    lens = rig.lens(eye)
    rays = rig.rays(border_px(rig.camera), eye)
    low, high = rays[:, :2].min(axis=0) * _FIELD_MARGIN, rays[:, :2].max(axis=0) * _FIELD_MARGIN
    if lens is not None:
        low, high = np.maximum(low, lens.field[0]), np.minimum(high, lens.field[1])
    return np.array(
        [
            [0.0, 0.0, 1.0, _NEAR_M],
            [1.0, 0.0, -low[0], 0.0],
            [-1.0, 0.0, high[0], 0.0],
            [0.0, 1.0, -low[1], 0.0],
            [0.0, -1.0, high[1], 0.0],
        ]
    )


def _clipped(triangles_m: Array, planes: Array) -> Array:
    """(T', 3, 3) triangles of the parts of (T, 3, 3) triangles inside all planes."""
    kept = triangles_m
    for plane in planes:
        height = kept @ plane[:3] - plane[3]
        inside = height >= 0
        crossing = inside.any(axis=1) & ~inside.all(axis=1)
        cut = [_cut(corners, above) for corners, above in zip(kept[crossing], height[crossing], strict=True)]
        kept = np.concatenate([kept[inside.all(axis=1)], *cut])
    return kept


def _cut(corners_m: Array, height_m: Array) -> Array:
    """(1 or 2, 3, 3) the part of a triangle at heights that are not negative (Sutherland and Hodgman)."""
    outline = []
    for index in range(3):
        following = (index + 1) % 3
        if height_m[index] >= 0:
            outline.append(corners_m[index])
        if (height_m[index] >= 0) != (height_m[following] >= 0):
            share = height_m[index] / (height_m[index] - height_m[following])
            outline.append(corners_m[index] + share * (corners_m[following] - corners_m[index]))
    return np.array([[outline[0], outline[index], outline[index + 1]] for index in range(1, len(outline) - 1)])


def _divided(triangles_m: Array, pieces: int) -> Array:
    """(T, 3 pieces, 3) points around each of (T, 3, 3) triangles."""
    share: Array = np.linspace(0.0, 1.0, pieces, endpoint=False)[:, None]
    start, end = triangles_m[:, :, None], np.roll(triangles_m, -1, axis=1)[:, :, None]
    points: Array = (start * (1.0 - share) + end * share).reshape(len(triangles_m), 3 * pieces, 3)
    return points


def _span_ends(outlines_px: Array, width_px: int, height_px: int) -> NDArray[np.int64]:
    """(H (W + 1),) difference in the number of outlines around a pixel centre and its left neighbour.

    Args:
        outlines_px: (P, M, 2) corners of convex outlines.
        width_px, height_px: size of the image.
    """
    start, end = outlines_px, np.roll(outlines_px, -1, axis=1)
    first = np.clip(np.ceil(np.minimum(start[..., 1], end[..., 1])), 0, height_px).astype(np.int64)
    last = np.clip(np.floor(np.maximum(start[..., 1], end[..., 1])), -1, height_px - 1).astype(np.int64)
    # A level edge lies between the ends of its neighbours.
    count = np.where(start[..., 1] == end[..., 1], 0, np.maximum(last - first + 1, 0)).ravel()
    edge = np.repeat(np.arange(count.size), count)
    row = first.ravel()[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    (u0, v0), (u1, v1) = start.reshape(-1, 2)[edge].T, end.reshape(-1, 2)[edge].T
    u = u0 + (row - v0) / (v1 - v0) * (u1 - u0)
    key = edge // outlines_px.shape[1] * height_px + row
    order = np.argsort(key, kind="stable")
    key, u = key[order], u[order]
    groups = np.flatnonzero(np.diff(key, prepend=-1))
    if not len(groups):
        return np.zeros(height_px * (width_px + 1), dtype=np.int64)
    low = np.clip(np.ceil(np.minimum.reduceat(u, groups)), 0, width_px).astype(np.int64)
    high = np.clip(np.floor(np.maximum.reduceat(u, groups)), -1, width_px - 1).astype(np.int64) + 1
    base = key[groups] % height_px * (width_px + 1)
    covered = high > low
    size = height_px * (width_px + 1)
    ends: NDArray[np.int64] = np.bincount(base[covered] + low[covered], minlength=size) - np.bincount(
        base[covered] + high[covered], minlength=size
    )
    return ends
