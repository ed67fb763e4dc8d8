"""Sampling a scene's tanker, its propellers in one exposure, and the line under a multirotor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.aircraft_ranges import TankerRanges
from datasets_manifest.recipe.recipe import Recipe
from drogue_models.parameters import DrogueParameters
from drogue_models.tankers.tanker import PROPELLERS, Tanker
from geometry.se3 import Array, RigidTransform
from scenes.environment_sampling import sample_uniform
from scenes.flight.suspension import HOSE_NODES, WORLD_FROM_TANKER, hose_tail_m

_FLAP_STEP_DEG = 5.0
_SWEEP_STEPS = 12
_LINE_SPREAD_DEG = 12.0


def tanker_of_scene(recipe: Recipe, scene_id: int) -> Tanker | None:
    """The tanker of a scene, or None for a wing with one pod in a recipe without `[tanker]`."""
    ranges = recipe.tanker
    if ranges is None:
        return None
    rng = frame_generator(recipe.stream_seed, scene_id, "tanker")
    variant_place, station_place, paint_place, light_place, nav_place = rng.random(5)
    variant = ranges.variants[_chosen([variant.weight for variant in ranges.variants], variant_place)]
    paints = ranges.paints_of(variant)
    # In steps, so that scenes share airframes.
    flaps_deg = _FLAP_STEP_DEG * round(sample_uniform(rng, ranges.flaps_deg) / _FLAP_STEP_DEG)
    return Tanker(
        type=variant.type,
        station=variant.stations[int(station_place * len(variant.stations))],
        paint=paints[_chosen([paint.weight for paint in paints], paint_place)].scheme,
        seed=int(rng.integers(2**31)),
        flaps_deg=flaps_deg,
        nav_lights=bool(nav_place < ranges.nav_light_scene_fraction),
        pod_light=ranges.pod_lights[int(light_place * len(ranges.pod_lights))],
        blade_phase_deg=float(np.floor(rng.random() * 360.0)),
    )


def _chosen(weights: Sequence[float], place: float) -> int:
    """Index of one of several choices by a place in [0, 1)."""
    ends = np.cumsum(weights)
    return int(np.searchsorted(ends, place * ends[-1], side="right"))


def tanker_at(tanker: Tanker | None, time_s: float, exposure_s: float) -> Tanker | None:
    """A tanker whose propellers have turned since the scene's beginning, and turn during the exposure.

    Args:
        tanker: of the scene.
        time_s: mid-exposure. [s]
        exposure_s: how long the shutter is open. [s]
    """
    if tanker is None or tanker.type not in PROPELLERS:
        return tanker
    propellers = PROPELLERS[tanker.type]
    whole_deg = 360.0 / propellers.blades
    # In steps, so that frames share meshes; what turns by less than half a step stands still.
    step_deg = whole_deg / _SWEEP_STEPS
    sweep_deg = min(whole_deg, step_deg * round(propellers.rate_deg_s * exposure_s / step_deg))
    phase_deg = (tanker.blade_phase_deg + propellers.rate_deg_s * time_s) % 360.0
    return tanker.model_copy(update={"blade_phase_deg": phase_deg, "blade_sweep_deg": sweep_deg})


def hang_line(
    rng: np.random.Generator,
    ranges: TankerRanges,
    drogue: DrogueParameters,
    left_from_drogue: RigidTransform,
    world_from_left: RigidTransform,
) -> tuple[RigidTransform, Array]:
    """Pose of a multirotor, and the line that holds a drogue at a given pose behind and below its belly.

    Args:
        rng: draws length, drop and side of the line.
        ranges: of the recipe.
        drogue: whose coupling the line enters.
        left_from_drogue, world_from_left: poses; world axes x east (the flight direction), y north, z up.

    Returns:
        `left_from_tanker`, and (17, 3) nodes from the coupling to the belly in the left camera. [m]
    """
    length_m, drop_deg = sample_uniform(rng, ranges.line_m), sample_uniform(rng, ranges.line_drop_deg)
    drop, side = np.radians(drop_deg), np.radians(rng.uniform(-_LINE_SPREAD_DEG, _LINE_SPREAD_DEG))
    ahead = np.array([np.cos(drop) * np.cos(side), np.cos(drop) * np.sin(side), np.sin(drop)])
    left_from_world = world_from_left.inverse()
    tail = left_from_drogue.apply([0.0, 0.0, hose_tail_m(drogue)])
    belly = tail + length_m * left_from_world.rotate(ahead)
    # A stiff line leaves the coupling along the drogue's axis and bends towards the belly.
    bend = tail + 0.35 * length_m * left_from_drogue.rotation[:, 2]
    s = np.linspace(0.0, 1.0, HOSE_NODES)[:, None]
    nodes: Array = (1 - s) ** 2 * tail + 2 * s * (1 - s) * bend + s**2 * belly
    return RigidTransform(left_from_world.rotation @ WORLD_FROM_TANKER, belly), nodes
