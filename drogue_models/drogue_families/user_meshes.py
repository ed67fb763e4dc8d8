"""A user's mesh in the place of canopy, ribs and coupling, and whether it can be drawn."""

from __future__ import annotations

import io

import numpy as np
import trimesh
from numpy.typing import NDArray

from drogue_models.drogue_families.fittings import FACE_THICKNESS_M
from drogue_models.drogue_families.mesh_files import body_mesh_data
from drogue_models.parameters import DrogueParameters
from drogue_models.untrusted_files import limited_memory
from geometry.se3 import Array

# Sizes of a drogue's body; anything outside was most likely drawn in millimetres or inches.
_SMALLEST_BODY_M, _LARGEST_BODY_M = 0.05, 10.0
_ARCHIVES = {"bz2", "gz", "tar.bz2", "tar.gz", "zip", "3mf", "3dxml", "zae"}
# float32 files round a front at z = 0, or a radius, by this much for bodies of a few metres.
_TOLERANCE_M = 1e-6
# A surface in the plane of the hub's face would flicker with it.
_BEHIND_HUB_M = 1e-4
# A cube of a hundredth of a millimetre: rounding errors of a doubled sheet, which encloses nothing.
_SMALLEST_PIECE_M3 = 1e-15
# Of a piece's corners, that are looked up inside the others.
_MOST_PLACES = 256


def load_body_mesh(drogue: DrogueParameters) -> trimesh.Trimesh:
    """A user's mesh of the drogue's body, in the drogue frame (z from the mouth to the hose, z >= 0). [m]

    Raises:
        ValueError: the drogue has none, or the file is missing, has another hash than when the drogue was loaded,
            cannot be read as a mesh, or is not a closed body of plausible size behind the rim plane, no wider than the
            rim, and clear of face and hub.
    """
    body = drogue.body_mesh
    if body is None:
        raise ValueError(f"body_mesh: {drogue.name} has none")
    mesh = _parse_body_mesh(body_mesh_data(body), body.file_type, str(body.file))
    fault = _size_fault(mesh, drogue) or _surface_fault(mesh) or _cover_fault(mesh, drogue)
    if fault:
        raise ValueError(f"body_mesh: {body.file} {fault}")
    return mesh


def _parse_body_mesh(data: bytes, file_type: str, name: str) -> trimesh.Trimesh:
    # An archive of a megabyte can hold gigabytes.
    readable = sorted(set(trimesh.available_formats()) - _ARCHIVES)
    if file_type not in readable:
        raise ValueError(f"body_mesh: {name} is of a kind that cannot be read; use one of {', '.join(readable)}")
    try:
        with limited_memory(len(data)):
            mesh = trimesh.load_mesh(io.BytesIO(data), file_type=file_type, process=False)
    except Exception as error:  # each of trimesh's readers fails in its own way
        raise ValueError(f"body_mesh: {name} cannot be read as {file_type}: {' '.join(str(error).split())}") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError(f"body_mesh: {name} holds no triangles; export one mesh of triangles")
    return mesh


def _size_fault(mesh: trimesh.Trimesh, drogue: DrogueParameters) -> str | None:
    """Why the mesh's extent cannot be used, and what to do; None for a valid mesh."""
    if not np.isfinite(mesh.vertices).all():
        return "has vertices that are not finite; export it again"
    low, high = mesh.bounds
    size_m = float((high - low).max())
    if not _SMALLEST_BODY_M <= size_m <= _LARGEST_BODY_M:
        return (
            f"must be {_SMALLEST_BODY_M:g} to {_LARGEST_BODY_M:g} m in size, with coordinates in metres, got {size_m:g}"
        )
    if low[2] < -_TOLERANCE_M:
        return f"must lie behind the rim plane (z >= 0, z from the mouth to the hose), got z down to {low[2]:g} m"
    # Distances and places are drawn so that the rim is in view.
    radius_m = float(np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1]).max())
    if radius_m > drogue.rim_radius_m + _TOLERANCE_M:
        return (
            f"must lie within rim_radius_m, {drogue.rim_radius_m:g} m, of the z axis, got {radius_m:g} m; make the "
            "mesh narrower or the rim wider"
        )
    return None


