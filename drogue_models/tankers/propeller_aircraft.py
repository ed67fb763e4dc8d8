"""Tankers with propellers or rotors: a four-engined transport, a tilt-rotor in forward flight, and a multirotor.

Dimensions that a source gives are in each airframe's `dimensions`; all others are our estimates in proportion.
"""

from __future__ import annotations

from dataclasses import replace
from math import radians, tan

import numpy as np

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
    Finish,
    SurfaceGrid,
    WingStation,
    body,
    grid,
    lifting_surface,
    revolved,
    tapered,
    wing_with_flaps,
)
from drogue_models.tankers.equipment import Rotor
from drogue_models.tankers.fairings import antenna, flap_tracks, hose_fairing, sponson, wing_box

_FORWARD: Place = (-1.0, 0.0, 0.0)
_UP: Place = (0.0, 0.0, 1.0)


def four_turboprop(flaps_deg: float) -> Airframe:
    """A transport with four turboprops on a high straight wing, a loading ramp and wing pods (KC-130J class)."""
    source = "Lockheed Martin, C-130J data sheet: length 29.79 m, span 40.41 m; EASA TCDS P.003, R391: 4.11 m, 6 blades"
    fuselage = body(
        "fuselage",
        [
            (0.0, 0.0, 0.0, -0.75, -0.75, 2.0),
            (0.25, 0.0, 0.70, -1.40, -0.15, 2.0),
            (1.3, 0.0, 1.28, -1.85, 0.45, 2.0),
            (2.6, 0.0, 1.70, -2.05, 1.55, 2.0),
            (4.5, 0.0, 2.05, -2.15, 1.98, 2.1),
            (6.5, 0.0, 2.16, -2.17, 2.10, 2.15),
            (17.0, 0.0, 2.16, -2.17, 2.10, 2.15),
            (20.0, 0.0, 2.05, -1.55, 2.08, 2.2),
            (24.5, 0.0, 1.45, -0.05, 1.95, 2.2),
            (28.0, 0.0, 0.65, 0.98, 1.72, 2.1),
            (29.3, 0.0, 0.18, 1.25, 1.50, 2.0),
        ],
        52,
        48,
    )
    rise = tan(radians(2.5))
    wing = [
        WingStation(9.55, 0.0, 2.05, 4.95, 0.18, 3.0),
        WingStation(9.62, 4.9, 2.05 + 4.9 * rise, 4.85, 0.17, 2.5),
        WingStation(10.65, 19.95, 2.05 + 19.95 * rise, 2.55, 0.12, 0.0),
    ]
    surfaces = [fuselage, *wing_with_flaps(wing, [(2.3, 7.25), (7.3, 13.2)], flaps_deg)]
    surfaces += flap_tracks(wing, (3.6, 6.6, 8.9, 11.6), 0.30, flaps_deg)
    trails, rotors = [], []
    for y_m in (4.95, 10.15):
        section = tapered(wing, y_m)
        hub = (section.x_m - 2.75, y_m, section.z_m - 0.42)
        surfaces.append(_turboprop(hub, section, True))
        surfaces.append(revolved("spinner", _spinner(0.92, 0.36), 32, hub, mirrored=True))
        for side in (1.0, -1.0):
            rotors.append(Rotor((hub[0] - 0.30, side * y_m, hub[2]), _FORWARD, 2.055, 0.33, 6, 0.36, 0.24))
        exhaust = (section.x_m + 0.55 * section.chord_m, y_m, section.z_m - 0.65)
        trails += [Trail(exhaust, 0.6, 4.0, 0.7), Trail(left_of(exhaust), 0.6, 4.0, 0.7)]
    pods, exit_m = wing_pod(wing, 13.9, (4.3, 0.42), 1.05, 1.02)
    surfaces += pods
    fin = [
        WingStation(20.4, 0.0, 1.6, 8.6, 0.05, camber=0.0),
        WingStation(23.3, 0.0, 2.7, 5.6, 0.12, camber=0.0),
        WingStation(26.1, 0.0, 7.75, 2.7, 0.11, camber=0.0),
    ]
    tail = [
        WingStation(24.35, 0.0, 1.55, 4.5, 0.12, -1.0, camber=0.0),
        WingStation(25.7, 7.85, 1.75, 2.3, 0.10, -1.0, camber=0.0),
    ]
    # The rudder reaches beyond the fuselage's tail.
    cone = body(
        "fin-cap",
        [
            (28.2, 0.0, 0.20, 1.0, 1.7, 2.0),
            (29.2, 0.0, 0.16, 1.15, 1.6, 2.0),
            (29.79, 0.0, 0.03, 1.35, 1.45, 2.0),
        ],
        10,
        20,
    )
    surfaces += [lifting_surface("tailplane", tail, 32, mirrored=True), lifting_surface("fin", fin, 32), cone]
    surfaces += [sponson(9.4, 18.0, 1.92, -1.42, 0.72), wing_box(8.6, 15.6, 1.6, 1.1, 2.75)]
    surfaces += [antenna(6.2, -2.15, -0.32), antenna(14.6, -2.15, -0.30), antenna(16.2, 2.08, 0.34)]
    right = (11.2, 20.08, tapered(wing, 19.95).z_m)
    return Airframe(
        grids=tuple(surfaces),
        rotors=tuple(rotors),
        stations_m={"left-pod": left_of(exit_m), "right-pod": exit_m},
        nav_lights_m=(left_of(right), right, (29.82, 0.0, 1.4)),
        dimensions=(
            SourceDimension("length", 29.79, source),
            SourceDimension("span", 40.41, source),
            SourceDimension("propeller_diameter", 4.11, source),
            SourceDimension("tailplane_span", 16.05, "Lockheed, C-130 three-view drawing: tailplane span 52 ft 8 in"),
        ),
        trails=(*trails, *oil_trails((exit_m, left_of(exit_m)))),
        roundels=(Roundel("fuselage", (19.4, 0.0, 0.3), 0.62, 1), Roundel("wing", (11.5, 16.4, 0.0), 0.75, 2, True)),
        panel_m=1.3,
        deck_m=(1.4, 3.4, 0.35),
        belt_z_m=0.55,
    )


