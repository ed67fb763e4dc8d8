"""Wear of the ring drogue's parts as maps: chalked and rubbed paint, fasteners, cloth, soot and oil.

What is rubbed and where is seen on drogues in service: probes strike the rim and the edges of the opening, the stream
carries soot and hydraulic fluid from the coupling towards the mouth, cloth fades between its seams. The amounts are our
choice: at middling wear the black face varies by some 10 % of its mean, as worn dark paint does between chalked and
greasy places.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from drogue_models.painted_mesh import wrapped_surface
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import Part
from drogue_models.procedural_maps import (
    Layer,
    MapGrid,
    bands,
    cover_share,
    covered,
    dots,
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
)
from drogue_models.surface_looks import SurfaceWear
from geometry.bilinear_sampling import sample_bilinear
from geometry.se3 import Array

Paint = NDArray[np.float64]
WornPart = tuple[trimesh.Trimesh, Array, NDArray[np.float32]]
"""A mesh whose vertices may be doubled at a seam, its (V, 2) texture coordinates and its map."""

# Diffuse reflectance (our choice): oxidised aluminium, soot, brown hydraulic fluid over paint, chalked paint, webbing.
METAL = (0.36, 0.36, 0.35)
SOOT = (0.022, 0.021, 0.020)
OIL = (0.045, 0.034, 0.020)
_CHALK = (0.20, 0.20, 0.19)
WEBBING = (0.30, 0.29, 0.26)
_GORES = 24


def worn_part(
    drogue: DrogueParameters, part: int, mesh: trimesh.Trimesh, rgb: ArrayLike, wear: SurfaceWear
) -> WornPart:
    """One part with its wear.

    Args:
        drogue: its dimensions.
        part: face, rim, canopy, ribs, coupling or hub.
        mesh: of the part.
        rgb: (3,) reflectance of its new paint.
        wear: how worn it is.
    """
    painters: dict[int, Callable[[], WornPart]] = {
        Part.FACE: partial(_face, drogue, mesh, rgb, wear),
        Part.HUB: partial(_hub, drogue, mesh, rgb, wear),
        Part.RIM: partial(_rim, drogue, mesh, rgb, wear),
        Part.CANOPY: partial(_canopy, drogue, mesh, rgb, wear),
        Part.RIBS: partial(_ribs, drogue, mesh, rgb, wear),
        Part.COUPLING: partial(_coupling, mesh, rgb, wear),
    }
    return painters[part]()


def aged_paint(grid: MapGrid, rgb: ArrayLike, wear: SurfaceWear, seed: int) -> Paint:
    """Paint with mottles, chalked clouds and a film of soot, which every painted part has."""
    return aged(grid, even_paint(grid, rgb), wear, seed)


def aged(grid: MapGrid, paint: Paint, wear: SurfaceWear, seed: int) -> Paint:
    """New paint, of several colours perhaps, with what `aged_paint` lays over it."""
    fine = fractal_noise(grid, seed + 1, 0.012, octaves=2)
    paint = shaded(paint, np.maximum(1.0 + 0.08 * wear.fading * fractal_noise(grid, seed, 0.10) + 0.02 * fine, 0.3))
    clouds = cover_share(fractal_noise(grid, seed + 2, 0.25), 0.15 + 0.45 * wear.fading, softness=2.0)
    paint = covered(paint, 0.15 * wear.fading * clouds, _CHALK)
    film = cover_share(fractal_noise(grid, seed + 3, 0.30), 0.1 + 0.6 * wear.soot, softness=2.0)
    return covered(paint, 0.45 * wear.soot * film, SOOT)


def _seed(wear: SurfaceWear, part: Part) -> int:
    """Each part has room for a hundred streams of its own."""
    return wear.seed * 1000 + 100 * (int(part) % 10)


def _face(drogue: DrogueParameters, mesh: trimesh.Trimesh, rgb: ArrayLike, wear: SurfaceWear) -> WornPart:
    """Plate: chalk, soot, screws around both edges, paint rubbed off the edges, and oil blown outwards."""
    side_m, seed = 2 * drogue.rim_radius_m, _seed(wear, Part.FACE)
    grid = MapGrid(side_m, side_m, 360, 360)
    radius_m, turn = _polar(grid)
    low_m, high_m = drogue.face_inner_radius_m, drogue.rim_radius_m - drogue.rim_tube_radius_m
    paint = aged_paint(grid, rgb, wear, seed)
    ring = MapGrid(np.pi * (low_m + high_m), high_m - low_m, 720, 64, wraps=True)
    rng = np.random.default_rng([seed, 50])
    count = round(4 + 20 * wear.oil)
    starts = np.stack([rng.random(count) * ring.width_m, rng.random(count) * 0.3 * ring.height_m], axis=-1)
    oil = streaks(ring, seed + 10, starts, 0.7 * ring.height_m, 0.012)
    paint = covered(paint, 0.5 * wear.oil * _around(oil, ring, radius_m - low_m, turn), OIL)
    # Nozzles and tools that slide along the plate leave arcs.
    arcs = cover_share(fractal_noise(ring, seed + 30, (0.25, 0.004), octaves=2), 0.03 * wear.edge_wear)
    paint = covered(paint, 0.25 * _around(arcs, ring, radius_m - low_m, turn), _CHALK)
    for edge_m in (low_m + 0.006, high_m - 0.006):
        angle = 2 * np.pi * (np.arange(48) + 0.5) / 48
        screws = dots(grid, side_m / 2 + edge_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1), 0.0022)
        paint = shaded(paint, 1.0 - 0.5 * wear.stitching * screws)
    distance_m = np.minimum(np.abs(radius_m - low_m), np.abs(high_m - radius_m))
    on_face = (radius_m > low_m - 0.005) & (radius_m < high_m + 0.005)
    rubbed = edge_wear(grid, seed + 20, np.where(on_face, distance_m, 1.0), 0.004, 0.012 * wear.edge_wear)
    return mesh, _square_uv(mesh, side_m), finished(covered(paint, 0.8 * rubbed, METAL))


def _hub(drogue: DrogueParameters, mesh: trimesh.Trimesh, rgb: ArrayLike, wear: SurfaceWear) -> WornPart:
    """Annulus: soot, and paint rubbed off where the probe's nozzle slides in."""
    assert drogue.hub is not None
    side_m, seed = 2 * drogue.hub.outer_radius_m, _seed(wear, Part.HUB)
    grid = MapGrid(side_m, side_m, 128, 128)
    radius_m, _ = _polar(grid)
    paint = aged_paint(grid, rgb, wear, seed)
    rubbed = edge_wear(grid, seed + 20, np.abs(radius_m - drogue.hub.inner_radius_m), 0.002, 0.02 * wear.edge_wear)
    return mesh, _square_uv(mesh, side_m), finished(covered(paint, 0.8 * rubbed, METAL))


