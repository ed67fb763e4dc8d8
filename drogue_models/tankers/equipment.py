"""What hangs on an airframe: refuelling pods and stores, jet nacelles, pylons, propellers and lamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from drogue_models.solids import loft
from drogue_models.tankers.airframe_grids import (
    Finish,
    SurfaceGrid,
    WingStation,
    grid,
    lifting_surface,
    revolved,
)
from geometry.se3 import Array

TUNNEL_RADIUS_M, TUNNEL_DEPTH_M = 0.17, 0.8  # as of the wing with a pod
POD_TAIL_RADIUS_M = 0.27


def pod(length_m: float, radius_m: float, mirrored: bool = False) -> list[SurfaceGrid]:
    """A refuelling pod or buddy store, its hose exit at the origin: body, collar and the turbine at its nose.

    Proportions are those of pods of 4 to 5 m by 0.65 to 0.9 m: a long nose with the ram-air turbine's hub, a cylinder,
    and a boat tail that ends blunt around the hose's tunnel.
    """
    share = np.concatenate([np.linspace(0.0, 0.3, 12), np.linspace(0.36, 0.62, 5), np.linspace(0.68, 1.0, 11)])
    nose = np.sqrt(1 - (1 - np.minimum(share / 0.3, 1.0)) ** 2)
    tail = np.clip((share - 0.62) / 0.38, 0.0, 1.0)
    hub_m = 0.30 * radius_m
    radius = hub_m + (radius_m - hub_m) * nose - (radius_m - POD_TAIL_RADIUS_M) * (3 * tail**2 - 2 * tail**3)
    x = length_m * (share - 1)
    spinner = [
        (-length_m - 0.34 + 0.34 * (1 - np.cos(a)), hub_m * np.sin(a), Finish.METAL) for a in (0.0, 0.5, 1.0, 1.4)
    ]
    outside = [(float(a), float(b), Finish.PAINT) for a, b in zip(x, radius, strict=True)]
    collar = [
        (0.0, POD_TAIL_RADIUS_M - 0.015, Finish.METAL),
        (0.0, TUNNEL_RADIUS_M + 0.02, Finish.METAL),
        (-0.02, TUNNEL_RADIUS_M, Finish.DARK),
        (-TUNNEL_DEPTH_M, TUNNEL_RADIUS_M, Finish.DARK),
        (-TUNNEL_DEPTH_M, 0.0, Finish.DARK),
    ]
    grids = [revolved("pod", [*spinner, *outside, *collar], 48, mirrored=mirrored, texel_share=2.0)]
    for angle in np.radians([40.0, 130.0, 220.0, 310.0]):
        grids.append(_turbine_blade(float(angle), -length_m - 0.12, hub_m, radius_m, mirrored))
    return grids


def _turbine_blade(angle: float, x_m: float, hub_m: float, tip_m: float, mirrored: bool) -> SurfaceGrid:
    radial = np.array([0.0, np.sin(angle), np.cos(angle)])
    across = np.array([0.0, np.cos(angle), -np.sin(angle)])
    rings = []
    for radius_m, pitch_deg, chord_m in ((0.5 * hub_m, 30.0, 0.09), (0.6 * tip_m, 50.0, 0.08), (tip_m, 65.0, 0.05)):
        pitch = np.radians(pitch_deg)
        wide = (across * np.sin(pitch) + np.array([np.cos(pitch), 0.0, 0.0])) * chord_m / 2
        thick = np.cross(radial, wide) * 0.12
        turn = 2 * np.pi * np.arange(8) / 8
        rings.append(
            np.array([x_m, 0.0, 0.0]) + radial * radius_m + np.cos(turn)[:, None] * wide + np.sin(turn)[:, None] * thick
        )
    return grid("blade", np.stack(rings), Finish.METAL, mirrored=mirrored, texel_share=0.6)


def jet_nacelle(
    inlet_m: ArrayLike, length_m: float, radius_m: float, core: float = 0.42, mirrored: bool = False
) -> SurfaceGrid:
    """A turbofan's nacelle: intake with the fan's face, cowl, fan nozzle, core and plug.

    Args:
        inlet_m: (3,) middle of the intake's lip.
        length_m: of the fan cowl.
        radius_m: largest.
        core: radius of the core's nozzle over the cowl's; the core is as long as a third of the cowl.
        mirrored: see `SurfaceGrid`.
    """
    paint, metal, dark = Finish.PAINT, Finish.METAL, Finish.DARK
    face = 0.22
    shape = [
        (face - 0.10, 0.0, metal),
        (face - 0.06, 0.13, metal),
        (face, 0.26, dark),
        (face, 0.80, dark),
        (0.12, 0.80, metal),
        (0.02, 0.85, metal),
        (0.0, 0.885, metal),
        (0.008, 0.915, metal),
        (0.03, 0.945, metal),
        (0.075, 0.975, metal),
        (0.085, 0.98, paint),
        (0.18, 1.0, paint),
        (0.36, 1.0, paint),
        (0.55, 0.985, paint),
        (0.75, 0.93, paint),
        (0.90, 0.86, paint),
        (1.0, 0.80, paint),
        (1.0, 0.785, metal),
        (0.90, 0.79, dark),
        (0.90, 0.66, dark),
        (0.98, 0.655, metal),
        (1.10, 0.60, metal),
        (1.22, 0.53, metal),
        (1.34, core, metal),
        (1.34, core - 0.015, dark),
        (1.26, core - 0.01, dark),
        (1.26, 0.26, dark),
        (1.34, 0.22, metal),
        (1.44, 0.13, metal),
        (1.52, 0.0, metal),
    ]
    profile = [(x * length_m, r * radius_m, finish) for x, r, finish in shape]
    return revolved("nacelle", profile, 48, inlet_m, mirrored=mirrored, texel_share=1.3)


def pylon(
    low: tuple[float, float, float, float],
    high: tuple[float, float, float, float],
    thickness: float = 0.10,
    mirrored: bool = False,
) -> SurfaceGrid:
    """A pylon between two sections (x of the nose, y, z, chord), from inside the lower body to inside the upper one."""
    stations = [
        WingStation(x, y, z, chord, thickness=thickness, camber=0.0)
        for x, y, z, chord in (tuple(np.array(low) * (1 - s) + np.array(high) * s) for s in (0.0, 0.33, 0.67, 1.0))
    ]
    return lifting_surface("pylon", stations, points=28, round_tip=False, mirrored=mirrored)


def stowed_drogue() -> SurfaceGrid:
    """What shows of a drogue that is drawn into its tunnel, in the axes of `pod`: the folded canopy's lip and cone."""
    rubber = Finish.RUBBER
    profile = [
        (-0.62, 0.0, rubber),
        (-0.62, 0.09, rubber),
        (-0.10, 0.12, rubber),
        (0.04, 0.155, rubber),
        (0.055, 0.150, rubber),
        (0.04, 0.140, rubber),
        (-0.25, 0.055, rubber),
        (-0.25, 0.0, rubber),
    ]
    return revolved("stowed-drogue", profile, 32)


