"""The drogue as closed meshes by part, in the drogue frame: seen from the camera, front faces look along -z."""

from __future__ import annotations

import numpy as np
import trimesh

from drogue_models.body_mesh import load_body_mesh
from drogue_models.bystanders import SECTIONS, BystanderShape
from drogue_models.hose import hose_mesh
from drogue_models.parameters import DrogueParameters, HubParameters
from drogue_models.parts import Part, marker_id
from drogue_models.solids import area_radius_m, bar, circle_m, plate, pocketed_plate, revolve
from drogue_models.tanker import tanker_mesh
from geometry.se3 import Array

__all__ = ["bystander_mesh", "drogue_meshes", "hose_mesh", "tanker_mesh"]

# Markers and hub: outlines within 10 um of the circle.
MARKER_SECTIONS = 128
# Large circles: the chord leaves the rim of 0.33 m by 25 um, a fortieth of a pixel at 2 m.
RIM_SECTIONS = 256
RIM_TUBE_SECTIONS = 16

# Our choices, as those of published drogues are not given.
FACE_THICKNESS_M = 0.005
POCKET_DEPTH_M = 0.004
MARKER_THICKNESS_M = 0.003
HUB_THICKNESS_M = 0.002
GROOVE_PER_HUB_THICKNESS = 1.5
# A dark sleeve lines the hub's hole: the bright wall of the hole would be seen past the near edge and move it.
SLEEVE_THICKNESS_M = 0.00002
RIB_WIDTH_M = 0.008
RIB_THICKNESS_M = 0.004
CANOPY_THICKNESS_M = 0.003
CANOPY_LENGTH_FRACTION = 0.36  # of the ribs' length
CANOPY_BULGE_M = 0.008
RECESS_DEPTH_M = 0.10


def drogue_meshes(drogue: DrogueParameters) -> dict[int, trimesh.Trimesh]:
    """All parts of a drogue, closed, with outward normals.

    Nothing stands before z = 0, so that nothing throws a shadow's edge over the markers. Markers fill holes of the
    face, and the hub a groove of the coupling, vertex on vertex.

    Args:
        drogue: its dimensions.

    Returns:
        Mesh by part id (`drogue_models.parts`) in the drogue frame [m]. A part that the drogue does not have (no hub,
        no ribs, or canopy and ribs replaced by the user's body, which counts as coupling) is left out.

    Raises:
        ValueError: the user's body mesh is missing, changed, or not fit for use.
    """
    meshes = {int(Part.FACE): _face(drogue), int(Part.RIM): _rim(drogue)}
    if drogue.body_mesh is not None:
        meshes[int(Part.COUPLING)] = load_body_mesh(drogue.body_mesh)
    else:
        meshes[int(Part.CANOPY)] = _canopy(drogue)
        meshes[int(Part.COUPLING)] = _coupling(drogue)
        if drogue.rib_count:
            meshes[int(Part.RIBS)] = _ribs(drogue)
    if drogue.hub is not None:
        meshes[int(Part.HUB)] = _hub(drogue, drogue.hub)
    for index in range(drogue.marker_count):
        meshes[marker_id(index)] = plate(_marker_outline_m(drogue, index), [], MARKER_THICKNESS_M)
    return meshes


def bystander_mesh(shape: BystanderShape) -> trimesh.Trimesh:
    """A closed mesh of a bystander in its own frame. [m]"""
    return revolve(shape.profile_m(), SECTIONS)


def _marker_outline_m(drogue: DrogueParameters, index: int) -> Array:
    radius_m = area_radius_m(drogue.marker_radius_m, MARKER_SECTIONS)
    return circle_m(radius_m, MARKER_SECTIONS, drogue.marker_positions_m[index])


def _face(drogue: DrogueParameters) -> trimesh.Trimesh:
    """The plate with a pocket for every marker, deeper than the marker: two surfaces at one place would flicker."""
    opening = circle_m(drogue.face_inner_radius_m, RIM_SECTIONS)
    pockets = [_marker_outline_m(drogue, index) for index in range(drogue.marker_count)]
    outer = circle_m(drogue.rim_radius_m - drogue.rim_tube_radius_m, RIM_SECTIONS)
    return pocketed_plate(outer, opening, pockets, FACE_THICKNESS_M, POCKET_DEPTH_M)


