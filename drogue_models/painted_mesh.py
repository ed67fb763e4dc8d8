"""A surface of one part with its paint: what renderers draw, masks project and mesh files hold."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from geometry.se3 import Array, read_only

LOWEST_REFLECTANCE, HIGHEST_REFLECTANCE = 0.01, 0.95
"""What painters of maps keep to: soot reflects 0.01 to 0.03 in the visible, fresh white paint up to 0.9."""


# Bodies of at least this thickness are a pixel wide out to 100 m. [m]
_NARROW_M = 0.06
# A polygon with the area of a disc reaches so much beyond the square around the disc.
_UV_TOLERANCE = 1e-3


class Sheen(NamedTuple):
    """Specular microfacets over the paint; see `drogue_models.parameters.SatinPaint`.

    Attributes:
        fraction: share of the light that they reflect.
        roughness: width of the facets' distribution.
    """

    fraction: float
    roughness: float


@dataclass(frozen=True, eq=False)
class PaintedMesh:
    """A surface of one part: triangles, and what they reflect and emit.

    Attributes:
        mesh: metres, outward normals; closed where it bounds a solid, apart from vertices split at creases and seams.
            Several surfaces may share it, so nobody may change it.
        reflectance: (3,) float64 or (h, w, 3) float32, diffuse, linear Rec. 709, each in [0, 1].
        uv: (V, 2) texture coordinates in [0, 1] but for rounding. Row 0 of the map is at v = 0, column 0 at u = 0; its
            border continues beyond its outermost texel centres. None for one reflectance.
        emission_cd_m2: (3,) radiance of a surface that shines, else zeros. [cd/m2]
        smooth: normals are interpolated from those of the mesh's vertices, already split at creases.
        sheen: microfacets over the paint, or None where it is matt.

    Raises:
        ValueError: arrays of other shapes, values out of range, or a map without texture coordinates.
    """

    mesh: trimesh.Trimesh
    reflectance: NDArray[np.floating[Any]]
    uv: Array | None = None
    emission_cd_m2: Array = field(default_factory=lambda: np.zeros(3))
    smooth: bool = False
    sheen: Sheen | None = None

    def __post_init__(self) -> None:
        is_map = np.ndim(self.reflectance) > 1
        reflectance = np.array(self.reflectance, dtype=np.float32 if is_map else np.float64)
        if reflectance.shape != (3,) and not (reflectance.ndim == 3 and reflectance.shape[2] == 3 and reflectance.size):
            raise ValueError(f"reflectance: must have shape (3,) or (h, w, 3), got {reflectance.shape}")
        # Written so that it also rejects NaN.
        if not (reflectance.min() >= 0 and reflectance.max() <= 1):
            raise ValueError(f"reflectance: must be in [0, 1], got {reflectance.min()} to {reflectance.max()}")
        reflectance.flags.writeable = False
        object.__setattr__(self, "reflectance", reflectance)
        emission = read_only(self.emission_cd_m2, (3,), "emission_cd_m2")
        if emission.min() < 0:
            raise ValueError(f"emission_cd_m2: must not be negative, got {emission.tolist()}")
        object.__setattr__(self, "emission_cd_m2", emission)
        if self.uv is None:
            if self.has_map:
                raise ValueError("uv: a map needs texture coordinates")
            return
        uv = read_only(self.uv, (len(self.mesh.vertices), 2), "uv")
        if len(uv) and not (uv.min() >= -_UV_TOLERANCE and uv.max() <= 1 + _UV_TOLERANCE):
            raise ValueError(f"uv: must be in [0, 1], got {uv.min()} to {uv.max()}")
        object.__setattr__(self, "uv", uv)

    @property
    def has_map(self) -> bool:
        """Whether the reflectance is a map."""
        return self.reflectance.ndim == 3

    @cached_property
    def topology(self) -> str:
        """Equal for meshes whose vertices can be moved into each other's places: the same faces of as many vertices."""
        faces = np.ascontiguousarray(self.mesh.faces, dtype=np.int64)
        return f"{len(self.mesh.vertices)} {hashlib.blake2b(faces.tobytes(), digest_size=16).hexdigest()}"

    @cached_property
    def narrow_edges(self) -> tuple[NDArray[np.int64], Array]:
        """Edges of all bodies that are thin, such as struts, cords and blades.

        Returns:
            (E, 2) indices of vertices, and (E,) the thickness of their bodies: four times the volume over the surface,
            which is the diameter of a long cylinder and twice the thickness of a plate. [m]
        """
        # Vertices are split at creases and seams.
        _, place = np.unique(np.round(self.mesh.vertices, 6), axis=0, return_inverse=True)
        faces, place = np.asarray(self.mesh.faces), place.ravel()
        joined = place[faces]
        links = coo_matrix((np.ones(2 * len(faces)), (joined[:, [0, 1]].ravel(), joined[:, [1, 2]].ravel())))
        links.resize(place.max() + 1, place.max() + 1)
        count, label = connected_components(links, directed=False)
        body = label[joined[:, 0]]
        corners = np.asarray(self.mesh.triangles)
        number = np.maximum(np.bincount(body, minlength=count), 1)
        middle = (
            np.stack([np.bincount(body, axis, count) for axis in corners.mean(axis=1).T], axis=-1) / number[:, None]
        )
        corners = corners - middle[body, None]
        across = np.cross(corners[:, 1], corners[:, 2])
        volume_m3 = np.bincount(body, np.einsum("ij,ij->i", corners[:, 0], across) / 6, count)
        thickness_m = 4 * np.abs(volume_m3) / np.maximum(np.bincount(body, self.mesh.area_faces, count), 1e-12)
        edges = faces[thickness_m[body] < _NARROW_M][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        edges = np.sort(edges, axis=1)
        _, first = np.unique(edges[:, 0] * len(self.mesh.vertices) + edges[:, 1], return_index=True)
        return edges[first], thickness_m[label[place[edges[first, 0]]]]

    @cached_property
    def mean_reflectance(self) -> Array:
        """(3,) mean over the map, or the one reflectance."""
        mean: Array = self.reflectance.astype(np.float64).reshape(-1, 3).mean(axis=0)
        return mean

    @cached_property
    def contrast(self) -> float:
        """Half the distance between the 16th and the 84th percentile of the map, summed over the bands, per mean."""
        total = self.reflectance.astype(np.float64).sum(axis=-1)
        low, high = np.percentile(total, [16, 84])
        return float((high - low) / 2 / max(float(total.mean()), 1e-12))


def wrapped_surface(mesh: trimesh.Trimesh, turn: ArrayLike, along: ArrayLike) -> tuple[trimesh.Trimesh, Array]:
    """A mesh whose texture coordinate u runs once around it, with its seam cut.

    Args:
        mesh: with a vertex at turn 0 wherever a triangle reaches across the seam.
        turn: (V,) u of its vertices in [0, 1), periodic.
        along: (V,) v of its vertices.

    Returns:
        The mesh with vertices at the seam twice, at u = 0 and at u = 1, and the vertex normals of the uncut one; and
        (V', 2) its texture coordinates.
    """
    u, v = np.asarray(turn, dtype=np.float64), np.asarray(along, dtype=np.float64)
    faces = np.array(mesh.faces)
    crosses = np.ptp(u[faces], axis=1) > 0.5
    low = crosses[:, None] & (u[faces] < 0.5)
    again, place = np.unique(faces[low], return_inverse=True)
    faces[low] = len(u) + place
    source = np.concatenate([np.arange(len(u)), again])
    # Normals of the uncut mesh, so that interpolation shows no edge along the seam.
    cut = trimesh.Trimesh(
        np.asarray(mesh.vertices)[source], faces, vertex_normals=np.asarray(mesh.vertex_normals)[source], process=False
    )
    uv: Array = np.stack([np.concatenate([u, np.minimum(u[again] + 1.0, 1.0)]), v[source]], axis=-1)
    return cut, uv


def texels_at(painted: PaintedMesh, uv: Array) -> NDArray[Any]:
    """(N, 3) reflectance at (N, 2) texture coordinates, of the nearest texels."""
    if not painted.has_map:
        return np.broadcast_to(painted.reflectance, (len(uv), 3))
    height, width = painted.reflectance.shape[:2]
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip((uv[:, 1] * height).astype(int), 0, height - 1)
    found: NDArray[Any] = painted.reflectance[row, column]
    return found
