"""The painted surfaces of a drogue.

Baskets, leaves, ribbons and printed cones have stripes, tape, seams, rivets, layers and wear. As on the ring drogue,
where marks lie is what service leaves: probes rub the mouth, the stream carries soot and fluid from the coupling
towards it, cloth fades between its seams. The amounts are our choice.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from drogue_models.bodies import BasketBody, ConeBody, DrogueBody, PetalBody, RibbonBody
from drogue_models.meshes import drogue_meshes
from drogue_models.painted_mesh import PaintedMesh, Sheen, texels_at, wrapped_surface
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import FIRST_MARKER_ID, Part, part_name, part_reflectance_rgb, part_satin
from drogue_models.procedural_maps import (
    MapGrid,
    bands,
    cover_share,
    covered,
    edge_wear,
    even_paint,
    finished,
    fractal_noise,
    lines,
    panel_tints,
    rivet_rows,
    shaded,
    stitches,
    streaks,
    stripes,
)
from drogue_models.ring_wear import METAL, OIL, SOOT, WEBBING, Paint, WornPart, aged, worn_part
from drogue_models.solids import with_creases
from drogue_models.surface_looks import SurfaceWear
from geometry.se3 import Array

_COLUMNS, _ROWS = 512, 96
# Printed layers of 0.2 mm are finer than a texel; what is seen are bands of slightly unlike layers (our choice).
_LAYER_BAND_M = 0.0015


def body_part(
    drogue: DrogueParameters, part: int, mesh: trimesh.Trimesh, rgb: ArrayLike, wear: SurfaceWear | None
) -> WornPart | None:
    """One part with its paint and wear; None where it has one even paint.

    Args:
        drogue: with a body.
        part: any but a marker.
        mesh: of the part.
        rgb: (3,) reflectance of its own new paint.
        wear: how worn it is, or None for new paint.
    """
    body = drogue.body
    assert body is not None
    if part == Part.CANOPY and (wear is not None or body.stripes is not None or (body.tape and body.tape.canopy_bands)):
        return _canopy(drogue, body, mesh, rgb, wear)
    if part == Part.COUPLING and (wear is not None or (body.tape and body.tape.coupling_bands)):
        return _coupling(body, mesh, rgb, wear)
    if wear is None or part == Part.LAMPS:
        return None
    return _ribs(mesh, rgb, wear) if part == Part.RIBS else worn_part(drogue, part, mesh, rgb, wear)


def _seed(wear: SurfaceWear, part: Part) -> int:
    """Each part has room for a hundred streams of its own, apart from those of the ring drogue."""
    return wear.seed * 1000 + 500 + 100 * (int(part) % 5)


def _canopy(
    drogue: DrogueParameters, body: DrogueBody, mesh: trimesh.Trimesh, rgb: ArrayLike, wear: SurfaceWear | None
) -> WornPart:
    turn, along_m, grid = _unrolled(mesh, _COLUMNS, _ROWS)
    paint = _striped(body, grid, even_paint(grid, rgb))
    if body.tape is not None:
        paint = covered(
            paint,
            bands(grid, _tape_m(body.tape.canopy_bands, body.tape.width_fraction, grid)),
            body.tape.reflectance_rgb,
        )
    if wear is not None:
        seed = _seed(wear, Part.CANOPY)
        paint = aged(grid, paint, wear, seed)
        match body:
            case BasketBody():
                seams = drogue.rib_count if body.canopy.style in ("pleated", "smooth") else body.canopy.segment_count
                paint = _cloth(grid, paint, wear, seed + 10, np.arange(seams) * grid.width_m / seams)
            case RibbonBody():
                weave = fractal_noise(grid, seed + 10, (0.10, 0.004), octaves=2)
                paint = shaded(paint, np.maximum(1.0 + 0.05 * weave, 0.3))
            case PetalBody():
                paint = _sheet(grid, paint, wear, seed + 10, drogue.rib_count)
            case ConeBody():
                layers = fractal_noise(grid, seed + 10, (10.0 * grid.width_m, _LAYER_BAND_M), octaves=2)
                paint = shaded(paint, np.maximum(1.0 + 0.04 * layers, 0.3))
        paint = covered(paint, 0.5 * wear.soot * _blown(grid, seed + 20, 30, 0.03), SOOT)
    return *wrapped_surface(mesh, turn, along_m / grid.height_m), finished(paint)


def _striped(body: DrogueBody, grid: MapGrid, paint: Paint) -> Paint:
    striping = body.stripes
    if striping is None:
        return paint
    if striping.across:
        pitch_m = grid.height_m / striping.count
        middles = (np.arange(striping.count) + 0.5) * pitch_m
        layer = bands(grid, [(at - striping.share * pitch_m / 2, at + striping.share * pitch_m / 2) for at in middles])
    else:
        period_m = grid.width_m / striping.count
        layer = stripes(grid, period_m, striping.share * period_m)
    return covered(paint, layer, striping.reflectance_rgb)


def _cloth(grid: MapGrid, paint: Paint, wear: SurfaceWear, seed: int, seams_m: Array) -> Paint:
    """Gores of unlike tint, hems, and seams with their thread."""
    weave = fractal_noise(grid, seed, (0.006, 0.15), octaves=2)
    tints = panel_tints(grid, seed + 1, seams_m, [], 0.05 * wear.fading)
    paint = shaded(paint, np.maximum(tints * (1.0 + 0.03 * weave), 0.3))
    height_m = grid.height_m
    hems = bands(grid, [(0.0, 0.012), (height_m - 0.012, height_m)])
    paint = shaded(paint, 1.0 - 0.25 * wear.stitching * np.maximum(hems, lines(grid, seams_m, 0.010)))
    around = np.concatenate([seams_m - 0.004, seams_m + 0.004])
    thread = np.maximum(
        stitches(grid, around, 0.008, (0.005, 0.0015)),
        stitches(grid, [0.009, height_m - 0.009], 0.008, (0.005, 0.0015), across=True),
    )
    return covered(paint, 0.5 * wear.stitching * thread, WEBBING)


def _sheet(grid: MapGrid, paint: Paint, wear: SurfaceWear, seed: int, leaves: int) -> Paint:
    """Rolled metal: leaves of unlike tint, rivets at their roots, scuffs at their tips."""
    edges_m = np.arange(leaves) * grid.width_m / leaves
    grain = fractal_noise(grid, seed, (0.003, 0.25), octaves=2)
    tints = panel_tints(grid, seed + 1, edges_m, [], 0.04 + 0.06 * wear.fading)
    paint = shaded(paint, np.maximum(tints * (1.0 + 0.04 * grain), 0.3))
    rivets = rivet_rows(grid, edges_m + 0.25 * grid.width_m / leaves, 0.02, 0.002)
    rivets *= (grid.y_m > 0.8 * grid.height_m)[:, None]
    paint = shaded(paint, 1.0 - 0.5 * wear.stitching * rivets)
    from_tip_m = np.repeat(grid.y_m[:, None], grid.columns, axis=1)
    return covered(paint, 0.8 * edge_wear(grid, seed + 2, from_tip_m, 0.01, 0.06 * wear.edge_wear), METAL)


def _coupling(body: DrogueBody, mesh: trimesh.Trimesh, rgb: ArrayLike, wear: SurfaceWear | None) -> WornPart:
    turn, along_m, grid = _unrolled(mesh, 256, 128)
    paint = even_paint(grid, rgb)
    if body.tape is not None:
        taped = bands(grid, _tape_m(body.tape.coupling_bands, body.tape.width_fraction, grid))
        paint = covered(paint, taped, body.tape.reflectance_rgb)
    if wear is not None:
        seed = _seed(wear, Part.COUPLING)
        paint = aged(grid, paint, wear, seed)
        distance_m = np.repeat(grid.y_m[:, None], grid.columns, axis=1)
        paint = covered(paint, 0.8 * edge_wear(grid, seed + 20, distance_m, 0.006, 0.04 * wear.edge_wear), METAL)
        paint = covered(paint, 0.7 * wear.oil * _blown(grid, seed + 30, 16, 0.02), OIL)
        paint = covered(paint, 0.5 * wear.soot * _blown(grid, seed + 40, 12, 0.05), SOOT)
    return *wrapped_surface(mesh, turn, along_m / grid.height_m), finished(paint)


def _ribs(mesh: trimesh.Trimesh, rgb: ArrayLike, wear: SurfaceWear) -> WornPart:
    """Struts, straps and holders: chafed near the mouth, oily near the coupling."""
    turn, along_m, grid = _unrolled(mesh, 256, _ROWS)
    seed = _seed(wear, Part.RIBS)
    paint = aged(grid, even_paint(grid, rgb), wear, seed)
    patches = fractal_noise(grid, seed + 10, (0.02, 0.06)) - 2.0 * grid.y_m[:, None] / grid.height_m
    paint = covered(paint, 0.8 * cover_share(patches, 0.15 * wear.edge_wear), METAL)
    paint = covered(paint, 0.5 * wear.oil * _blown(grid, seed + 30, 30, 0.01), OIL)
    return *wrapped_surface(mesh, turn, along_m / grid.height_m), finished(paint)


def _tape_m(count: int, width_fraction: float, grid: MapGrid) -> list[tuple[float, float]]:
    """Limits of evenly spaced bands along v. [m]"""
    pitch_m = grid.height_m / max(count, 1)
    half_m = width_fraction * pitch_m / 2
    return [((index + 0.5) * pitch_m - half_m, (index + 0.5) * pitch_m + half_m) for index in range(count)]


def _blown(grid: MapGrid, seed: int, count: int, width_m: float) -> Array:
    """Streaks from random places towards the mouth, against v."""
    starts = np.random.default_rng([seed, 50]).random((count, 2)) * (grid.width_m, grid.height_m)
    return streaks(grid, seed, starts, 0.5 * grid.height_m, width_m, upstream=True)


def _unrolled(mesh: trimesh.Trimesh, columns: int, rows: int) -> tuple[Array, Array, MapGrid]:
    """Turn of every vertex from the +y axis in [0, 1), its length from the mouth [m], and the grid of a map."""
    points = np.asarray(mesh.vertices)
    turn = (np.arctan2(points[:, 1], points[:, 0]) - np.pi / 2) / (2 * np.pi) % 1.0
    # Vertices within a rounding error before the seam are on it.
    turn = np.where(turn > 1.0 - 1e-9, 0.0, turn)
    radius_m, z_m = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    along_m = (z_m - z_m.min()) + (radius_m.max() - radius_m)
    return turn, along_m, MapGrid(2 * np.pi * float(radius_m.max()), float(along_m.max()), columns, rows, wraps=True)


@lru_cache(maxsize=16)
def drogue_surfaces(drogue: DrogueParameters, wear: SurfaceWear | None = None) -> dict[int, PaintedMesh]:
    """The surface of every part of a drogue by part id, in the drogue frame; nobody may change it.

    Markers and hub have texture coordinates over the square around them, with v along y.

    Raises:
        ValueError: the user's body mesh is missing, changed, or not fit for use.
    """
    return {part: _painted(drogue, part, mesh, wear) for part, mesh in _meshes(drogue).items()}


@lru_cache(maxsize=16)
def _meshes(drogue: DrogueParameters) -> dict[int, trimesh.Trimesh]:
    meshes = drogue_meshes(drogue)
    if drogue.body is None:
        return meshes
    # Cloth and other curved parts have rounded shading, with creases where they fold.
    return {part: with_creases(mesh) if _is_rounded(part) else mesh for part, mesh in meshes.items()}


def _is_rounded(part: int) -> bool:
    """Whether a part of a body has interpolated normals; the rim's torus has no creases."""
    return part < FIRST_MARKER_ID and part not in (Part.RIM, Part.HUB)


