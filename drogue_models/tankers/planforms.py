"""All airframes by type, and their meshes: every one complete, closed and outward."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from drogue_models.tankers.airframe import Airframe
from drogue_models.tankers.airframe_grids import SurfaceGrid
from drogue_models.tankers.combat_aircraft import fighter, unmanned
from drogue_models.tankers.jet_transports import four_jet, twin_jet_high_wing, twin_jet_wide
from drogue_models.tankers.propeller_aircraft import four_turboprop, multirotor, tilt_rotor
from drogue_models.tankers.tanker import TankerType
from geometry.se3 import Array

_BUILDERS: dict[TankerType, Callable[[float], Airframe]] = {
    "four-jet": four_jet,
    "twin-jet-wide": twin_jet_wide,
    "four-turboprop": four_turboprop,
    "twin-jet-high-wing": twin_jet_high_wing,
    "fighter": fighter,
    "tilt-rotor": tilt_rotor,
    "unmanned": unmanned,
    "multirotor": multirotor,
}
# Faces that meet at more than this angle have an edge between them; 48 points around a pod turn by 7.5 degrees.
_CREASE_DEG = 32.0


@lru_cache(maxsize=48)
def airframe(tanker_type: TankerType, flaps_deg: float) -> Airframe:
    """The airframe of a type."""
    return _BUILDERS[tanker_type](flaps_deg)


def grid_mesh(part: SurfaceGrid, left: bool = False) -> trimesh.Trimesh:
    """One surface, closed and outward, without texture. [m]"""
    points, faces = _corners(part, left)
    mesh = trimesh.Trimesh(points.reshape(-1, 3), faces, process=False)
    mesh.merge_vertices()
    mesh.update_faces(mesh.nondegenerate_faces(height=1e-12))
    return mesh


def _corners(part: SurfaceGrid, left: bool) -> tuple[Array, NDArray[np.int64]]:
    """(S, N + 1, 3) points with the seam twice, and the faces between them without those that have no area."""
    points = np.concatenate([part.points_m, part.points_m[:, :1]], axis=1)
    if left:
        points = points * [1.0, -1.0, 1.0]
    rings, around = points.shape[:2]
    here = np.arange(rings - 1)[:, None] * around + np.arange(around - 1)
    faces = np.concatenate(
        [
            np.stack([here, here + 1, here + around + 1], axis=-1).reshape(-1, 3),
            np.stack([here, here + around + 1, here + around], axis=-1).reshape(-1, 3),
        ]
    )
    corners = points.reshape(-1, 3)[faces]
    size = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    faces = faces[size > 1e-12]
    return points, faces[:, ::-1] if left else faces


@dataclass(frozen=True, eq=False)
class _Split:
    """Vertices of a surface, one for every normal that they have.

    Attributes:
        vertices: (V,) which of the given points each one is.
        normals: (V, 3).
        faces: (F, 3) between them.
    """

    vertices: NDArray[np.int64]
    normals: Array
    faces: NDArray[np.int64]


def _with_creases(points: Array, faces: NDArray[np.int64]) -> _Split:
    """Normals of every corner: the mean over the faces there that meet its own at less than the crease's angle.

    Points at the same place count as one, so that no edge shows along the texture's seam.
    """
    corners = points[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = area / np.linalg.norm(area, axis=-1, keepdims=True)
    _, place = np.unique(np.round(points * 1e6).astype(np.int64), axis=0, return_inverse=True)
    at, face = place[faces].ravel(), np.repeat(np.arange(len(faces)), 3)
    member = csr_matrix((np.ones(len(at)), (np.arange(len(at)), at)))
    pairs = (member @ member.T).tocoo()
    near = (flat[face[pairs.row]] * flat[face[pairs.col]]).sum(axis=-1) > np.cos(np.radians(_CREASE_DEG))
    kept = csr_matrix((np.ones(int(near.sum())), (pairs.row[near], pairs.col[near])), shape=pairs.shape)
    normal = kept @ area[face]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    keys = np.column_stack([faces.ravel(), np.round(normal * 1e4).astype(np.int64)])
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return _Split(faces.ravel()[first], normal[first], inverse.reshape(-1, 3))


def joined_mesh(
    grids: Sequence[SurfaceGrid], uv_of: Callable[[int], Array], offset_m: Array
) -> tuple[trimesh.Trimesh, Array]:
    """All surfaces as one mesh with interpolated normals, and the texture coordinates of its vertices.

    Args:
        grids: surfaces; mirrored ones are added on the left.
        uv_of: (S, N + 1, 2) coordinates of one of them by its index.
        offset_m: (3,) added to all points.
    """
    points, uvs, normals, faces = [], [], [], []
    count = 0
    for index, part in enumerate(grids):
        for left in (False, True) if part.mirrored else (False,):
            places, around = _corners(part, left)
            split = _with_creases(places.reshape(-1, 3), around)
            points.append(places.reshape(-1, 3)[split.vertices])
            uvs.append(uv_of(index).reshape(-1, 2)[split.vertices])
            normals.append(split.normals)
            faces.append(split.faces + count)
            count += len(split.vertices)
    mesh = trimesh.Trimesh(
        np.concatenate(points) + offset_m,
        np.concatenate(faces),
        vertex_normals=np.concatenate(normals),
        process=False,
    )
    return mesh, np.concatenate(uvs)