def _rim(drogue: DrogueParameters) -> trimesh.Trimesh:
    """A torus that touches z = 0 from behind where the face ends."""
    tube_m = drogue.rim_tube_radius_m
    profile = circle_m(tube_m, RIM_TUBE_SECTIONS, (drogue.rim_radius_m - tube_m, tube_m))
    # The sine of a multiple of pi is not exactly 0: keep the rounding from standing before the face.
    return revolve(np.maximum(profile, [0.0, 0.0]), RIM_SECTIONS)


def _rib_line_m(drogue: DrogueParameters) -> tuple[Array, Array]:
    """Both ends (radius, z) of a rib's centre line: inside the rim, and in the coupling's collar. [m]"""
    front = (drogue.rim_radius_m - drogue.rim_tube_radius_m, max(drogue.rim_tube_radius_m, FACE_THICKNESS_M))
    back = (drogue.coupling_radius_m, drogue.hub_depth_m + 0.15 * drogue.coupling_length_m)
    return np.array(front), np.array(back)


def _ribs(drogue: DrogueParameters) -> trimesh.Trimesh:
    front, back = _rib_line_m(drogue)
    thickness_m = min(RIB_THICKNESS_M, drogue.rim_tube_radius_m)
    ribs = []
    for angle in 2 * np.pi * (np.arange(drogue.rib_count) + 0.5) / drogue.rib_count:
        radial = np.array([np.cos(angle), np.sin(angle), 0.0])
        ends = [radial * radius + [0.0, 0.0, z] for radius, z in (front, back)]
        ribs.append(bar(ends[0], ends[1], [-radial[1], radial[0], 0.0], (RIB_WIDTH_M, thickness_m)))
    return trimesh.util.concatenate(ribs)


def _canopy(drogue: DrogueParameters) -> trimesh.Trimesh:
    """A band of cloth outside the front part of the ribs, bulged by the air that it catches."""
    front, back = _rib_line_m(drogue)
    share = np.linspace(0.0, 1.0, 9)[:, None]
    across = np.array([(back - front)[1], (front - back)[0]]) / np.linalg.norm(back - front)
    inner = front + (back - front) * CANOPY_LENGTH_FRACTION * share + across * RIB_THICKNESS_M / 2
    inner = inner + across * CANOPY_BULGE_M * 4 * share * (1 - share)
    outer = inner + across * CANOPY_THICKNESS_M
    profile = np.vstack([outer, inner[::-1]])
    # Nothing may reach beyond the rim, however narrow its tube is.
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
        inner_m, outer_m = _hub_radii_m(drogue.hub)
        thickness_m = GROOVE_PER_HUB_THICKNESS * _hub_thickness_m(drogue)
        sleeve_m = inner_m - SLEEVE_THICKNESS_M
        profile = [(0.0, recess_m), (sleeve_m, recess_m), (sleeve_m, 0.0), (inner_m, 0.0)]
        profile += [(inner_m, thickness_m), (outer_m, thickness_m), (outer_m, 0.0)]
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


def _hub_radii_m(hub: HubParameters) -> tuple[float, float]:
    return area_radius_m(hub.inner_radius_m, MARKER_SECTIONS), area_radius_m(hub.outer_radius_m, MARKER_SECTIONS)


def _hub_thickness_m(drogue: DrogueParameters) -> float:
    return min(HUB_THICKNESS_M, 0.1 * drogue.coupling_length_m)


def _hub(drogue: DrogueParameters, hub: HubParameters) -> trimesh.Trimesh:
    inner_m, outer_m = _hub_radii_m(hub)
    thickness_m = _hub_thickness_m(drogue)
    profile = [(inner_m, 0.0), (outer_m, 0.0), (outer_m, thickness_m), (inner_m, thickness_m)]
    return revolve(np.array(profile) + np.array([0.0, hub.depth_m]), MARKER_SECTIONS)
