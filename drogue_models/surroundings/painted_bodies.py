"""Closed bodies with paint of their own, joined to one surface with one map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from drogue_models.frozen_model import ReflectanceRgb
from drogue_models.painted_mesh import HIGHEST_REFLECTANCE, LOWEST_REFLECTANCE, PaintedMesh
from drogue_models.solids import loft, revolve
from geometry.se3 import Array

COLUMNS = 128
BARE_METAL: ReflectanceRgb = (0.42, 0.41, 0.39)  # worn aluminium and steel, diffuse share; our choice
_CREASE_RAD = np.radians(25.0)
Paint = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PaintedBody:
    """One closed body.

    Attributes:
        mesh: with outward normals. [m]
        uv: (V, 2) places of its vertices in its own paint, [0, 1]; row 0 is at v = 0.
        paint: (h, COLUMNS, 3) diffuse reflectance in linear Rec. 709.
    """

    mesh: trimesh.Trimesh
    uv: Array
    paint: Paint

    def moved(self, matrix: ArrayLike) -> PaintedBody:
        """The body at a (4, 4) pose. [m]"""
        mesh = self.mesh.copy()
        mesh.apply_transform(np.asarray(matrix, dtype=np.float64))
        return PaintedBody(mesh, self.uv, self.paint)


def joined(bodies: Sequence[PaintedBody], emission_cd_m2: ArrayLike = (0.0, 0.0, 0.0)) -> PaintedMesh:
    """All bodies as one surface, split at creases; their paints lie one below the other in its map.

    The paint is matt: a sheen on bodies that fill much of the view takes as many paths as all else in the frame.
    """
    height = sum(len(body.paint) for body in bodies)
    meshes, places, row = [], [], 0
    for body in bodies:
        mesh, source = split_at_creases(body.mesh)
        # From the middle of the first texel to that of the last, so that no neighbour shines through.
        u = (0.5 + body.uv[source, 0] * (COLUMNS - 1)) / COLUMNS
        v = (row + 0.5 + body.uv[source, 1] * (len(body.paint) - 1)) / height
        meshes.append(mesh)
        places.append(np.column_stack([u, v]))
        row += len(body.paint)
    paint = np.clip(np.concatenate([body.paint for body in bodies]), LOWEST_REFLECTANCE, HIGHEST_REFLECTANCE)
    return PaintedMesh(
        mesh=trimesh.util.concatenate(meshes),
        reflectance=paint.astype(np.float32),
        uv=np.concatenate(places),
        emission_cd_m2=np.asarray(emission_cd_m2, dtype=np.float64),
        smooth=True,
    )


def split_at_creases(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, NDArray[np.int64]]:
    """The mesh with vertices of its own on either side of every crease, and (V',) the vertices that they were."""
    soft = mesh.face_adjacency[mesh.face_adjacency_angles < _CREASE_RAD]
    groups = trimesh.graph.connected_component_labels(soft, node_count=len(mesh.faces))
    corners = np.stack([np.asarray(mesh.faces).ravel(), np.repeat(groups, 3)], axis=1)
    found, faces = np.unique(corners, axis=0, return_inverse=True)
    source = found[:, 0].astype(np.int64)
    split = trimesh.Trimesh(np.asarray(mesh.vertices)[source], faces.reshape(-1, 3), process=False)
    return split, source


def turned(profile_m: ArrayLike, sections: int, paint: Paint) -> PaintedBody:
    """A body of revolution around z.

    Args:
        profile_m: (P, 2) closed profile (radius, z), see `revolve`; its first and last corner lie on the axis.
        sections: even number, around the axis.
        paint: rows run along the profile from its first corner to its last, columns around one half; the other half
            mirrors it, so that there is no seam.
    """
    profile = np.asarray(profile_m, dtype=np.float64)
    steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    v = steps / steps[-1]
    around = 1.0 - np.abs(np.arange(sections) / (sections / 2) - 1.0)
    inner = np.column_stack([np.repeat(around, len(profile) - 2), np.tile(v[1:-1], sections)])
    return PaintedBody(revolve(profile, sections), np.vstack([inner, [[0.5, 0.0], [0.5, 1.0]]]), paint)


def swept(
    path_m: ArrayLike, radii_m: ArrayLike, sections: int, paint: Paint, painted_m: float | None = None
) -> PaintedBody:
    """A round tube along a path.

    Args:
        path_m: (S, 3) centre line. [m]
        radii_m: (S,) [m]
        sections: even number, around the tube.
        paint: rows run along the path, columns around one half.
        painted_m: length that the rows cover; beyond it the last row goes on. None for the whole path. [m]
    """
    path, radii = np.asarray(path_m, dtype=np.float64), np.asarray(radii_m, dtype=np.float64)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.empty_like(path)
    carried = np.eye(3)[int(np.argmin(np.abs(tangent[0])))]
    for index, along in enumerate(tangent):
        across = carried - (carried @ along) * along
        carried = side[index] = across / np.linalg.norm(across)
    up = np.cross(tangent, side)
    angle = 2 * np.pi * np.arange(sections) / sections
    ring = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * up[:, None]
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    around = 1.0 - np.abs(np.arange(sections) / (sections / 2) - 1.0)
    v = np.minimum(along_m / (painted_m or along_m[-1]), 1.0)
    uv = np.column_stack([np.tile(around, len(path)), np.repeat(v, sections)])
    mesh = loft(path[:, None] + radii[:, None, None] * ring)
    return PaintedBody(mesh, np.vstack([uv, [[0.5, 0.0], [0.5, 1.0]]]), paint)


def flat_sided(mesh: trimesh.Trimesh, paint: Paint, across: int, along: int) -> PaintedBody:
    """A body with paint projected along one axis.

    Args:
        mesh: closed.
        paint: its columns run along axis `across` of the mesh's bounds, its rows along axis `along`.
        across, along: two of 0, 1, 2.
    """
    low, high = np.asarray(mesh.bounds)
    share = (np.asarray(mesh.vertices) - low) / np.maximum(high - low, 1e-12)
    return PaintedBody(mesh, share[:, [across, along]], paint)


def weathered(
    rng: np.random.Generator, rows: int, base_rgb: ArrayLike, grime: float = 0.2, streaks: float = 0.1
) -> Paint:
    """(rows, COLUMNS, 3) paint with blotches of grime and streaks along its rows, in the direction of the flow.

    Args:
        rng: of the pattern.
        rows: of the result.
        base_rgb: (3,) clean paint, or (rows, 3) or (rows, COLUMNS, 3).
        grime, streaks: largest loss of reflectance by each.
    """
    base = np.asarray(base_rgb, dtype=np.float64)
    paint = np.broadcast_to(base[:, None] if base.ndim == 2 else base, (rows, COLUMNS, 3))
    blotch = _noise(rng, rows, (6.0, 6.0)) * 0.6 + _noise(rng, rows, (1.5, 1.5)) * 0.4
    streak = 0.7 * _noise(rng, rows, (rows / 4, 3.0)) + 0.3 * _noise(rng, rows, (rows / 10, 1.0))
    loss = (1 - grime * blotch) * (1 - streaks * streak)
    return np.asarray(paint * loss[..., None])


def chipped(
    rng: np.random.Generator, paint: Paint, rows: ArrayLike, reach: float, share: float, metal: ReflectanceRgb
) -> Paint:
    """The paint with bare metal near rows, which are edges that others rub.

    Args:
        rng: of the pattern.
        paint: (h, COLUMNS, 3).
        rows: (R,) rows of the edges.
        reach: from an edge. [rows]
        share: of the edge itself that is bare.
        metal: what shows.
    """
    away = np.abs(np.arange(len(paint))[:, None] - np.asarray(rows, dtype=np.float64)).min(axis=1) / reach
    limit = 1.0 - share * np.exp(-(away**2))
    bare = (_noise(rng, len(paint), (0.7, 0.7)) > limit[:, None])[..., None]
    return np.asarray(np.where(bare, np.array(metal), paint))


def _noise(rng: np.random.Generator, rows: int, sigma: tuple[float, float]) -> Array:
    """(rows, COLUMNS) smooth noise in [0, 1], evenly distributed."""
    smooth = gaussian_filter(rng.standard_normal((rows, COLUMNS)), sigma, mode="nearest")
    rank = np.empty(smooth.size)
    rank[np.argsort(smooth, axis=None)] = np.linspace(0.0, 1.0, smooth.size)
    return rank.reshape(smooth.shape)


def banded(rows: int, base_rgb: ArrayLike, bands: Sequence[tuple[float, float, ReflectanceRgb]]) -> Paint:
    """(rows, 3) paint with bands from one share of the length to another."""
    paint = np.tile(np.asarray(base_rgb, dtype=np.float64), (rows, 1))
    place = (np.arange(rows) + 0.5) / rows
    for start, end, color in bands:
        paint[(place >= start) & (place < end)] = color
    return paint
