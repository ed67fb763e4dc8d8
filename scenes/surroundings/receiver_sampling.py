"""Sampling a scene's receiver: its probe, and what its cameras see of its nose, canopy and glare shield."""

from __future__ import annotations

import numpy as np

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.aircraft_ranges import ReceiverRanges
from datasets_manifest.types.appearance import Obstacle
from drogue_models.frozen_model import ReflectanceRgb
from drogue_models.obstacles import ObstacleShape, ProbeForm
from geometry.se3 import Array, RigidTransform, exp_twist
from geometry.stereo import StereoRig
from scenes.environment_sampling import sample_uniform

_PROBE_LENGTH_M = 6.0
# Paints of probes and receivers: greys of fighters, white, olive, sand, naval grey-blue. Our choice.
_PAINTS: tuple[ReflectanceRgb, ...] = (
    (0.45, 0.45, 0.44),
    (0.30, 0.31, 0.32),
    (0.17, 0.18, 0.19),
    (0.68, 0.68, 0.66),
    (0.10, 0.11, 0.06),
    (0.38, 0.30, 0.20),
    (0.24, 0.29, 0.33),
)
# Columns: x, y and z of a probe's axes (right, up, backwards) in the body's axes (forward, right, down).
_BODY_FROM_PROBE = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# Columns: the same axes of nose, frame and shield in the left camera's (right, down, forward).
_LEFT_FROM_COCKPIT = np.diag([1.0, -1.0, -1.0])


def receiver_of_scene(
    seed: int, scene_id: int, ranges: ReceiverRanges, rig: StereoRig, keeps_tip: bool
) -> tuple[Obstacle, ...]:
    """The receiver's probe and the parts of it in view.

    Args:
        seed: of the dataset.
        scene_id: which scene.
        ranges: of the recipe.
        rig: where cameras and probe are.
        keeps_tip: whether the tip stays where the rig has it.
    """
    probe = _probe(frame_generator(seed, scene_id, "receiver probe"), ranges, rig, keeps_tip)
    body = _body(frame_generator(seed, scene_id, "receiver body"), ranges, rig)
    return (*(() if probe is None else (probe,)), *body)


def _probe(rng: np.random.Generator, ranges: ReceiverRanges, rig: StereoRig, keeps_tip: bool) -> Obstacle | None:
    # Every draw is made for every probe, so that one key does not change what another draws.
    form = ranges.probes[int(rng.integers(len(ranges.probes)))]
    side = ranges.sides[int(rng.integers(len(ranges.sides)))]
    away, down = (sample_uniform(rng, ranges.tip_fraction) for _ in range(2))
    shift = rng.uniform(-1.0, 1.0, 3) * ranges.jitter_m
    turn = rng.uniform(-1.0, 1.0, 3) * np.radians(ranges.jitter_deg)
    radius_m, paint = sample_uniform(rng, ranges.probe_radius_m), _PAINTS[int(rng.integers(len(_PAINTS)))]
    seed = int(rng.integers(1, 2**31))
    if form == "none":
        return None
    tip_m = np.array(rig.probe_tip_body_m)
    mirrored = bool(tip_m[1] < 0)
    if not keeps_tip:
        across = 0.0 if form == "probe-nose" or side == "centre" else -1.0 if side == "left" else 1.0
        mirrored = across < 0 or (across == 0 and bool(seed % 2))
        tip_m = np.array([tip_m[0], across * abs(tip_m[1]) * away, tip_m[2] * down]) + shift
    return _placed_probe(form, rig, tip_m, turn, radius_m=radius_m, paint=paint, seed=seed, mirrored=mirrored)


def _placed_probe(
    form: ProbeForm,
    rig: StereoRig,
    tip_body_m: Array,
    turn_rad: Array,
    *,
    radius_m: float,
    paint: ReflectanceRgb,
    seed: int,
    mirrored: bool,
) -> Obstacle:
    turned = exp_twist(np.concatenate([np.zeros(3), turn_rad])).rotation
    body_from_probe = RigidTransform(_BODY_FROM_PROBE @ turned, tip_body_m)
    shape = ObstacleShape(form=form, radius_m=radius_m, length_m=_PROBE_LENGTH_M, seed=seed, mirrored=mirrored)
    left_from_body = rig.body_from_left.inverse()
    return Obstacle(kind="probe", shape=shape, left_from_object=left_from_body @ body_from_probe, reflectance_rgb=paint)


