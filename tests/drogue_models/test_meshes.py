from __future__ import annotations

import numpy as np
import pytest
import trimesh
from shapely.geometry import Polygon
from shapely.ops import unary_union

from drogue_models.meshes import drogue_meshes, hose_mesh
from drogue_models.parameters import DrogueParameters, even_ring
from drogue_models.parts import Part, drogue_part_ids, marker_id, part_reflectance_rgb
from drogue_models.presets import PRESETS
from drogue_models.tankers.wing_with_pod import tanker_mesh

RED_8 = PRESETS["red-8"]
# What users may ask for at the edges: no hub, no ribs, many small markers, a rim thinner than the face, a deep hub,
# ribs nearly as wide as the rim.
UNUSUAL = (
    DrogueParameters(name="bare", marker_positions_m=even_ring(3, 0.27), hub=None, rib_count=0),
    DrogueParameters(name="many", marker_positions_m=even_ring(32, 0.27), marker_radius_m=0.02, rim_tube_radius_m=1e-3),
    DrogueParameters(name="small", marker_positions_m=even_ring(4, 0.09), marker_radius_m=0.01, rim_radius_m=0.11,
                     face_inner_radius_m=0.07, coupling_radius_m=0.05, coupling_length_m=0.01, hose_radius_m=0.02,
                     hub={"depth_m": 0.05, "inner_radius_m": 0.02, "outer_radius_m": 0.04}),
    DrogueParameters(name="tiny", marker_positions_m=even_ring(4, 0.022), marker_radius_m=0.004, rim_radius_m=0.03,
                     rim_tube_radius_m=5e-4, face_inner_radius_m=0.015, coupling_radius_m=0.012, hose_radius_m=0.004,
                     hub={"depth_m": 0.02, "inner_radius_m": 0.005, "outer_radius_m": 0.01}),
)  # fmt: skip
ALL = (*PRESETS.values(), *UNUSUAL)


def front_triangles(mesh: trimesh.Trimesh, z_m: float = 0.0) -> np.ndarray:
    """(T, 3, 2) triangles that lie in the plane exactly."""
    triangles = np.asarray(mesh.triangles)
    return triangles[(triangles[:, :, 2] == z_m).all(axis=1)][:, :, :2]


def areas_m2(triangles: np.ndarray) -> np.ndarray:
    """(T,) areas of (T, 3, 2) triangles."""
    return np.abs(np.linalg.det(triangles[:, 1:] - triangles[:, :1])) / 2


def area_m2(triangles: np.ndarray) -> float:
    return float(areas_m2(triangles).sum())


def first_hit_share(origin: np.ndarray, target: np.ndarray, triangles: np.ndarray) -> float:
    """Share of the way from origin to target at the first triangle (Moeller and Trumbore); inf if there is none."""
    direction = target - origin
    edge_1, edge_2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    across = np.cross(direction, edge_2)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / np.einsum("ij,ij->i", edge_1, across)
        start = origin - triangles[:, 0]
        u = inverse * np.einsum("ij,ij->i", start, across)
        beside = np.cross(start, edge_1)
        v = inverse * (beside @ direction)
        share = inverse * np.einsum("ij,ij->i", edge_2, beside)
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (share > 0)
    return float(share[hit].min()) if hit.any() else np.inf


@pytest.mark.parametrize("drogue", ALL, ids=lambda drogue: drogue.name)
def test_every_part_is_closed_with_outward_normals(drogue: DrogueParameters) -> None:
    meshes = drogue_meshes(drogue)
    for part, mesh in meshes.items():
        assert mesh.is_watertight and mesh.is_winding_consistent, part
        for body in mesh.split():
            assert body.volume > 0, part
        assert mesh.area_faces.min() > 0, part
    absent = {int(Part.LAMPS), *([int(Part.RIBS)] if drogue.rib_count == 0 else [])}
    absent |= {int(Part.HUB)} if drogue.hub is None else set()
    assert set(meshes) == set(drogue_part_ids(drogue.marker_count)) - absent


@pytest.mark.parametrize("drogue", ALL, ids=lambda drogue: drogue.name)
def test_nothing_stands_before_the_markers_or_outside_the_rim(drogue: DrogueParameters) -> None:
    meshes = drogue_meshes(drogue)
    for part, mesh in meshes.items():
        vertices = np.asarray(mesh.vertices)
        assert vertices[:, 2].min() >= 0, part
        # One rounding of a cosine times the radius.
        assert np.hypot(vertices[:, 0], vertices[:, 1]).max() <= drogue.rim_radius_m + 1e-15, part
    for index in range(drogue.marker_count):
        marker = meshes[marker_id(index)]
        assert marker.bounds[0][2] == 0
        front = np.asarray(marker.face_normals)[(np.asarray(marker.triangles)[:, :, 2] == 0).all(axis=1)]
        # Triangles in a plane of equal z have no other components but rounding.
        np.testing.assert_allclose(front, np.broadcast_to([0.0, 0.0, -1.0], front.shape), rtol=0, atol=1e-15)


