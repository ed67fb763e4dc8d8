"""Frames with a straight rod, and how much of each pixel it covers."""

from __future__ import annotations

import numpy as np

from datasets_manifest.types.appearance import Obstacle
from datasets_manifest.types.frame import FrameSpec
from drogue_models.obstacles import ObstacleShape
from geometry.se3 import RigidTransform
from scenes.sampler import sample_frame
from tests.support.recipe_builder import RIG_160_PX, build_recipe, stations


def rod_frame(radius_m: float) -> FrameSpec:
    """A rod of 5 m, 10 m away, that nearly follows the rows of the left image, and nothing else."""
    recipe = build_recipe(
        name="rod",
        rig=RIG_160_PX,
        frames={"count": 1, "empty_fraction": 1.0},
        distance=stations(5.0),
        environment={"ground": "sea", "clouds": {"scene_fraction": 0.0}},
    )
    along = np.array([1.0, 0.031, 0.0]) / np.hypot(1.0, 0.031)
    down = np.array([-along[1], along[0], 0.0])
    pose = RigidTransform(np.column_stack([down, np.cross(along, down), along]), np.array([0.1, 0.13, 10.0]))
    rod = Obstacle(
        kind="obstacle",
        shape=ObstacleShape(form="bar", radius_m=radius_m, length_m=5.6),
        left_from_object=pose,
        reflectance_rgb=(0.3, 0.3, 0.3),
    )
    return sample_frame(recipe, 0).model_copy(update={"bystanders": (rod,), "left_from_tanker": None})


def receiver_rod_frame() -> FrameSpec:
    """A rod 1 m before the cameras, below a drogue 10 m away that moves by 30 px of the rod's scale meanwhile."""
    recipe = build_recipe(name="rod", rig=RIG_160_PX, frames={"count": 1}, distance=stations(10.0))
    frame = sample_frame(recipe, 0)
    (rod,) = rod_frame(0.02).bystanders
    place_m = np.array([0.0, 35.0 / frame.rig.camera.fy_px, 1.0])
    rod = rod.model_copy(update={"left_from_object": RigidTransform(rod.left_from_object.rotation, place_m)})
    pose = RigidTransform(frame.left_from_drogue.rotation, np.array([0.1, 0.0, 10.0]))
    speed_m_s = 30.0 / frame.rig.camera.fy_px / frame.exposure.time_s
    return frame.model_copy(
        update={
            "bystanders": (rod,),
            "left_from_drogue": pose,
            "left_from_tanker": None,
            "hose_nodes_left_m": None,
            "left_twist_per_s": np.zeros(6),
            "drogue_twist_per_s": np.array([0.0, speed_m_s, 0.0, 0.0, 0.0, 0.0]),
        }
    )


def rod_coverage(frame: FrameSpec, side: int = 12) -> np.ndarray:
    """(H, W) share of each pixel that an endless rod covers: rays that pass its axis within the radius."""
    (rod,), camera = frame.bystanders, frame.rig.camera
    axis, middle = rod.left_from_object.rotation[:, 2], rod.left_from_object.translation_m
    fine = (np.arange(side) + 0.5) / side - 0.5
    v, u = np.meshgrid(
        (np.arange(camera.height_px)[:, None] + fine).ravel(),
        (np.arange(camera.width_px)[:, None] + fine).ravel(),
        indexing="ij",
    )
    across = np.cross(axis, camera.rays(np.stack([u, v], axis=-1)))
    hit = np.abs(across @ middle) < rod.shape.radius_m * np.linalg.norm(across, axis=-1)
    return hit.reshape(camera.height_px, side, camera.width_px, side).mean(axis=(1, 3))
