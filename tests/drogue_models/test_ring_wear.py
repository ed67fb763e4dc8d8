"""Wear of the ring drogue: maps of every part, evenly spread over its seam, as large a contrast as was asked for."""

from __future__ import annotations

import numpy as np
import pytest

from drogue_models.drogue_surfaces import drogue_surfaces, encode_mesh_file
from drogue_models.painted_mesh import PaintedMesh, texels_at, wrapped_surface
from drogue_models.parameters import DrogueParameters, SatinPaint
from drogue_models.parts import FIRST_MARKER_ID, Part, part_reflectance_rgb
from drogue_models.presets import PRESETS
from drogue_models.solids import revolve
from drogue_models.surface_looks import SurfaceWear

DROGUE = PRESETS["red-8"]
WORN_PARTS = (Part.FACE, Part.RIM, Part.CANOPY, Part.RIBS, Part.COUPLING, Part.HUB)
MIDDLING = SurfaceWear(seed=5)


@pytest.fixture(scope="module")
def worn() -> dict[int, PaintedMesh]:
    return drogue_surfaces(DROGUE, MIDDLING)


def test_every_part_but_the_markers_has_a_map_of_modest_size(worn: dict[int, PaintedMesh]) -> None:
    assert {part for part in worn if worn[part].has_map} == {int(part) for part in WORN_PARTS}
    for part in WORN_PARTS:
        height, width = worn[part].reflectance.shape[:2]
        assert height * width <= 512 * 256
        assert worn[part].reflectance.min() >= np.float32(0.01)


def test_wear_leaves_every_triangle_in_its_place(worn: dict[int, PaintedMesh]) -> None:
    for part, painted in drogue_surfaces(DROGUE).items():
        np.testing.assert_array_equal(worn[part].mesh.triangles, painted.mesh.triangles)


def test_the_face_varies_by_several_per_cent_of_its_mean(worn: dict[int, PaintedMesh]) -> None:
    face = worn[Part.FACE]
    points = np.asarray(face.mesh.sample(20_000, seed=1))
    radius = np.hypot(points[:, 0], points[:, 1])
    # Between the screws at either edge, where the markers are.
    front = (points[:, 2] < 1e-6) & (radius > 0.225) & (radius < 0.31)
    seen = texels_at(face, points[front][:, :2] / (2 * DROGUE.rim_radius_m) + 0.5).sum(axis=1)
    assert 0.03 < seen.std() / seen.mean() < 0.20


def test_more_wear_shows_more() -> None:
    none, most = (
        drogue_surfaces(DROGUE, SurfaceWear(seed=5, soot=x, oil=x, edge_wear=x, fading=x, stitching=x, tape=x))
        for x in (0.0, 1.0)
    )
    for part in WORN_PARTS:
        # Unworn paint keeps its grain alone, and reflects what its part does.
        assert none[part].contrast < 0.07 < most[part].contrast
        expected = np.maximum(part_reflectance_rgb(DROGUE, part), 0.01)
        np.testing.assert_allclose(none[part].mean_reflectance, expected, rtol=0.02)


def test_maps_depend_on_the_seed_alone() -> None:
    first = drogue_surfaces(DROGUE, SurfaceWear(seed=8))
    drogue_surfaces.cache_clear()
    drogue_surfaces(DROGUE, SurfaceWear(seed=9))
    again = drogue_surfaces(DROGUE, SurfaceWear(seed=8))
    other = drogue_surfaces(DROGUE, SurfaceWear(seed=9))
    for part in WORN_PARTS:
        np.testing.assert_array_equal(first[part].reflectance, again[part].reflectance)
        assert not np.array_equal(first[part].reflectance, other[part].reflectance)


@pytest.mark.parametrize("part", [Part.RIM, Part.CANOPY, Part.RIBS, Part.COUPLING])
def test_no_triangle_reaches_across_the_seam(worn: dict[int, PaintedMesh], part: Part) -> None:
    painted = worn[part]
    u = painted.uv[:, 0][painted.mesh.faces]
    corners = np.asarray(painted.mesh.vertices)[painted.mesh.faces]
    # Triangles of fans meet the axis, where there is no turn.
    off_axis = np.hypot(corners[..., 0], corners[..., 1]).min(axis=1) > 1e-6
    assert np.ptp(u[off_axis], axis=1).max() < 0.02