def _spinner(length_m: float, radius_m: float) -> list[tuple[float, float, int]]:
    nose = [
        (-length_m * np.cos(angle), radius_m * np.sin(angle), int(Finish.METAL)) for angle in np.linspace(0, 1.5, 9)
    ]
    return [*nose, (0.05, radius_m, int(Finish.DARK)), (0.05, 0.0, int(Finish.DARK))]


def _turboprop(hub: Place, wing: WingStation, mirrored: bool) -> SurfaceGrid:
    """A slender nacelle under a wing's leading edge, with its intake below the spinner."""
    x, y, z = hub
    tail_m = wing.x_m + 0.82 * wing.chord_m
    return body(
        "nacelle",
        [
            (x + 0.02, y, 0.34, z - 0.36, z + 0.34, 2.0),
            (x + 0.12, y, 0.44, z - 0.72, z + 0.42, 2.3),
            (x + 0.8, y, 0.55, z - 0.84, z + 0.50, 2.5),
            (x + 2.2, y, 0.56, z - 0.84, z + 0.62, 2.5),
            (wing.x_m + 0.35 * wing.chord_m, y, 0.48, z - 0.62, wing.z_m + 0.1, 2.3),
            (wing.x_m + 0.62 * wing.chord_m, y, 0.30, z - 0.28, wing.z_m + 0.05, 2.0),
            (tail_m, y, 0.03, z + 0.18, wing.z_m - 0.1, 2.0),
        ],
        26,
        28,
        mirrored=mirrored,
    )


