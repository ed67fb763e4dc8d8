"""The triangles of everything that stands in a frame, by part, in the frame of one eye."""

from __future__ import annotations

import numpy as np
import trimesh

from datasets_manifest.types.frame import FrameSpec
from drogue_models.meshes import bystander_mesh, drogue_meshes, hose_mesh, tanker_mesh
from drogue_models.parts import FIRST_MARKER_ID, Part
from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye
from render.surfaces import missing_parts


def part_triangles(frame: FrameSpec, eye: Eye) -> dict[int, Array]:
    """(T, 3, 3) corners of the triangles of every part at mid-exposure, in the frame of an eye. [m]

    Of markers and hub only the front faces: their other sides are sunk in the part around them.

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
    for bystander in frame.bystanders:
        part = int(Part[bystander.kind.upper()])
        meshes.append((part, bystander_mesh(bystander.shape), bystander.left_from_object))
    offset_m = frame.rig.eye_offset_m(eye)
    found: dict[int, list[Array]] = {}
    for part, mesh, left_from_mesh in meshes:
        found.setdefault(part, []).append(left_from_mesh.apply(np.asarray(mesh.triangles)) - offset_m)
    return {part: np.concatenate(triangles) for part, triangles in found.items()}


def _is_feature(part: int) -> bool:
    return part == Part.HUB or part >= FIRST_MARKER_ID


def _front(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return mesh.submesh([np.flatnonzero(mesh.face_normals[:, 2] < -0.5)], append=True)
