"""Small tankers with a buddy store: a twin-engined carrier fighter, and an unmanned one with a slender wing.

Dimensions that a source gives are in each airframe's `dimensions`; all others are our estimates in proportion.
"""

from __future__ import annotations

import numpy as np

from drogue_models.tankers.airframe import Airframe, Place, Roundel, SourceDimension, Trail, left_of, oil_trails
from drogue_models.tankers.airframe_grids import (
    Finish,
    SurfaceGrid,
    WingStation,
    body,
    lifting_surface,
    revolved,
    tapered,
    wing_with_flaps,
)
from drogue_models.tankers.equipment import pod, pylon

_STORE = (4.95, 0.33)  # length and radius of a buddy store: about 16 ft by 26 in, of D-704 and 31-301 class


def _store(exit_m: Place, hang_m: tuple[float, float, float], thickness: float = 0.09) -> list[SurfaceGrid]:
    """A buddy store with its pylon; `hang_m` is the pylon's nose, chord and top."""
    nose_m, chord_m, top_z_m = hang_m
    parts = [part.moved(exit_m) for part in pod(*_STORE)]
    low_z_m = exit_m[2] + 0.5 * _STORE[1]
    parts.append(
        pylon((nose_m, exit_m[1], low_z_m, chord_m), (nose_m, exit_m[1], top_z_m, chord_m), thickness=thickness)
    )
    return parts


