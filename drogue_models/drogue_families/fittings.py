"""Solids that drogues of several kinds have: rim, hub, marker holders, coupling, lamps, struts and pierced shells."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from drogue_models.bodies import BodyLine
from drogue_models.parameters import (
    BODY_FRACTION,
    BOLT_RADIUS_M,
    BORE_LENGTH_FRACTION,
    HOLDER_BORDER_M,
    HOLDER_THICKNESS_M,
    DrogueParameters,
    HubParameters,
)
from drogue_models.solids import area_radius_m, bar, circle_m, loft, plate, pocketed_plate, revolve
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


# Markers and hub: outlines within 10 um of the circle.
MARKER_SECTIONS = 128
# Large circles: the chord leaves the rim of 0.33 m by 25 um, a fortieth of a pixel at 2 m.
RIM_SECTIONS = 256
RIM_TUBE_SECTIONS = 16

# Our choices, as dimensions of published drogues do not include them.
FACE_THICKNESS_M = 0.005
POCKET_DEPTH_M = 0.004
MARKER_THICKNESS_M = 0.003
HUB_THICKNESS_M = 0.002
GROOVE_PER_HUB_THICKNESS, HOLDER_PER_HUB_THICKNESS = 1.5, 2.0
# A dark sleeve lines the hub's hole: its bright wall would be visible past the near edge and shift that edge.
SLEEVE_THICKNESS_M = 0.00002
_BRACKET_M = (0.012, 0.003)
_BOLT_HEIGHT_M = 0.003
_LAMP_GAP_M = 0.001


def rim(drogue: DrogueParameters) -> trimesh.Trimesh:
    """A torus that touches z = 0 from behind where the face ends."""
    tube_m = drogue.rim_tube_radius_m
    profile = circle_m(tube_m, RIM_TUBE_SECTIONS, (drogue.rim_radius_m - tube_m, tube_m))
    # The sine of a multiple of pi is not exactly 0: keep rounding errors from reaching before the face.
    return revolve(np.maximum(profile, [0.0, 0.0]), RIM_SECTIONS)


def hub_radii_m(hub: HubParameters) -> tuple[float, float]:
    """Inner and outer radius of the polygons that stand for the hub's edges. [m]"""
    return area_radius_m(hub.inner_radius_m, MARKER_SECTIONS), area_radius_m(hub.outer_radius_m, MARKER_SECTIONS)


def hub_thickness_m(drogue: DrogueParameters) -> float:
    """Thickness of the hub's annulus. [m]"""
    return min(HUB_THICKNESS_M, 0.1 * drogue.coupling_length_m)


def hub_annulus(drogue: DrogueParameters, hub: HubParameters) -> trimesh.Trimesh:
    """The bright annulus, flush with the coupling's front."""
    inner_m, outer_m = hub_radii_m(hub)
    thickness_m = hub_thickness_m(drogue)
    profile = [(inner_m, 0.0), (outer_m, 0.0), (outer_m, thickness_m), (inner_m, thickness_m)]
    return revolve(np.array(profile) + np.array([0.0, hub.depth_m]), MARKER_SECTIONS)


def hub_groove_m(drogue: DrogueParameters, hub: HubParameters) -> list[tuple[float, float]]:
    """Corners (radius, z behind the front) of the coupling's groove, from the sleeve in the hole outwards. [m]"""
    inner_m, outer_m = hub_radii_m(hub)
    thickness_m = GROOVE_PER_HUB_THICKNESS * hub_thickness_m(drogue)
    sleeve_m = inner_m - SLEEVE_THICKNESS_M
    return [(sleeve_m, 0.0), (inner_m, 0.0), (inner_m, thickness_m), (outer_m, thickness_m), (outer_m, 0.0)]


def hub_holder(drogue: DrogueParameters, hub: HubParameters) -> trimesh.Trimesh:
    """A dish of the structure's colour around the hub's annulus, whose bright walls would be seen beyond its edges."""
    groove = hub_groove_m(drogue, hub)
    edge_m = groove[-1][0] + min(HOLDER_BORDER_M, drogue.coupling_radius_m - hub.outer_radius_m)
    back_m = HOLDER_PER_HUB_THICKNESS * hub_thickness_m(drogue)
    profile = [*groove, (edge_m, 0.0), (edge_m, back_m), (groove[0][0], back_m)]
    return revolve(np.array(profile) + np.array([0.0, hub.depth_m]), MARKER_SECTIONS)


def marker_outline_m(drogue: DrogueParameters, index: int) -> Array:
    """(128, 2) corners of the polygon with the area of a marker. [m]"""
    radius_m = area_radius_m(drogue.marker_radius_m, MARKER_SECTIONS)
    return circle_m(radius_m, MARKER_SECTIONS, drogue.marker_positions_m[index])


def marker_plate(drogue: DrogueParameters, index: int) -> trimesh.Trimesh:
    """A marker at its depth, facing the mouth."""
    mesh = plate(marker_outline_m(drogue, index), [], MARKER_THICKNESS_M)
    return _moved_back(mesh, drogue.marker_centers_m[index][2])