@pytest.mark.parametrize("drogue", ALL, ids=lambda drogue: drogue.name)
def test_markers_have_the_area_and_centre_of_their_discs(drogue: DrogueParameters) -> None:
    meshes = drogue_meshes(drogue)
    for index, center in enumerate(drogue.marker_positions_m):
        front = front_triangles(meshes[marker_id(index)])
        areas = areas_m2(front)
        # The polygon's radius is chosen for the disc's area: rounding of about 126 triangles is left.
        assert areas.sum() == pytest.approx(np.pi * drogue.marker_radius_m**2, rel=1e-12)
        centroid = (front.mean(axis=1) * areas[:, None]).sum(axis=0) / areas.sum()
        np.testing.assert_allclose(centroid, center, rtol=0, atol=1e-14)
        outline = np.linalg.norm(np.unique(front.reshape(-1, 2), axis=0) - center, axis=1)
        # Circumradius over radius is 1 + step^2 / 12 to first order.
        assert np.abs(outline / drogue.marker_radius_m - 1).max() < 1.01 * (2 * np.pi / 128) ** 2 / 12


@pytest.mark.parametrize("drogue", ALL, ids=lambda drogue: drogue.name)
def test_markers_fill_the_holes_of_the_face_without_gap_or_overlap(drogue: DrogueParameters) -> None:
    meshes = drogue_meshes(drogue)
    fronts = [front_triangles(meshes[int(Part.FACE)])]
    fronts += [front_triangles(meshes[marker_id(index)]) for index in range(drogue.marker_count)]
    triangles = np.concatenate(fronts)
    union = unary_union([Polygon(triangle) for triangle in triangles])
    sections = 256
    outer_m = drogue.rim_radius_m - drogue.rim_tube_radius_m
    ring_m2 = sections / 2 * np.sin(2 * np.pi / sections) * (outer_m**2 - drogue.face_inner_radius_m**2)
    # Overlap would make the sum too large, a gap would make it too small; rounding of some thousand triangles.
    assert area_m2(triangles) == pytest.approx(ring_m2, rel=1e-11)
    assert union.area == pytest.approx(ring_m2, rel=1e-11)


def front_vertices(mesh: trimesh.Trimesh, z_m: float) -> set[tuple[float, ...]]:
    return {tuple(vertex) for vertex in np.asarray(mesh.vertices) if vertex[2] == z_m}


def test_shared_outlines_have_equal_vertices() -> None:
    meshes = drogue_meshes(RED_8)
    face = front_vertices(meshes[int(Part.FACE)], 0.0)
    for index in range(RED_8.marker_count):
        assert len(front_vertices(meshes[marker_id(index)], 0.0)) == 128
        assert front_vertices(meshes[marker_id(index)], 0.0) <= face
    assert front_vertices(meshes[int(Part.HUB)], 0.25) <= front_vertices(meshes[int(Part.COUPLING)], 0.25)


def test_backs_of_features_stand_clear_of_their_pockets() -> None:
    """Two surfaces at one place would take turns in front of a ray that slips through a seam."""
    meshes = drogue_meshes(RED_8)
    for feature, pocket in ((marker_id(0), Part.FACE), (int(Part.HUB), Part.COUPLING)):
        back = meshes[feature].bounds[1][2]
        assert np.abs(np.asarray(meshes[int(pocket)].vertices)[:, 2] - back).min() > 5e-4


def test_hub_lies_flush_in_the_coupling() -> None:
    meshes = drogue_meshes(RED_8)
    hub, depth_m = RED_8.hub, 0.25
    assert hub is not None
    front = front_triangles(meshes[int(Part.HUB)], depth_m)
    assert area_m2(front) == pytest.approx(np.pi * (hub.outer_radius_m**2 - hub.inner_radius_m**2), rel=1e-12)
    around = front_triangles(meshes[int(Part.COUPLING)], depth_m)
    sleeve_m2 = np.pi * (hub.inner_radius_m**2 - (hub.inner_radius_m - 2e-5) ** 2)
    collar_m2 = np.pi * (RED_8.coupling_radius_m**2 - hub.outer_radius_m**2)
    # The sleeve's width is exact, its polygon's radius is not the circle's: 0.1 % of its own 6e-6 m2.
    assert area_m2(around) == pytest.approx(collar_m2 + sleeve_m2, abs=1e-8)
    assert meshes[int(Part.COUPLING)].bounds[0][2] == depth_m