def _rim(drogue: DrogueParameters, mesh: trimesh.Trimesh, rgb: ArrayLike, wear: SurfaceWear) -> WornPart:
    """Tube: scuffed in patches where probes and ground equipment strike it."""
    tube_m, seed = drogue.rim_tube_radius_m, _seed(wear, Part.RIM)
    grid = MapGrid(2 * np.pi * drogue.rim_radius_m, np.pi * tube_m, 512, 16, wraps=True)
    paint = aged_paint(grid, rgb, wear, seed)
    patches = fractal_noise(grid, seed + 20, (0.15, 1.0)) + 0.5 * fractal_noise(grid, seed + 21, (0.02, 0.01))
    paint = covered(paint, 0.8 * cover_share(patches, 0.12 * wear.edge_wear), METAL)
    # Once from the inner to the outer side of the tube: front and back look alike, which needs no second seam.
    points = np.asarray(mesh.vertices)
    along = np.clip((np.hypot(points[:, 0], points[:, 1]) - drogue.rim_radius_m) / (2 * tube_m) + 1.0, 0.0, 1.0)
    return *wrapped_surface(mesh, _turn(points), along), finished(paint)


def _canopy(drogue: DrogueParameters, mesh: trimesh.Trimesh, rgb: ArrayLike, wear: SurfaceWear) -> WornPart:
    """Cloth: gores between seams, hems, faded clouds, and soot carried towards the mouth."""
    points, seed = np.asarray(mesh.vertices), _seed(wear, Part.CANOPY)
    along, length_m, radius_m = _along_axis(points)
    grid = MapGrid(2 * np.pi * radius_m, length_m, 512, 64, wraps=True)
    gores = drogue.rib_count or _GORES
    seams_m = np.arange(gores) * grid.width_m / gores
    paint = aged_paint(grid, rgb, wear, seed)
    weave = fractal_noise(grid, seed + 10, (0.006, 0.15), octaves=2)
    paint = shaded(paint, panel_tints(grid, seed + 11, seams_m, [], 0.05 * wear.fading) * (1.0 + 0.03 * weave))
    hems = bands(grid, [(0.0, 0.012), (length_m - 0.012, length_m)])
    paint = shaded(paint, 1.0 - 0.25 * wear.stitching * np.maximum(hems, lines(grid, seams_m, 0.010)))
    thread = np.maximum(
        stitches(grid, np.concatenate([seams_m - 0.004, seams_m + 0.004]), 0.008, (0.005, 0.0015)),
        stitches(grid, [0.009, length_m - 0.009], 0.008, (0.005, 0.0015), across=True),
    )
    paint = covered(paint, 0.5 * wear.stitching * thread, WEBBING)
    paint = covered(paint, 0.5 * wear.soot * _blown(grid, seed + 20, 40, 0.03), SOOT)
    return *wrapped_surface(mesh, _turn(points), along), finished(paint)