def marker_holders(drogue: DrogueParameters) -> list[trimesh.Trimesh]:
    """A dark dish around each marker, with a bracket to the nearest strut."""
    solids = []
    assert drogue.body is not None
    has_struts = drogue.body.family in ("basket", "ribbons")
    line, angles = drogue.body_line, strut_angles(max(drogue.rib_count, 1))
    for index, (x, y, depth_m) in enumerate(drogue.marker_centers_m):
        outer = circle_m(drogue.marker_radius_m + HOLDER_BORDER_M, MARKER_SECTIONS, (x, y))
        solids.append(_moved_back(_dish(outer, marker_outline_m(drogue, index)), depth_m))
        own = np.arctan2(y, x)
        # A wall is everywhere, struts are not.
        angle = angles[np.argmin(np.abs(np.angle(np.exp(1j * (angles - own)))))] if has_struts else own
        behind_m = depth_m + HOLDER_THICKNESS_M + _BRACKET_M[1] / 2
        reach_m = line.radius_m(behind_m)
        foot = np.array([reach_m * np.cos(angle), reach_m * np.sin(angle), behind_m])
        start = np.array([x, y, behind_m])
        across = np.cross([0.0, 0.0, 1.0], foot - start)
        if np.linalg.norm(across) > 0:
            solids.append(bar(start, foot, across / np.linalg.norm(across), _BRACKET_M))
    return solids


def _dish(outer_m: Array, pocket_m: Array) -> trimesh.Trimesh:
    """A round plate with one pocket in its front."""
    return pocketed_plate(outer_m, None, [pocket_m], HOLDER_THICKNESS_M, POCKET_DEPTH_M)


def _moved_back(mesh: trimesh.Trimesh, depth_m: float) -> trimesh.Trimesh:
    if depth_m:
        mesh.vertices = np.asarray(mesh.vertices) + np.array([0.0, 0.0, depth_m])
    return mesh


def reception_coupling(drogue: DrogueParameters) -> trimesh.Trimesh:
    """Flange, guide cone, bore, body with its rings, rollers and bolts, swivel, and the hose's end."""
    assert drogue.body is not None
    sizes, hub = drogue.body.coupling, drogue.hub
    collar_m, length_m = area_radius_m(drogue.coupling_radius_m, MARKER_SECTIONS), drogue.coupling_length_m
    throat_m, guide_m = sizes.throat_radius_m, sizes.guide_length_m
    if hub is None:
        mouth = [(drogue.coupling_entry_radius_m, 0.0)]
    else:
        groove = hub_groove_m(drogue, hub)
        # The sleeve stays straight behind the annulus, where its lit wall would blur the inner edge.
        mouth = [(groove[0][0], 2 * GROOVE_PER_HUB_THICKNESS * hub_thickness_m(drogue)), *groove]
    bore_m = min(guide_m + throat_m, BORE_LENGTH_FRACTION * length_m)

    def ring(share: float) -> float:
        """Radius between those of the hose (0) and of the flange (1)."""
        return drogue.hose_radius_m + share * (collar_m - drogue.hose_radius_m)

    body_m = ring(0.85)
    profile = [
        (0.0, bore_m), (throat_m, bore_m), (throat_m, guide_m), *mouth,
        (collar_m, 0.0), (collar_m, 0.10 * length_m), (body_m, 0.12 * length_m), (body_m, 0.40 * length_m),
        (ring(0.96), 0.42 * length_m), (ring(0.96), 0.50 * length_m), (ring(BODY_FRACTION), 0.53 * length_m),
        (ring(BODY_FRACTION), 0.64 * length_m), (ring(0.40), 0.72 * length_m), (ring(0.40), 0.94 * length_m),
        (ring(0.0), length_m), (0.0, length_m),
    ]  # fmt: skip
    solids = [revolve(np.array(profile) + np.array([0.0, drogue.hub_depth_m]), MARKER_SECTIONS)]
    for angle in strut_angles(sizes.roller_count) if sizes.roller_count else ():
        solids.append(_roller(angle, body_m, drogue.hub_depth_m + 0.16 * length_m, 0.20 * length_m, collar_m))
    if sizes.bolt_count:
        inner_m = drogue.coupling_entry_radius_m if hub is None else hub.outer_radius_m
        circle = (inner_m + drogue.coupling_radius_m) / 2
        solids += [_bolt(angle, circle, drogue.hub_depth_m) for angle in strut_angles(sizes.bolt_count)]
    return trimesh.util.concatenate(solids)


def _roller(angle: float, radius_m: float, z_m: float, length_m: float, collar_m: float) -> trimesh.Trimesh:
    """A housing on the coupling's body, half sunk in it."""
    radial = np.array([np.cos(angle), np.sin(angle), 0.0])
    height_m, width_m = 0.2 * collar_m, 0.24 * collar_m
    middle = radial * (radius_m + 0.9 * (collar_m - radius_m) - height_m / 2)
    start, end = (middle + np.array([0.0, 0.0, place_m]) for place_m in (z_m, z_m + length_m))
    return bar(start, end, [-radial[1], radial[0], 0.0], (width_m, height_m))


def _bolt(angle: float, radius_m: float, front_m: float) -> trimesh.Trimesh:
    """A hexagonal head on the flange's front, sunk in it a little."""
    center = (radius_m * np.cos(angle), radius_m * np.sin(angle))
    mesh = plate(circle_m(BOLT_RADIUS_M, 6, center), [], 1.5 * _BOLT_HEIGHT_M)
    return _moved_back(mesh, front_m - _BOLT_HEIGHT_M)


def lamps(drogue: DrogueParameters) -> trimesh.Trimesh:
    """Round lamps inside the rim, wholly behind its plane."""
    assert drogue.body is not None and drogue.body.lamps is not None
    radius_m = drogue.body.lamps.radius_m
    angle = np.linspace(-np.pi / 2, np.pi / 2, 13)
    profile = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    # The cosine of a right angle is not exactly 0.
    profile[[0, -1], 0] = 0.0
    ball = revolve(profile, 24)
    balls = []
    for x, y in drogue.lamp_positions_m:
        one = ball.copy()
        one.apply_translation([x, y, radius_m + _LAMP_GAP_M])
        balls.append(one)
    return trimesh.util.concatenate(balls)
