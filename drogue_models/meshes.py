"""Closed meshes of the drogue by part, of its hose and of obstacles.

In the drogue frame front faces look along -z, towards the camera. `python -m drogue_models.meshes FILE.ply` writes the
body of the example drogue that ships.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from drogue_models.drogue_families.body_meshes import body_meshes
from drogue_models.drogue_families.fittings import (
    FACE_THICKNESS_M,
    MARKER_SECTIONS,
    POCKET_DEPTH_M,
    RIM_SECTIONS,
    hub_annulus,
    hub_groove_m,
    hub_holder,
    marker_outline_m,
    marker_plate,
    rim,
)
from drogue_models.drogue_families.user_meshes import load_body_mesh
from drogue_models.obstacles import OBSTACLE_SECTIONS, ObstacleShape
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import Part, marker_id
from drogue_models.solids import area_radius_m, bar, circle_m, loft, pocketed_plate, revolve
from geometry.se3 import Array

# Cosine of a hose's direction with the x axis beyond which its rings begin at the y axis.
_STEEP = 0.9

HOSE_RINGS_PER_SEGMENT = 6
HOSE_SECTIONS = 32
HOSE_END_FRACTION = 0.005


def hose_mesh(nodes_m: ArrayLike, radius_m: float) -> trimesh.Trimesh:
    """The hose: a closed tube along a smooth curve through nodes.

    The numbers of vertices and faces depend on the number of nodes only, so that a renderer can move the vertices of a
    loaded mesh.

    Args:
        nodes_m: (K, 3) centre line, K >= 2, without equal neighbours. [m]
        radius_m: > 0. [m]

    Raises:
        ValueError: nodes of another shape, or two equal neighbours.
    """
    nodes = np.asarray(nodes_m, dtype=np.float64)
    if nodes.ndim != 2 or nodes.shape[0] < 2 or nodes.shape[1] != 3:
        raise ValueError(f"nodes_m: must have shape (K, 3) with K >= 2, got {nodes.shape}")
    if not radius_m > 0:
        raise ValueError(f"radius_m: must be positive, got {radius_m}")
    chord_m = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
    if not chord_m.min() > 0:
        raise ValueError("nodes_m: must be finite and neighbours must differ")
    knots = np.concatenate([[0.0], np.cumsum(chord_m)])
    curve = CubicSpline(knots, nodes, bc_type="natural")
    between = np.arange(HOSE_RINGS_PER_SEGMENT) / HOSE_RINGS_PER_SEGMENT
    inner = (knots[:-1, None] + chord_m[:, None] * between).ravel()[1:]
    # A ring close to each end keeps the cap's direction out of the tube's interpolated normals.
    ends_m = HOSE_END_FRACTION * chord_m[[0, -1]]
    at = np.concatenate([[0.0, ends_m[0]], inner, [knots[-1] - ends_m[1], knots[-1]]])
    tangents = curve(at, 1)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    side, up = _carried_frame(tangents)
    angle = 2 * np.pi * np.arange(HOSE_SECTIONS) / HOSE_SECTIONS
    around = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * up[:, None]
    return loft(curve(at)[:, None] + radius_m * around)


def _carried_frame(tangents: Array) -> tuple[Array, Array]:
    """Two (S, 3) unit vectors across the curve with minimal rotation along it, `side x up = tangent`."""
    side = np.empty_like(tangents)
    # The same axis for hoses that differ little: their vertices and the flow of images follow them.
    seed = np.eye(3)[1 if abs(tangents[0, 0]) > _STEEP else 0]
    for index, tangent in enumerate(tangents):
        across = seed - (seed @ tangent) * tangent
        seed = side[index] = across / np.linalg.norm(across)
    return side, np.cross(tangents, side)


# Our choices, as dimensions of published drogues do not include them.
RIB_WIDTH_M = 0.008
RIB_THICKNESS_M = 0.004
CANOPY_THICKNESS_M = 0.003
CANOPY_LENGTH_FRACTION = 0.36  # of the ribs' length
CANOPY_BULGE_M = 0.008
RECESS_DEPTH_M = 0.10


def drogue_meshes(drogue: DrogueParameters) -> dict[int, trimesh.Trimesh]:
    """All parts of a drogue, closed, with outward normals.

    No part reaches before z = 0, so that none casts a shadow's edge onto the markers. Markers fill pockets of the face,
    and the hub a groove of the coupling, or of a holder in a user's body, with shared vertices.

    Args:
        drogue: its dimensions.

    Returns:
        Mesh by part id (`drogue_models.parts`) in the drogue frame [m]. A part that the drogue does not have (no hub,
        no ribs, or canopy and ribs replaced by the user's body, which counts as coupling) is left out.

    Raises:
        ValueError: the user's body mesh is missing, changed, or not fit for use.
    """
    if drogue.body is not None:
        return body_meshes(drogue)
    meshes = {int(Part.FACE): _face(drogue), int(Part.RIM): rim(drogue)}
    if drogue.body_mesh is not None:
        holders = [] if drogue.hub is None else [hub_holder(drogue, drogue.hub)]
        meshes[int(Part.COUPLING)] = trimesh.util.concatenate([load_body_mesh(drogue), *holders])
    else:
        meshes[int(Part.CANOPY)] = _canopy(drogue)
        meshes[int(Part.COUPLING)] = _coupling(drogue)
        if drogue.rib_count:
            meshes[int(Part.RIBS)] = _ribs(drogue)
    if drogue.hub is not None:
        meshes[int(Part.HUB)] = hub_annulus(drogue, drogue.hub)
    for index in range(drogue.marker_count):
        meshes[marker_id(index)] = marker_plate(drogue, index)
    return meshes


def obstacle_mesh(shape: ObstacleShape) -> trimesh.Trimesh:
    """A closed mesh of an obstacle in its own frame. [m]"""
    return revolve(shape.profile_m(), OBSTACLE_SECTIONS)


def _face(drogue: DrogueParameters) -> trimesh.Trimesh:
    """The plate with a pocket for every marker, deeper than the marker, as coincident surfaces would flicker."""
    opening = circle_m(drogue.face_inner_radius_m, RIM_SECTIONS)
    pockets = [marker_outline_m(drogue, index) for index in range(drogue.marker_count)]
    outer = circle_m(drogue.rim_radius_m - drogue.rim_tube_radius_m, RIM_SECTIONS)
    return pocketed_plate(outer, opening, pockets, FACE_THICKNESS_M, POCKET_DEPTH_M)


def _rib_line_m(drogue: DrogueParameters) -> tuple[Array, Array]:
    """Both ends (radius, z) of a rib's centre line: inside the rim, and in the coupling's collar. [m]"""
    front = (drogue.rim_radius_m - drogue.rim_tube_radius_m, max(drogue.rim_tube_radius_m, FACE_THICKNESS_M))
    back = (drogue.coupling_radius_m, drogue.hub_depth_m + 0.15 * drogue.coupling_length_m)
    return np.array(front), np.array(back)


def _ribs(drogue: DrogueParameters) -> trimesh.Trimesh:
    front, back = _rib_line_m(drogue)
    thickness_m = min(RIB_THICKNESS_M, drogue.rim_tube_radius_m)
    # The corners of a rib's end must not reach beyond a small rim.
    room_m = math.sqrt(max(drogue.rim_radius_m**2 - (RIB_WIDTH_M / 2) ** 2, 0.0)) - thickness_m / 2
    front[0] = min(front[0], room_m)
    ribs = []
    for angle in 2 * np.pi * (np.arange(drogue.rib_count) + 0.5) / drogue.rib_count:
        radial = np.array([np.cos(angle), np.sin(angle), 0.0])
        ends = [radial * radius + [0.0, 0.0, z] for radius, z in (front, back)]
        ribs.append(bar(ends[0], ends[1], [-radial[1], radial[0], 0.0], (RIB_WIDTH_M, thickness_m)))
    return trimesh.util.concatenate(ribs)


def _canopy(drogue: DrogueParameters) -> trimesh.Trimesh:
    """A band of cloth outside the front part of the ribs, bulged by the air stream."""
    front, back = _rib_line_m(drogue)
    share = np.linspace(0.0, 1.0, 9)[:, None]
    across = np.array([(back - front)[1], (front - back)[0]]) / np.linalg.norm(back - front)
    inner = front + (back - front) * CANOPY_LENGTH_FRACTION * share + across * RIB_THICKNESS_M / 2
    inner = inner + across * CANOPY_BULGE_M * 4 * share * (1 - share)
    outer = inner + across * CANOPY_THICKNESS_M
    profile = np.vstack([outer, inner[::-1]])
    # The canopy must not reach beyond the rim, however narrow its tube is.
    profile[:, 0] -= max(0.0, profile[:, 0].max() - drogue.rim_radius_m)
    return revolve(profile, MARKER_SECTIONS)


def _coupling(drogue: DrogueParameters) -> trimesh.Trimesh:
    """The body behind the hub: a collar with a deep dark mouth, a neck, and a taper to the hose."""
    collar_m = area_radius_m(drogue.coupling_radius_m, MARKER_SECTIONS)
    length_m, hose_m = drogue.coupling_length_m, drogue.hose_radius_m
    neck_m = (0.75 * collar_m + 0.25 * hose_m, 0.45 * collar_m + 0.55 * hose_m)
    recess_m = min(RECESS_DEPTH_M, 0.5 * length_m)
    if drogue.hub is None:
        mouth_m = 0.6 * collar_m
        profile = [(0.0, recess_m), (mouth_m, recess_m), (mouth_m, 0.0)]
    else:
        groove = hub_groove_m(drogue, drogue.hub)
        profile = [(0.0, recess_m), (groove[0][0], recess_m), *groove]
    profile += [
        (collar_m, 0.0),
        (collar_m, 0.30 * length_m),
        (neck_m[0], 0.34 * length_m),
        (neck_m[0], 0.60 * length_m),
        (neck_m[1], 0.72 * length_m),
        (hose_m, length_m),
        (0.0, length_m),
    ]
    return revolve(np.array(profile) + np.array([0.0, drogue.hub_depth_m]), MARKER_SECTIONS)


_EXAMPLE_SECTIONS = 48


def example_body() -> trimesh.Trimesh:
    """A closed funnel of moulded plastic with a coupling at its end, for a rim of 0.30 m and a hub 0.22 m deep. [m]"""
    depth_m, mouth_m = 0.22, 0.04
    share = np.linspace(0.0, 1.0, 9)
    # A trumpet: steep near the rim, slender at the coupling.
    inside_m = 0.285 - (0.285 - 0.085) * share**0.6
    inside = np.stack([inside_m, 0.012 + (depth_m - 0.012) * share], axis=-1)
    outside = np.stack([inside_m + 0.006, inside[:, 1]], axis=-1)
    # The seat of the hub lies 3 mm behind the hub's face.
    seat = [(0.0, depth_m + 0.09), (mouth_m, depth_m + 0.09), (mouth_m, depth_m + 0.003), (0.085, depth_m + 0.003)]
    end = [(0.091, depth_m + 0.05), (0.06, depth_m + 0.08), (0.045, depth_m + 0.16), (0.0, depth_m + 0.16)]
    return revolve(np.vstack([seat, inside[::-1], outside, end]), _EXAMPLE_SECTIONS)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m drogue_models.meshes FILE.ply")
    example_body().export(Path(sys.argv[1]))
