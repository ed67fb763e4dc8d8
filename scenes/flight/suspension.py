"""The hose between a drogue at a given pose and its tanker, in steady flight: shape, paint and the tanker's pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.aircraft_ranges import HoseRanges
from datasets_manifest.recipe.sequence_ranges import HoseParameters
from drogue_models.frozen_model import ReflectanceRgb
from drogue_models.parameters import BORE_LENGTH_FRACTION, DrogueParameters
from drogue_models.surface_looks import HoseBand, HoseLook
from geometry.se3 import Array, RigidTransform
from scenes.environment_sampling import sample_uniform
from scenes.flight.towed_hose import HOSE_LINKS, HoseEnds, hose_at_rest

# World axes of a tanker that flies east: aft, right wing, up.
WORLD_FROM_TANKER = np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
# Length of hose inside the coupling's tail, so that no gap shows, and at most so much of what is solid of the coupling,
# so that it does not show in the mouth.
_HOSE_OVERLAP_M, _HOSE_OVERLAP_FRACTION = 0.02, 0.9

HOSE_NODES = 17
# Position of the drogue behind and below the pod: equilibrium of a 15 m hose at 120 m/s in a lumped-mass model.
_TRAIL_AFT_M, _TRAIL_BELOW_M = 14.2, 4.9
_LATERAL_SPREAD_M = 0.6
# The hose leaves the pod nearly level and steepens towards the drogue.
_SLOPE_AT_POD = 0.2

_FOOT_M = 0.3048
_WHITE: ReflectanceRgb = (0.62, 0.61, 0.58)  # paint on rubber, a little dirty; our choice
_YELLOW: ReflectanceRgb = (0.62, 0.42, 0.05)
_ORANGE: ReflectanceRgb = (0.55, 0.17, 0.04)


@dataclass(frozen=True)
class SceneHose:
    """The hose of a scene.

    Attributes:
        parameters: with its length, scaled to the drogue.
        retracted: whether the drogue waits just behind the exit.
    """

    parameters: HoseParameters
    retracted: bool


def hose_of_scene(seed: int, scene_id: int, ranges: HoseRanges, drogue: DrogueParameters) -> SceneHose:
    """Length and weights of the hose in a scene."""
    rng = frame_generator(seed, scene_id, "hose")
    place, length_m = rng.random(), sample_uniform(rng, ranges.length_m)
    retracted_m = sample_uniform(rng, ranges.retracted_length_m)
    retracted = place < ranges.retracted_scene_fraction
    if retracted:
        length_m = retracted_m
    elif place >= 1 - ranges.trailed_scene_fraction:
        length_m = ranges.length_m.high
    model = ranges.model
    thicker = 2 * drogue.hose_radius_m / model.diameter_m
    wider = 2 * drogue.rim_radius_m / model.drogue_diameter_m
    changes = {
        "length_m": length_m,
        "diameter_m": 2 * drogue.hose_radius_m,
        "drogue_diameter_m": 2 * drogue.rim_radius_m,
        # Sections, and sheets of cloth and metal, weigh in proportion to their areas.
        "mass_per_length_kg_m": model.mass_per_length_kg_m * thicker**2,
        "drogue_mass_kg": model.drogue_mass_kg * wider**2,
    }
    return SceneHose(parameters=model.model_copy(update=changes), retracted=retracted)


def hose_look_of_scene(seed: int, scene_id: int, ranges: HoseRanges) -> HoseLook:
    """Paint of the hose in a scene."""
    rng = frame_generator(seed, scene_id, "hose look")
    grey = sample_uniform(rng, ranges.reflectance)
    banded, style = rng.random() < ranges.banded_scene_fraction, int(rng.integers(len(_BAND_STYLES)))
    paint = (_WHITE, _WHITE, _YELLOW, _ORANGE)[int(rng.integers(4))]
    bands = [
        HoseBand(start_m=start_ft * _FOOT_M, end_m=end_ft * _FOOT_M, reflectance_rgb=paint)
        for start_ft, end_ft in (_BAND_STYLES[style] if banded else ())
    ]
    return HoseLook(
        reflectance_rgb=(grey, grey, grey * 1.05),
        bands=tuple(bands),
        sheen_fraction=sample_uniform(rng, ranges.sheen_fraction),
        roughness=sample_uniform(rng, ranges.roughness),
        seed=int(rng.integers(2**31)),
    )


# Bands by their distances from the coupling. [ft] The first is the black 75 ft hose of the KDC-10's wing pods: four
# white marks of 1 ft every 10 ft, then two of 5 ft that bound the 20 ft in which fuel flows (Omega, "KDC-10 Air-to-Air
# Refueling Procedures", studylib.net/doc/5317882). The others are our variations: only the marks every 10 ft, and the
# fuel-flow zone filled with stripes of 1 ft.
_MARKS_FT = tuple((place, place + 1.0) for place in (10.0, 20.0, 30.0, 40.0))
_BAND_STYLES: tuple[tuple[tuple[float, float], ...], ...] = (
    (*_MARKS_FT, (45.0, 50.0), (70.0, 75.0)),
    (*_MARKS_FT, (50.0, 51.0), (60.0, 61.0), (70.0, 71.0)),
    ((10.0, 11.0), (20.0, 21.0), *((place, place + 1.0) for place in np.arange(25.0, 45.0, 2.0).tolist())),
)


def sample_suspension(
    rng: np.random.Generator,
    drogue: DrogueParameters,
    left_from_drogue: RigidTransform,
    world_from_left: RigidTransform,
) -> tuple[RigidTransform, Array]:
    """Tanker pose and centre line of a smooth curve as hose, for a drogue at a given pose in steady flight.

    Args:
        rng: draws the lateral offset.
        drogue: whose coupling the hose enters.
        left_from_drogue, world_from_left: poses; world axes x east (the flight direction), y north, z up.

    Returns:
        `left_from_tanker`, and (17, 3) nodes from the coupling to the pod in the left camera. [m]
    """
    left_from_world = world_from_left.inverse()
    offset_world = np.array([_TRAIL_AFT_M, rng.uniform(-_LATERAL_SPREAD_M, _LATERAL_SPREAD_M), _TRAIL_BELOW_M])
    pod = left_from_drogue.translation_m + left_from_world.rotate(offset_world)
    tail = left_from_drogue.apply([0.0, 0.0, hose_tail_m(drogue)])
    length_m = float(np.linalg.norm(pod - tail))
    start_tangent = left_from_drogue.rotation[:, 2] * length_m
    into_pod = left_from_world.rotate(np.array([1.0, 0.0, _SLOPE_AT_POD]))
    end_tangent = into_pod / np.linalg.norm(into_pod) * length_m
    s = np.linspace(0.0, 1.0, HOSE_NODES)[:, None]
    # Cubic Hermite curve: the drogue's own direction at one end, the pod's at the other.
    nodes = (
        (2 * s**3 - 3 * s**2 + 1) * tail
        + (s**3 - 2 * s**2 + s) * start_tangent
        + (3 * s**2 - 2 * s**3) * pod
        + (s**3 - s**2) * end_tangent
    )
    return RigidTransform(left_from_world.rotation @ WORLD_FROM_TANKER, pod), nodes


def hose_tail_m(drogue: DrogueParameters) -> float:
    """Where the hose begins on the drogue's axis, behind the rim plane. [m]"""
    solid_m = (1.0 - BORE_LENGTH_FRACTION) * drogue.coupling_length_m
    overlap_m = min(_HOSE_OVERLAP_M, _HOSE_OVERLAP_FRACTION * solid_m)
    return drogue.hub_depth_m + drogue.coupling_length_m - overlap_m


