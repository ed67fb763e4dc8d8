"""Meshes of baskets, leaves, ribbons and printed cones: rim, canopy, ribs, coupling, hub, lamps and markers."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from drogue_models.bodies import BasketBody, BodyLine, Canopy, ConeBody, PetalBody, RibbonBody
from drogue_models.drogue_families.fittings import (
    around_axis,
    hub_annulus,
    lamps,
    line_points_m,
    marker_holders,
    marker_plate,
    reception_coupling,
    rim,
    share_at_m,
    shell,
    strut,
    strut_angles,
)
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import Part, marker_id
from drogue_models.solids import circle_m, revolve
from geometry.se3 import Array

Mask = NDArray[np.bool_]

_STRUT_PIECES = 14
_CLOTH_M, _CORD_M = 0.0025, 0.002
_STRAP_M = 0.0015
_COLUMNS_PER_BILLOW, _COLUMNS_PER_FOLD, _CLOTH_ROWS = 12, 8, 14
_ROUND_SECTIONS = 192
# The cone's wall between which shares of its length the windows lie, and their share of that.
_CLOSED_ENDS, _WINDOW_SHARE = (0.14, 0.84), 0.78


def body_meshes(drogue: DrogueParameters) -> dict[int, trimesh.Trimesh]:
    """All parts of a drogue with a body, by part id. [m]"""
    assert drogue.body is not None
    match drogue.body:
        case BasketBody() as body:
            parts = _basket(drogue, body)
        case PetalBody() as body:
            parts = {Part.CANOPY: _leaves(drogue, body)}
        case RibbonBody() as body:
            parts = _ribbons(drogue, body)
        case ConeBody() as body:
            parts = {Part.CANOPY: _cone(drogue, body)}
    holders = marker_holders(drogue)
    if holders:
        ribs = [parts[Part.RIBS]] if Part.RIBS in parts else []
        parts[Part.RIBS] = trimesh.util.concatenate([*ribs, *holders])
    meshes = {int(Part.RIM): rim(drogue)} | {int(part): mesh for part, mesh in parts.items()}
    meshes[int(Part.COUPLING)] = reception_coupling(drogue)
    if drogue.hub is not None:
        meshes[int(Part.HUB)] = hub_annulus(drogue, drogue.hub)
    if drogue.body.lamps is not None:
        meshes[int(Part.LAMPS)] = lamps(drogue)
    return meshes | {marker_id(index): marker_plate(drogue, index) for index in range(drogue.marker_count)}


def _basket(drogue: DrogueParameters, body: BasketBody) -> dict[Part, trimesh.Trimesh]:
    line, angles = drogue.body_line, strut_angles(drogue.rib_count)
    shares = np.linspace(0.0, 1.0, _STRUT_PIECES)
    points, _ = line_points_m(line, shares)
    widths = body.strut_width_m + (body.strut_root_width_m - body.strut_width_m) * shares
    points = points + _inset_m(drogue, body.strut_thickness_m, float(widths.max()))
    solids = [strut(points, angle, widths, body.strut_thickness_m) for angle in angles]
    solids += _cords(line, body, drogue.rib_count)
    return {Part.RIBS: trimesh.util.concatenate(solids), Part.CANOPY: _canopy(drogue, body, line)}


def _inset_m(drogue: DrogueParameters, thickness_m: float, width_m: float) -> Array:
    """(radius, z) by which struts thicker than the rim's tube must move to stay inside the rim and behind it. [m]"""
    beyond_m = thickness_m / 2 + width_m**2 / (8 * drogue.rim_radius_m) - drogue.rim_tube_radius_m
    return max(beyond_m + 1e-4, 0.0) * np.array([-1.0, 1.0])


def _cords(line: BodyLine, body: BasketBody, strut_count: int) -> list[trimesh.Trimesh]:
    """Rings of straight cord from strut to strut, evenly spaced behind the canopy."""
    first = share_at_m(line, body.canopy.length_m)
    shares = first + (0.92 - first) * (np.arange(body.cord_rings) + 1) / (body.cord_rings + 0.5)
    points, _ = line_points_m(line, shares)
    rings = []
    for radius, z in points:
        ring = revolve(circle_m(_CORD_M, 8, (radius, z)), strut_count)
        # The first corner is at +x, the first strut at +y.
        ring.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0.0, 0.0, 1.0]))
        rings.append(ring)
    return rings


def _canopy(drogue: DrogueParameters, body: BasketBody, line: BodyLine) -> trimesh.Trimesh:
    canopy, base_m = body.canopy, body.strut_thickness_m / 2
    if canopy.style == "tube":
        radius_m, gap_m = canopy.length_m / 2, 2 * drogue.rim_tube_radius_m
        center = (drogue.rim_radius_m - radius_m, gap_m / 2 + radius_m)
        return revolve(circle_m(radius_m, 40, center), _ROUND_SECTIONS)
    shares = np.linspace(0.0, share_at_m(line, canopy.length_m), _CLOTH_ROWS)
    angles, present, lift = _cloth_grid(canopy, drogue.rib_count)
    return _cloth(drogue, line, shares, angles, base_m + lift, present)


