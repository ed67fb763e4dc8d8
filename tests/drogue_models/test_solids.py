from __future__ import annotations

import numpy as np
import trimesh
from shapely.geometry import Polygon

from drogue_models.drogue_families.fittings import marker_outline_m
from drogue_models.meshes import drogue_meshes
from drogue_models.parts import Part
from drogue_models.presets import load_drogue
from drogue_models.solids import bar, circle_m, pocketed_plate

SQUARE_M = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def boxes_over_area(mesh: trimesh.Trimesh) -> float:
    """Faces of the boxes around the triangles, three of each, over the triangles' area: what rays meet in vain."""
    sides = np.ptp(mesh.triangles, axis=1)
    return float((sides * np.roll(sides, 1, axis=1)).sum() / mesh.area)


def test_rays_meet_few_boxes_of_face_and_ribs_in_vain() -> None:
    meshes = drogue_meshes(load_drogue("red-8"))
    # They have 2 to 8; slivers across the face had 33, ribs in one piece 95.
    for part in (Part.FACE, Part.RIBS, Part.RIM, Part.CANOPY):
        assert boxes_over_area(meshes[part]) < 9, part


def test_plate_has_the_area_of_its_outlines_whatever_is_between_them() -> None:
    drogue = load_drogue("red-5")
    outer, opening = circle_m(0.324, 256), circle_m(0.21, 256)
    pockets = [marker_outline_m(drogue, index) for index in range(drogue.marker_count)]
    mesh = pocketed_plate(outer, opening, pockets, 0.005, 0.004)
    assert mesh.is_watertight and mesh.is_winding_consistent
    front = mesh.area_faces[(mesh.face_normals[:, 2] < -0.5) & (mesh.triangles_center[:, 2] == 0.0)].sum()
    assert np.isclose(front, Polygon(outer, [opening, *pockets]).area, rtol=1e-9)
    expected = 0.005 * Polygon(outer, [opening]).area - 0.004 * sum(Polygon(pocket).area for pocket in pockets)
    assert np.isclose(mesh.volume, expected, rtol=1e-9)


def test_plate_is_closed_where_a_hole_comes_close_to_a_long_edge() -> None:
    # No triangle of well-shaped ones has the long edge: the circle on it holds corners of the hole.
    hole = circle_m(0.2, 32, (0.0, -0.79))
    mesh = pocketed_plate(SQUARE_M, hole, [], 0.01, 0.005)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert np.isclose(mesh.volume, 0.01 * Polygon(SQUARE_M, [hole]).area, rtol=1e-9)


def test_slanting_bar_has_its_size_in_short_pieces() -> None:
    mesh = bar([0.0, 0.0, 0.0], [0.3, 0.4, 0.0], [0.0, 0.0, 1.0], (0.02, 0.01))
    assert mesh.is_watertight
    assert np.isclose(mesh.volume, 0.5 * 0.02 * 0.01, rtol=1e-9)
    # Nine pieces of at most three times the width.
    assert np.ptp(mesh.triangles @ [0.6, 0.8, 0.0], axis=1).max() <= 0.06 + 1e-12