def _ribs(drogue: DrogueParameters, mesh: trimesh.Trimesh, rgb: ArrayLike, wear: SurfaceWear) -> WornPart:
    """Struts: unlike tints, chafed where the canopy ends and at both ends, some with tape around them."""
    points, seed = np.asarray(mesh.vertices), _seed(wear, Part.RIBS)
    along, length_m, radius_m = _along_axis(points)
    grid = MapGrid(2 * np.pi * radius_m, length_m, 8 * drogue.rib_count, 128, wraps=True)
    pitch_m = grid.width_m / drogue.rib_count
    paint = aged_paint(grid, rgb, wear, seed)
    paint = shaded(
        paint, panel_tints(grid, seed + 10, np.arange(drogue.rib_count) * pitch_m, [], 0.02 + 0.08 * wear.fading)
    )
    rng = np.random.default_rng([seed, 50])
    taped = np.zeros((grid.rows, grid.columns))
    for index in np.flatnonzero(rng.random(drogue.rib_count) < wear.tape):
        low_m = rng.uniform(0.3, 0.7) * length_m
        around = bands(grid, [(index * pitch_m, (index + 1) * pitch_m)], across=False)
        taped = np.maximum(taped, around * bands(grid, [(low_m, low_m + rng.uniform(0.02, 0.05))]))
    paint = covered(paint, 0.8 * taped, WEBBING)
    ends_m = np.minimum(np.minimum(grid.y_m, length_m - grid.y_m), np.abs(grid.y_m - 0.36 * length_m))
    distance_m = np.repeat(ends_m[:, None], grid.columns, axis=1)
    paint = covered(paint, 0.8 * edge_wear(grid, seed + 20, distance_m, 0.02, 0.10 * wear.edge_wear), METAL)
    paint = covered(paint, 0.5 * wear.oil * _blown(grid, seed + 30, 30, pitch_m / 3), OIL)
    # Ribs stand half a step from the x axis, so that none reaches across the seam.
    return *wrapped_surface(mesh, _turn(points), along), finished(paint)


