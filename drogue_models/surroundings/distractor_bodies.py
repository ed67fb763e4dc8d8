"""Things that are round or bright near a tanker and are not drogues.

Axes: z forward in the formation's flight direction, y up, x to the left, so that a receiver looks at their aft side.
Sizes are typical ones of what they are named after; sources stand where each is built.
"""

from __future__ import annotations

import numpy as np

from drogue_models.frozen_model import ReflectanceRgb
from drogue_models.obstacles import ObstacleShape
from drogue_models.painted_mesh import PaintedMesh
from drogue_models.solids import bar, loft
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

# Luminance of linear Rec. 709 (ITU-R BT.709).
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_BLACK: ReflectanceRgb = (0.03, 0.03, 0.03)
_SOOT: ReflectanceRgb = (0.05, 0.045, 0.04)
_RUBBER: ReflectanceRgb = (0.035, 0.035, 0.035)
_WHITE: ReflectanceRgb = (0.75, 0.75, 0.73)
_ROUNDELS: tuple[tuple[tuple[float, ReflectanceRgb], ...], ...] = (
    ((0.34, (0.45, 0.03, 0.04)), (0.67, (0.75, 0.75, 0.73)), (1.01, (0.02, 0.05, 0.25))),
    ((0.34, (0.02, 0.05, 0.25)), (0.67, (0.75, 0.75, 0.73)), (1.01, (0.45, 0.03, 0.04))),
    ((0.5, (0.45, 0.03, 0.04)), (1.01, (0.02, 0.05, 0.25))),
    ((0.45, (0.24, 0.25, 0.26)), (0.75, (0.36, 0.37, 0.38)), (1.01, (0.16, 0.17, 0.18))),
    ((0.55, (0.02, 0.20, 0.07)), (0.8, (0.75, 0.75, 0.73)), (1.01, (0.55, 0.22, 0.03))),
)


def distractor_surface(
    shape: ObstacleShape, reflectance_rgb: ReflectanceRgb, luminance_cd_m2: float = 0.0
) -> PaintedMesh:
    """One of the forms of this module, painted and worn; a lamp shines with a luminance. [cd/m2]"""
    rng = np.random.default_rng([shape.seed, 23])
    match shape.form:
        case "nacelle":
            bodies = _nacelle(shape, rng, reflectance_rgb)
        case "intake":
            bodies = _intake(shape, rng, reflectance_rgb)
        case "wheel":
            bodies = _wheel(shape, rng)
        case "antenna":
            bodies = _antenna(shape, rng, reflectance_rgb)
        case "roundel":
            bodies = _roundel(shape, rng)
        case "bird":
            bodies = _bird(shape, rng, reflectance_rgb)
        case "pod":
            bodies = _pod(shape, rng, reflectance_rgb)
        case _:
            color = np.array(reflectance_rgb)
            return joined(_lamp(shape, rng), color * luminance_cd_m2 / (color @ _LUMINANCE))
    return joined(bodies)


