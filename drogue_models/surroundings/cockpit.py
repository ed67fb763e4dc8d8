"""What a receiver's own camera sees of it besides the probe: the nose, the canopy's frame, the glare shield.

Axes: x to the receiver's right, y up, z backwards. Sizes are ours, estimated from photographs of fighters and
transports.
A canopy's panes are not drawn: neither engine shows glass here, and a frame's reflection without a pane would be false.
"""

from __future__ import annotations

import numpy as np

from drogue_models.frozen_model import ReflectanceRgb
from drogue_models.obstacles import ObstacleShape
from drogue_models.painted_mesh import PaintedMesh
from drogue_models.solids import loft
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