def fighter(flaps_deg: float) -> Airframe:
    """A twin-engined, twin-finned carrier fighter with a buddy store under its belly (F/A-18E class)."""
    source = "Boeing, F/A-18E/F Super Hornet: length 60 ft 1.25 in, span 44 ft 8.5 in over the wing-tip rails"
    fuselage = body(
        "fuselage",
        [
            (0.0, 0.0, 0.0, -0.22, -0.22, 2.0),
            (0.35, 0.0, 0.14, -0.36, -0.07, 2.0),
            (1.6, 0.0, 0.40, -0.62, 0.20, 2.0),
            (3.6, 0.0, 0.62, -0.85, 0.50, 2.1),
            (6.0, 0.0, 0.78, -0.92, 0.66, 2.2),
            (8.2, 0.0, 1.05, -0.92, 0.72, 2.4),
            (10.0, 0.0, 1.32, -0.90, 0.68, 2.8),
            (13.0, 0.0, 1.36, -0.78, 0.60, 3.0),
            (15.2, 0.0, 1.16, -0.62, 0.52, 3.0),
            (16.2, 0.0, 0.80, -0.45, 0.40, 3.0),
            (16.75, 0.0, 0.30, -0.20, 0.22, 2.4),
        ],
        50,
        52,
        texel_share=1.3,
    )
    canopy = body(
        "canopy",
        [
            (2.9, 0.0, 0.04, 0.40, 0.44, 2.0),
            (3.5, 0.0, 0.32, 0.30, 0.86, 2.0),
            (4.6, 0.0, 0.43, 0.30, 1.18, 2.0),
            (5.8, 0.0, 0.40, 0.35, 1.08, 2.0),
            (7.6, 0.0, 0.06, 0.55, 0.72, 2.0),
        ],
        26,
        32,
    )
    spine = body(
        "fuselage-fairing",
        [
            (6.0, 0.0, 0.20, 0.3, 0.92, 2.0),
            (7.2, 0.0, 0.36, 0.3, 0.98, 2.0),
            (10.5, 0.0, 0.34, 0.3, 0.92, 2.0),
            (14.6, 0.0, 0.20, 0.3, 0.66, 2.0),
            (16.3, 0.0, 0.05, 0.1, 0.30, 2.0),
        ],
        24,
        28,
    )
    dark = Finish.DARK
    intake = body(
        "fuselage-fairing",
        [
            (8.6, 1.02, 0.22, -0.58, -0.02, 4.0, dark),
            (7.5, 1.06, 0.32, -0.74, 0.08, 5.0, dark),
            (7.2, 1.08, 0.36, -0.80, 0.14, 5.0, dark),
            (7.22, 1.08, 0.39, -0.84, 0.17, 5.0, Finish.PAINT),
            (8.4, 1.08, 0.44, -0.90, 0.20, 4.5),
            (11.0, 1.00, 0.48, -0.88, 0.20, 3.6),
            (14.0, 0.80, 0.52, -0.76, 0.25, 2.8),
            (15.4, 0.62, 0.54, -0.62, 0.44, 2.2),
            (16.5, 0.56, 0.48, -0.50, 0.44, 2.0),
        ],
        40,
        36,
        mirrored=True,
    )
    wing = [
        WingStation(8.35, 0.0, 0.32, 5.7, 0.055, 0.0),
        WingStation(9.05, 1.3, 0.32, 5.0, 0.055, 0.0),
        WingStation(10.95, 6.35, 0.05, 2.15, 0.045, -2.0),
    ]
    extension = [
        WingStation(4.3, 0.45, 0.36, 5.6, 0.035, 0.0, camber=0.0),
        WingStation(5.6, 0.95, 0.36, 4.6, 0.035, 0.0, camber=0.0),
        WingStation(7.6, 1.45, 0.34, 2.9, 0.035, 0.0, camber=0.0),
        WingStation(8.9, 1.62, 0.32, 1.6, 0.035, 0.0, camber=0.0),
    ]
    surfaces = [fuselage, canopy, spine, intake, *wing_with_flaps(wing, [(1.5, 4.3)], flaps_deg, 16)]
    surfaces.append(lifting_surface("wing-extension", extension, 28, mirrored=True))
    rail = [(0.0, 0.0, 0), (0.05, 0.05, 0), (0.25, 0.085, 0), (2.5, 0.085, 0), (2.75, 0.05, 0), (2.78, 0.0, 0)]
    tip = tapered(wing, 6.35)
    surfaces.append(revolved("rail", rail, 20, (tip.x_m - 0.35, 6.72, tip.z_m), mirrored=True))
    surfaces.append(
        body(
            "rail",
            [
                (tip.x_m + 0.05, 6.55, 0.14, tip.z_m - 0.03, tip.z_m + 0.03, 3.0),
                (tip.x_m + 2.05, 6.55, 0.14, tip.z_m - 0.03, tip.z_m + 0.03, 3.0),
            ],
            4,
            16,
            mirrored=True,
        )
    )
    tail = [
        WingStation(15.20, 1.03, -0.05, 2.65, 0.05, 0.0, camber=0.0),
        WingStation(16.85, 3.55, -0.12, 1.40, 0.04, 0.0, camber=0.0),
    ]
    lean = np.radians(20.0)
    fin = [
        WingStation(12.5, 0.95, 0.45, 3.0, 0.05, camber=0.0),
        WingStation(14.0, 0.95 + np.sin(lean) * 2.55, 0.45 + np.cos(lean) * 2.55, 1.45, 0.04, camber=0.0),
    ]
    surfaces += [
        lifting_surface("tailplane", tail, 28, mirrored=True),
        lifting_surface("fin", fin, 28, mirrored=True),
    ]
    metal = Finish.METAL
    nozzle = [
        (-2.2, 0.0, 0),
        (-2.1, 0.30, 0),
        (-1.5, 0.50, 0),
        (-0.8, 0.545, 0),
        (-0.75, 0.54, metal),
        (-0.35, 0.49, metal),
        (0.0, 0.41, metal),
        (0.0, 0.395, metal),
        (-0.25, 0.42, dark),
        (-0.7, 0.36, dark),
        (-0.75, 0.0, dark),
    ]
    surfaces.append(revolved("nozzle", nozzle, 48, (17.75, 0.56, -0.02), mirrored=True, texel_share=1.6))
    exit_m = (12.9, 0.0, -1.62)
    surfaces += _store(exit_m, (9.0, 2.3, -0.75), 0.07)
    for y_m in (3.35,):
        section = tapered(wing, y_m)
        tank = [
            (length, radius, 0)
            for length, radius in (
                (0.0, 0.0),
                (0.1, 0.1),
                (0.6, 0.25),
                (1.6, 0.34),
                (3.3, 0.34),
                (4.4, 0.2),
                (4.9, 0.0),
            )
        ]
        z_m = section.z_m - 0.85
        surfaces.append(revolved("tank", tank, 32, (section.x_m - 0.9, y_m, z_m), mirrored=True))
        surfaces.append(
            pylon(
                (section.x_m + 0.1, y_m, z_m + 0.2, 2.2),
                (section.x_m + 0.15, y_m, section.z_m, min(2.4, 0.7 * section.chord_m)),
                0.06,
                mirrored=True,
            )
        )
    right = (tip.x_m + 0.3, 6.80, tip.z_m + 0.03)
    jet = (17.3, 0.56, 0.0)
    return Airframe(
        grids=tuple(surfaces),
        rotors=(),
        stations_m={"buddy-store": exit_m},
        nav_lights_m=(left_of(right), right, (15.48, 0.95 + np.sin(lean) * 2.4, 0.45 + np.cos(lean) * 2.4)),
        nav_light_radius_m=0.05,
        dimensions=(
            SourceDimension("length", 18.31, source),
            SourceDimension("span", 13.62, source),
        ),
        trails=(
            Trail((15.6, 0.56, 0.0), 0.5, 2.0, 0.5),
            Trail((15.6, -0.56, 0.0), 0.5, 2.0, 0.5),
            Trail(jet, 0.5, 2.0, 0.5),
            *oil_trails((exit_m,)),
        ),
        roundels=(Roundel("fuselage", (6.6, 0.0, 0.05), 0.22, 1), Roundel("wing", (11.6, 4.9, 0.0), 0.35, 2, True)),
        panel_m=0.75,
        deck_m=None,
    )