@pytest.mark.parametrize("tilt_deg", [0.0, 8.0, 15.0])
@pytest.mark.parametrize("distance_m", [1.7, 10.0])
def test_hub_is_seen_whole(tilt_deg: float, distance_m: float) -> None:
    meshes = drogue_meshes(RED_8)
    triangles = np.concatenate([np.asarray(mesh.triangles) for mesh in meshes.values()])
    # Azimuths between and along ribs, which stand every 15 degrees.
    for azimuth in np.radians([0.0, 7.5, 50.0, 97.5, 180.0, 211.0, 262.5, 318.0]):
        tilt = np.radians(tilt_deg)
        across = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        eye = distance_m * (np.sin(tilt) * across - np.cos(tilt) * np.array([0.0, 0.0, 1.0]))
        for radius_m in (0.0505, 0.0745):
            for angle in azimuth + np.radians([3.0, 63.0, 123.0, 183.0, 243.0, 303.0]):
                target = np.array([radius_m * np.cos(angle), radius_m * np.sin(angle), 0.25])
                # The way to the hub's face is free if the first thing on it is that face; 1 um of 2 m in float64.
                assert first_hit_share(eye, target, triangles) == pytest.approx(1.0, abs=5e-7)


def test_face_cuts_the_hub_beyond_28_degrees() -> None:
    meshes = drogue_meshes(RED_8)
    triangles = np.concatenate([np.asarray(mesh.triangles) for mesh in meshes.values()])
    target = np.array([0.0, 0.0745, 0.25])
    # (0.21 - 0.0745) / 0.25 is the tangent of 28.5 degrees; seen from afar, in the direction of that edge.
    shares = [
        first_hit_share(
            target + 1e3 * np.array([0.0, np.sin(np.radians(deg)), -np.cos(np.radians(deg))]), target, triangles
        )
        for deg in (27.5, 29.5)
    ]
    assert shares[0] == pytest.approx(1.0, abs=1e-9) and shares[1] < 1 - 1e-5


def test_markers_do_not_show_from_behind() -> None:
    meshes = drogue_meshes(RED_8)
    triangles = np.concatenate([np.asarray(mesh.triangles) for mesh in meshes.values()])
    x, y = RED_8.marker_positions_m[0]
    back = np.array([x + 0.001, y + 0.002, 0.004])
    assert first_hit_share(back + np.array([0.0, 0.0, 0.05]), back, triangles) < 0.99


def test_triangle_budget() -> None:
    assert sum(len(mesh.faces) for mesh in drogue_meshes(RED_8).values()) < 40_000
    assert len(tanker_mesh().faces) < 12_000


def test_same_drogue_same_bytes() -> None:
    first, second = drogue_meshes(RED_8), drogue_meshes(RED_8)
    for part, mesh in first.items():
        assert np.asarray(mesh.vertices).tobytes() == np.asarray(second[part].vertices).tobytes()
        assert np.asarray(mesh.faces).tobytes() == np.asarray(second[part].faces).tobytes()


def test_every_part_has_a_reflectance() -> None:
    for drogue in ALL:
        for part in [*drogue_meshes(drogue), int(Part.HOSE), int(Part.TANKER)]:
            assert all(0 <= value <= 1 for value in part_reflectance_rgb(drogue, part))
    assert part_reflectance_rgb(PRESETS["white-5"], marker_id(4)) == (0.8, 0.8, 0.8)


@pytest.mark.parametrize("part", [int(Part.SKY), marker_id(8), 200])
def test_ids_without_a_surface_are_refused(part: int) -> None:
    with pytest.raises(ValueError, match=f"part_id: .*got {part}"):
        part_reflectance_rgb(RED_8, part)


def test_hose_is_a_closed_tube_of_fixed_layout() -> None:
    rng = np.random.default_rng(1)
    line = np.linspace([0.0, 0.0, 0.45], [0.5, -3.0, 15.0], 8)
    hoses = [hose_mesh(line + rng.normal(scale=0.1, size=line.shape), 0.0335) for _ in range(5)]
    for hose in hoses:
        assert hose.is_watertight and hose.is_winding_consistent and hose.volume > 0
        np.testing.assert_array_equal(hose.faces, hoses[0].faces)
        assert hose.vertices.shape == hoses[0].vertices.shape


