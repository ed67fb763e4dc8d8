"""Jet tankers in the proportions of their classes: four jets, a wide-body twin, and a high-wing twin.

Dimensions that a source gives are in each airframe's `dimensions`; all others are our estimates in proportion.
"""

from __future__ import annotations

from math import radians, tan

from drogue_models.tankers.airframe import (
    Airframe,
    Place,
    Roundel,
    SourceDimension,
    Trail,
    left_of,
    oil_trails,
    wing_pod,
)
from drogue_models.tankers.airframe_grids import (
    SurfaceGrid,
    WingStation,
    body,
    lifting_surface,
    tapered,
    wing_with_flaps,
)
from drogue_models.tankers.equipment import jet_nacelle, pylon
from drogue_models.tankers.fairings import antenna, belly_fairing, flap_tracks, hose_fairing, sponson, wing_box


def _engine(
    wing: list[WingStation], y_m: float, ahead_m: float, drop_m: float, length_m: float, radius_m: float
) -> tuple[list[SurfaceGrid], Place]:
    """A nacelle under a wing with its pylon, mirrored; and where its jet leaves."""
    section = tapered(wing, y_m)
    inlet = (section.x_m - ahead_m, y_m, section.z_m - drop_m)
    cowl = jet_nacelle(inlet, length_m, radius_m, mirrored=True)
    nose_m = inlet[0] + 0.28 * length_m
    root = inlet[2] + 0.75 * radius_m
    strut = pylon(
        (nose_m, y_m, root - 0.3 * radius_m, section.x_m + 0.30 * section.chord_m - nose_m),
        (
            section.x_m - 0.45 * ahead_m,
            y_m,
            section.z_m + 0.01 * section.chord_m,
            0.45 * ahead_m + 0.62 * section.chord_m,
        ),
        thickness=0.075,
        mirrored=True,
    )
    return [cowl, strut], (inlet[0] + 1.3 * length_m, y_m, inlet[2])


