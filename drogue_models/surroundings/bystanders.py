"""A frame's bystanders: the receiver's probe, its nose, canopy and glare shield, and their painted surfaces.

Axes of a probe: z backwards along the nozzle from its tip at the origin, x to the receiver's right, y up. Arrangements
follow aircraft in service; no drawings of them are published, so that the sizes are ours, estimated from photographs:

* `probe-straight`: fixed beside the nose, as on the A-4 Skyhawk; a tube of 7 to 9 cm that tapers forward.
* `probe-cranked`: fixed, bent inwards and down to its foot, as on the Mirage 2000, the Rafale and the A-6 Intruder.
* `probe-retractable`: an arm with an elbow that swings out of the fuselage's side, with its actuator's rod, as on the
  F/A-18 and the Tornado.
* `probe-nose`: on the centreline before the windscreen, curving down into the nose, as on the Buccaneer.
* `probe-boom`: the helicopter's telescopic boom, as on the HH-60, the CH-53 and the AW101: 2 to 3 m of inner tube in an
  outer tube of 12 cm, so that the tip reaches beyond the rotor.

All carry the nozzle that STANAG 3447 makes common to NATO's receivers: valve head, latching groove, collar, and a waist
that breaks before the tube does. Its sizes are estimated, too.

Axes of what a receiver's own camera sees besides the probe: x to the receiver's right, y up, z backwards. Sizes are
ours, estimated from photographs of fighters and transports. A canopy's panes are not drawn: neither engine shows glass
here, and a frame's reflection without a pane would be false.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from drogue_models.frozen_model import ReflectanceRgb
from drogue_models.meshes import obstacle_mesh
from drogue_models.obstacles import COCKPIT_FORMS, PLAIN_FORMS, PROBE_FORMS, ObstacleShape
from drogue_models.painted_mesh import PaintedMesh
from drogue_models.solids import loft, with_creases
from drogue_models.surroundings.distractor_bodies import distractor_surface
from drogue_models.surroundings.painted_bodies import (
    BARE_METAL,
    COLUMNS,
    PaintedBody,
    banded,
    chipped,
    flat_sided,
    joined,
    swept,
    turned,
    weathered,
)
from geometry.se3 import Array

# (radius, z) of the nozzle for a tube of 4 cm radius. [m]
_NOZZLE_M = (
    (0.012, 0.0), (0.024, 0.003), (0.0285, 0.012), (0.030, 0.050), (0.0345, 0.060), (0.0345, 0.082), (0.031, 0.086),
    (0.031, 0.096), (0.036, 0.100), (0.044, 0.120), (0.047, 0.140), (0.047, 0.205), (0.0415, 0.215), (0.0345, 0.225),
    (0.0345, 0.300), (0.044, 0.306), (0.044, 0.330), (0.040, 0.336), (0.040, 0.360),
)  # fmt: skip
_TUBE_RADIUS_M = 0.04
_NOZZLE_END_M = 0.35
_SECTIONS = 48
_PAINTED_M = 2.2
_STEEL: ReflectanceRgb = (0.30, 0.29, 0.28)
_DARK_METAL: ReflectanceRgb = (0.09, 0.09, 0.09)
_BRASS: ReflectanceRgb = (0.40, 0.31, 0.14)
_RED: ReflectanceRgb = (0.45, 0.05, 0.04)
_BLACK: ReflectanceRgb = (0.03, 0.03, 0.03)
_WHITE: ReflectanceRgb = (0.72, 0.72, 0.70)


def probe_surface(shape: ObstacleShape, reflectance_rgb: ReflectanceRgb) -> PaintedMesh:
    """A probe with its nozzle, painted and worn.

    Args:
        shape: one of the forms of this module; `radius_m` is that of its tube behind the nozzle.
        reflectance_rgb: of the tube's paint.
    """
    rng = np.random.default_rng([shape.seed, 21])
    scale = shape.radius_m / _TUBE_RADIUS_M
    path, radii = _tube_line(shape, rng)
    bodies = [_nozzle(rng, scale), _tube(rng, path, radii, reflectance_rgb)]
    bodies += [_ring(rng, path, radii, place_m) for place_m in _ring_places_m(shape, rng)]
    if shape.form == "probe-retractable":
        bodies.append(_actuator(rng, path))
    return joined(bodies)


def _nozzle(rng: np.random.Generator, scale: float) -> PaintedBody:
    """Valve head, groove, collar and waist, of bare or painted metal with rubbed edges."""
    profile = np.array(_NOZZLE_M) * scale
    body = (_STEEL, _DARK_METAL, _BRASS)[int(rng.integers(3))]
    collar = (body, _RED, _BLACK, _WHITE)[int(rng.integers(4))]
    closed = np.vstack([[0.0, 0.0], profile, [0.0, profile[-1, 1]]])
    rows = 96
    steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    place = steps / steps[-1]
    edges = place[[3, 5, 10, 12, 16]] * rows
    paint = banded(rows, body, [(float(place[10]), float(place[13]), collar)])
    paint = weathered(rng, rows, paint, grime=0.25, streaks=0.1)
    return turned(closed, _SECTIONS, chipped(rng, paint, edges, 1.2, 0.3, BARE_METAL))


def _tube_line(shape: ObstacleShape, rng: np.random.Generator) -> tuple[Array, Array]:
    """(S, 3) centre line behind the nozzle and (S,) radii. [m]"""
    radius, outboard = shape.radius_m, -1.0 if shape.mirrored else 1.0
    end_m = max(shape.length_m, 1.0)
    start_m = _NOZZLE_END_M * radius / _TUBE_RADIUS_M
    bends: list[tuple[float, float, float, float]] = []
    match shape.form:
        case "probe-cranked":
            # Turns of the way back: starts, length, towards the outside, downwards. [m, m, rad, rad]
            turn, down = np.radians(rng.uniform(-22, -8)), np.radians(rng.uniform(6, 22))
            bends.append((rng.uniform(0.55, 0.95), rng.uniform(0.15, 0.35), turn, down))
        case "probe-retractable":
            bends.append(
                (rng.uniform(0.6, 1.0), 0.18, np.radians(rng.uniform(-35, -15)), np.radians(rng.uniform(15, 40)))
            )
        case "probe-nose":
            bends.append((rng.uniform(0.45, 0.8), rng.uniform(0.3, 0.5), 0.0, np.radians(rng.uniform(12, 28))))
    steps = np.concatenate([np.arange(start_m, 2.5, 0.04), np.arange(2.5, end_m + 0.2, 0.2)])
    turn, down = np.zeros(len(steps)), np.zeros(len(steps))
    for begins, lasts, by_turn, by_down in bends:
        share = np.clip((steps - begins) / lasts, 0.0, 1.0)
        smooth = share * share * (3 - 2 * share)
        turn += by_turn * smooth
        down += by_down * smooth
    direction = np.stack([outboard * np.sin(turn), -np.sin(down) * np.cos(turn), np.cos(down) * np.cos(turn)], axis=-1)
    path = np.zeros((len(steps), 3))
    path[0, 2] = start_m
    path[1:] = path[0] + np.cumsum(direction[:-1] * np.diff(steps)[:, None], axis=0)
    if shape.form == "probe-boom":
        inner_m = rng.uniform(0.9, 1.9)
        stage = 1 / (1 + np.exp(-(steps - inner_m) / 0.008))
        return path, radius * (1.05 + 0.45 * stage)
    taper = np.clip((steps - start_m) / rng.uniform(0.8, 2.0), 0.0, 1.0)
    return path, radius * (1.0 + rng.uniform(0.05, 0.5) * taper)


def _ring_places_m(shape: ObstacleShape, rng: np.random.Generator) -> list[float]:
    """Where clamps and joints go around the tube. [m]"""
    count = int(rng.integers(1, 4))
    return sorted(rng.uniform(0.5, 1.8, count).tolist()) if shape.form != "probe-nose" else [0.42]


def _tube(rng: np.random.Generator, path: Array, radii: Array, paint_rgb: ReflectanceRgb) -> PaintedBody:
    # Only the front of it is ever in view; the paint behind goes on as the last row.
    rows = 224
    bands: list[tuple[float, float, ReflectanceRgb]] = []
    style, length_m = int(rng.integers(5)), _PAINTED_M
    if style == 0:
        bands = [(0.25 * k / length_m, (0.25 * k + 0.125) / length_m, _RED) for k in range(4)]
    elif style == 1:
        bands = [(0.0, 0.35 / length_m, _BLACK)]
    elif style == 2:
        bands = [(0.15 / length_m, 0.25 / length_m, _WHITE)]
    paint = weathered(rng, rows, banded(rows, paint_rgb, bands), grime=0.22, streaks=0.12)
    paint = chipped(rng, paint, [0.0, 20.0], 3.0, 0.12, BARE_METAL)
    return swept(path, radii, _SECTIONS, paint, _PAINTED_M)


def _ring(rng: np.random.Generator, path: Array, radii: Array, place_m: float) -> PaintedBody:
    """A clamp or joint around the tube."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    index = int(np.clip(np.searchsorted(along, place_m), 1, len(path) - 2))
    axis = path[index + 1] - path[index - 1]
    axis /= np.linalg.norm(axis)
    half_m, radius = rng.uniform(0.012, 0.03), 1.12 * radii[index]
    ends = np.array([-1.0, -0.8, 0.8, 1.0])[:, None] * half_m * axis
    paint = weathered(rng, 8, (_STEEL, _DARK_METAL)[int(rng.integers(2))], grime=0.25)
    return swept(path[index] + ends, radius * np.array([0.93, 1.0, 1.0, 0.93]), _SECTIONS, paint)