def tilt_rotor(flaps_deg: float) -> Airframe:
    """A tilt-rotor with its nacelles forward, the hose leaving its open ramp (V-22 class)."""
    source = (
        "Bell Boeing, V-22 Osprey Pocket Guide: rotor diameter 38 ft, width with rotors 84 ft 7 in, fuselage 57 ft 4 in"
    )
    fuselage = body(
        "fuselage",
        [
            (0.0, 0.0, 0.0, -0.75, -0.75, 2.0),
            (0.25, 0.0, 0.42, -1.10, -0.35, 2.0),
            (1.3, 0.0, 0.85, -1.35, 0.35, 2.2),
            (2.8, 0.0, 1.10, -1.42, 1.00, 2.6),
            (4.5, 0.0, 1.18, -1.45, 1.22, 3.0),
            (11.2, 0.0, 1.18, -1.45, 1.22, 3.0),
            (12.6, 0.0, 1.12, -1.05, 1.20, 2.9),
            (14.6, 0.0, 0.90, -0.05, 1.12, 2.6),
            (16.6, 0.0, 0.55, 0.55, 1.02, 2.3),
            (17.2, 0.0, 0.20, 0.70, 0.95, 2.0),
        ],
        50,
        52,
    )
    wing = [
        WingStation(7.15, 0.0, 1.62, 2.55, 0.23, 2.0),
        WingStation(6.55, 6.75, 1.62 + 6.75 * tan(radians(3.5)), 2.55, 0.23, 2.0),
    ]
    surfaces = [fuselage, *wing_with_flaps(wing, [(1.4, 5.6)], flaps_deg, 14)]
    surfaces += [sponson(5.0, 12.6, 1.18, -0.92, 0.62), wing_box(6.0, 11.4, 1.05, 0.7, 2.02)]
    axis_z = wing[-1].z_m - 0.05
    y_m, hub_x = 7.10, 3.55
    nacelle = body(
        "nacelle",
        [
            (hub_x + 0.45, y_m, 0.44, axis_z - 0.46, axis_z + 0.44, 2.0),
            (hub_x + 0.9, y_m, 0.60, axis_z - 0.80, axis_z + 0.56, 2.3),
            (hub_x + 2.2, y_m, 0.66, axis_z - 0.98, axis_z + 0.66, 2.6),
            (hub_x + 4.3, y_m, 0.64, axis_z - 0.92, axis_z + 0.66, 2.6),
            (hub_x + 5.4, y_m, 0.50, axis_z - 0.62, axis_z + 0.52, 2.3),
            (hub_x + 5.9, y_m, 0.40, axis_z - 0.46, axis_z + 0.40, 2.1),
            (hub_x + 5.88, y_m, 0.35, axis_z - 0.41, axis_z + 0.35, 2.1, Finish.DARK),
            (hub_x + 5.2, y_m, 0.33, axis_z - 0.40, axis_z + 0.33, 2.1, Finish.DARK),
        ],
        36,
        36,
        mirrored=True,
    )
    surfaces += [nacelle, revolved("spinner", _spinner(0.85, 0.46), 32, (hub_x + 0.5, y_m, axis_z), mirrored=True)]
    rotors = tuple(
        Rotor((hub_x, side * y_m, axis_z), _FORWARD, 5.79, 0.42, 3, 0.90, 0.56, (62.0, 24.0), side > 0, 3600)
        for side in (1.0, -1.0)
    )
    tail = [
        WingStation(15.75, 0.0, 1.08, 1.7, 0.13, 0.0, camber=0.0),
        WingStation(15.75, 2.72, 1.08, 1.7, 0.13, 0.0, camber=0.0),
    ]
    fin_high = [
        WingStation(15.35, 2.80, 0.25, 1.55, 0.11, camber=0.0),
        WingStation(15.35, 2.80, 1.08, 2.1, 0.11, camber=0.0),
        WingStation(16.15, 2.80, 3.45, 1.35, 0.11, camber=0.0),
    ]
    surfaces += [
        lifting_surface("tailplane", tail, 28, round_tip=False, mirrored=True),
        lifting_surface("fin", fin_high, 28, mirrored=True),
    ]
    exit_m = (15.9, 0.0, -0.12)
    surfaces += hose_fairing(exit_m, 2.6, 0.9, 0.55)
    right = (hub_x + 3.4, y_m + 0.66, axis_z)
    jet = (hub_x + 5.9, y_m, axis_z)
    return Airframe(
        grids=tuple(surfaces),
        rotors=rotors,
        stations_m={"centreline": exit_m},
        nav_lights_m=(left_of(right), right, (17.25, 0.0, 0.85)),
        nav_light_radius_m=0.05,
        dimensions=(
            SourceDimension("length", 17.48, source),
            SourceDimension("width_with_rotors", 25.78, source),
            SourceDimension("propeller_diameter", 11.58, source),
        ),
        trails=(
            Trail((hub_x + 4.6, y_m, axis_z), 0.7, 4.0, 0.75),
            Trail((hub_x + 4.6, -y_m, axis_z), 0.7, 4.0, 0.75),
            Trail(jet, 0.7, 4.0, 0.6),
            *oil_trails((exit_m,)),
        ),
        roundels=(Roundel("fuselage", (10.4, 0.0, 0.2), 0.40, 1),),
        panel_m=0.9,
        deck_m=(1.0, 3.0, 0.05),
        belt_z_m=0.35,
        pod_lights=True,
    )


