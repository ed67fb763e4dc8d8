"""Sampling a scene's drogue and its condition, and the other objects of a frame."""

from __future__ import annotations

import numpy as np

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.drogue_ranges import AppearanceRanges, WearRanges
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.appearance import DrogueCondition, Obstacle, SurfaceCondition
from drogue_models.frozen_model import ReflectanceRgb
from drogue_models.obstacles import ObstacleShape
from drogue_models.parameters import RED_PAINT, WHITE_PAINT, DrogueParameters
from drogue_models.surface_wear import SurfaceWear
from geometry.se3 import Array, RigidTransform, rotation_from_angles
from geometry.stereo import StereoRig
from scenes.environment_sampling import sample_uniform

# Three markers determine a pose; fewer could not be distinguished from other things.
_FEWEST_MARKERS = 3
_PROBE_LENGTH_M = 6.0
_PROBE_GREY: ReflectanceRgb = (0.45, 0.45, 0.44)
_BLACK_RUBBER: ReflectanceRgb = (0.04, 0.04, 0.04)
_ORANGE: ReflectanceRgb = (0.60, 0.16, 0.03)
_DISTRACTOR_PAINTS = (RED_PAINT, WHITE_PAINT, _BLACK_RUBBER, _ORANGE)
_MOST_DISTRACTORS = 3