def hang_hose(
    rng: np.random.Generator,
    ranges: HoseRanges,
    hose: SceneHose,
    drogue: DrogueParameters,
    left_from_drogue: RigidTransform,
    world_from_left: RigidTransform,
) -> tuple[RigidTransform, Array]:
    """Tanker pose and centre line of the hose at rest behind a level tanker, for a drogue at a given pose.

    The tanker's heading is the one in which the drogue does not bend the hose to the side. A tanker with a retracted
    hose has the drogue's pitch, too, so that the drogue sits straight behind the exit.

    Args:
        rng: draws drop and swing of the frame.
        ranges: of the recipe.
        hose: of the scene.
        drogue: whose coupling the hose enters.
        left_from_drogue, world_from_left: poses; world axes x east, y north, z up.

    Returns:
        `left_from_tanker`, and (37, 3) nodes from the coupling to the exit in the left camera. [m]
    """
    drop_rad = np.radians(sample_uniform(rng, ranges.drop_deg))
    swing_rad = np.radians(sample_uniform(rng, ranges.swing_deg))
    axis = world_from_left.rotate(left_from_drogue.rotation[:, 2])
    elevation = float(np.arcsin(np.clip(axis[2], -1.0, 1.0)))
    heading = float(np.arctan2(axis[1], axis[0]))
    if hose.retracted:
        nodes = straight_hose_nodes_m(hose.parameters.length_m)
        pitch, entering = elevation, 0.0
    else:
        ends = HoseEnds(0.0, -elevation, float(drop_rad), float(swing_rad))
        nodes = hose_at_rest(hose.parameters, ends, ranges.airspeed_m_s).nodes_m
        pitch = 0.0
        last = nodes[-1] - nodes[-2]
        entering = float(np.arctan2(last[1], last[0]))
    world_from_tanker = _turned_about_up(heading - entering) @ WORLD_FROM_TANKER @ _pitched(pitch)
    left_from_tanker = world_from_left.rotation.T @ world_from_tanker
    tail = left_from_drogue.apply([0.0, 0.0, hose_tail_m(drogue)])
    nodes_left = tail + (nodes - nodes[-1]) @ left_from_tanker.T
    return RigidTransform(left_from_tanker, nodes_left[0]), nodes_left[::-1].copy()


def straight_hose_nodes_m(length_m: float) -> Array:
    """(37, 3) nodes of a hose straight out of the exit, in the tanker's axes. [m]"""
    nodes: Array = np.linspace(0.0, 1.0, HOSE_LINKS + 1)[:, None] * np.array([length_m, 0.0, 0.0])
    return nodes


def _turned_about_up(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])


def _pitched(nose_up: float) -> Array:
    """Rotation of tanker axes by which its x axis, aft, points down by an angle. [rad]"""
    return np.array(
        [[np.cos(nose_up), 0.0, np.sin(nose_up)], [0.0, 1.0, 0.0], [-np.sin(nose_up), 0.0, np.cos(nose_up)]]
    )
