"""Thin closed shells around the drogue's axis with holes, and struts along its body."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from drogue_models.bodies import BodyLine
from drogue_models.solids import loft
from geometry.se3 import Array


def line_points_m(line: BodyLine, shares: Array) -> tuple[Array, Array]:
    """Points of a body's line and its outward normals, as (radius, z).

    Args:
        line: of the body.
        shares: (S,) places, 0 at the rim and 1 at the coupling.

    Returns:
        (S, 2) points [m] and (S, 2) unit normals, away from the axis and towards the hose.
    """
    (front_m, low_m), (back_m, high_m) = line.front_m, line.back_m
    # With u = 1 - share from the coupling, r = back + (front - back) u (1 - flare (1 - u)).
    u = 1.0 - shares
    radius = back_m + (front_m - back_m) * u * (1.0 - line.flare * (1.0 - u))
    slope = -(front_m - back_m) * (1.0 - line.flare + 2.0 * line.flare * u)
    along = np.stack([slope, np.full_like(slope, high_m - low_m)], axis=-1)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    points: Array = np.stack([radius, low_m + (high_m - low_m) * shares], axis=-1)
    return points, np.stack([along[:, 1], -along[:, 0]], axis=-1)


def share_at_m(line: BodyLine, length_m: float) -> float:
    """Share of a body's line that lies within a length of it from the rim; 1 for a length beyond its end."""
    shares = np.linspace(0.0, 1.0, 257)
    points, _ = line_points_m(line, shares)
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return float(np.interp(length_m, lengths, shares))


def shell(inside_m: Array, outside_m: Array, present: NDArray[np.bool_], is_ring: bool) -> trimesh.Trimesh:
    """A closed shell between two surfaces on one grid.

    Args:
        inside_m, outside_m: (S, N, 3) rows from the mouth to the hose, columns counter-clockwise around z. [m]
        present: (S - 1, N) for a ring, else (S - 1, N - 1): which cells of the grid have material. Two that touch at a
            corner only would share an edge of four faces there.
        is_ring: whether the last column joins the first one.
    """
    rows, columns = inside_m.shape[:2]
    count = rows * columns
    index = np.arange(count).reshape(rows, columns)
    wide = np.concatenate([index, index[:, :1]], axis=1) if is_ring else index
    a, b, c, d = wide[:-1, :-1], wide[:-1, 1:], wide[1:, 1:], wide[1:, :-1]
    quads = [
        np.stack([a, b, c, d], axis=-1)[present] + count,
        np.stack([a, d, c, b], axis=-1)[present],
    ]
    # A wall closes every side of a cell beyond which there is none: from its inner edge to its outer one.
    for first, second, beyond in _sides(a, b, c, d, present, is_ring):
        open_ = present & ~beyond
        quads.append(np.stack([first, second, second + count, first + count], axis=-1)[open_])
    faces = np.concatenate(quads)
    triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    mesh = trimesh.Trimesh(
        np.concatenate([inside_m.reshape(-1, 3), outside_m.reshape(-1, 3)]), triangles, process=False
    )
    mesh.remove_unreferenced_vertices()
    return mesh


def _sides(
    a: NDArray[np.int64],
    b: NDArray[np.int64],
    c: NDArray[np.int64],
    d: NDArray[np.int64],
    present: NDArray[np.bool_],
    is_ring: bool,
) -> list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]]:
    """The four sides of all cells: both ends of the edge, and whether there is material beyond it."""
    none_row, none_column = np.zeros_like(present[:1]), np.zeros_like(present[:, :1])
    before = np.concatenate([none_row, present[:-1]])
    behind = np.concatenate([present[1:], none_row])
    last, first = (present[:, -1:], present[:, :1]) if is_ring else (none_column, none_column)
    left = np.concatenate([last, present[:, :-1]], axis=1)
    right = np.concatenate([present[:, 1:], first], axis=1)
    return [(a, b, before), (b, c, right), (c, d, behind), (d, a, left)]


def around_axis(radii_m: Array, depths_m: Array, angles: Array) -> Array:
    """(..., 3) points at radii, depths and angles that broadcast. [m]"""
    radii, depths, angles = np.broadcast_arrays(radii_m, depths_m, angles)
    points: Array = np.stack([radii * np.cos(angles), radii * np.sin(angles), depths], axis=-1)
    return points


def strut(points_m: Array, angle: float, widths_m: Array, thickness_m: float, offset_m: float = 0.0) -> trimesh.Trimesh:
    """A flat strut along a curve in a plane through the axis.

    Args:
        points_m: (S, 2) its line as (radius, z). [m]
        angle: of the plane.
        widths_m: (S,) across the plane. [m]
        thickness_m: [m]
        offset_m: of its middle from the line, away from the axis. [m]
    """
    along = np.gradient(points_m, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    outward = np.stack([along[:, 1], -along[:, 0]], axis=-1)
    radial, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle), 0.0])

    def placed(flat: Array) -> Array:
        return np.column_stack([flat[:, :1] * radial, flat[:, 1]])

    middle, thick = placed(points_m + offset_m * outward), placed(outward) * thickness_m / 2
    wide = widths_m[:, None] * across / 2
    corners = (middle - wide + thick, middle + wide + thick, middle + wide - thick, middle - wide - thick)
    return loft(np.stack(corners, axis=1))


def strut_angles(count: int) -> Array:
    """(count,) angles of evenly spaced struts, the first one on the +y axis, where the first marker of a ring is."""
    angles: Array = np.pi / 2 + 2 * np.pi * np.arange(count) / count
    return angles