def _nacelle(shape: ObstacleShape, rng: np.random.Generator, paint_rgb: ReflectanceRgb) -> list[PaintedBody]:
    """A turbofan's nacelle seen from behind: cold and hot nozzle, and the plug in the middle.

    In the proportions of a CFM56-2: fan cowl 2.0 m across, 4.2 m long (EASA type certificate data sheet E.066 gives
    1.85 m for the engine's fan case; the cowl is our estimate).
    """
    r, length = shape.radius_m, shape.length_m
    profile = [
        (0.0, -0.10 * length), (0.10 * r, 0.0), (0.24 * r, 0.12 * length), (0.24 * r, 0.20 * length),
        (0.40 * r, 0.20 * length), (0.45 * r, 0.02 * length), (0.47 * r, 0.02 * length), (0.56 * r, 0.22 * length),
        (0.60 * r, 0.40 * length), (0.80 * r, 0.40 * length), (0.84 * r, 0.26 * length), (0.86 * r, 0.26 * length),
        (0.97 * r, 0.45 * length), (1.0 * r, 0.65 * length), (0.98 * r, 0.85 * length), (0.90 * r, 0.97 * length),
        (0.84 * r, 1.0 * length), (0.0, 1.0 * length),
    ]  # fmt: skip
    steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    place = steps / steps[-1]
    rows = 256
    titanium: ReflectanceRgb = (0.22, 0.20, 0.18)
    bands = [
        (0.0, float(place[3]), titanium),
        (float(place[3]), float(place[5]), _SOOT),
        (float(place[5]), float(place[8]), titanium),
        (float(place[8]), float(place[10]), _SOOT),
    ]
    paint = weathered(rng, rows, banded(rows, paint_rgb, bands), grime=0.25, streaks=0.2)
    paint = chipped(rng, paint, place[[5, 11, 15]] * rows, 1.2, 0.25, BARE_METAL)
    # Joints of the cowl's panels.
    for row in (place[12] * rows, place[13] * rows):
        paint[int(row)] *= 0.6
    return [turned(np.array(profile), 96, paint), _pylon(rng, (0.9 * r, 1.6 * r), length, paint_rgb)]


def _intake(shape: ObstacleShape, rng: np.random.Generator, paint_rgb: ReflectanceRgb) -> list[PaintedBody]:
    """An engine's intake seen from the front: polished lip, dark duct, fan with spinner.

    The lip of a CFM56-2 is 1.5 to 1.6 m across inside (our estimate from its 1.73 m fan, EASA data sheet E.066).
    """
    r, length = shape.radius_m, shape.length_m
    profile = [
        (0.0, 0.22 * length), (0.16 * r, 0.27 * length), (0.24 * r, 0.34 * length), (0.78 * r, 0.34 * length),
        (0.76 * r, 0.15 * length), (0.80 * r, 0.04 * length), (0.85 * r, 0.0), (0.90 * r, 0.02 * length),
        (0.96 * r, 0.12 * length), (1.0 * r, 0.4 * length), (0.95 * r, 0.8 * length), (0.8 * r, length),
        (0.0, length),
    ]  # fmt: skip
    steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    place = steps / steps[-1]
    rows = 256
    spinner = ((0.06, 0.06, 0.06), (0.35, 0.35, 0.34))[int(rng.integers(2))]
    bands = [
        (0.0, float(place[2]), spinner),
        (float(place[2]), float(place[3]), (0.09, 0.09, 0.09)),
        (float(place[3]), float(place[5]), (0.20, 0.20, 0.20)),
        (float(place[5]), float(place[8]), (0.55, 0.55, 0.54)),
    ]
    paint = np.repeat(banded(rows, paint_rgb, bands)[:, None], COLUMNS, axis=1)
    fan = slice(int(place[2] * rows), int(place[3] * rows))
    # Blades of the fan: 44 in the round, 22 in the mirrored half.
    paint[fan] *= (0.45 + 0.9 * (np.sin(np.arange(COLUMNS) * 2 * np.pi * 22 / COLUMNS) > 0))[None, :, None]
    if rng.random() < 0.5:
        turn = np.arange(rows)[:, None] / rows * 60 + np.arange(COLUMNS)[None] / COLUMNS * 0.5
        spiral = (turn % 1.0 < 0.12) & (np.arange(rows)[:, None] < place[2] * rows)
        paint[spiral] = 0.7
    return [turned(np.array(profile), 96, weathered(rng, rows, paint, grime=0.2, streaks=0.15))]