def multirotor(flaps_deg: float) -> Airframe:
    """A quadcopter on two-legged landing gear that carries the drogue on a line from its belly (DJI M210 class)."""
    del flaps_deg
    source = "DJI, Matrice 210 user manual: 883 x 886 x 398 mm with propellers, diagonal 643 mm, propellers 17 in"
    arm_m = 0.643 / 2 / np.sqrt(2.0)
    hull = body(
        "fuselage",
        [
            (-0.165, 0.0, 0.045, -0.020, 0.035, 3.0),
            (-0.155, 0.0, 0.062, -0.045, 0.048, 3.2),
            (-0.10, 0.0, 0.080, -0.060, 0.062, 3.4),
            (0.03, 0.0, 0.085, -0.062, 0.070, 3.4),
            (0.11, 0.0, 0.078, -0.055, 0.060, 3.4),
            (0.155, 0.0, 0.060, -0.040, 0.040, 3.2),
            (0.165, 0.0, 0.040, -0.020, 0.025, 3.0),
        ],
        26,
        40,
        texel_share=1.4,
    )
    surfaces = [hull]
    rotors = []
    for x_m in (-arm_m, arm_m):
        motor = (x_m, arm_m, 0.058)
        surfaces.append(_tube("arm", (0.45 * x_m, 0.055, 0.005), (x_m, arm_m, 0.035), 0.013, mirrored=True))
        can = [
            (-0.038, 0.0, Finish.PLASTIC),
            (-0.038, 0.017, Finish.PLASTIC),
            (-0.033, 0.020, Finish.PLASTIC),
            (-0.004, 0.020, Finish.METAL),
            (0.0, 0.022, Finish.PLASTIC),
            (0.012, 0.022, Finish.PLASTIC),
            (0.018, 0.017, Finish.DARK),
            (0.024, 0.0, Finish.DARK),
        ]
        surfaces.append(_upright(revolved("motor", can, 28, mirrored=True), motor))
        for side in (1.0, -1.0):
            rotors.append(
                Rotor(
                    (x_m, side * arm_m, 0.085),
                    _UP,
                    0.2160,
                    0.012,
                    2,
                    0.034,
                    0.017,
                    (24.0, 10.0),
                    bool(side * x_m > 0),
                )
            )
    for y_m in (0.055,):
        foot_y = 0.165
        surfaces.append(_tube("leg", (0.02, y_m, -0.045), (0.02, foot_y, -0.267), 0.0105, mirrored=True))
        surfaces.append(_tube("skid", (-0.15, foot_y, -0.274), (0.19, foot_y, -0.274), 0.0115, mirrored=True))
    for x_m in (-0.13, 0.17):
        surfaces.append(
            _tube(
                "skid", (x_m - 0.02, 0.165, -0.274), (x_m + 0.02, 0.165, -0.274), 0.0155, Finish.RUBBER, mirrored=True
            )
        )
    # Battery bays behind, antennas of the satellite receiver above, a camera on its gimbal in front.
    surfaces.append(_box("battery", (0.135, 0.036, 0.012), (0.085, 0.060, 0.085), mirrored=True))
    surfaces.append(_tube("mast", (0.05, 0.05, 0.06), (0.05, 0.05, 0.082), 0.005, mirrored=True))
    puck = [
        (-0.008, 0.0, 4),
        (-0.008, 0.026, 4),
        (0.0, 0.030, 4),
        (0.010, 0.030, 4),
        (0.018, 0.022, 4),
        (0.020, 0.0, 4),
    ]
    surfaces.append(_upright(revolved("antenna", puck, 28, mirrored=True), (0.05, 0.05, 0.088)))
    surfaces.append(_box("gimbal", (-0.135, 0.0, -0.082), (0.03, 0.05, 0.06)))
    lens = [(-0.03, 0.0, 2), (-0.03, 0.020, 2), (-0.028, 0.023, 1), (0.0, 0.028, 4), (0.05, 0.028, 4), (0.05, 0.0, 4)]
    surfaces.append(revolved("camera", lens, 28, (-0.155, 0.0, -0.125)))
    # The line comes from a hook under the middle.
    surfaces.append(_box("hook", (0.03, 0.0, -0.068), (0.06, 0.04, 0.02)))
    surfaces.append(_tube("hook", (0.03, 0.0, -0.07), (0.03, 0.0, -0.118), 0.008))
    right = (-arm_m - 0.012, arm_m, 0.018)
    return Airframe(
        grids=tuple(surfaces),
        rotors=tuple(rotors),
        stations_m={"belly": (0.03, 0.0, -0.12)},
        nav_lights_m=(left_of(right), right, (0.168, 0.0, 0.005)),
        nav_light_radius_m=0.006,
        dimensions=(
            SourceDimension("length_with_rotors", 0.883, source),
            SourceDimension("width_with_rotors", 0.886, source),
            SourceDimension("height", 0.398, source),
            SourceDimension("propeller_diameter", 0.432, source),
        ),
        panel_m=0.12,
        pod_lights=False,
    )