def _painted(drogue: DrogueParameters, part: int, mesh: trimesh.Trimesh, wear: SurfaceWear | None) -> PaintedMesh:
    satin, lamps = part_satin(drogue, part), None if drogue.body is None else drogue.body.lamps
    rgb = np.array(part_reflectance_rgb(drogue, part))
    # Markers have dirt of their own, see `datasets_manifest.types.appearance.SurfaceCondition`.
    worn = wear is not None and part < FIRST_MARKER_ID
    painted, uv, reflectance = mesh, _square_uv(drogue, part, mesh), rgb
    if drogue.body is not None and part < FIRST_MARKER_ID:
        own = body_part(drogue, part, mesh, rgb, wear)
        painted, uv, reflectance = (mesh, uv, rgb) if own is None else own
    elif worn and wear is not None:
        painted, uv, reflectance = worn_part(drogue, part, mesh, rgb, wear)
    return PaintedMesh(
        mesh=painted,
        reflectance=reflectance,
        uv=uv,
        emission_cd_m2=np.array(lamps.radiance_rgb if lamps is not None and part == Part.LAMPS else (0.0, 0.0, 0.0)),
        smooth=part == Part.RIM or (drogue.body is not None and _is_rounded(part)),
        sheen=None if satin is None else Sheen(satin.sheen_fraction, satin.roughness),
    )