def _cloth_grid(canopy: Canopy, strut_count: int) -> tuple[Array, Mask, Array]:
    """Angles of the columns, which cells have cloth, and its distance outside the struts on the grid. [m]"""
    along = np.linspace(0.0, 1.0, _CLOTH_ROWS)[:, None]
    # Hems hold the cloth at both ends.
    free = np.sqrt(np.maximum(4 * along * (1 - along), 0.0))
    if canopy.style == "smooth":
        angles = _columns(_ROUND_SECTIONS)
        return angles, _all_present(angles), 0.5 * canopy.billow_m * free + np.zeros(len(angles))
    if canopy.style == "segmented":
        return _segments(canopy, free)
    angles = _columns(strut_count * canopy.folds_per_strut * _COLUMNS_PER_FOLD)
    phase = (angles - np.pi / 2) * strut_count
    billow = canopy.billow_m * np.abs(np.sin(phase / 2))
    folds = canopy.fold_depth_m * (0.5 - 0.5 * np.cos(phase * canopy.folds_per_strut))
    # Folds are gathered at the mouth's hem and run out towards the struts' roots.
    return angles, _all_present(angles), billow * (0.35 + 0.65 * free) + folds * (1.0 - 0.6 * along)


def _segments(canopy: Canopy, free: Array) -> tuple[Array, Mask, Array]:
    cells = 2 * _COLUMNS_PER_BILLOW
    cut = min(max(round(canopy.gap_fraction * cells), 1), cells - 4)
    # The columns within a piece are even, those of the gap too, so that the gap has its exact width.
    width = 2 * np.pi / canopy.segment_count
    piece = np.linspace(0.0, (1 - canopy.gap_fraction) * width, cells - cut + 1)
    gap = np.linspace((1 - canopy.gap_fraction) * width, width, cut + 1)[1:-1]
    inside = np.concatenate([piece, gap])
    angles = np.concatenate(
        [np.pi / 2 + canopy.gap_fraction * width / 2 + inside + width * k for k in range(canopy.segment_count)]
    )
    is_piece = np.tile(np.arange(cells) < cells - cut, canopy.segment_count)
    across = np.tile(np.clip(inside / piece[-1], 0.0, 1.0), canopy.segment_count)
    lift = canopy.billow_m * np.sqrt(np.maximum(4 * across * (1 - across), 0.0)) * (0.4 + 0.6 * free)
    return angles, np.tile(is_piece, (_CLOTH_ROWS - 1, 1)), lift


def _columns(count: int) -> Array:
    angles: Array = np.pi / 2 + 2 * np.pi * np.arange(count) / count
    return angles


def _all_present(angles: Array, rows: int = _CLOTH_ROWS) -> Mask:
    return np.ones((rows - 1, len(angles)), dtype=bool)


def _cloth(
    drogue: DrogueParameters, line: BodyLine, shares: Array, angles: Array, lift_m: Array, present: Mask
) -> trimesh.Trimesh:
    """Cloth at a distance outside a body's line, nowhere beyond the rim.

    Args:
        drogue: gives the rim.
        line: of the body.
        shares: (S,) rows along the line.
        angles: (N,) of the columns.
        lift_m: (S, N) of the cloth's inner side from the line. [m]
        present: see `shell`.
    """
    points, normals = line_points_m(line, shares)
    return _wall(drogue, points, normals, (lift_m, _CLOTH_M), angles, present)


def _wall(
    drogue: DrogueParameters, points: Array, normals: Array, place_m: tuple[Array, float], angles: Array, present: Mask
) -> trimesh.Trimesh:
    """A shell outside points of a body's line, nowhere beyond the rim and its plane; `place_m`: lift and thickness."""
    lift_m, thickness_m = place_m
    room_m = (drogue.rim_radius_m - points[:, 0]) / np.maximum(normals[:, 0], 1e-9)
    outer_m = np.minimum(lift_m + thickness_m, room_m[:, None])
    sides = [
        around_axis(points[:, :1] + off * normals[:, :1], np.maximum(points[:, 1:] + off * normals[:, 1:], 0.0), angles)
        for off in (outer_m - thickness_m, outer_m)
    ]
    return shell(sides[0], sides[1], present, is_ring=True)