@pytest.mark.parametrize("side", [[0.3, 0.3], [0.3, -0.3], [-0.2, 0.0], [0.0, 0.0]])
def test_a_hose_that_moves_a_little_carries_its_vertices_along(side: list[float]) -> None:
    nodes = np.linspace([0.0, 0.0, 0.45], [*side, 5.0], 6)
    moved = nodes + np.linspace(0.0, 1.0, 6)[:, None] * np.random.default_rng(2).normal(scale=1e-4, size=(6, 3))
    shift_m = np.linalg.norm(hose_mesh(moved, 0.03).vertices - hose_mesh(nodes, 0.03).vertices, axis=1).max()
    # The spline overshoots its nodes a little, and the turn of a ring adds to its middle's way.
    assert shift_m < 5 * np.linalg.norm(moved - nodes, axis=1).max()


def test_straight_hose_has_the_volume_of_its_prism() -> None:
    hose = hose_mesh([[0.0, 0.0, 0.0], [0.0, 3.0, 4.0]], 0.05)
    sections = 32
    # A regular polygon of circumradius 0.05 m, 5 m long.
    prism_m3 = sections / 2 * np.sin(2 * np.pi / sections) * 0.05**2 * 5
    assert hose.volume == pytest.approx(prism_m3, rel=1e-12)


def test_hose_passes_through_its_nodes_and_keeps_its_radius() -> None:
    angle = np.linspace(0, 2, 9)
    nodes = 5 * np.stack([np.cos(angle), np.sin(angle), 0.2 * angle], axis=-1)
    rings = np.asarray(hose_mesh(nodes, 0.03).vertices)[:-2].reshape(-1, 32, 3)
    centers = rings.mean(axis=1)
    # Six rings from node to node, and one more beside either end.
    np.testing.assert_allclose(np.delete(centers, [1, -2], axis=0)[::6], nodes, rtol=0, atol=1e-13)
    radii = np.linalg.norm(rings - centers[:, None], axis=-1)
    np.testing.assert_allclose(radii, 0.03, rtol=0, atol=1e-13)
    # The frame does not spin: a ring turns about the curve only by the product of two parts of the curve's own turn
    # from ring to ring, which is below 0.06 rad here.
    along, chords = rings[:, 0] - centers, np.diff(centers, axis=0)
    sideways = np.cross(chords / np.linalg.norm(chords, axis=1, keepdims=True), along[:-1])
    assert np.abs((along[1:] * sideways).sum(axis=1)).max() / 0.03**2 < 0.06**2 / 2


def test_hose_s_interpolated_normals_stand_across_it() -> None:
    hose = hose_mesh([[0.0, 0.0, 0.0], [0.0, 0.1, 2.0], [0.0, 0.0, 4.0]], 0.03)
    rings = np.asarray(hose.vertices)[:-2].reshape(-1, 32, 3)[1:-1]
    normals = np.asarray(hose.vertex_normals)[:-2].reshape(-1, 32, 3)[1:-1]
    outward = rings - rings.mean(axis=1, keepdims=True)
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    # The nearest rings at the ends are 10 mm from the caps; facets turn by 0.02 rad from ring to ring.
    assert (outward * normals).sum(axis=-1).min() > np.cos(0.03)


@pytest.mark.parametrize(
    ("nodes", "radius_m", "message"),
    [
        (np.zeros((1, 3)), 0.03, "nodes_m: must have shape"),
        (np.zeros((4, 2)), 0.03, "nodes_m: must have shape"),
        (np.zeros((3, 3)), 0.03, "nodes_m: .*neighbours must differ"),
        ([[0.0, 0.0, 0.0], [0.0, 0.0, np.nan]], 0.03, "nodes_m: must be finite"),
        ([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], 0.0, "radius_m: must be positive"),
    ],
)
def test_impossible_hoses_are_refused(nodes: np.ndarray, radius_m: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        hose_mesh(nodes, radius_m)


def test_tanker_is_closed_and_leaves_room_for_the_hose() -> None:
    tanker = tanker_mesh()
    assert tanker.is_watertight and all(body.volume > 0 for body in tanker.split())
    triangles = np.asarray(tanker.triangles)
    # A hose that leaves the tunnel straight aft meets only the tunnel's end, 0.8 m inside.
    aft, inside = np.array([2.0, 0.001, 0.002]), np.array([-2.0, 0.001, 0.002])
    assert first_hit_share(aft, inside, triangles) == pytest.approx((2.0 + 0.8) / 4.0, abs=1e-12)
    assert np.ptp(tanker.bounds, axis=0)[1] == pytest.approx(30.0)
