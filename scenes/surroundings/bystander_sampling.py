"""Sampling a frame's bystanders: probe, parts of the receiver, obstacles close to the cameras, distractors."""

from __future__ import annotations

import numpy as np

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.appearance import Obstacle
from drogue_models.frozen_model import ReflectanceRgb
from drogue_models.obstacles import PLAIN_FORMS, ObstacleShape
from drogue_models.tankers.tanker import Tanker
from drogue_models.tankers.tanker_surfaces import tanker_surfaces
from drogue_models.tankers.wing_with_pod import wing_surfaces
from geometry.se3 import RigidTransform
from geometry.stereo import StereoRig
from scenes.flight.trajectory import FrameKinematics
from scenes.framing import rotation_with_z, sample_point_in_view
from scenes.surroundings.distractor_sampling import BLACK_RUBBER, DistractorScene, sample_distractor
from scenes.surroundings.receiver_sampling import receiver_of_scene

_PROBE_LENGTH_M = 6.0
_PROBE_GREY: ReflectanceRgb = (0.45, 0.45, 0.44)
_MOST_DISTRACTORS = 3


def bystanders_of_frame(
    recipe: Recipe, scene_id: int, frame_index: int, kinematics: FrameKinematics, tanker: Tanker | None
) -> tuple[Obstacle, ...]:
    """Probe, receiver, rod and distractors of one frame.

    Args:
        recipe: as it holds for the frame's scene.
        scene_id: which scene.
        frame_index: of the frame.
        kinematics: of the frame.
        tanker: of the scene, or None for the wing with one pod.
    """
    # Other objects stay the same throughout a sequence.
    key = frame_index if kinematics.sequence_id is None else kinematics.sequence_id
    rng = frame_generator(recipe.stream_seed, key, "bystanders")
    objects: list[Obstacle] = [_probe(recipe)] if recipe.target.probe else []
    if recipe.receiver is not None:
        keeps_tip = recipe.sequence is not None
        objects += receiver_of_scene(recipe.stream_seed, scene_id, recipe.receiver, recipe.rig, keeps_tip)
    objects += sample_obstacles(rng, recipe, kinematics, tanker)
    return tuple(objects) if kinematics.obstacle is None else (*objects, kinematics.obstacle)


def sample_obstacles(
    rng: np.random.Generator, recipe: Recipe, kinematics: FrameKinematics, tanker: Tanker | None
) -> list[Obstacle]:
    """Rod and distractors of one frame.

    Args:
        rng: of the frame.
        recipe: its section `[target]` has the ranges.
        kinematics: gives the drogue, which distractors stay behind, and the place of the tanker.
        tanker: which they may belong to.
    """
    obstructed, distracted = rng.random(2) < (
        recipe.target.obstacle_frame_fraction,
        recipe.target.distractor_frame_fraction,
    )
    rod = _sample_rod(rng, recipe.rig)
    count = int(rng.integers(1, _MOST_DISTRACTORS + 1))
    pose = kinematics.left_from_drogue
    painted = any(form not in PLAIN_FORMS for form in recipe.target.distractor_forms)
    scene = DistractorScene(
        rig=recipe.rig,
        forms=recipe.target.distractor_forms,
        nearest_m=2.5 if pose is None else float(pose.translation_m[2]) + 1.0,
        world_from_left=kinematics.world_from_left,
        left_from_tanker=kinematics.left_from_tanker,
        tanker=() if not (painted and distracted) else wing_surfaces() if tanker is None else tanker_surfaces(tanker),
    )
    return [*([rod] if obstructed else []), *(sample_distractor(rng, scene) for _ in range(count if distracted else 0))]


def _probe(recipe: Recipe) -> Obstacle:
    """The receiver's plain probe: its tip at the rig's position, its tube backwards along the body axis."""
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
    place = sample_point_in_view(rng, rig, depth_m)
    along = np.array([np.cos(turn), np.sin(turn), rng.uniform(-0.2, 0.2)])
    shape = ObstacleShape(form="bar", radius_m=rng.uniform(0.003, 0.008), length_m=3.0)
    return Obstacle(
        kind="obstacle",
        shape=shape,
        left_from_object=RigidTransform(rotation_with_z(along / np.linalg.norm(along)), place),
        reflectance_rgb=BLACK_RUBBER,
    )