def _actuator(rng: np.random.Generator, path: Array) -> PaintedBody:
    """The rod that swings the arm out, below and beside it."""
    aft = path[np.linspace(24, len(path) - 1, 12).astype(int)]
    away = np.linspace(0.02, 0.35, 12)[:, None] * np.array([0.0, -1.0, 0.0])
    paint = weathered(rng, 16, np.full((16, COLUMNS, 3), 0.5), grime=0.3)
    return swept(aft + away, np.full(12, 0.014), 24, paint)


_RADOMES: tuple[ReflectanceRgb, ...] = ((0.05, 0.05, 0.05), (0.22, 0.23, 0.24), (0.45, 0.44, 0.38))
_FELT: ReflectanceRgb = (0.025, 0.025, 0.027)
_SEAL: ReflectanceRgb = (0.03, 0.03, 0.03)


def cockpit_surface(shape: ObstacleShape, reflectance_rgb: ReflectanceRgb) -> PaintedMesh:
    """One of the forms of this module, painted and worn."""
    rng = np.random.default_rng([shape.seed, 22])
    match shape.form:
        case "nose":
            return _nose(shape, rng, reflectance_rgb)
        case "canopy-frame":
            return _canopy_frame(shape, rng, reflectance_rgb)
        case _:
            return _glare_shield(shape, rng)


