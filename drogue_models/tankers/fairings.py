"""Fairings of an airframe: around wing roots and main gear, over flap tracks, and around a fuselage's hose."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drogue_models.tankers.airframe import Place
from drogue_models.tankers.airframe_grids import (
    Finish,
    SurfaceGrid,
    WingStation,
    body,
    lifting_surface,
    revolved,
    tapered,
)
from drogue_models.tankers.equipment import POD_TAIL_RADIUS_M, TUNNEL_RADIUS_M


def flap_tracks(
    wing: list[WingStation], places_m: tuple[float, ...], length: float, flaps_deg: float
) -> list[SurfaceGrid]:
    """Fairings over the tracks of the flaps, which move back with them."""
    tracks = []
    for y_m in places_m:
        section = tapered(wing, y_m)
        middle = (
            section.x_m + (0.86 + 0.04 * flaps_deg / 40) * section.chord_m,
            y_m,
            section.z_m - (0.075 + 0.03 * flaps_deg / 40) * section.chord_m,
        )
        tracks.append(_flap_track(middle, length * section.chord_m, 0.028 * section.chord_m + 0.06))
    return tracks


def hose_fairing(exit_m: Place, length_m: float, width_m: float, top_z_m: float) -> list[SurfaceGrid]:
    """A fuselage unit: a fairing under the belly that ends bluntly around the collar from which the hose comes."""
    x, y, z = exit_m
    low_m = z - 0.42
    fairing = body(
        "hose-unit",
        [
            (x - length_m, y, 0.1, z + 0.3, top_z_m, 2.4),
            (x - 0.85 * length_m, y, 0.30 * width_m, z, top_z_m, 2.4),
            (x - 0.5 * length_m, y, 0.5 * width_m, low_m, top_z_m, 2.8),
            (x - 0.12 * length_m, y, 0.5 * width_m, low_m, top_z_m, 2.8),
            (x - 0.15, y, 0.46 * width_m, low_m + 0.02, top_z_m, 2.8),
            # Back into the fairing, around the collar.
            (x - 0.151, y, 0.37, z - 0.37, z + 0.37, 2.0, Finish.METAL),
            (x - 0.60, y, 0.365, z - 0.365, z + 0.365, 2.0, Finish.DARK),
        ],
        28,
        40,
        texel_share=1.8,
    )
    paint, metal, dark = Finish.PAINT, Finish.METAL, Finish.DARK
    collar = [
        (-0.5, 0.0, paint),
        (-0.5, 0.36, paint),
        (-0.12, 0.36, paint),
        (-0.03, 0.30, metal),
        (0.0, POD_TAIL_RADIUS_M, metal),
        (0.0, TUNNEL_RADIUS_M + 0.02, metal),
        (-0.02, TUNNEL_RADIUS_M, dark),
        (-0.45, TUNNEL_RADIUS_M, dark),
        (-0.45, 0.0, dark),
    ]
    return [fairing, revolved("pod", collar, 40, exit_m, texel_share=2.0)]


def belly_fairing(nose_m: float, tail_m: float, half_m: float, low_m: float, high_m: float) -> SurfaceGrid:
    """The fairing around a low wing's root under a fuselage."""
    length_m = tail_m - nose_m
    return body(
        "fuselage-fairing",
        [
            (nose_m, 0.0, 0.3, low_m + 0.75, high_m, 2.5),
            (nose_m + 0.15 * length_m, 0.0, 0.85 * half_m, low_m + 0.2, high_m, 2.6),
            (nose_m + 0.35 * length_m, 0.0, half_m, low_m, high_m, 2.8),
            (nose_m + 0.65 * length_m, 0.0, half_m, low_m, high_m, 2.8),
            (nose_m + 0.87 * length_m, 0.0, 0.75 * half_m, low_m + 0.3, high_m, 2.6),
            (tail_m, 0.0, 0.2, low_m + 0.9, high_m, 2.5),
        ],
        30,
        40,
    )


def sponson(nose_m: float, tail_m: float, y_m: float, z_m: float, half_m: float) -> SurfaceGrid:
    """The fairing of the main gear at the side of a high-wing transport."""
    length_m = tail_m - nose_m
    shape = (
        (0.0, 0.06, -0.12, 0.12, 2.2),
        (0.12, 0.6, -0.72, 0.64, 2.3),
        (0.35, 1.0, -1.0, 1.0, 2.6),
        (0.68, 1.0, -1.0, 1.0, 2.6),
        (0.90, 0.55, -0.47, 0.64, 2.3),
        (1.0, 0.06, 0.12, 0.28, 2.0),
    )
    sections = [
        (nose_m + along * length_m, y_m, wide * half_m, z_m + low * half_m, z_m + high * half_m, power)
        for along, wide, low, high, power in shape
    ]
    return body("sponson", sections, 28, 32, mirrored=True)


def antenna(x_m: float, z_m: float, height_m: float) -> SurfaceGrid:
    """A blade antenna on the middle of a fuselage, upwards or with a negative height downwards."""
    foot, tip = z_m - 0.2 * height_m, z_m + height_m
    chord_m = 1.1 * abs(height_m)
    stations = [
        WingStation(x_m, 0.0, foot, chord_m, 0.09, camber=0.0),
        WingStation(x_m + 0.6 * abs(height_m), 0.0, tip, 0.5 * chord_m, 0.09, camber=0.0),
    ]
    return lifting_surface("antenna", stations, 16)


def wing_box(nose_m: float, tail_m: float, half_m: float, low_m: float, high_m: float) -> SurfaceGrid:
    """The fairing over the wing's middle on top of a fuselage."""
    length_m = tail_m - nose_m
    return body(
        "fuselage-fairing",
        [
            (nose_m, 0.0, 0.3, low_m, low_m + 0.85, 2.2),
            (nose_m + 0.2 * length_m, 0.0, 0.8 * half_m, low_m, high_m - 0.25, 2.4),
            (nose_m + 0.42 * length_m, 0.0, half_m, low_m, high_m, 2.6),
            (nose_m + 0.65 * length_m, 0.0, half_m, low_m, high_m - 0.05, 2.6),
            (tail_m, 0.0, 0.3, low_m, low_m + 0.8, 2.2),
        ],
        28,
        40,
    )


def _flap_track(middle_m: ArrayLike, length_m: float, radius_m: float) -> SurfaceGrid:
    """A slender body under a wing over the track of a flap; deeper than wide."""
    share = np.linspace(0.0, 1.0, 17)
    radius = radius_m * np.sin(np.pi * share**0.75) ** 0.8
    radius[[0, -1]] = 0.0
    profile = [(length_m * (s - 0.5), r, Finish.PAINT) for s, r in zip(share, radius, strict=True)]
    fairing = revolved("fairing", profile, 20, mirrored=True)
    return SurfaceGrid(
        fairing.role, fairing.points_m * [1.0, 0.8, 1.5] + np.asarray(middle_m), fairing.finish, True, 1.0
    )