def _body(rng: np.random.Generator, ranges: ReceiverRanges, rig: StereoRig) -> list[Obstacle]:
    low, arch = rng.random(2)
    paint = _PAINTS[int(rng.integers(len(_PAINTS)))]
    nose, frame, shield = (_nose(rng, rig, paint), _canopy_frame(rng, rig, paint), _glare_shield(rng, rig))
    found = []
    if low < ranges.nose_scene_fraction:
        found.append(nose)
    elif low >= 1 - ranges.glare_shield_scene_fraction:
        found.append(shield)
    if arch < ranges.canopy_scene_fraction:
        found.append(frame)
    return found


def _place(rig: StereoRig, across_m: float, down_m: float, depth_m: float) -> RigidTransform:
    """Pose of a part of the cockpit: beside the middle of both eyes, below the left one, before it."""
    return RigidTransform(_LEFT_FROM_COCKPIT, np.array([rig.baseline_m / 2 + across_m, down_m, depth_m]))


def _slope(rig: StereoRig, row_fraction: float) -> float:
    """Tangent of the angle below the axis of a row, given as a share of the image's height."""
    camera = rig.camera
    return float((row_fraction * camera.height_px - camera.cy_px) / camera.fy_px)


def _nose(rng: np.random.Generator, rig: StereoRig, paint: ReflectanceRgb) -> Obstacle:
    """The nose below the cameras, whose skyline is at most 6 to 16 % of the image's height above its lower edge."""
    tip_m, radius_m = rng.uniform(1.8, 4.0), rng.uniform(0.35, 0.6)
    length_m = rng.uniform(2.6, 3.6)
    slope, across_m = _slope(rig, rng.uniform(0.84, 0.94)), rng.uniform(-0.15, 0.15)
    seed = int(rng.integers(1, 2**31))
    depth = np.linspace(0.3, tip_m, 60)
    behind = np.minimum(tip_m - depth, length_m)
    curve = (radius_m**2 + length_m**2) / (2 * radius_m)
    girth = np.sqrt(curve**2 - (length_m - behind) ** 2) + radius_m - curve
    down_m = float((slope * depth + girth).max())
    shape = ObstacleShape(form="nose", radius_m=radius_m, length_m=length_m, seed=seed)
    return Obstacle(
        kind="obstacle", shape=shape, left_from_object=_place(rig, across_m, down_m, tip_m), reflectance_rgb=paint
    )


def _canopy_frame(rng: np.random.Generator, rig: StereoRig, paint: ReflectanceRgb) -> Obstacle:
    """An arch around the view of both eyes, near the edges of the images."""
    camera, depth_m = rig.camera, rng.uniform(0.5, 0.9)
    beside, above = rng.uniform(-0.01, 0.06), rng.uniform(0.0, 0.08)
    half_view_m = (0.5 - beside) * camera.width_px / camera.fx_px * depth_m
    down_m = _slope(rig, above) * depth_m
    wide_m = rng.uniform(0.010, 0.022)
    shape = ObstacleShape(
        form="canopy-frame",
        radius_m=half_view_m + rig.baseline_m / 2,
        length_m=rng.uniform(0.5, 0.7),
        tube_radius_m=wide_m,
        seed=int(rng.integers(1, 2**31)),
    )
    return Obstacle(
        kind="obstacle", shape=shape, left_from_object=_place(rig, 0.0, down_m, depth_m), reflectance_rgb=paint
    )


def _glare_shield(rng: np.random.Generator, rig: StereoRig) -> Obstacle:
    """The shield below the view; its far edge is its skyline, 5 to 13 % of the image's height above the lower edge."""
    depth_m, length_m = rng.uniform(0.45, 0.7), rng.uniform(0.3, 0.5)
    slope = _slope(rig, rng.uniform(0.87, 0.95))
    edge_m, half_m = rng.uniform(0.015, 0.03), rng.uniform(0.45, 0.7) + rig.baseline_m / 2
    shape = ObstacleShape(
        form="glare-shield",
        radius_m=half_m,
        length_m=length_m,
        tube_radius_m=edge_m,
        seed=int(rng.integers(1, 2**31)),
    )
    # The shield rises by 0.02 m to its far edge.
    down_m = slope * (depth_m + length_m) + 0.02
    return Obstacle(
        kind="obstacle",
        shape=shape,
        left_from_object=_place(rig, rng.uniform(-0.05, 0.05), down_m, depth_m),
        reflectance_rgb=(0.03, 0.03, 0.03),
    )