@dataclass(frozen=True)
class Rotor:
    """A propeller or rotor.

    Attributes:
        center_m: (3,) of the disc.
        axis: (3,) unit vector of thrust.
        radius_m, root_m: where the blades end and begin.
        blades: number.
        root_chord_m, tip_chord_m: of each blade.
        pitch_deg: of root and tip out of the disc's plane.
        clockwise: seen from behind the disc.
        slivers: of a disc that turns fully; at least the pixels around it at the nearest distance.
    """

    center_m: tuple[float, float, float]
    axis: tuple[float, float, float]
    radius_m: float
    root_m: float
    blades: int
    root_chord_m: float
    tip_chord_m: float
    pitch_deg: tuple[float, float] = (55.0, 30.0)
    clockwise: bool = True
    slivers: int = 1200


def rotor_mesh(rotor: Rotor, phase_deg: float, sweep_deg: float) -> trimesh.Trimesh:
    """The blades of a rotor: standing still, or spread over the angle through which they turn.

    A moving blade covers each place of its sector for a share of the time. So the sector gets thin opaque slivers that
    cover this share of it: together they are as wide as the blade.
    """
    axis = np.array(rotor.axis)
    first = np.cross(axis, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first) * (1.0 if rotor.clockwise else -1.0)
    sweep_deg = min(sweep_deg, 360.0 / rotor.blades)
    starts = np.radians(phase_deg + 360.0 * np.arange(rotor.blades) / rotor.blades)
    if sweep_deg == 0.0:
        blades = [_blade(rotor, first, second, float(angle)) for angle in starts]
        return trimesh.util.concatenate(blades)
    count = int(np.ceil(rotor.slivers * sweep_deg / 360.0))
    # Unequal steps, because equal ones make patterns with the pixels.
    uneven = 0.8 * (np.random.default_rng(count).random((rotor.blades, count)) - 0.5)
    steps = np.radians(sweep_deg) * ((np.arange(count) + 0.5 + uneven) / count - 0.5)
    angle = (starts[:, None] + steps).ravel()
    along = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    across = -np.sin(angle)[:, None] * first + np.cos(angle)[:, None] * second
    thin = 0.0005 * rotor.radius_m * axis
    corners = []
    for radius_m, chord_m, pitch, lift in (
        (rotor.root_m, rotor.root_chord_m, rotor.pitch_deg[0], 1.0),
        (rotor.radius_m, rotor.tip_chord_m, rotor.pitch_deg[1], -1.0),
    ):
        half_m = chord_m * np.cos(np.radians(pitch)) / count / 2
        corners += [along * radius_m - across * half_m + lift * thin, along * radius_m + across * half_m - lift * thin]
    points = np.stack(corners, axis=1) + np.array(rotor.center_m)
    # A flat tetrahedron over the sliver's four corners.
    faces = np.array([[0, 1, 2], [1, 3, 2], [0, 3, 1], [0, 2, 3]])
    if np.dot(np.cross(points[0, 1] - points[0, 0], points[0, 2] - points[0, 0]), points[0, 3] - points[0, 0]) > 0:
        faces = faces[:, ::-1]
    every = (4 * np.arange(len(points))[:, None, None] + faces).reshape(-1, 3)
    return trimesh.Trimesh(points.reshape(-1, 3), every, process=False)