def _wheel(shape: ObstacleShape, rng: np.random.Generator) -> list[PaintedBody]:
    """A landing gear's wheel on its leg, seen from the side; axle along z.

    Main wheels of transports are 1.0 to 1.3 m across and 0.4 m wide (such as tyre size 46x17 in, as on the C-130's
    nose; tyre makers' tables), those of fighters about 0.7 m.
    """
    r, half = shape.radius_m, 0.19 * shape.radius_m
    profile = [
        (0.0, -0.9 * half), (0.16 * r, -0.95 * half), (0.20 * r, -0.55 * half), (0.50 * r, -0.45 * half),
        (0.55 * r, -0.9 * half), (0.62 * r, -1.0 * half), (0.85 * r, -1.0 * half), (0.95 * r, -0.8 * half),
        (1.0 * r, -0.45 * half), (1.0 * r, 0.45 * half), (0.95 * r, 0.8 * half), (0.85 * r, 1.0 * half),
        (0.60 * r, 1.0 * half), (0.55 * r, 0.5 * half), (0.0, 0.5 * half),
    ]  # fmt: skip
    steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    place = steps / steps[-1]
    rows = 160
    rim = ((0.65, 0.65, 0.63), (0.30, 0.30, 0.30), (0.50, 0.48, 0.40))[int(rng.integers(3))]
    bands = [
        (0.0, float(place[5]), rim),
        (float(place[5]), float(place[12]), _RUBBER),
        (float(place[12]), 1.0, rim),
        (float(place[2]), float(place[2]) + 0.02, _SOOT),
    ]
    tyre = np.repeat(banded(rows, rim, bands)[:, None], COLUMNS, axis=1)
    for column in range(8, COLUMNS, 21):
        tyre[int(place[2] * rows) : int(place[3] * rows), column : column + 5] = _SOOT
    wheel = turned(np.array(profile), 64, weathered(rng, rows, tyre, grime=0.35, streaks=0.05))
    leg_m = np.array([[0.0, 0.0, 0.3 * r], [0.0, 0.35 * r, 0.45 * r], [0.0, 2.6 * r, 0.45 * r]])
    legs = np.vstack([leg_m[:1], np.linspace(leg_m[1], leg_m[2], 8)])
    radii = np.concatenate([[0.07 * r, 0.075 * r], np.full(3, 0.075 * r), np.full(4, 0.12 * r)])
    leg = weathered(rng, 48, banded(48, _WHITE, [(0.25, 0.5, (0.6, 0.6, 0.58))]), grime=0.3, streaks=0.3)
    return [wheel, swept(legs, radii, 24, leg)]


def _antenna(shape: ObstacleShape, rng: np.random.Generator, paint_rgb: ReflectanceRgb) -> list[PaintedBody]:
    """A blade antenna, hanging from or standing on the skin; its foot at y = 0, up along y.

    Communication blades are 0.2 to 0.35 m high with a chord of 0.15 to 0.3 m (makers' data sheets of VHF and UHF
    blades; our range).
    """
    height, chord = shape.length_m, shape.radius_m
    place = np.linspace(0.0, 1.0, 10)
    outline = 0.5 * (1 - np.cos(np.linspace(0.0, np.pi, 13)))
    thick = 0.12 * (1.4845 * np.sqrt(outline) - 0.63 * outline - 1.758 * outline**2 + 1.4215 * outline**3)
    thick = np.maximum(thick - 0.12 * 0.518 * outline**4, 0.002)
    section = np.vstack([np.column_stack([outline, thick / 2]), np.column_stack([outline, -thick / 2])[-2:0:-1]])
    rings = np.empty((len(place), len(section), 3))
    for index, up in enumerate(place):
        size = chord * (1 - 0.45 * up)
        rings[index] = np.column_stack(
            [section[:, 1] * size, np.full(len(section), up * height), -0.4 * up * chord - section[:, 0] * size]
        )
    blade = loft(rings)
    if blade.volume < 0:
        blade = loft(rings[:, ::-1])
    paint = banded(96, paint_rgb, [(0.0, 0.06, (0.08, 0.08, 0.08))])
    return [flat_sided(blade, weathered(rng, 96, paint, grime=0.3, streaks=0.2), 2, 1)]