def _tube(
    role: str, start: Place, end: Place, radius_m: float, finish: int = Finish.PAINT, mirrored: bool = False
) -> SurfaceGrid:
    """A round tube with slightly rounded ends."""
    first, last = np.array(start), np.array(end)
    along = (last - first) / np.linalg.norm(last - first)
    helper = np.eye(3)[int(np.argmin(np.abs(along)))]
    wide = np.cross(along, helper)
    wide /= np.linalg.norm(wide)
    other = np.cross(along, wide)
    turn = 2 * np.pi * np.arange(20) / 20
    ring = np.cos(turn)[:, None] * wide + np.sin(turn)[:, None] * other
    ends = [(first, 0.8), (first + 0.2 * radius_m * along, 1.0), (last - 0.2 * radius_m * along, 1.0), (last, 0.8)]
    return grid(role, np.stack([place + share * radius_m * ring for place, share in ends]), finish, mirrored)


def _box(role: str, middle: Place, size_m: Place, mirrored: bool = False) -> SurfaceGrid:
    """A box with rounded edges."""
    x, y, z = middle
    length, width, height = size_m
    rows = []
    for share, fill in ((-0.5, 0.86), (-0.47, 0.97), (-0.42, 1.0), (0.42, 1.0), (0.47, 0.97), (0.5, 0.86)):
        half = height / 2 * fill
        rows.append((x + share * length, y, width / 2 * fill, z - half, z + half, 6.0))
    return body(role, rows, 8, 32, mirrored)


def _upright(part: SurfaceGrid, place: Place) -> SurfaceGrid:
    """A body along x, turned so that x points up, and moved."""
    turn = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    return replace(part, points_m=part.points_m @ turn.T + np.array(place))