def _blade(rotor: Rotor, first: Array, second: Array, angle: float) -> trimesh.Trimesh:
    """One blade that stands still: twisted, with a rounded tip."""
    axis = np.array(rotor.axis)
    along = np.cos(angle) * first + np.sin(angle) * second
    across = -np.sin(angle) * first + np.cos(angle) * second
    turn = 2 * np.pi * np.arange(10) / 10
    rings = []
    for share in (0.0, 0.15, 0.35, 0.6, 0.85, 0.96, 1.0):
        radius_m = rotor.root_m + share * (rotor.radius_m - rotor.root_m)
        chord_m = rotor.root_chord_m + share * (rotor.tip_chord_m - rotor.root_chord_m)
        chord_m *= 1.0 + 0.18 * np.sin(np.pi * share) if share < 0.97 else 0.55
        # Its width in the disc's plane changes evenly, as that of a sliver does.
        flat = np.cos(np.radians(rotor.pitch_deg))
        pitch = np.arccos(flat[0] + share * (flat[1] - flat[0]))
        wide = (across * np.cos(pitch) + axis * np.sin(pitch)) * chord_m / 2
        thick = np.cross(along, wide) * (0.24 - 0.16 * min(1.0, 2 * share))
        rings.append(
            np.array(rotor.center_m) + along * radius_m + np.cos(turn)[:, None] * wide + np.sin(turn)[:, None] * thick
        )
    return loft(np.stack(rings))


def lamp_mesh(center_m: Sequence[float], radius_m: float) -> trimesh.Trimesh:
    """The lens of a lamp: a ball, mostly outside the surface that it sits on."""
    # Status lamps of a pod are a few pixels wide at most.
    ball = trimesh.creation.icosphere(subdivisions=2 if radius_m > 0.03 else 1, radius=radius_m)
    ball.apply_translation(np.asarray(center_m, dtype=np.float64))
    return ball
