"""Closed solids with outward normals, of which parts consist: plates, bodies of revolution, lofts and bars."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import Delaunay
from shapely import contains_xy
from shapely.geometry import Polygon

from geometry.se3 import Array

# Distance between the points inside a flat cap, over the mean length of its outlines' edges.
_LATTICE_PER_EDGE = 2.5
# Longest piece of a bar, over its width.
_PIECE_PER_WIDTH = 3.0


def area_radius_m(radius_m: float, sections: int) -> float:
    """Circumradius of the regular polygon with the area of a disc. [m]

    A marker drawn with it has the disc's area and centre; its outline leaves the circle by at most
    `radius (2 pi / sections)^2 / 12` (10 um for 0.05 m and 128 sections).
    """
    step = 2 * np.pi / sections
    return float(radius_m * np.sqrt(step / np.sin(step)))


def circle_m(radius_m: float, sections: int, center_m: tuple[float, float] = (0.0, 0.0)) -> Array:
    """(sections, 2) vertices of a regular polygon, counter-clockwise, the first one towards +x. [m]"""
    angle = 2 * np.pi * np.arange(sections) / sections
    points: Array = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * radius_m + np.asarray(center_m)
    return points


def plate(outer_m: Array, holes_m: Sequence[Array], thickness_m: float) -> trimesh.Trimesh:
    """A flat plate between z = 0 and z = `thickness_m`.

    Args:
        outer_m: (N, 2) outline.
        holes_m: (M, 2) outline of each hole.
        thickness_m: > 0.
    """
    # Without processing, two plates that share an outline keep exactly equal vertices along it.
    mesh = trimesh.creation.extrude_polygon(Polygon(outer_m, holes_m), thickness_m, engine="earcut", process=False)
    mesh.merge_vertices()
    return mesh


def pocketed_plate(
    outer_m: Array, opening_m: Array | None, pockets_m: Sequence[Array], thickness_m: float, depth_m: float
) -> trimesh.Trimesh:
    """A flat plate between z = 0 and z = `thickness_m` with pockets sunk into its front; one solid without inner faces.

    Args:
        outer_m: (N, 2) outline of the plate.
        opening_m: (N, 2) outline of its hole, or None.
        pockets_m: (M, 2) outline of each pocket.
        thickness_m: of the plate.
        depth_m: of the pockets, below `thickness_m`.
    """
    holes = [] if opening_m is None else [opening_m]
    parts = [_cap(outer_m, [*holes, *pockets_m], 0.0, -1), _cap(outer_m, holes, thickness_m, 1)]
    parts += [_cap(pocket, [], depth_m, -1) for pocket in pockets_m]
    parts += [_wall(outer_m, thickness_m, 1), *(_wall(hole, thickness_m, -1) for hole in holes)]
    parts += [_wall(pocket, depth_m, -1) for pocket in pockets_m]
    mesh = trimesh.util.concatenate(parts)
    mesh.merge_vertices()
    return mesh


def _cap(outer_m: Array, holes_m: Sequence[Array], z_m: float, facing: int) -> trimesh.Trimesh:
    """A flat piece at one height that looks along +z or -z."""
    points, faces = _compact_triangles([outer_m, *holes_m])
    flat = trimesh.Trimesh(np.column_stack([points, np.full(len(points), z_m)]), faces, process=False)
    if np.sign(flat.face_normals[:, 2].sum()) != facing:
        flat.invert()
    return flat


def _compact_triangles(outlines_m: Sequence[Array]) -> tuple[Array, NDArray[np.int64]]:
    """Triangles of a polygon, nearly equilateral where its outlines are round.

    Triangles between far corners would be long and narrow: their boxes overlap, and a ray meets dozens of them before
    it finds the one that it hits.

    Args:
        outlines_m: (N, 2) its outline, and that of each hole.

    Returns:
        (V, 2) corners, those of the outlines among them [m], and (F, 3) triangles.
    """
    polygon = Polygon(outlines_m[0], outlines_m[1:])
    corners = np.vstack(outlines_m)
    edges = np.vstack([_edges_around(len(outline)) for outline in outlines_m])
    edges += np.repeat(np.cumsum([0, *map(len, outlines_m[:-1])]), [len(outline) for outline in outlines_m])[:, None]
    step_m = _LATTICE_PER_EDGE * float(np.linalg.norm(np.diff(corners[edges], axis=1), axis=-1).mean())
    low, high = corners.min(axis=0), corners.max(axis=0)
    x, y = np.meshgrid(np.arange(low[0], high[0], step_m), np.arange(low[1], high[1], np.sqrt(3) / 2 * step_m))
    x[1::2] += step_m / 2
    inside = contains_xy(polygon.buffer(-step_m / 2), x, y)
    points = np.vstack([corners, np.column_stack([x[inside], y[inside]])])
    faces = Delaunay(points).simplices.astype(np.int64)
    faces = faces[contains_xy(polygon, points[faces].mean(axis=1))]
    if np.array_equal(_border_of(faces), np.unique(np.sort(edges, axis=1), axis=0)):
        return points, faces
    # An outline has a corner close to the middle of another's long edge.
    points, faces = trimesh.creation.triangulate_polygon(polygon, engine="earcut")
    return points, faces


def _edges_around(count: int) -> NDArray[np.int64]:
    """(count, 2) neighbours on a closed outline of so many corners."""
    here = np.arange(count)
    return np.column_stack([here, (here + 1) % count])


def _border_of(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """(B, 2) edges of one triangle only, each in rising order, sorted."""
    edges, uses = np.unique(np.sort(trimesh.geometry.faces_to_edges(faces), axis=1), axis=0, return_counts=True)
    border: NDArray[np.int64] = edges[uses == 1]
    return border


def _wall(outline_m: Array, height_m: float, facing: int) -> trimesh.Trimesh:
    """The wall between z = 0 and `height_m` over a counter-clockwise outline, looking outwards (1) or inwards (-1)."""
    count = len(outline_m)
    here, beside = np.arange(count), (np.arange(count) + 1) % count
    points = np.vstack([np.column_stack([outline_m, np.full(count, z_m)]) for z_m in (0.0, height_m)])
    faces = np.vstack(
        [np.column_stack([here, beside, beside + count]), np.column_stack([here, beside + count, here + count])]
    )
    wall = trimesh.Trimesh(points, faces, process=False)
    if facing < 0:
        wall.invert()
    return wall


def revolve(profile_m: ArrayLike, sections: int) -> trimesh.Trimesh:
    """The body that a closed profile sweeps around the z axis.

    Args:
        profile_m: (P, 2) corners (radius, z), counter-clockwise with the radius to the right and z up; the last corner
            joins the first. A profile that touches the axis has exactly its first and last corner on it.
        sections: around the axis.
    """
    profile = np.asarray(profile_m, dtype=np.float64)
    on_axis = profile[0, 0] == 0.0
    swept = profile[1:-1] if on_axis else profile
    count = len(swept)
    ring = circle_m(1.0, sections)
    vertices = np.empty((sections, count, 3))
    vertices[..., :2] = ring[:, None, :] * swept[None, :, :1]
    vertices[..., 2] = swept[:, 1]
    here = np.arange(sections)[:, None] * count
    there = (np.arange(sections)[:, None] + 1) % sections * count
    edge = np.arange(count - 1 if on_axis else count)
    low, high = edge, (edge + 1) % count
    faces = [
        np.stack([here + low, there + low, there + high], axis=-1).reshape(-1, 3),
        np.stack([here + low, there + high, here + high], axis=-1).reshape(-1, 3),
    ]
    points = vertices.reshape(-1, 3)
    if on_axis:
        first, last = len(points), len(points) + 1
        points = np.vstack([points, [[0.0, 0.0, profile[0, 1]], [0.0, 0.0, profile[-1, 1]]]])
        start, end = here[:, 0], here[:, 0] + count - 1
        start_next, end_next = there[:, 0], there[:, 0] + count - 1
        faces.append(np.stack([np.full(sections, first), start_next, start], axis=-1))
        faces.append(np.stack([np.full(sections, last), end, end_next], axis=-1))
    return trimesh.Trimesh(points, np.vstack(faces), process=False)


def loft(rings_m: ArrayLike) -> trimesh.Trimesh:
    """A tube over equal rings, closed by a fan at either end.

    Args:
        rings_m: (S, N, 3) rings of N points that run counter-clockwise when seen against the direction from the first
            ring to the last; end rings must be star-shaped around their mean.
    """
    rings = np.asarray(rings_m, dtype=np.float64)
    slices, count = rings.shape[:2]
    here = np.arange(slices - 1)[:, None] * count + np.arange(count)
    beside = np.arange(slices - 1)[:, None] * count + (np.arange(count) + 1) % count
    first, last = slices * count, slices * count + 1
    around, next_around = np.arange(count), (np.arange(count) + 1) % count
    top = (slices - 1) * count
    faces = [
        np.stack([here, beside, beside + count], axis=-1).reshape(-1, 3),
        np.stack([here, beside + count, here + count], axis=-1).reshape(-1, 3),
        np.stack([np.full(count, first), next_around, around], axis=-1),
        np.stack([np.full(count, last), top + around, top + next_around], axis=-1),
    ]
    points = np.vstack([rings.reshape(-1, 3), rings[0].mean(axis=0), rings[-1].mean(axis=0)])
    return trimesh.Trimesh(points, np.vstack(faces), process=False)


def bar(start_m: ArrayLike, end_m: ArrayLike, width_along: ArrayLike, size_m: tuple[float, float]) -> trimesh.Trimesh:
    """A flat bar with a rectangular section.

    Args:
        start_m, end_m: (3,) ends of its centre line. [m]
        width_along: (3,) direction of its width, across the line.
        size_m: width and thickness. [m]
    """
    start, end = np.asarray(start_m, dtype=np.float64), np.asarray(end_m, dtype=np.float64)
    along = (end - start) / np.linalg.norm(end - start)
    wide = np.asarray(width_along, dtype=np.float64) * size_m[0] / 2
    thick = np.cross(along, wide / np.linalg.norm(wide)) * size_m[1] / 2
    corners = np.array([-wide - thick, wide - thick, wide + thick, -wide + thick])
    # A triangle over the length of a slanting bar has a box far larger than itself, which most rays near it meet.
    pieces = math.ceil(float(np.linalg.norm(end - start)) / (_PIECE_PER_WIDTH * max(size_m)))
    middle = np.linspace(start, end, pieces + 1)
    return loft(middle[:, None] + corners)


def with_creases(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same surface for interpolated normals: smooth on round parts, with creases where faces meet at an angle.

    Faces that meet at more than 15 degrees share no vertices, so that the mesh is no longer closed. The angle is little
    more than that between neighbouring faces of round parts: a tilted normal at the end of a tube would be interpolated
    over its whole length, and face away from a camera close beside the tube.
    """
    return trimesh.graph.smooth_shade(mesh, angle=np.radians(15.0), facet_minarea=None)