def _roundel(shape: ObstacleShape, rng: np.random.Generator) -> list[PaintedBody]:
    """A round plate with a national marking: rings of colour, as on a wing or fuselage; faces -z."""
    rows = 160
    rings = _ROUNDELS[int(rng.integers(len(_ROUNDELS)))]
    profile = np.array(
        [(0.0, 0.0), (shape.radius_m, 0.0), (shape.radius_m, shape.tube_radius_m), (0.0, shape.tube_radius_m)]
    )
    front = shape.radius_m / (2 * shape.radius_m + shape.tube_radius_m)
    bands, low = [], 0.0
    for high, color in rings:
        bands.append((low * front, min(high, 1.0) * front + 1e-9, color))
        low = high
    paint = banded(rows, (0.3, 0.3, 0.3), bands)
    # Corners along the face, so that the paint's rows run evenly from the middle.
    face = np.linspace(0.0, shape.radius_m, 9)[1:-1]
    profile = np.vstack([profile[:1], np.column_stack([face, np.zeros(len(face))]), profile[1:]])
    return [turned(profile, 96, weathered(rng, rows, paint, grime=0.3, streaks=0.2))]


def _bird(shape: ObstacleShape, rng: np.random.Generator, paint_rgb: ReflectanceRgb) -> list[PaintedBody]:
    """A gull or goose on the wing, flying along z; `radius_m` is half its span.

    Herring gulls span 1.25 to 1.55 m at 0.55 to 0.67 m length (Cramp and Simmons, Birds of the Western Palearctic).
    """
    half = shape.radius_m
    body_m = 0.42 * 2 * half
    share = np.linspace(0.0, 1.0, 15)
    girth = 0.16 * half * np.sin(np.pi * np.clip(share, 0.0, 1.0)) ** 0.7 * (1.15 - 0.5 * np.abs(share - 0.45))
    profile = np.column_stack([girth, body_m * (share - 0.5)])
    profile[[0, -1], 0] = 0.0
    white = np.array(paint_rgb)
    trunk = turned(profile, 24, weathered(rng, 48, banded(48, white, [(0.0, 0.1, _BLACK)]), grime=0.25))
    beat = rng.uniform(-0.5, 0.6)
    bodies = [trunk]
    for side in (-1.0, 1.0):
        place = np.linspace(0.0, 1.0, 12)
        chord = 0.34 * half * (1 - 0.75 * place**1.6)
        rise = half * (beat * place - 0.45 * beat * place**2 + 0.12 * np.sin(np.pi * place))
        sweep = body_m * (0.12 + 0.1 * np.sin(np.pi * place) - 0.28 * place**2)
        outline = np.array([(0.5, 0.0), (0.2, 0.05), (-0.2, 0.035), (-0.5, 0.0), (-0.2, -0.02), (0.2, -0.03)])
        rings = np.empty((12, 6, 3))
        for index in range(12):
            rings[index, :, 0] = side * (0.06 * half + 0.94 * half * place[index])
            rings[index, :, 1] = rise[index] + outline[:, 1] * chord[index]
            rings[index, :, 2] = sweep[index] + outline[:, 0] * chord[index]
        wing = loft(rings)
        if wing.volume < 0:
            wing = loft(rings[:, ::-1])
        dark = np.tile(white * 0.55, (64, COLUMNS, 1))
        # Black tips: columns run along the span.
        span = np.linspace(0.0, 1.0, COLUMNS)
        dark[:, (span > 0.82) if side > 0 else (span < 0.18)] = _BLACK
        bodies.append(flat_sided(wing, weathered(rng, 64, dark, grime=0.2, streaks=0.0), 0, 2))
    tail = bar([0.0, 0.0, -0.40 * body_m], [0.0, 0.0, -0.72 * body_m], [1.0, 0.0, 0.0], (0.22 * half, 0.015 * half))
    bodies.append(flat_sided(tail, weathered(rng, 16, white, grime=0.2), 0, 2))
    return bodies