def _surface_fault(mesh: trimesh.Trimesh) -> str | None:
    """Why the mesh bounds no solid, and what to do; None for a valid mesh, whose repeated vertices are merged."""
    # Formats with normals or texture repeat the vertices along their seams.
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    if not mesh.is_watertight:
        return "must be closed (watertight); close its holes and export it again"
    if not mesh.is_winding_consistent:
        return "must have its normals outwards everywhere; recalculate them and export it again"
    piece_of_face = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    # Signed, between each triangle and the origin.
    volumes_m3 = np.bincount(piece_of_face, weights=np.linalg.det(mesh.triangles) / 6)
    for piece in np.flatnonzero(volumes_m3 < _SMALLEST_PIECE_M3):
        own = piece_of_face == piece
        is_flat = abs(volumes_m3[piece]) < _SMALLEST_PIECE_M3
        if is_flat or not _is_inside(_places_on(mesh.triangles[own]), mesh.triangles[~own]):
            x, y, z = mesh.triangles[own].reshape(-1, 3).mean(axis=0)
            where = f"the piece of {np.count_nonzero(own)} triangles around ({x:.3g}, {y:.3g}, {z:.3g}) m"
            if is_flat:
                return f"must enclose a volume, but {where} does not; remove it, or give it thickness"
            return (
                f"must have its normals outwards everywhere, but {where} is inside out; recalculate them and export it "
                "again"
            )
    return None


def _places_on(triangles_m: Array) -> Array:
    """(N, 3) some hundred corners of a surface, its outermost among them. [m]"""
    corners: Array = triangles_m.reshape(-1, 3)
    outermost = np.concatenate([corners.argmin(axis=0), corners.argmax(axis=0)])
    return np.concatenate([corners[outermost], corners[:: len(corners) // _MOST_PLACES + 1]])


def _is_inside(places_m: Array, triangles_m: Array) -> bool:
    """Whether all of (N, 3) places lie inside closed surfaces of (T, 3, 3) triangles.

    The solid angles of the triangles sum to 4 pi inside (A. van Oosterom, J. Strackee, IEEE TBME 30(2), 1983,
    doi:10.1109/TBME.1983.325207).
    """
    for place in places_m:
        a, b, c = np.moveaxis(triangles_m - place, 1, 0)
        la, lb, lc = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
        above = np.einsum("ij,ij->i", a, np.cross(b, c))
        below = la * lb * lc + (
            np.einsum("ij,ij->i", a, b) * lc + np.einsum("ij,ij->i", b, c) * la + np.einsum("ij,ij->i", c, a) * lb
        )
        if float(np.arctan2(above, below).sum()) < np.pi:
            return False
    return True


def _cover_fault(mesh: trimesh.Trimesh, drogue: DrogueParameters) -> str | None:
    """Why the mesh would cover markers or hub, and what to do; None for a valid mesh."""
    inner_m, outer_m = drogue.face_inner_radius_m, drogue.rim_radius_m - drogue.rim_tube_radius_m
    low_m, high_m = _radii_before(mesh, FACE_THICKNESS_M - _TOLERANCE_M)
    if ((low_m < outer_m) & (high_m > inner_m)).any():
        return (
            f"must lie behind the face, whose back is at z = {FACE_THICKNESS_M:g} m, between {inner_m:g} and "
            f"{outer_m:g} m from the z axis, where it would cover the markers; move it back"
        )
    hub = drogue.hub
    if hub is not None and (_radii_before(mesh, hub.depth_m + _BEHIND_HUB_M)[0] < hub.outer_radius_m).any():
        return (
            f"must lie behind the hub's face, z = {hub.depth_m:g} m, within {hub.outer_radius_m:g} m of the z axis, "
            "where it would cover the hub; leave room for it, or change hub.depth_m"
        )
    return None


def _radii_before(mesh: trimesh.Trimesh, z_m: float) -> tuple[Array, Array]:
    """(T,) least and largest distance from the z axis of each triangle's part before a depth. [m]"""
    cut = mesh.slice_plane([0.0, 0.0, z_m], [0.0, 0.0, -1.0]).triangles[:, :, :2]
    start, along = cut, np.roll(cut, -1, axis=1) - cut
    length2 = (along**2).sum(axis=-1)
    share = np.clip(-(start * along).sum(axis=-1) / np.where(length2 > 0, length2, 1.0), 0.0, 1.0)
    least: Array = np.linalg.norm(start + share[..., None] * along, axis=-1).min(axis=1)
    sides = start[..., 0] * along[..., 1] - start[..., 1] * along[..., 0]
    holds_axis: NDArray[np.bool_] = (sides > 0).all(axis=1) | (sides < 0).all(axis=1)
    return np.where(holds_axis, 0.0, least), np.linalg.norm(cut, axis=-1).max(axis=1)