def four_jet(flaps_deg: float) -> Airframe:
    """A narrow-body tanker with four jets under a low swept wing, wing pods and a fuselage unit (707-320B class)."""
    source = "Boeing D6-58322, 707 Airplane Characteristics for Airport Planning: 707-320B/C"
    fuselage = body(
        "fuselage",
        [
            (0.0, 0.0, 0.0, -0.75, -0.75, 2.0),
            (0.35, 0.0, 0.55, -1.30, -0.10, 2.0),
            (1.6, 0.0, 1.10, -1.80, 0.75, 2.0),
            (3.1, 0.0, 1.50, -2.03, 1.70, 2.0),
            (5.2, 0.0, 1.82, -2.14, 2.10, 2.0),
            (7.5, 0.0, 1.88, -2.17, 2.16, 2.05),
            (28.0, 0.0, 1.88, -2.17, 2.16, 2.05),
            (33.0, 0.0, 1.74, -1.75, 2.15, 2.0),
            (39.0, 0.0, 1.10, -0.40, 2.0, 2.0),
            (43.2, 0.0, 0.45, 0.75, 1.72, 2.0),
            (44.35, 0.0, 0.12, 1.15, 1.45, 2.0),
        ],
        64,
        56,
    )
    slope = tan(radians(7.0))
    wing = [
        WingStation(12.6, 0.0, -1.40, 12.6, 0.145, 2.0),
        WingStation(17.4, 6.1, -1.35 + 4.4 * slope, 7.5, 0.115, 1.0),
        WingStation(29.55, 21.95, -1.35 + 20.2 * slope, 2.85, 0.10, -1.5),
    ]
    surfaces = [fuselage, *wing_with_flaps(wing, [(2.3, 7.6), (9.0, 14.3)], flaps_deg)]
    surfaces += flap_tracks(wing, (4.0, 6.6, 10.4, 13.2), 0.42, flaps_deg)
    trails = []
    for y_m in (8.3, 14.4):
        engine, jet = _engine(wing, y_m, 3.3, 1.45, 3.1, 0.82)
        surfaces += engine
        trails += [Trail(jet, 0.7, 6.0, 0.55), Trail(left_of(jet), 0.7, 6.0, 0.55)]
    pods, exit_m = wing_pod(wing, 19.0, (4.2, 0.40), 1.15)
    surfaces += pods
    unit_m = (34.6, 0.0, -2.02)
    surfaces += hose_fairing(unit_m, 4.6, 1.5, -0.6)
    tail = [
        WingStation(38.2, 0.0, 0.95, 5.3, 0.10, -1.5, camber=0.0),
        WingStation(43.95, 6.85, 0.95 + 6.85 * slope, 2.1, 0.09, -1.5, camber=0.0),
    ]
    fin = [
        WingStation(31.8, 0.0, 1.5, 9.2, 0.05, camber=0.0),
        WingStation(35.2, 0.0, 2.7, 6.3, 0.09, camber=0.0),
        WingStation(41.6, 0.0, 8.75, 2.9, 0.09, camber=0.0),
    ]
    surfaces += [lifting_surface("tailplane", tail, 32, mirrored=True), lifting_surface("fin", fin, 32)]
    surfaces.append(belly_fairing(12.8, 26.6, 2.3, -2.45, -0.3))
    surfaces += [
        antenna(9.2, -2.16, -0.34),
        antenna(29.4, -1.98, -0.34),
        antenna(10.0, 2.15, 0.36),
        antenna(20.0, 2.15, 0.36),
    ]
    tip = tapered(wing, 21.95)
    right = (tip.x_m + 0.55, 22.12, tip.z_m)
    return Airframe(
        grids=tuple(surfaces),
        rotors=(),
        stations_m={"left-pod": left_of(exit_m), "right-pod": exit_m, "centreline": unit_m},
        nav_lights_m=(left_of(right), right, (44.36, 0.0, 1.3)),
        dimensions=(
            SourceDimension("length", 46.61, source),
            SourceDimension("span", 44.42, source),
            SourceDimension("fuselage_width", 3.76, source),
            SourceDimension("tailplane_span", 13.95, source),
        ),
        trails=(*trails, *oil_trails((exit_m, left_of(exit_m), unit_m))),
        roundels=(Roundel("fuselage", (32.0, 0.0, 0.5), 0.85, 1), Roundel("wing", (25.3, 16.6, 0.0), 1.0, 2, True)),
        deck_m=(2.0, 4.2, 0.62),
        belt_z_m=0.55,
        belly_line_m=(13.0, 30.0),
    )


