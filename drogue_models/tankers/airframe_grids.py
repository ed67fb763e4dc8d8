"""Closed surfaces of an airframe as grids of points: bodies, lifting surfaces and bodies of revolution.

Body axes: x aft from the nose, y along the right wing, z up. The points around a ring run counter-clockwise when seen
against the direction from the first ring to the last, so that the faces look outwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator

from geometry.se3 import Array

TRAILING_EDGE_FRACTION = 0.004  # thickness of a trailing edge over the chord


class Finish(IntEnum):
    """What covers a ring of a grid."""

    PAINT = 0
    METAL = 1
    DARK = 2
    RUBBER = 3
    PLASTIC = 4


@dataclass(frozen=True, eq=False)
class SurfaceGrid:
    """A closed surface: rings along it, points around each.

    Attributes:
        role: what it is, which decides what is painted on it.
        points_m: (S, N, 3) in body axes; the last point of a ring joins the first, and the end rings have no area. [m]
        finish: (S,) of each ring.
        mirrored: whether there is another one on the other side, which shares its paint.
        texel_share: texels per metre over those of a fuselage.
    """

    role: str
    points_m: Array
    finish: NDArray[np.uint8]
    mirrored: bool = False
    texel_share: float = 1.0

    def moved(self, offset_m: ArrayLike) -> SurfaceGrid:
        """The same surface elsewhere."""
        return replace(self, points_m=self.points_m + np.asarray(offset_m, dtype=np.float64))

    def turned(self, rotation: Array, center_m: ArrayLike) -> SurfaceGrid:
        """The same surface, turned around a point."""
        center = np.asarray(center_m, dtype=np.float64)
        return replace(self, points_m=(self.points_m - center) @ rotation.T + center)


def grid(
    role: str, points_m: Array, finish: int | ArrayLike = Finish.PAINT, mirrored: bool = False, texel_share: float = 1.0
) -> SurfaceGrid:
    """A grid whose first and last ring are closed by their means where they have an area."""
    points = np.asarray(points_m, dtype=np.float64)
    finishes = np.broadcast_to(np.asarray(finish, dtype=np.uint8), len(points)).copy()
    for end in (0, -1):
        ring = points[end]
        if _ring_area_m2(ring) > 1e-9:
            cap = np.broadcast_to(ring.mean(axis=0), ring.shape)[None]
            points = np.concatenate([cap, points]) if end == 0 else np.concatenate([points, cap])
            finishes = np.insert(finishes, 0 if end == 0 else len(finishes), finishes[end])
    return SurfaceGrid(role, points, finishes, mirrored, texel_share)


def _ring_area_m2(ring: Array) -> float:
    beside = np.roll(ring, -1, axis=0)
    return float(np.linalg.norm(np.cross(ring - ring[0], beside - ring[0]).sum(axis=0)) / 2)


def body(
    role: str,
    sections: Sequence[Sequence[float]],
    rings: int,
    points: int,
    mirrored: bool = False,
    texel_share: float = 1.0,
) -> SurfaceGrid:
    """A smooth body along x.

    Args:
        role: see `SurfaceGrid`.
        sections: rows (x, y of the middle, half width, z of the bottom, z of the top, power of the superellipse; 2 is
            an ellipse; optionally another finish than paint from here on) from nose to tail; x may turn back into a
            duct. [m]
        rings, points: along and around it.
        mirrored, texel_share: see `SurfaceGrid`.
    """
    table = np.array([row[:6] for row in sections], dtype=np.float64)
    finish = np.array([row[6] if len(row) > 6 else Finish.PAINT for row in sections])
    steps = np.linalg.norm(np.diff(table[:, :5], axis=0), axis=1)
    place = np.concatenate([[0.0], np.cumsum(steps)])
    inner = np.linspace(0.0, place[-1], rings)
    # The given sections are kept, so that their edges stay where they are.
    along = np.unique(np.concatenate([place, inner[np.abs(inner[:, None] - place).min(axis=1) > 0.3 * inner[1]]]))
    values = PchipInterpolator(place, table)(along)
    x, y, half, low, high, power = (column[:, None] for column in values.T)
    angle = 2 * np.pi * np.arange(points) / points
    side, up = -np.sin(angle), np.cos(angle)
    wide, tall = (np.sign(part) * np.abs(part) ** (2 / power) for part in (side, up))
    ring = np.stack(
        [np.broadcast_to(x, wide.shape), y + half * wide, (low + high) / 2 + (high - low) / 2 * tall], axis=-1
    )
    return grid(
        role,
        ring,
        finish[np.searchsorted(place, along + 1e-9, side="right") - 1],
        mirrored=mirrored,
        texel_share=texel_share,
    )


def revolved(
    role: str,
    profile: ArrayLike,
    points: int,
    center_m: ArrayLike = (0.0, 0.0, 0.0),
    mirrored: bool = False,
    texel_share: float = 1.0,
) -> SurfaceGrid:
    """A body of revolution around a line along x.

    Args:
        role: see `SurfaceGrid`.
        profile: rows (x, radius, finish) from nose to tail, and inwards again for a tunnel. [m]
        points: around it.
        center_m: (3,) where the profile's x = 0 lies on the axis.
        mirrored, texel_share: see `SurfaceGrid`.
    """
    table = np.asarray(profile, dtype=np.float64)
    angle = 2 * np.pi * np.arange(points) / points
    ring = np.empty((len(table), points, 3))
    ring[..., 0] = table[:, :1]
    ring[..., 1] = -np.sin(angle) * table[:, 1:2]
    ring[..., 2] = np.cos(angle) * table[:, 1:2]
    return grid(
        role,
        ring + np.asarray(center_m, dtype=np.float64),
        table[:, 2].astype(np.uint8),
        mirrored=mirrored,
        texel_share=texel_share,
    )


@dataclass(frozen=True)
class WingStation:
    """One section of a lifting surface.

    Attributes:
        x_m: of the leading edge.
        y_m, z_m: of the chord line.
        chord_m: from nose to tail of the section.
        thickness: over the chord.
        twist_deg: nose up.
        cut: share of the chord after which the section ends bluntly.
        camber: of the mean line over the chord.
    """

    x_m: float
    y_m: float
    z_m: float
    chord_m: float
    thickness: float = 0.12
    twist_deg: float = 0.0
    cut: float = 1.0
    camber: float = 0.015


def aerofoil(points: int, thickness: float, camber: float = 0.0) -> Array:
    """(points, 2) outline of a section of chord 1, from the trailing edge along the lower side to the nose and back.

    Source: NACA four-digit thickness law with the coefficient that closes the trailing edge, which is then opened by
    `TRAILING_EDGE_FRACTION`; parabolic mean line.
    """
    x = (1 + np.cos(np.linspace(0.0, np.pi, points // 2))) / 2
    half = thickness / 0.2 * (0.2969 * np.sqrt(x) - 0.1260 * x - 0.3516 * x**2 + 0.2843 * x**3 - 0.1036 * x**4)
    half = half + TRAILING_EDGE_FRACTION / 2 * x
    middle = 4 * camber * x * (1 - x)
    lower, upper = np.stack([x, middle - half], axis=-1), np.stack([x, middle + half], axis=-1)
    # The nose belongs to both sides once.
    return np.vstack([lower, upper[-2::-1]])


def lifting_surface(
    role: str,
    stations: Sequence[WingStation],
    points: int = 40,
    round_tip: bool = True,
    mirrored: bool = False,
    texel_share: float = 1.0,
) -> SurfaceGrid:
    """A wing, fin or blade through its stations, from root to tip; the tip is rounded.

    Args:
        role: see `SurfaceGrid`.
        stations: from root to tip, in the right half for wings and upwards for fins.
        points: around each section.
        round_tip: false for a flat end.
        mirrored, texel_share: see `SurfaceGrid`.
    """
    middles = np.array([(station.y_m, station.z_m) for station in stations])
    spans = np.gradient(middles, axis=0) if len(stations) > 2 else np.repeat(np.diff(middles, axis=0), 2, axis=0)
    spans = spans / np.maximum(np.linalg.norm(spans, axis=1, keepdims=True), 1e-9)
    for index in np.flatnonzero(np.linalg.norm(spans, axis=1) < 0.5):
        spans[index] = spans[index - 1]
    rings = [_section(station, span, points) for station, span in zip(stations, spans, strict=True)]
    if round_tip:
        rings += _tip(stations[-1], spans[-1], points)
    return grid(role, np.stack(rings), mirrored=mirrored, texel_share=texel_share)


def _section(station: WingStation, span: Array, points: int, flatness: float = 1.0) -> Array:
    outline = aerofoil(points, station.thickness * flatness, station.camber)
    if flatness == 0.0:
        outline[:, 1] = 4 * station.camber * outline[:, 0] * (1 - outline[:, 0])
    outline[:, 0] = np.minimum(outline[:, 0], station.cut)
    if station.cut < 1.0:
        outline = _cut_outline(outline, station, points)
    pitch = np.radians(station.twist_deg)
    # Turned around a quarter of the chord.
    x, z = outline[:, 0] - 0.25, outline[:, 1]
    along, up = 0.25 + np.cos(pitch) * x + np.sin(pitch) * z, -np.sin(pitch) * x + np.cos(pitch) * z
    ring = np.empty((len(outline), 3))
    ring[:, 0] = station.x_m + along * station.chord_m
    # The direction of thickness is the x axis crossed with the span.
    ring[:, 1] = station.y_m - span[1] * up * station.chord_m
    ring[:, 2] = station.z_m + span[0] * up * station.chord_m
    return ring


def _cut_outline(outline: Array, station: WingStation, points: int) -> Array:
    """Sections that end bluntly: the points behind the cut go to the two corners of the blunt end."""
    whole = aerofoil(points, station.thickness, station.camber)
    nose = len(whole) // 2
    lower, upper = whole[: nose + 1][::-1], whole[nose:]
    behind = whole[:, 0] >= station.cut
    low_z = np.interp(station.cut, lower[:, 0], lower[:, 1])
    high_z = np.interp(station.cut, upper[:, 0], upper[:, 1])
    result = outline.copy()
    result[behind, 1] = np.where(np.arange(len(whole))[behind] < nose, low_z, high_z)
    return result


def _tip(station: WingStation, span: Array, points: int) -> list[Array]:
    """Rings that round the tip and end in a line."""
    reach_m = 0.5 * station.thickness * station.chord_m
    rings = []
    for angle in np.radians([30.0, 60.0, 80.0, 90.0]):
        shrunk = 1 - 0.06 * (1 - np.cos(angle))
        moved = replace(
            station,
            x_m=station.x_m + (1 - shrunk) * station.chord_m * 0.7,
            y_m=station.y_m + span[0] * reach_m * np.sin(angle),
            z_m=station.z_m + span[1] * reach_m * np.sin(angle),
            chord_m=station.chord_m * shrunk,
        )
        rings.append(_section(moved, span, points, max(float(np.cos(angle)), 0.0) if angle < 1.57 else 0.0))
    return rings


def tapered(stations: Sequence[WingStation], y_m: float) -> WingStation:
    """The section of a lifting surface at one place along the span, between its stations."""
    places = [station.y_m for station in stations]
    values = {
        name: float(np.interp(y_m, places, [getattr(station, name) for station in stations]))
        for name in ("x_m", "z_m", "chord_m", "thickness", "twist_deg", "camber")
    }
    return WingStation(y_m=y_m, **values)


def wing_with_flaps(
    stations: Sequence[WingStation], flap_spans_m: Sequence[tuple[float, float]], flaps_deg: float, rings: int = 20
) -> list[SurfaceGrid]:
    """A right wing, cut where it has flaps, and the flaps behind it; each is mirrored.

    Args:
        stations: of the whole wing.
        flap_spans_m: inner and outer y of each flap.
        flaps_deg: deflection.
        rings: along the span, about.
    """
    hinge, edge_m = 0.76, 0.012
    places = [(float(y_m), 1.0) for y_m in np.linspace(stations[0].y_m, stations[-1].y_m, rings)]
    places += [(station.y_m, 1.0) for station in stations]
    cuts_m = _joined_spans(flap_spans_m)
    places = [(y_m, 1.0) for y_m, _ in places if not any(low - 0.1 < y_m < high + 0.1 for low, high in cuts_m)]
    for low_m, high_m in cuts_m:
        places += [(low_m, 1.0), (high_m, 1.0)]
        inner = [float(y_m) for y_m in np.linspace(low_m + edge_m, high_m - edge_m, 8)]
        inner += [station.y_m for station in stations if low_m + 0.1 < station.y_m < high_m - 0.1]
        places += [(y_m, hinge) for y_m in inner]
    flaps = [
        _flap(stations, low_m + 3 * edge_m, high_m - 3 * edge_m, hinge, flaps_deg) for low_m, high_m in flap_spans_m
    ]
    cuts = [replace(tapered(stations, y_m), cut=cut) for y_m, cut in sorted(set(places))]
    return [lifting_surface("wing", cuts, mirrored=True), *flaps]


def _joined_spans(spans_m: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Spans of flaps; those less than a metre apart have no piece of wing between them."""
    joined = [spans_m[0]]
    for low_m, high_m in spans_m[1:]:
        if low_m - joined[-1][1] < 1.0:
            joined[-1] = (joined[-1][0], high_m)
        else:
            joined.append((low_m, high_m))
    return joined


def _flap(stations: Sequence[WingStation], low_m: float, high_m: float, hinge: float, flaps_deg: float) -> SurfaceGrid:
    """A flap that fills the cut and moves backwards and downwards as it turns."""
    moved = flaps_deg / 40.0
    inner = [station.y_m for station in stations if low_m < station.y_m < high_m]
    sections = []
    for y_m in sorted({low_m, *inner, high_m}):
        wing = tapered(stations, y_m)
        chord_m = (1.0 - hinge + 0.03) * wing.chord_m
        back_m = (hinge - 0.03 + 0.10 * moved) * wing.chord_m
        drop = np.sin(np.radians(wing.twist_deg)) * (hinge - 0.25)
        sections.append(
            WingStation(
                x_m=wing.x_m + back_m,
                y_m=y_m,
                z_m=wing.z_m - (drop + 0.045 * moved - 0.006) * wing.chord_m,
                chord_m=chord_m,
                thickness=0.16,
                twist_deg=wing.twist_deg + flaps_deg,
                camber=0.02,
            )
        )
    return lifting_surface("flap", sections, points=24, round_tip=False, mirrored=True)
