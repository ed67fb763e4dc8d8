"""Amodal part masks of one eye: every part as if nothing occluded it."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.records import PairRecord
from drogue_models.meshes import drogue_meshes, hose_mesh, obstacle_mesh
from drogue_models.parts import DROGUE_PARTS, FIRST_MARKER_ID, MAX_MARKERS, Part, drogue_part_ids, part_name
from drogue_models.tanker import tanker_mesh
from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye
from labelgen.silhouettes import silhouette
from render.analytic_engine.ring_passes import flat_part_masks
from render.surfaces import missing_parts

Mask = NDArray[np.bool_]

# Parts that may occlude a drogue.
OCCLUDERS = (int(Part.PROBE), int(Part.OBSTACLE))


def named_parts(record: PairRecord) -> dict[str, tuple[int, ...]]:
    """Part ids by name of the mask, for all masks of a pair.

    `drogue` is everything inside its box, `occluder` the receiver's probe and obstacles; all others are single parts.
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
    for part in np.flatnonzero(np.bincount(part_id.ravel(), minlength=256)[: FIRST_MARKER_ID + MAX_MARKERS]):
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
    meshes: list[tuple[int, trimesh.Trimesh, RigidTransform]] = []
    if frame.drogue is not None and frame.left_from_drogue is not None:
        gone = missing_parts(frame)
        for part, mesh in drogue_meshes(frame.drogue).items():
            if part not in gone:
                meshes.append((part, _front(mesh) if _is_feature(part) else mesh, frame.left_from_drogue))
        if frame.hose_nodes_left_m is not None:
            here = RigidTransform(np.eye(3), np.zeros(3))
            meshes.append((int(Part.HOSE), hose_mesh(frame.hose_nodes_left_m, frame.drogue.hose_radius_m), here))
        if frame.left_from_tanker is not None:
            meshes.append((int(Part.TANKER), tanker_mesh(), frame.left_from_tanker))
    for obstacle in frame.bystanders:
        part = int(Part[obstacle.kind.upper()])
        meshes.append((part, obstacle_mesh(obstacle.shape), obstacle.left_from_object))
    offset_m = frame.rig.eye_offset_m(eye)
    found: dict[int, list[Array]] = {}
    for part, mesh, left_from_mesh in meshes:
        found.setdefault(part, []).append(left_from_mesh.apply(np.asarray(mesh.triangles)) - offset_m)
    return {part: np.concatenate(triangles) for part, triangles in found.items()}


def _is_feature(part: int) -> bool:
    return part == Part.HUB or part >= FIRST_MARKER_ID


def _front(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return mesh.submesh([np.flatnonzero(mesh.face_normals[:, 2] < -0.5)], append=True)