def _nose(shape: ObstacleShape, rng: np.random.Generator, paint_rgb: ReflectanceRgb) -> PaintedMesh:
    """A tangent ogive with a radome, lightning strips and a pitot tube; its tip at the origin.

    `radius_m` is its radius `length_m` behind the tip.
    """
    share = np.linspace(0.0, 1.0, 33) ** 1.5
    ratio = (shape.radius_m**2 + shape.length_m**2) / (2 * shape.radius_m)
    outside = np.sqrt(ratio**2 - (shape.length_m * (1 - share)) ** 2) + shape.radius_m - ratio
    profile = np.column_stack([outside, shape.length_m * share])
    profile[0, 0] = 0.0
    rows = 256
    radome, joint = _RADOMES[int(rng.integers(3))], rng.uniform(0.35, 0.6)
    line: ReflectanceRgb = (0.06, 0.06, 0.06)
    bands = [(0.0, joint, radome), (joint, joint + 0.006, line), (joint + 0.22, joint + 0.224, line)]
    paint = np.repeat(banded(rows, paint_rgb, bands)[:, None], COLUMNS, axis=1)
    if rng.random() < 0.5:
        for column in (16, 48, 80, 112):
            paint[12 : int(joint * rows), column : column + 2] = BARE_METAL
    paint = weathered(rng, rows, paint, grime=0.2, streaks=0.12)
    paint = chipped(rng, paint, [0.0, joint * rows], 1.5, 0.15, BARE_METAL)
    body = turned(np.vstack([profile, [0.0, shape.length_m]]), 96, paint)
    bodies = [body]
    if rng.random() < 0.6:
        length_m = rng.uniform(0.25, 0.9)
        steps = np.linspace(-length_m, 0.08, 9)
        radii = np.interp(steps, [-length_m, -0.3 * length_m, -0.29 * length_m, 0.08], [0.008, 0.008, 0.014, 0.02])
        bands = [(0.5 * k / 4, 0.5 * k / 4 + 0.06, paint_rgb) for k in range(4)] if rng.random() < 0.3 else []
        metal = weathered(rng, 32, banded(32, (0.3, 0.3, 0.29), bands))
        bodies.append(swept(np.column_stack([np.zeros((9, 2)), steps]), radii, 24, metal))
    return joined(bodies)


def _canopy_frame(shape: ObstacleShape, rng: np.random.Generator, paint_rgb: ReflectanceRgb) -> PaintedMesh:
    """An arch over the windscreen, with a rubber seal along its inner edge and a row of screws.

    Its crown is at the origin; `radius_m` is half its width, `length_m` its height, `tube_radius_m` half the width of
    the frame.
    """
    half_m, height_m, wide_m = shape.radius_m, shape.length_m, shape.tube_radius_m
    corner = min(0.4 * half_m, 0.4 * height_m)
    angle = np.linspace(0.0, np.pi / 2, 17)
    right = np.column_stack([half_m - corner + corner * np.sin(angle), -corner + corner * np.cos(angle)])
    post = np.column_stack([np.full(8, half_m), np.linspace(-corner, -height_m, 9)[1:]])
    one_side = np.vstack([[[0.0, 0.0]], right, post])
    line = np.vstack([one_side[::-1] * [-1.0, 1.0], one_side[1:]])
    line = line[np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-9])]
    lean = rng.uniform(0.0, 0.35)
    middle = np.column_stack([line, -lean * line[:, 1] * -1.0])
    frame = _strip(middle, wide_m, 0.012, 0.0)
    rows = 400
    paint = np.repeat(banded(rows, paint_rgb, [])[:, None], COLUMNS, axis=1)
    for row in range(10, rows, 22):
        paint[row : row + 2, 61:65] *= 0.35
    frame_body = _along_strip(frame, len(middle), weathered(rng, rows, paint, grime=0.3, streaks=0.1))
    seal = _along_strip(
        _strip(middle, 0.18 * wide_m, 0.02, wide_m), len(middle), weathered(rng, 16, np.array(_SEAL), 0.2)
    )
    return joined([frame_body, seal])