def drogue_of_scene(recipe: Recipe, scene_id: int) -> DrogueParameters:
    """The drogue of a scene, which frames without a drogue have in common."""
    variants = recipe.target.variants
    if not variants:
        return recipe.drogue
    if recipe.frames.in_turn:
        return variants[scene_id // max(len(recipe.families), 1) % len(variants)].drogue
    shares = np.cumsum([variant.weight for variant in variants])
    place = frame_generator(recipe.seed, scene_id, "drogue variant").random() * shares[-1]
    return variants[int(np.searchsorted(shares, place, side="right"))].drogue


def condition_of_scene(recipe: Recipe, scene_id: int, drogue: DrogueParameters) -> DrogueCondition | None:
    """The condition of a scene's drogue, or None when it is as new."""
    rng, ranges = frame_generator(recipe.seed, scene_id, "drogue condition"), recipe.target
    missing = rng.random(drogue.marker_count) < ranges.missing_marker_fraction
    spared = rng.permutation(drogue.marker_count)[:_FEWEST_MARKERS]
    missing[spared] = False
    markers = tuple(_sample_surface(rng, ranges, bool(gone)) for gone in missing)
    hub = _sample_surface(rng, ranges, False)
    condition = DrogueCondition(
        markers=markers,
        hub=hub,
        body_reflectance_fraction=sample_uniform(rng, ranges.body_reflectance_fraction),
        wear=None if ranges.wear is None else _wear_of_scene(recipe.seed, scene_id, ranges.wear),
    )
    as_new = DrogueCondition(markers=(SurfaceCondition(),) * drogue.marker_count)
    return None if condition == as_new else condition


def _wear_of_scene(seed: int, scene_id: int, ranges: WearRanges) -> SurfaceWear:
    rng = frame_generator(seed, scene_id, "surface wear")
    pattern = int(rng.integers(2**31))
    shares = {name: sample_uniform(rng, getattr(ranges, name)) for name in WearRanges.model_fields}
    return SurfaceWear(seed=pattern, **shares)


def _sample_surface(rng: np.random.Generator, ranges: AppearanceRanges, missing: bool) -> SurfaceCondition:
    dirty, failed = rng.random(2) < (ranges.dirty_marker_fraction, ranges.failed_lamp_fraction)
    dirt, lamp = sample_uniform(rng, ranges.dirt_fraction), sample_uniform(rng, ranges.lamp_fraction)
    seed, reflectance = int(rng.integers(2**31)), sample_uniform(rng, ranges.marker_reflectance_fraction)
    return SurfaceCondition(
        missing=missing,
        reflectance_fraction=reflectance,
        dirt_fraction=dirt if dirty else 0.0,
        dirt_seed=seed if dirty else 0,
        lamp_fraction=0.0 if failed else lamp,
    )


def sample_obstacles(
    rng: np.random.Generator, recipe: Recipe, left_from_drogue: RigidTransform | None
) -> tuple[Obstacle, ...]:
    """Probe, rod and distractors of one frame.

    Args:
        rng: of the frame.
        recipe: its section `[target]` has the ranges.
        left_from_drogue: pose of the drogue, which distractors stay behind; None in a frame without a drogue.
    """
    objects = [_probe(recipe)] if recipe.target.probe else []
    obstructed, distracted = rng.random(2) < (
        recipe.target.obstacle_frame_fraction,
        recipe.target.distractor_frame_fraction,
    )
    rod = _sample_rod(rng, recipe.rig)
    if obstructed:
        objects.append(rod)
    count = int(rng.integers(1, _MOST_DISTRACTORS + 1))
    nearest_m = 2.5 if left_from_drogue is None else float(left_from_drogue.translation_m[2]) + 1.0
    distractors = [_sample_distractor(rng, recipe, nearest_m) for _ in range(count)]
    return (*objects, *(distractors if distracted else ()))


def _probe(recipe: Recipe) -> Obstacle:
    """The receiver's probe: its tip at the rig's position, its tube backwards along the body axis."""
    left_from_body = recipe.rig.body_from_left.inverse()
    tip_m = left_from_body.apply(recipe.rig.probe_tip_body_m)
    backwards = left_from_body.rotate(np.array([-1.0, 0.0, 0.0]))
    return Obstacle(
        kind="probe",
        shape=ObstacleShape(form="probe", radius_m=recipe.target.probe_radius_m, length_m=_PROBE_LENGTH_M),
        left_from_object=RigidTransform(rotation_with_z(backwards), tip_m),
        reflectance_rgb=_PROBE_GREY,
    )


def _sample_rod(rng: np.random.Generator, rig: StereoRig) -> Obstacle:
    """A thin rod across the view 0.5 to 1.3 m from the cameras, like a pitot tube or a canopy frame."""
    depth_m, turn = rng.uniform(0.5, 1.3), rng.uniform(0.0, np.pi)
    place = _point_in_view(rng, rig, depth_m)
    along = np.array([np.cos(turn), np.sin(turn), rng.uniform(-0.2, 0.2)])
    shape = ObstacleShape(form="bar", radius_m=rng.uniform(0.003, 0.008), length_m=3.0)
    return Obstacle(
        kind="obstacle",
        shape=shape,
        left_from_object=RigidTransform(rotation_with_z(along / np.linalg.norm(along)), place),
        reflectance_rgb=_BLACK_RUBBER,
    )


def _sample_distractor(rng: np.random.Generator, recipe: Recipe, nearest_m: float) -> Obstacle:
    """A round object beyond a distance: a ball, a plate or a ring, about as large in the image as a drogue."""
    depth_m = nearest_m + 40.0 * rng.random() ** 2
    size_m = float(rng.uniform(0.1, 0.45)) * max(1.0, depth_m / 12.0)
    forms = recipe.target.distractor_forms
    form = forms[int(rng.integers(len(forms)))]
    shape = ObstacleShape(form=form, radius_m=size_m, length_m=0.02, tube_radius_m=size_m * rng.uniform(0.08, 0.3))
    pitch, yaw, roll = np.radians(rng.uniform(-1.0, 1.0, 3) * (40.0, 40.0, 180.0))
    attitude = rotation_from_angles(pitch, yaw, roll)
    paint = _DISTRACTOR_PAINTS[int(rng.integers(len(_DISTRACTOR_PAINTS)))]
    return Obstacle(
        kind="distractor",
        shape=shape,
        left_from_object=RigidTransform(attitude, _point_in_view(rng, recipe.rig, depth_m)),
        reflectance_rgb=paint,
    )


def _point_in_view(rng: np.random.Generator, rig: StereoRig, depth_m: float) -> Array:
    """(3,) a point in view of the left eye, or just outside. [m]"""
    camera = rig.camera
    u, v = rng.uniform(-0.05, 1.05, 2) * (camera.width_px, camera.height_px)
    return np.array([(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, 1.0]) * depth_m


def rotation_with_z(direction: Array) -> Array:
    """A rotation whose third column is a (3,) unit vector."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    x = np.cross(helper, direction)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(direction, x), direction], axis=-1)