def _coupling(mesh: trimesh.Trimesh, rgb: ArrayLike, wear: SurfaceWear) -> WornPart:
    """Body of metal: rows of fasteners, edges rubbed bright, and oil from its joints."""
    points, seed = np.asarray(mesh.vertices), _seed(wear, Part.COUPLING)
    along, length_m, radius_m = _along_axis(points)
    grid = MapGrid(2 * np.pi * radius_m, length_m, 256, 128, wraps=True)
    joints_m = np.array([0.3, 0.6]) * length_m
    paint = aged_paint(grid, rgb, wear, seed)
    bolts = rivet_rows(grid, joints_m + 0.012, 0.03, 0.0025, across=True)
    paint = shaded(paint, 1.0 - 0.5 * wear.stitching * np.maximum(bolts, lines(grid, joints_m, 0.002, across=True)))
    distance_m = np.repeat(grid.y_m[:, None], grid.columns, axis=1)
    paint = covered(paint, 0.8 * edge_wear(grid, seed + 20, distance_m, 0.006, 0.04 * wear.edge_wear), METAL)
    paint = covered(paint, 0.7 * wear.oil * _blown(grid, seed + 30, 16, 0.02), OIL)
    paint = covered(paint, 0.5 * wear.soot * _blown(grid, seed + 40, 12, 0.05), SOOT)
    return *wrapped_surface(mesh, _turn(points), along), finished(paint)


def _blown(grid: MapGrid, seed: int, count: int, width_m: float) -> Layer:
    """Streaks from random places towards the mouth, against v."""
    starts = np.random.default_rng([seed, 50]).random((count, 2)) * (grid.width_m, grid.height_m)
    return streaks(grid, seed, starts, 0.5 * grid.height_m, width_m, upstream=True)


def _polar(grid: MapGrid) -> tuple[Array, Array]:
    """(rows, columns) distance from the middle of a square map [m], and turn around it in [0, 1)."""
    x, y = grid.x_m[None, :] - grid.width_m / 2, grid.y_m[:, None] - grid.height_m / 2
    return np.hypot(x, y), np.arctan2(y, x) / (2 * np.pi) % 1.0


def _around(layer: Layer, ring: MapGrid, height_m: Array, turn: Array) -> Layer:
    """A layer of an unrolled ring at turns around it and heights above its inner edge."""
    column = (turn * ring.columns - 0.5).astype(np.float32)
    row = (height_m / ring.texel_m[1] - 0.5).astype(np.float32)
    wrapped = np.hstack([layer[:, -1:], layer, layer[:, :1]]).astype(np.float32)
    sampled: Layer = sample_bilinear(wrapped, column + 1, row, cv2.BORDER_REPLICATE)
    return sampled.astype(np.float64)


def _square_uv(mesh: trimesh.Trimesh, side_m: float) -> Array:
    uv: Array = np.clip(np.asarray(mesh.vertices)[:, :2] / side_m + 0.5, 0.0, 1.0)
    return uv


def _turn(points_m: Array) -> Array:
    """(V,) turn around z in [0, 1); vertices within a rounding error before the x axis are on it."""
    turn = np.arctan2(points_m[:, 1], points_m[:, 0]) / (2 * np.pi) % 1.0
    on_seam: Array = np.where(turn > 1.0 - 1e-9, 0.0, turn)
    return on_seam


def _along_axis(points_m: Array) -> tuple[Array, float, float]:
    """(V,) v from the outermost front edge along sides and front alike, its length, and the largest radius. [m]"""
    radius_m, z_m = np.hypot(points_m[:, 0], points_m[:, 1]), points_m[:, 2]
    along_m = (z_m - z_m.min()) + (radius_m.max() - radius_m)
    length_m = float(along_m.max())
    return along_m / length_m, length_m, float(radius_m.max())