def _strip(middle_m: Array, half_width_m: float, half_depth_m: float, inwards_m: float) -> Array:
    """(S, 8, 3) rings of a strip with chamfered edges along an arch, shifted towards the arch's inside."""
    tangent = np.gradient(middle_m, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    depth = np.array([0.0, 0.0, 1.0]) - tangent[:, 2:] * tangent
    depth /= np.linalg.norm(depth, axis=1, keepdims=True)
    wide = np.cross(depth, tangent)
    corners = np.array(
        [(-1, -0.5), (-0.8, -1), (0.8, -1), (1, -0.5), (1, 0.5), (0.8, 1), (-0.8, 1), (-1, 0.5)], dtype=np.float64
    )
    a, b = corners[:, 0] * half_width_m, corners[:, 1] * half_depth_m
    # Rings run right-handed about the way along the arch.
    rings: Array = (
        (middle_m - wide * inwards_m)[:, None] + a[None, :, None] * wide[:, None] + b[None, :, None] * depth[:, None]
    )
    handed = np.cross(wide[0], depth[0]) @ tangent[0]
    return rings if handed > 0 else rings[:, ::-1]


def _along_strip(rings_m: Array, steps: int, paint: Array) -> PaintedBody:
    around = np.abs(np.linspace(-1.0, 1.0, rings_m.shape[1]))
    v = np.repeat(np.linspace(0.0, 1.0, steps), rings_m.shape[1])
    uv = np.column_stack([np.tile(around, steps), v])
    return PaintedBody(loft(rings_m), np.vstack([uv, [[0.5, 0.0], [0.5, 1.0]]]), paint)


def _glare_shield(shape: ObstacleShape, rng: np.random.Generator) -> PaintedMesh:
    """The padded hood over the instruments: its upper rear edge at the origin, `radius_m` half its width.

    `length_m` is its depth away from the pilot, `tube_radius_m` the radius of its padded edge.
    """
    across = np.linspace(-1.0, 1.0, 33)
    crown = rng.uniform(0.02, 0.07)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 9)
    edge = shape.tube_radius_m
    # Section in (z, y): away from the pilot along the top, back underneath. The padded edge looks at the pilot.
    rounded = np.column_stack([edge * np.cos(angle), edge * np.sin(angle) - edge])
    section = np.vstack([rounded, [[-shape.length_m, 0.02]], [[-shape.length_m, -2 * edge]]])
    rings = np.empty((len(across), len(section), 3))
    for index, place in enumerate(across):
        rings[index, :, 0] = place * shape.radius_m
        rings[index, :, 1] = section[:, 1] - crown * place**2
        rings[index, :, 2] = section[:, 0] + 0.12 * (1 - place**2) * (section[:, 0] > 0)
    body = loft(rings)
    if body.volume < 0:
        body = loft(rings[:, ::-1])
    rows = 64
    paint = weathered(rng, rows, np.array(_FELT) * rng.uniform(0.8, 1.8), grime=0.35, streaks=0.0)
    return joined([flat_sided(body, paint, 0, 2)])


@lru_cache(maxsize=64)
def bystander_surface(
    shape: ObstacleShape, reflectance_rgb: ReflectanceRgb, luminance_cd_m2: float = 0.0
) -> PaintedMesh:
    """A bystander in its own axes; nobody may change it.

    Args:
        shape: its form and dimensions.
        reflectance_rgb: of its main paint; of a lamp its colour.
        luminance_cd_m2: of a lamp. [cd/m2]
    """
    if shape.form in PLAIN_FORMS:
        return PaintedMesh(mesh=with_creases(obstacle_mesh(shape)), reflectance=np.array(reflectance_rgb), smooth=True)
    if shape.form in PROBE_FORMS:
        return probe_surface(shape, reflectance_rgb)
    if shape.form in COCKPIT_FORMS:
        return cockpit_surface(shape, reflectance_rgb)
    return distractor_surface(shape, reflectance_rgb, luminance_cd_m2)