def unmanned(flaps_deg: float) -> Airframe:
    """An unmanned tanker with a slender wing, a V-tail and a buddy store under its left wing (MQ-25 class)."""
    source = "Boeing, MQ-25 Stingray: length 51 ft, span 75 ft"
    fuselage = body(
        "fuselage",
        [
            (0.0, 0.0, 0.0, -0.10, -0.10, 2.0),
            (0.25, 0.0, 0.30, -0.32, 0.10, 2.0),
            (1.3, 0.0, 0.74, -0.72, 0.40, 2.2),
            (3.2, 0.0, 1.08, -0.98, 0.72, 2.5),
            (6.0, 0.0, 1.22, -1.05, 0.95, 2.7),
            (9.5, 0.0, 1.20, -1.00, 0.95, 2.7),
            (12.5, 0.0, 1.00, -0.62, 0.72, 2.6),
            (14.6, 0.0, 0.72, -0.26, 0.42, 2.8),
            (15.2, 0.0, 0.60, -0.16, 0.32, 3.2),
            (15.17, 0.0, 0.55, -0.12, 0.27, 3.2, Finish.DARK),
            (14.3, 0.0, 0.48, -0.10, 0.24, 3.0, Finish.DARK),
        ],
        52,
        52,
        texel_share=1.3,
    )
    wing = [
        WingStation(5.9, 0.0, 0.30, 3.1, 0.145, 1.5),
        WingStation(6.35, 1.1, 0.30, 2.65, 0.14, 1.5),
        WingStation(9.05, 11.3, 0.62, 1.05, 0.12, -1.0),
    ]
    surfaces = [fuselage, *wing_with_flaps(wing, [(1.5, 7.2)], flaps_deg, 20)]
    lean = np.radians(42.0)
    reach = 3.3
    tail = [
        WingStation(12.3, 0.45, 0.35, 2.4, 0.10, camber=0.0),
        WingStation(14.2, 0.45 + np.cos(lean) * reach, 0.35 + np.sin(lean) * reach, 1.28, 0.09, camber=0.0),
    ]
    surfaces.append(lifting_surface("tailplane", tail, 32, mirrored=True))
    inlet = body(
        "fuselage-fairing",
        [
            (3.4, 0.0, 0.20, 0.45, 0.72, 2.4),
            (4.2, 0.0, 0.46, 0.45, 1.02, 2.6),
            (6.0, 0.0, 0.58, 0.45, 1.15, 2.6),
            (10.0, 0.0, 0.50, 0.40, 1.02, 2.6),
            (13.4, 0.0, 0.10, 0.35, 0.55, 2.2),
        ],
        28,
        32,
    )
    surfaces.append(inlet)
    y_m = 2.6
    section = tapered(wing, y_m)
    exit_m = (section.x_m + 0.86 * section.chord_m + 0.9, -y_m, section.z_m - 1.02)
    surfaces += _store(exit_m, (section.x_m + 0.15, 1.7, section.z_m))
    tank = [
        (length, radius, 0)
        for length, radius in ((0.0, 0.0), (0.1, 0.1), (0.6, 0.24), (1.6, 0.32), (3.2, 0.32), (4.3, 0.18), (4.8, 0.0))
    ]
    surfaces.append(revolved("tank", tank, 32, (section.x_m - 1.5, y_m, section.z_m - 1.02)))
    surfaces.append(
        pylon((section.x_m + 0.15, y_m, section.z_m - 0.85, 1.7), (section.x_m + 0.15, y_m, section.z_m, 1.7), 0.09)
    )
    tip = tapered(wing, 11.3)
    right = (tip.x_m + 0.2, 11.38, tip.z_m)
    return Airframe(
        grids=tuple(surfaces),
        rotors=(),
        stations_m={"buddy-store": exit_m},
        nav_lights_m=(left_of(right), right, (15.2, 0.0, 0.36)),
        nav_light_radius_m=0.05,
        dimensions=(
            SourceDimension("length", 15.54, source),
            SourceDimension("span", 22.86, source),
        ),
        trails=(*oil_trails((exit_m,)),),
        roundels=(Roundel("fuselage", (8.6, 0.0, 0.05), 0.30, 1), Roundel("wing", (8.6, 6.9, 0.0), 0.40, 2, True)),
        panel_m=0.9,
        deck_m=None,
    )