def _leaves(drogue: DrogueParameters, body: PetalBody) -> trimesh.Trimesh:
    """Leaves with one edge above the neighbour on one side and one below on the other."""
    line, sheet_m, count = drogue.body_line, body.sheet_m, drogue.rib_count
    shares, across = np.linspace(0.0, 1.0, _STRUT_PIECES), np.linspace(-1.0, 1.0, 9)
    wide = 1.0 + body.overlap_fraction
    opened = body.root_fraction + (wide - body.root_fraction) * _smooth_step((1.0 - shares) / 0.55)
    points, normals = line_points_m(line, shares)
    # Against the rim's torus from inside; both sheets where they overlap stay within the rim.
    points = points - [max(drogue.rim_tube_radius_m, 1.8 * sheet_m - drogue.rim_tube_radius_m), 0.0]
    lap_m = 1.2 * sheet_m * across
    back_m = body.tip_m * across**2 * (1.0 - shares[:, None]) ** 2
    solids = []
    for angle in strut_angles(count):
        turn = angle + np.pi / count * opened[:, None] * across
        low, high = (
            around_axis(
                points[:, :1] + (lap_m + side * sheet_m) * normals[:, :1],
                np.maximum(points[:, 1:] + back_m + (lap_m + side * sheet_m) * normals[:, 1:], 0.0),
                turn,
            )
            for side in (-0.5, 0.5)
        )
        solids.append(shell(low, high, np.ones((len(shares) - 1, len(across) - 1), dtype=bool), is_ring=False))
    return trimesh.util.concatenate(solids)


def _smooth_step(share: Array) -> Array:
    x = np.clip(share, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def _ribbons(drogue: DrogueParameters, body: RibbonBody) -> dict[Part, trimesh.Trimesh]:
    line, count = drogue.body_line, drogue.rib_count
    points, _ = line_points_m(line, np.linspace(0.0, 1.0, _STRUT_PIECES))
    widths = np.full(_STRUT_PIECES, min(body.strap_width_m, 0.8 * 2 * np.pi * drogue.coupling_radius_m / count))
    points = points + _inset_m(drogue, _STRAP_M, float(widths.max()))
    straps = [strut(points, angle, widths, _STRAP_M) for angle in strut_angles(count)]
    angles = _columns(count * _COLUMNS_PER_BILLOW)
    billow = np.abs(np.sin((angles - np.pi / 2) * count / 2))
    pitch_m = body.covered_fraction * line.length_m() / (body.ribbon_count - body.slot_fraction)
    rows, bands = 5, []
    for index in range(body.ribbon_count):
        low, high = (share_at_m(line, place * pitch_m) for place in (index, index + 1 - body.slot_fraction))
        shares = np.linspace(low, high, rows)
        lift = _STRAP_M / 2 + body.billow_m * billow * np.ones((rows, 1))
        bands.append(_cloth(drogue, line, shares, angles, lift, _all_present(angles, rows)))
    return {Part.RIBS: trimesh.util.concatenate(straps), Part.CANOPY: trimesh.util.concatenate(bands)}


def _cone(drogue: DrogueParameters, body: ConeBody) -> trimesh.Trimesh:
    """A wall with rows of windows between webs; the first and the last part of it are closed."""
    shares, is_open_row = _window_rows(body)
    angles, is_open_column = _window_columns(body)
    present = ~(is_open_row[:, None] & is_open_column)
    points, normals = line_points_m(drogue.body_line, shares)
    lift_m = np.full((len(shares), 1), -body.wall_m / 2)
    return _wall(drogue, points, normals, (lift_m, body.wall_m), angles, present)


def _window_rows(body: ConeBody) -> tuple[Array, Mask]:
    """Shares of the rows along the cone, and between which of them the windows lie."""
    first, last = _CLOSED_ENDS
    pitch = (last - first) / body.window_rows
    steps, is_open = [np.linspace(0.0, first, 5)[:-1]], [np.zeros(4, dtype=bool)]
    for row in range(body.window_rows):
        low = first + row * pitch
        steps += [np.linspace(low, low + _WINDOW_SHARE * pitch, 7)[:-1], low + pitch * np.array([_WINDOW_SHARE, 0.9])]
        is_open += [np.ones(6, dtype=bool), np.zeros(2, dtype=bool)]
    steps.append(np.linspace(last, 1.0, 6))
    is_open.append(np.zeros(5, dtype=bool))
    return np.concatenate(steps), np.concatenate(is_open)


def _window_columns(body: ConeBody) -> tuple[Array, Mask]:
    """Angles of the columns around the cone, and between which of them the windows lie."""
    if body.window_count == 0:
        return _columns(_ROUND_SECTIONS), np.zeros(_ROUND_SECTIONS, dtype=bool)
    cells = max(12, _ROUND_SECTIONS // body.window_count)
    web = min(max(round(body.web_fraction * cells), 2), cells - 2)
    width, share = 2 * np.pi / body.window_count, body.web_fraction
    inside = np.concatenate([np.linspace(0.0, share, web + 1)[:-1], np.linspace(share, 1.0, cells - web + 1)[:-1]])
    starts = np.pi / 2 + width * (np.arange(body.window_count) - share / 2)
    angles = (starts[:, None] + width * inside).ravel()
    return angles, np.tile(np.arange(cells) >= web, body.window_count)