def test_a_cut_seam_keeps_shape_and_normals() -> None:
    ring = revolve([(1.0, 0.0), (1.2, 0.1), (1.0, 0.2)], 24)
    turn = np.arctan2(ring.vertices[:, 1], ring.vertices[:, 0]) / (2 * np.pi) % 1.0
    cut, uv = wrapped_surface(ring, turn, ring.vertices[:, 2] / 0.2)
    assert len(cut.vertices) == len(ring.vertices) + 3, "one doubled vertex for each corner of the profile"
    np.testing.assert_array_equal(cut.triangles, ring.triangles)
    places = {tuple(point): normal for point, normal in zip(ring.vertices, ring.vertex_normals, strict=True)}
    for point, normal in zip(cut.vertices, cut.vertex_normals, strict=True):
        np.testing.assert_allclose(normal, places[tuple(point)], atol=1e-12)
    assert uv[:, 0].max() == 1.0 and uv[:, 0].min() == 0.0


def test_drogues_without_ribs_or_hub_and_with_satin_wear_too() -> None:
    bare = DrogueParameters(
        name="bare",
        marker_positions_m=DROGUE.marker_positions_m,
        hub=None,
        rib_count=0,
        satin=SatinPaint(parts=("canopy", "coupling")),
    )
    worn = drogue_surfaces(bare, MIDDLING)
    assert Part.HUB not in worn and Part.RIBS not in worn
    assert worn[Part.CANOPY].sheen is not None and worn[Part.CANOPY].has_map
    assert all(worn[part].reflectance.ndim == 1 for part in worn if part >= FIRST_MARKER_ID)


def test_a_worn_drogue_is_written_with_its_maps(worn: dict[int, PaintedMesh]) -> None:
    import io

    import trimesh

    scene = trimesh.load_scene(io.BytesIO(encode_mesh_file(worn, ".glb")), file_type="glb")
    loaded = scene.geometry["canopy"]
    picture = np.asarray(loaded.visual.material.baseColorTexture.convert("RGB"))
    assert picture.shape[:2] == worn[Part.CANOPY].reflectance.shape[:2]
    # In the middle of every face, because corners lie on the edges of texels, which 32 bits round either way.
    uv = np.asarray(loaded.visual.uv)[loaded.faces].mean(axis=1)
    height, width = picture.shape[:2]
    # The reader counts v upwards from the picture's last row.
    places = np.stack([uv[:, 0] * width, (1.0 - uv[:, 1]) * height], axis=1)
    column, row = places.astype(int).T
    seen = picture[row, column] / 255.0
    linear = np.where(seen <= 0.04045, seen / 12.92, ((seen + 0.055) / 1.055) ** 2.4)
    canopy = worn[Part.CANOPY]
    expected = texels_at(canopy, canopy.uv[canopy.mesh.faces].mean(axis=1))
    inside = np.all(np.abs(places - np.rint(places)) > 1e-3, axis=1)
    assert np.mean(inside) > 0.5
    # Half a level of eight bits.
    np.testing.assert_allclose(linear[inside], expected[inside], rtol=0, atol=0.004)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reflectance": np.full((2, 2, 3), 0.5)}, "uv: a map needs"),
        ({"reflectance": np.full(3, 1.5)}, r"reflectance: must be in \[0, 1\]"),
        ({"reflectance": np.full(3, np.nan)}, "reflectance: must be in"),
        ({"reflectance": np.full(4, 0.5)}, "reflectance: must have shape"),
        ({"uv": np.full((6, 2), 1.2)}, r"uv: must be in \[0, 1\]"),
        ({"uv": np.full((5, 2), 0.5)}, "uv: must have shape"),
        ({"emission_cd_m2": np.array([1.0, -1.0, 0.0])}, "emission_cd_m2: must not be negative"),
    ],
)
def test_a_painted_mesh_refuses_what_no_engine_could_draw(change: dict[str, np.ndarray], message: str) -> None:
    mesh = revolve([(1.0, 0.0), (1.2, 0.1)], 3)
    with pytest.raises(ValueError, match=message):
        PaintedMesh(**{"mesh": mesh, "reflectance": np.full(3, 0.5), **change})
