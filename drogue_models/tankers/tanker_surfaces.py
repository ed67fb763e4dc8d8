"""A tanker as painted surfaces in the tanker frame, whose origin is where the hose leaves."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray

from drogue_models.painted_mesh import PaintedMesh
from drogue_models.tankers.aircraft_paint import SCHEMES, paint_aircraft
from drogue_models.tankers.airframe import Place
from drogue_models.tankers.atlas import Chart, lay_out
from drogue_models.tankers.equipment import POD_TAIL_RADIUS_M, TUNNEL_RADIUS_M, lamp_mesh, rotor_mesh, stowed_drogue
from drogue_models.tankers.planforms import airframe, grid_mesh, joined_mesh
from drogue_models.tankers.tanker import PaintScheme, Tanker, TankerType
from geometry.se3 import Array

_RED, _GREEN, _WHITE, _AMBER = (1.0, 0.04, 0.02), (0.03, 1.0, 0.25), (1.0, 0.95, 0.85), (1.0, 0.45, 0.02)
# Mean luminance of a lens: 40 cd (14 CFR 25.1391, forward; 20 cd aft) from 0.1 m, so thousands of cd/m2. [cd/m2]
_NAV_LUMINANCE_CD_M2 = 3000.0
# Floodlit or fluorescent status lamps, readable against a lit sky (our choice). [cd/m2]
_POD_LUMINANCE_CD_M2 = 2500.0
_POD_LAMP_RADIUS_M = 0.028
_BLADE_RGB: dict[TankerType, tuple[float, float, float]] = {"multirotor": (0.035, 0.035, 0.037)}
_OTHER_BLADE_RGB = (0.055, 0.056, 0.058)
_CANOPY_RGB = (0.14, 0.14, 0.13)  # of a drogue that is drawn in: grey cloth, a little soiled (our choice)


def tanker_surfaces(tanker: Tanker) -> tuple[PaintedMesh, ...]:
    """All surfaces of a tanker in its frame: the airframe, drawn-in drogues, lamps and propellers. [m]"""
    return (
        *_fixed_surfaces(tanker.model_copy(update={"blade_phase_deg": 0.0, "blade_sweep_deg": 0.0})),
        *_blades(tanker),
    )


def airframe_size_m(tanker: Tanker) -> Array:
    """(3,) length, span and height of the airframe. [m]"""
    mesh, _ = _airframe_mesh(tanker.type, tanker.flaps_deg)
    return np.asarray(mesh.extents)


# A map takes 25 MB, and frames of one scene follow each other or are far apart.
@lru_cache(maxsize=3)
def _fixed_surfaces(tanker: Tanker) -> tuple[PaintedMesh, ...]:
    frame = airframe(tanker.type, tanker.flaps_deg)
    origin = -np.array(frame.stations_m[tanker.station])
    mesh, uv = _airframe_mesh(tanker.type, tanker.flaps_deg)
    moved = trimesh.Trimesh(mesh.vertices + origin, mesh.faces, vertex_normals=mesh.vertex_normals, process=False)
    paint = _paint(tanker.type, tanker.flaps_deg, tanker.paint, tanker.seed)
    return (PaintedMesh(moved, paint, uv, smooth=True), *_stowed_drogues(tanker, origin), *_lamps(tanker, origin))


@lru_cache(maxsize=48)
def _charts(tanker_type: TankerType, flaps_deg: float) -> tuple[Chart, ...]:
    return tuple(lay_out(airframe(tanker_type, flaps_deg).grids))


@lru_cache(maxsize=48)
def _airframe_mesh(tanker_type: TankerType, flaps_deg: float) -> tuple[trimesh.Trimesh, Array]:
    charts = _charts(tanker_type, flaps_deg)
    return joined_mesh(airframe(tanker_type, flaps_deg).grids, lambda index: charts[index].uv, np.zeros(3))


def _paint(tanker_type: TankerType, flaps_deg: float, paint: PaintScheme, seed: int) -> NDArray[np.float32]:
    frame = airframe(tanker_type, flaps_deg)
    return paint_aircraft(frame, _charts(tanker_type, flaps_deg), SCHEMES[paint], seed)


def _stowed_drogues(tanker: Tanker, origin: Array) -> list[PaintedMesh]:
    """Drogues at the stations that are not in use."""
    exits = airframe(tanker.type, tanker.flaps_deg).stations_m
    others = [grid_mesh(stowed_drogue().moved(place)) for name, place in exits.items() if name != tanker.station]
    if not others:
        return []
    mesh = trimesh.util.concatenate(others)
    mesh.apply_translation(origin)
    return [PaintedMesh(mesh, np.array(_CANOPY_RGB))]


@lru_cache(maxsize=4)
def _blades(tanker: Tanker) -> tuple[PaintedMesh, ...]:
    frame = airframe(tanker.type, 0.0)
    if not frame.rotors:
        return ()
    origin = np.array(frame.stations_m[tanker.station])
    meshes = [
        # Propellers are not in step.
        rotor_mesh(rotor, tanker.blade_phase_deg + 37.0 * index, tanker.blade_sweep_deg)
        for index, rotor in enumerate(frame.rotors)
    ]
    mesh = trimesh.util.concatenate(meshes)
    mesh.apply_translation(-origin)
    rgb = np.array(_BLADE_RGB.get(tanker.type, _OTHER_BLADE_RGB))
    return (PaintedMesh(mesh, rgb),)


def _lamps(tanker: Tanker, origin: Array) -> list[PaintedMesh]:
    frame = airframe(tanker.type, tanker.flaps_deg)
    lamps = []
    for place, color in zip(frame.nav_lights_m, (_RED, _GREEN, _WHITE), strict=True):
        lamps.append(_lamp([place], frame.nav_light_radius_m, color, _NAV_LUMINANCE_CD_M2, tanker.nav_lights, origin))
    if frame.pod_lights:
        exit_m = frame.stations_m[tanker.station]
        for turn_deg, name, color in ((35.0, "amber", _AMBER), (90.0, "green", _GREEN), (145.0, "red", _RED)):
            places = [_beside(exit_m, side * turn_deg) for side in (1.0, -1.0)]
            shines = tanker.pod_light == name
            lamps.append(_lamp(places, _POD_LAMP_RADIUS_M, color, _POD_LUMINANCE_CD_M2, shines, origin))
    return lamps


def _beside(exit_m: Place, turn_deg: float) -> Place:
    """A place on the collar around the hose's exit, by the angle from up."""
    turn, radius_m = np.radians(turn_deg), (POD_TAIL_RADIUS_M + TUNNEL_RADIUS_M + 0.02) / 2
    return exit_m[0], exit_m[1] + radius_m * float(np.sin(turn)), exit_m[2] + radius_m * float(np.cos(turn))


def _lamp(
    places_m: list[Place], radius_m: float, color: tuple[float, float, float], cd_m2: float, shines: bool, origin: Array
) -> PaintedMesh:
    mesh = trimesh.util.concatenate([lamp_mesh(place, radius_m) for place in places_m])
    mesh.apply_translation(origin)
    rgb = np.array(color)
    luminance = rgb @ np.array([0.2126, 0.7152, 0.0722])
    emission = cd_m2 * rgb / luminance if shines else np.zeros(3)
    return PaintedMesh(mesh, np.clip(0.05 + 0.35 * rgb, 0.01, 0.95), emission_cd_m2=emission, smooth=True)