def _lamp(shape: ObstacleShape, rng: np.random.Generator) -> list[PaintedBody]:
    """The glass dome of a lamp, facing -z; the whole of it shines."""
    angle = np.linspace(-np.pi / 2, 0.0, 9)
    dome = np.column_stack([shape.radius_m * np.cos(angle), 0.7 * shape.radius_m * np.sin(angle)])
    dome[0, 0] = 0.0
    closed = np.vstack([dome, [[shape.radius_m, 0.25 * shape.radius_m], [0.0, 0.25 * shape.radius_m]]])
    return [turned(closed, 48, weathered(rng, 16, np.full(3, 0.5)))]


def _pylon(
    rng: np.random.Generator, heights_m: tuple[float, float], length_m: float, paint_rgb: ReflectanceRgb
) -> PaintedBody:
    """A pylon that stands on a body of a length, between two heights above its axis."""
    outline = 0.5 * (1 - np.cos(np.linspace(0.0, np.pi, 11)))
    thick = 0.05 * length_m * np.sqrt(np.maximum(outline * (1 - outline), 1e-6))
    around = np.vstack([np.column_stack([thick, outline]), np.column_stack([-thick, outline])[-2:0:-1]])
    rings = [
        np.column_stack([around[:, 0], np.full(len(around), y_m), back + around[:, 1] * chord])
        for y_m, chord, back in zip(
            heights_m, (0.5 * length_m, 0.6 * length_m), (0.3 * length_m, 0.42 * length_m), strict=True
        )
    ]
    pylon = loft(np.array(rings))
    if pylon.volume < 0:
        pylon = loft(np.array(rings)[:, ::-1])
    return flat_sided(pylon, weathered(rng, 64, np.array(paint_rgb), streaks=0.0), 2, 1)


def _pod(shape: ObstacleShape, rng: np.random.Generator, paint_rgb: ReflectanceRgb) -> list[PaintedBody]:
    """A refuelling pod on its pylon, seen from behind: the dark exit of its hose, the turbine's blades in front.

    A Cobham 900 series pod is 4.2 m long and 0.83 m across (maker's brochure, from memory).
    """
    r, length = shape.radius_m, shape.length_m
    exit_m = 0.40 * r
    profile = [
        (0.0, 0.7), (exit_m, 0.7), (exit_m, 0.0), (1.45 * exit_m, 0.0), (0.82 * r, 0.13 * length),
        (0.95 * r, 0.25 * length), (r, 0.40 * length), (r, 0.72 * length), (0.93 * r, 0.84 * length),
        (0.75 * r, 0.93 * length), (0.42 * r, 0.985 * length), (0.0, length),
    ]  # fmt: skip
    steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    place = steps / steps[-1]
    rows = 256
    bands = [(0.0, float(place[2]), _SOOT), (float(place[2]), float(place[3]), (0.12, 0.12, 0.12))]
    bands += [(at, at + 0.004, (0.1, 0.1, 0.1)) for at in (0.32, 0.5, 0.7, 0.86)]
    if rng.random() < 0.5:
        bands.append((float(place[9]), 1.0, ((0.5, 0.06, 0.04), (0.55, 0.4, 0.05))[int(rng.integers(2))]))
    paint = weathered(rng, rows, banded(rows, paint_rgb, bands), grime=0.25, streaks=0.2)
    paint = chipped(rng, paint, place[[3, 9]] * rows, 1.2, 0.25, BARE_METAL)
    bodies = [turned(np.array(profile), 64, paint)]
    bodies.append(_pylon(rng, (0.6 * r, 2.4 * r), length, paint_rgb))
    turn = rng.uniform(0.0, np.pi / 2)
    for angle in turn + np.arange(4) * np.pi / 2:
        radial = np.array([np.cos(angle), np.sin(angle), 0.0])
        start = np.array([0.0, 0.0, 0.97 * length])
        pitched = np.cross([0.0, 0.0, 1.0], radial) * 0.8 + [0.0, 0.0, 0.6]
        blade = bar(start, start + 1.05 * r * radial, pitched, (0.09, 0.014))
        bodies.append(flat_sided(blade, weathered(rng, 8, (0.1, 0.1, 0.1)), 0, 1))
    return bodies