def _square_uv(drogue: DrogueParameters, part: int, mesh: trimesh.Trimesh) -> Array | None:
    """(V, 2) coordinates over the square around a marker or the hub, None for other parts."""
    if part == Part.HUB and drogue.hub is not None:
        center_m, radius_m = (0.0, 0.0), drogue.hub.outer_radius_m
    elif part >= FIRST_MARKER_ID:
        center_m, radius_m = drogue.marker_positions_m[part - FIRST_MARKER_ID], drogue.marker_radius_m
    else:
        return None
    uv: Array = (np.asarray(mesh.vertices)[:, :2] - np.asarray(center_m)) / (2 * radius_m) + 0.5
    return uv


def encode_mesh_file(surfaces: Mapping[int, PaintedMesh], suffix: str) -> bytes:
    """Contents of a file for viewers of 3-D models.

    GLB keeps one node per part with its colour or map, PLY and OBJ have coloured vertices, STL has the shape only.

    Args:
        surfaces: by part id, see `drogue_surfaces`.
        suffix: `.glb`, `.ply`, `.stl` or `.obj`.
    """
    scene = trimesh.Scene()
    colored = []
    for part, painted in surfaces.items():
        if suffix == ".glb":
            name = part_name(part)
            scene.add_geometry(_textured(painted, name), node_name=name, geom_name=name)
        else:
            mesh = painted.mesh.copy()
            texels = painted.reflectance[None] if painted.uv is None else texels_at(painted, painted.uv)
            rgb = np.broadcast_to(_srgb(texels.astype(np.float64)), (len(mesh.vertices), 3))
            opaque = np.full((len(rgb), 1), 255, dtype=np.uint8)
            mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=np.hstack([rgb, opaque]))
            colored.append(mesh)
    data = (scene if suffix == ".glb" else trimesh.util.concatenate(colored)).export(file_type=suffix[1:])
    return data.encode() if isinstance(data, str) else bytes(data)


def _textured(painted: PaintedMesh, name: str) -> trimesh.Trimesh:
    """The mesh with a glTF material; flat shading needs each triangle's own vertices."""
    # glTF's base colour is linear, its texture is not; its materials are metals unless told otherwise.
    material = trimesh.visual.material.PBRMaterial(name=name, metallicFactor=0.0, roughnessFactor=1.0)
    if painted.has_map:
        # glTF's row 0 is at v = 0 too, but trimesh counts v from the other end.
        material.baseColorTexture = Image.fromarray(_srgb(painted.reflectance.astype(np.float64))[::-1])
    else:
        material.baseColorFactor = [*painted.reflectance.tolist(), 1.0]
    flat = trimesh.Trimesh(**trimesh.triangles.to_kwargs(painted.mesh.triangles), process=False)
    uv = None if painted.uv is None or not painted.has_map else painted.uv[painted.mesh.faces.ravel()]
    flat.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return flat


def _srgb(linear: Array) -> NDArray[np.uint8]:
    """Linear values as viewers of vertex colours and textures expect them (IEC 61966-2-1)."""
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    levels: NDArray[np.uint8] = np.rint(255 * encoded).astype(np.uint8)
    return levels
