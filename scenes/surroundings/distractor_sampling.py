"""Sampling distractors: plain round objects beyond the drogue, and things that belong to tankers and the sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from datasets_manifest.recipe.drogue_ranges import DistractorForm
from datasets_manifest.types.appearance import Obstacle
from drogue_models.frozen_model import ReflectanceRgb
from drogue_models.obstacles import DISTRACTOR_BODIES, DistractorBody, ObstacleShape
from drogue_models.painted_mesh import PaintedMesh
from drogue_models.parameters import RED_PAINT, WHITE_PAINT
from geometry.se3 import Array, RigidTransform, rotation_from_angles
from geometry.stereo import StereoRig
from scenes.framing import rotation_with_z_and_up, sample_point_in_view

BLACK_RUBBER: ReflectanceRgb = (0.04, 0.04, 0.04)
_ORANGE: ReflectanceRgb = (0.60, 0.16, 0.03)
_DISTRACTOR_PAINTS = (RED_PAINT, WHITE_PAINT, BLACK_RUBBER, _ORANGE)
_AIRCRAFT_PAINTS: tuple[ReflectanceRgb, ...] = (
    (0.36, 0.37, 0.38),
    (0.55, 0.56, 0.57),
    (0.2, 0.21, 0.22),
    (0.7, 0.7, 0.68),
)
_BIRD_PAINTS: tuple[ReflectanceRgb, ...] = ((0.65, 0.64, 0.6), (0.12, 0.1, 0.08), (0.3, 0.27, 0.22))
_LAMP_COLORS: tuple[ReflectanceRgb, ...] = ((1.0, 0.03, 0.02), (0.02, 1.0, 0.25), (1.0, 0.95, 0.85), (1.0, 0.5, 0.03))
_LAMP_CD_M2 = (5_000.0, 200_000.0)  # from a position light of 40 cd to a landing light, over their glass; our choice
_BESIDE_POD_M = 1.2
# Half width or radius, and length, of the bodies. [m] Sources: `drogue_models.surroundings.distractor_bodies`.
_SIZES_M: dict[DistractorBody, tuple[tuple[float, float], tuple[float, float]]] = {
    "nacelle": ((0.55, 1.1), (2.6, 4.4)),
    "intake": ((0.45, 1.0), (1.6, 2.6)),
    "wheel": ((0.33, 0.62), (1.0, 1.0)),
    "antenna": ((0.15, 0.30), (0.2, 0.35)),
    "roundel": ((0.3, 0.9), (1.0, 1.0)),
    "lamp": ((0.025, 0.09), (1.0, 1.0)),
    "bird": ((0.45, 0.80), (1.0, 1.0)),
    "pod": ((0.33, 0.45), (3.2, 4.4)),
}
# Bodies that hang below a tanker, those that stand on its skin, and those that fly by themselves.
_HANGING: tuple[DistractorBody, ...] = ("nacelle", "wheel", "pod")
_ON_SKIN: tuple[DistractorBody, ...] = ("antenna", "roundel", "lamp")


@dataclass(frozen=True, eq=False)
class DistractorScene:
    """What distractors are placed in.

    Attributes:
        rig: the cameras.
        forms: to choose from.
        nearest_m: no distractor is nearer. [m]
        world_from_left: pose; world axes x east, y north, z up.
        left_from_tanker: pose of the tanker, or None without one.
        tanker: surfaces of the tanker in its own axes.
    """

    rig: StereoRig
    forms: tuple[DistractorForm, ...]
    nearest_m: float
    world_from_left: RigidTransform
    left_from_tanker: RigidTransform | None
    tanker: Sequence[PaintedMesh]


def sample_distractor(rng: np.random.Generator, scene: DistractorScene) -> Obstacle:
    """A distractor beyond a distance."""
    depth_m = scene.nearest_m + 40.0 * rng.random() ** 2
    size_m = float(rng.uniform(0.1, 0.45)) * max(1.0, depth_m / 12.0)
    form = scene.forms[int(rng.integers(len(scene.forms)))]
    if form in DISTRACTOR_BODIES:
        return _sample_body(rng, scene, form, depth_m)
    shape = ObstacleShape(form=form, radius_m=size_m, length_m=0.02, tube_radius_m=size_m * rng.uniform(0.08, 0.3))
    pitch, yaw, roll = np.radians(rng.uniform(-1.0, 1.0, 3) * (40.0, 40.0, 180.0))
    attitude = rotation_from_angles(pitch, yaw, roll)
    paint = _DISTRACTOR_PAINTS[int(rng.integers(len(_DISTRACTOR_PAINTS)))]
    # Room for the object itself, which is the larger the farther away it is.
    depth_m += shape.radius_m + shape.tube_radius_m
    return Obstacle(
        kind="distractor",
        shape=shape,
        left_from_object=RigidTransform(attitude, sample_point_in_view(rng, scene.rig, depth_m)),
        reflectance_rgb=paint,
    )


def _sample_body(rng: np.random.Generator, scene: DistractorScene, form: DistractorBody, depth_m: float) -> Obstacle:
    """A thing that exists, of its true size: on the tanker where it belongs there, else in the sky."""
    (narrow_m, wide_m), (short_m, long_m) = _SIZES_M[form]
    share = rng.random()
    shape = ObstacleShape(
        form=form,
        radius_m=narrow_m + share * (wide_m - narrow_m),
        length_m=short_m + share * (long_m - short_m),
        tube_radius_m=0.006,
        seed=int(rng.integers(1, 2**31)),
    )
    paints = _LAMP_COLORS if form == "lamp" else _BIRD_PAINTS if form == "bird" else _AIRCRAFT_PAINTS
    paint = paints[int(rng.integers(len(paints)))]
    low, high = np.log(_LAMP_CD_M2)
    luminance_cd_m2 = float(np.exp(rng.uniform(low, high)))
    free = RigidTransform(_free_attitude(rng, scene, form), sample_point_in_view(rng, scene.rig, depth_m))
    place = _place_on_tanker(rng, scene, shape)
    if place is None and scene.left_from_tanker is not None and form in (*_HANGING, *_ON_SKIN):
        # A part of an aircraft does not fly beside one: a bird takes its place.
        span_m = _SIZES_M["bird"][0]
        bird = ObstacleShape(form="bird", radius_m=span_m[0] + share * (span_m[1] - span_m[0]), seed=shape.seed)
        return Obstacle(kind="distractor", shape=bird, left_from_object=free, reflectance_rgb=_BIRD_PAINTS[0])
    return Obstacle(
        kind="distractor",
        shape=shape,
        left_from_object=free if place is None else place,
        reflectance_rgb=paint,
        luminance_cd_m2=luminance_cd_m2 if form == "lamp" else 0.0,
    )


def _free_attitude(rng: np.random.Generator, scene: DistractorScene, form: DistractorBody) -> Array:
    """(3, 3) `left_from_object` of a body in the sky: it flies about the way the camera looks, banked a little.

    A bird flies anywhere; an intake belongs to an aircraft that comes the other way.
    """
    left_from_world = scene.world_from_left.rotation.T
    heading, climb, bank = rng.uniform(-1.0, 1.0, 3)
    turn = np.pi * heading if form == "bird" else np.radians(30.0) * heading + (np.pi if form == "intake" else 0.0)
    rise = np.radians(12.0) * climb
    ahead = np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
    # The bodies that face -z show their mouths to a camera behind them; an intake's mouth faces forward.
    level = rotation_with_z_and_up(-ahead if form == "intake" else ahead, np.array([0.0, 0.0, 1.0]))
    roll = np.radians(25.0) * bank
    banked = np.array([[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(left_from_world @ level @ banked)


def _place_on_tanker(rng: np.random.Generator, scene: DistractorScene, shape: ObstacleShape) -> RigidTransform | None:
    """Where a body belongs on the tanker in view, or None where there is none, or none of it is in view."""
    pick, spin = rng.random(2)
    if scene.left_from_tanker is None or (shape.form not in _HANGING and shape.form not in _ON_SKIN):
        return None
    middles, normals, areas = _skin(scene)
    if shape.form in _HANGING:
        # Beside the pod whose hose is in view.
        fits = (normals[:, 2] < -0.5) & (np.abs(middles[:, 1]) > _BESIDE_POD_M)
    else:
        to_camera = scene.left_from_tanker.inverse().translation_m - middles
        fits = np.einsum("ni,ni->n", normals, to_camera) > 0.3 * np.linalg.norm(to_camera, axis=1)
    in_left = scene.left_from_tanker.apply(middles)
    # Room for the body itself, so that none of it comes nearer than allowed.
    fits &= in_left[:, 2] > scene.nearest_m + 2 * shape.radius_m + shape.length_m
    camera = scene.rig.camera
    pixel = camera.project(np.where(fits[:, None], in_left, [0.0, 0.0, 1.0]))
    fits &= (pixel > 0).all(axis=1) & (pixel < (camera.width_px, camera.height_px)).all(axis=1)
    if not fits.any():
        return None
    chances = np.cumsum(np.where(fits, areas, 0.0))
    index = int(np.searchsorted(chances, pick * chances[-1], side="right"))
    point, normal = middles[index], normals[index]
    if shape.form in _HANGING:
        attitude = np.column_stack([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
        reach_m = {"nacelle": 1.5, "wheel": 2.4, "pod": 2.2}[shape.form] * shape.radius_m
        place = point + np.array([0.4 * shape.length_m, 0.0, -reach_m])
        if shape.form == "wheel":
            attitude = np.column_stack([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
            place = point - np.array([0.0, 0.0, reach_m])
    elif shape.form == "antenna":
        # Its foot on the skin, its leading edge forward.
        forward = np.array([-1.0, 0.0, 0.0])
        flat = forward - (forward @ normal) * normal
        flat = (
            flat / np.linalg.norm(flat)
            if np.linalg.norm(flat) > 1e-3
            else rotation_with_z_and_up(normal, forward)[:, 0]
        )
        attitude = np.column_stack([np.cross(normal, flat), normal, flat])
        place = point - 0.02 * normal
    else:
        turn = 2 * np.pi * spin
        up = np.array([np.cos(turn), np.sin(turn), 0.3])
        attitude, place = rotation_with_z_and_up(-normal, up), point + 0.008 * normal
    pose: RigidTransform = scene.left_from_tanker @ RigidTransform(attitude, place)
    return pose


def _skin(scene: DistractorScene) -> tuple[Array, Array, Array]:
    """(T, 3) middles [m], (T, 3) outward normals and (T,) areas of the tanker's triangles, in its axes."""
    meshes = [painted.mesh for painted in scene.tanker]
    middles = np.concatenate([np.asarray(mesh.triangles_center) for mesh in meshes])
    normals = np.concatenate([np.asarray(mesh.face_normals) for mesh in meshes])
    return middles, normals, np.concatenate([np.asarray(mesh.area_faces) for mesh in meshes])