def twin_jet_wide(flaps_deg: float) -> Airframe:
    """A wide-body tanker with two large jets, winglets, wing pods and a fuselage unit (A330-200 class)."""
    source = "Airbus, A330 Aircraft Characteristics, Airport and Maintenance Planning: A330-200"
    fuselage = body(
        "fuselage",
        [
            (0.0, 0.0, 0.0, -0.95, -0.95, 2.0),
            (0.30, 0.0, 0.75, -1.65, -0.20, 2.0),
            (1.7, 0.0, 1.65, -2.35, 1.10, 2.0),
            (3.6, 0.0, 2.35, -2.68, 2.30, 2.0),
            (6.5, 0.0, 2.78, -2.82, 2.78, 2.0),
            (8.5, 0.0, 2.82, -2.82, 2.82, 2.0),
            (37.5, 0.0, 2.82, -2.82, 2.82, 2.0),
            (43.0, 0.0, 2.66, -2.20, 2.82, 2.0),
            (50.0, 0.0, 1.78, -0.35, 2.72, 2.0),
            (55.5, 0.0, 0.75, 1.10, 2.40, 2.0),
            (57.5, 0.0, 0.28, 1.62, 2.12, 2.0),
        ],
        72,
        64,
    )
    rise = tan(radians(5.6))
    wing = [
        WingStation(17.2, 0.0, -1.75, 13.4, 0.15, 3.5),
        WingStation(19.3, 2.8, -1.60, 11.0, 0.15, 3.5),
        WingStation(23.6, 9.37, -1.55 + 6.55 * rise, 7.35, 0.115, 1.5),
        WingStation(30.1, 19.3, -1.45 + 16.5 * rise, 4.95, 0.11, 0.0),
        WingStation(36.1, 28.7, -1.05 + 25.9 * rise, 2.65, 0.105, -1.5),
    ]
    surfaces = [fuselage, *wing_with_flaps(wing, [(3.0, 9.0), (9.9, 19.6)], flaps_deg, 24)]
    tip = wing[-1]
    winglet = [
        tip,
        WingStation(36.75, 29.25, tip.z_m + 0.18, 2.25, 0.10, -1.0),
        WingStation(37.45, 29.65, tip.z_m + 0.75, 1.75, 0.09, 0.0),
        WingStation(38.55, 30.05, tip.z_m + 1.95, 0.85, 0.08, 0.0),
    ]
    surfaces.append(lifting_surface("winglet", winglet, 32, mirrored=True))
    surfaces += flap_tracks(wing, (6.0, 10.8, 14.0, 17.2), 0.46, flaps_deg)
    engine, jet = _engine(wing, 9.37, 5.0, 2.35, 4.6, 1.46)
    surfaces += engine
    pods, exit_m = wing_pod(wing, 19.2, (4.6, 0.44), 1.30)
    surfaces += pods
    unit_m = (43.6, 0.0, -2.55)
    surfaces += hose_fairing(unit_m, 5.2, 1.7, -1.2)
    tail = [
        WingStation(48.3, 0.0, 1.15, 6.9, 0.10, -1.5, camber=0.0),
        WingStation(56.25, 9.62, 1.15 + 9.6 * rise, 2.45, 0.09, -1.5, camber=0.0),
    ]
    fin = [
        WingStation(42.0, 0.0, 2.2, 12.0, 0.05, camber=0.0),
        WingStation(45.6, 0.0, 3.2, 8.3, 0.10, camber=0.0),
        WingStation(53.5, 0.0, 12.1, 3.6, 0.09, camber=0.0),
    ]
    surfaces += [lifting_surface("tailplane", tail, 32, mirrored=True), lifting_surface("fin", fin, 32)]
    surfaces.append(belly_fairing(15.5, 33.0, 3.05, -3.25, -0.6))
    surfaces += [
        antenna(10.5, -2.8, -0.38),
        antenna(35.5, -2.8, -0.38),
        antenna(12.0, 2.8, 0.38),
        antenna(26.0, 2.8, 0.38),
    ]
    right = (37.05, 29.45, tip.z_m + 0.45)
    return Airframe(
        grids=tuple(surfaces),
        rotors=(),
        stations_m={"left-pod": left_of(exit_m), "right-pod": exit_m, "centreline": unit_m},
        nav_lights_m=(left_of(right), right, (57.55, 0.0, 1.87)),
        dimensions=(
            SourceDimension("length", 58.82, source),
            SourceDimension("span", 60.30, source),
            SourceDimension("fuselage_width", 5.64, source),
            SourceDimension("tailplane_span", 19.40, source),
        ),
        trails=(
            Trail(jet, 1.1, 6.0, 0.3),
            Trail(left_of(jet), 1.1, 6.0, 0.3),
            *oil_trails((exit_m, left_of(exit_m), unit_m)),
        ),
        roundels=(Roundel("fuselage", (40.5, 0.0, 0.9), 0.95, 1), Roundel("wing", (33.5, 23.0, 0.0), 0.95, 2, True)),
        panel_m=2.2,
        deck_m=(2.1, 4.6, 0.75),
        belt_z_m=0.65,
        belly_line_m=(16.0, 38.0),
    )


