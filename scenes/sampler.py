"""From a recipe and a frame index to a complete frame: any frame alone, in any order, on any machine."""

from __future__ import annotations

from typing import Literal

import numpy as np

from datasets_manifest.frame import FrameSpec
from datasets_manifest.recipe import Recipe
from drogue_models.parameters import DrogueParameters
from geometry.se3 import Array, RigidTransform
from scenes.distance import sample_distance_m
from scenes.environment import draw, environment_of_scene
from scenes.families import recipe_of_scene
from scenes.framing import sample_pose
from scenes.metering import meter
from scenes.seeding import generator
from scenes.suspension import sample_suspension
from scenes.target import condition_of_scene, drogue_of_scene, sample_bystanders

SplitName = Literal["train", "val", "test"]
SPLITS: tuple[SplitName, ...] = ("train", "val", "test")
FRAME_PERIOD_S = 0.04  # 25 pairs a second
# Camera axes (right, down, forward) of a receiver that flies east, in world axes (east, north, up).
_WORLD_FROM_LEVEL_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def scene_of_frame(recipe: Recipe, frame_index: int) -> int:
    """Which scene a frame belongs to: every run of as many frames as there are scenes visits each once."""
    scenes = recipe.frames.scenes
    order = generator(recipe.seed, frame_index // scenes, "scene order").permutation(scenes)
    return int(order[frame_index % scenes])


def split_of_scene(recipe: Recipe, scene_id: int) -> SplitName:
    """Which split a scene belongs to: shares of the scenes in a drawn order, rounded to whole scenes."""
    scenes = recipe.frames.scenes
    place = int(np.flatnonzero(generator(recipe.seed, 0, "split").permutation(scenes) == scene_id)[0])
    train_end = round(recipe.split.train * scenes)
    val_end = round((recipe.split.train + recipe.split.val) * scenes)
    return "train" if place < train_end else "val" if place < val_end else "test"


def sample_frame(recipe: Recipe, frame_index: int) -> FrameSpec:
    """Everything about one frame.

    Args:
        recipe: what dataset to make.
        frame_index: in [0, count).

    Raises:
        ValueError: an index outside the recipe, or a pose that cannot be framed.
    """
    if not 0 <= frame_index < recipe.frames.count:
        raise ValueError(f"frame: must be in [0, {recipe.frames.count}), got {frame_index}")
    seed = recipe.seed
    scene_id = scene_of_frame(recipe, frame_index)
    recipe = recipe_of_scene(recipe, scene_id)
    environment = environment_of_scene(seed, scene_id, recipe.environment)
    world_from_left = _sample_receiver(generator(seed, frame_index, "receiver"), recipe)
    drogue = drogue_of_scene(recipe, scene_id)
    left_from_drogue = _pose_of_frame(recipe, drogue, frame_index)
    empty = left_from_drogue is None
    left_from_tanker, nodes = None, None
    if left_from_drogue is not None:
        left_from_tanker, nodes = sample_suspension(
            generator(seed, frame_index, "suspension"), drogue, left_from_drogue, world_from_left
        )
    left_twist, drogue_twist = _sample_motion(generator(seed, frame_index, "motion"), recipe)
    return FrameSpec(
        seed=seed,
        frame_index=frame_index,
        scene_id=scene_id,
        family=recipe.family,
        time_s=frame_index * FRAME_PERIOD_S,
        drogue=None if empty else drogue,
        sought=drogue if empty and recipe.target.variants else None,
        condition=None if empty else condition_of_scene(recipe, scene_id, drogue),
        bystanders=sample_bystanders(generator(seed, frame_index, "bystanders"), recipe, left_from_drogue),
        left_from_drogue=left_from_drogue,
        world_from_left=world_from_left,
        left_twist_per_s=left_twist,
        drogue_twist_per_s=drogue_twist,
        left_from_tanker=left_from_tanker,
        hose_nodes_left_m=nodes,
        rig=recipe.rig,
        sensor=recipe.sensor,
        exposure=meter(recipe.exposure, environment, recipe.rig.camera, world_from_left, recipe.sensor),
        environment=environment,
    )


def sample_left_from_drogue(recipe: Recipe, frame_index: int) -> RigidTransform | None:
    """The pose of `sample_frame` alone, without light and exposure; None without a drogue.

    Raises:
        ValueError: a pose that cannot be framed.
    """
    scene_id = scene_of_frame(recipe, frame_index)
    recipe = recipe_of_scene(recipe, scene_id)
    return _pose_of_frame(recipe, drogue_of_scene(recipe, scene_id), frame_index)


def _pose_of_frame(recipe: Recipe, drogue: DrogueParameters, frame_index: int) -> RigidTransform | None:
    """`left_from_drogue`, or None without a drogue; the recipe is that of the scene."""
    if generator(recipe.seed, frame_index, "empty").random() < recipe.frames.empty_fraction:
        return None
    distance_m = sample_distance_m(generator(recipe.seed, frame_index, "distance"), recipe.distance, frame_index)
    return sample_pose(generator(recipe.seed, frame_index, "pose"), recipe, drogue, distance_m)


def _sample_receiver(rng: np.random.Generator, recipe: Recipe) -> RigidTransform:
    """`world_from_left` of a receiver that flies east, pitched and banked."""
    pitch, bank = np.radians([draw(rng, recipe.pose.camera_pitch_deg), draw(rng, recipe.pose.camera_bank_deg)])
    about_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    about_z = np.array([[np.cos(bank), -np.sin(bank), 0], [np.sin(bank), np.cos(bank), 0], [0, 0, 1]])
    return RigidTransform(_WORLD_FROM_LEVEL_CAMERA @ about_x @ about_z, np.zeros(3))


def _sample_motion(rng: np.random.Generator, recipe: Recipe) -> tuple[Array, Array]:
    """(6,) twists of the left camera and of the drogue. [m/s, rad/s]"""
    draws = rng.uniform(-1.0, 1.0, 12)
    rate = np.radians(recipe.pose.rate_deg_s)
    left = np.concatenate([np.zeros(3), draws[3:6] * rate])
    drogue = np.concatenate([draws[6:9] * recipe.pose.speed_m_s, draws[9:12] * rate])
    return left, drogue