def twin_jet_high_wing(flaps_deg: float) -> Airframe:
    """A military transport with two jets under a high wing, a T-tail, a loading ramp and wing pods (KC-390 class)."""
    source = "Embraer, C-390 Millennium data sheet: length 35.2 m, span 35.05 m"
    fuselage = body(
        "fuselage",
        [
            (0.0, 0.0, 0.0, -0.95, -0.95, 2.0),
            (0.30, 0.0, 0.62, -1.55, -0.35, 2.0),
            (1.7, 0.0, 1.35, -2.05, 0.55, 2.05),
            (3.4, 0.0, 1.85, -2.30, 1.75, 2.1),
            (6.0, 0.0, 2.20, -2.42, 2.18, 2.2),
            (8.5, 0.0, 2.28, -2.45, 2.25, 2.3),
            (20.5, 0.0, 2.28, -2.45, 2.25, 2.3),
            (24.0, 0.0, 2.18, -1.75, 2.22, 2.4),
            (28.5, 0.0, 1.62, -0.20, 2.10, 2.4),
            (32.2, 0.0, 0.80, 0.95, 1.95, 2.2),
            (33.6, 0.0, 0.22, 1.40, 1.78, 2.0),
        ],
        60,
        60,
    )
    wing = [
        WingStation(11.5, 0.0, 2.30, 6.9, 0.14, 2.5),
        WingStation(12.3, 2.2, 2.28, 6.3, 0.135, 2.5),
        WingStation(13.5, 5.6, 2.15, 5.0, 0.125, 1.5),
        WingStation(17.95, 17.35, 1.75, 2.2, 0.11, -1.0),
    ]
    surfaces = [fuselage, *wing_with_flaps(wing, [(2.5, 5.9), (6.2, 12.3)], flaps_deg)]
    surfaces += flap_tracks(wing, (4.0, 7.6, 9.6, 11.6), 0.5, flaps_deg)
    engine, jet = _engine(wing, 5.6, 4.3, 1.50, 3.5, 1.02)
    surfaces += engine
    pods, exit_m = wing_pod(wing, 13.6, (4.2, 0.40), 1.05, 0.95)
    surfaces += pods
    fin = [
        WingStation(24.0, 0.0, 1.7, 10.0, 0.05, camber=0.0),
        WingStation(27.4, 0.0, 2.8, 6.2, 0.12, camber=0.0),
        WingStation(30.2, 0.0, 7.05, 4.5, 0.12, camber=0.0),
    ]
    tail = [
        WingStation(29.9, 0.0, 7.15, 4.0, 0.11, -1.0, camber=0.0),
        WingStation(33.3, 6.0, 7.05, 1.9, 0.10, -1.0, camber=0.0),
    ]
    bullet = body(
        "fin-cap",
        [
            (29.2, 0.0, 0.0, 7.12, 7.12, 2.0),
            (29.5, 0.0, 0.20, 6.92, 7.34, 2.0),
            (30.8, 0.0, 0.36, 6.72, 7.50, 2.0),
            (33.2, 0.0, 0.32, 6.80, 7.42, 2.0),
            (34.4, 0.0, 0.08, 7.05, 7.20, 2.0),
        ],
        24,
        28,
    )
    surfaces += [lifting_surface("tailplane", tail, 32, mirrored=True), lifting_surface("fin", fin, 32), bullet]
    surfaces.append(sponson(12.0, 22.6, 2.05, -1.62, 0.85))
    surfaces.append(wing_box(9.8, 20.6, 1.7, 1.2, 2.95))
    surfaces += [antenna(7.5, -2.43, -0.32), antenna(22.2, -2.02, -0.30), antenna(8.0, 2.23, 0.34)]
    right = (18.6, 17.5, 1.75)
    return Airframe(
        grids=tuple(surfaces),
        rotors=(),
        stations_m={"left-pod": left_of(exit_m), "right-pod": exit_m},
        nav_lights_m=(left_of(right), right, (34.45, 0.0, 7.12)),
        dimensions=(
            SourceDimension("length", 35.20, source),
            SourceDimension("span", 35.05, source),
        ),
        trails=(
            Trail(jet, 0.8, 5.0, 0.45),
            Trail(left_of(jet), 0.8, 5.0, 0.45),
            *oil_trails((exit_m, left_of(exit_m))),
        ),
        roundels=(Roundel("fuselage", (23.2, 0.0, 0.6), 0.7, 1), Roundel("wing", (18.1, 15.4, 0.0), 0.62, 2, True)),
        deck_m=(2.0, 4.3, 0.45),
        belt_z_m=0.7,
    )
