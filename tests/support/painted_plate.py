"""A flat plate with a map before the camera, as a bystander of a frame without a drogue."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from datasets_manifest.types.appearance import Obstacle
from datasets_manifest.types.frame import FrameSpec
from drogue_models.obstacles import ObstacleShape
from drogue_models.painted_mesh import PaintedMesh
from geometry.se3 import RigidTransform
from render.engine import EyeRadiance

PLATE_M = (0.8, 0.6)
DISTANCE_M = 4.0
# Reflectance by quarter of the plate: towards low v and high v, each towards low u and high u.
QUARTERS = np.array([[[0.8, 0.1, 0.1], [0.1, 0.8, 0.1]], [[0.1, 0.1, 0.8], [0.6, 0.6, 0.6]]])


def plate(reflectance: np.ndarray, emission_cd_m2: float = 0.0) -> PaintedMesh:
    """u along x, v along y: to the right and down in the left image."""
    mesh = trimesh.creation.box((*PLATE_M, 0.01))
    uv = np.asarray(mesh.vertices)[:, :2] / PLATE_M + 0.5
    return PaintedMesh(mesh=mesh, reflectance=reflectance, uv=uv, emission_cd_m2=np.full(3, emission_cd_m2))


def quarters(side_px: int = 8) -> np.ndarray:
    """(side, side, 3) map of `QUARTERS`."""
    return np.kron(QUARTERS, np.ones((side_px // 2, side_px // 2, 1)))


def frame_with(
    monkeypatch: pytest.MonkeyPatch, frame: FrameSpec, surfaces: list[tuple[PaintedMesh, tuple[float, float, float]]]
) -> FrameSpec:
    """The frame without its drogue, with these surfaces at places in the left camera instead. [m]"""
    painted = {}
    obstacles = []
    for index, (surface, place_m) in enumerate(surfaces):
        shape = ObstacleShape(form="ball", radius_m=0.1 + 0.01 * index)
        painted[shape] = surface
        pose = RigidTransform(np.eye(3), np.array(place_m))
        obstacles.append(
            Obstacle(kind="distractor", shape=shape, left_from_object=pose, reflectance_rgb=(0.5, 0.5, 0.5))
        )
    monkeypatch.setattr("render.surfaces.bystander_surface", lambda shape, *_: painted[shape])
    nothing = {"drogue": None, "left_from_drogue": None, "left_from_tanker": None, "hose_nodes_left_m": None}
    return frame.model_copy(update={**nothing, "condition": None, "bystanders": tuple(obstacles)})


def quarter_means(frame: FrameSpec, seen: EyeRadiance) -> np.ndarray:
    """(2, 2, 3) mean radiance of the left image in the middle of the plate's quarters, rows by v."""
    camera = frame.rig.camera
    means = np.empty((2, 2, 3))
    for row in (0, 1):
        for column in (0, 1):
            low = np.array([(column - 1) * PLATE_M[0], (row - 1) * PLATE_M[1]]) / 2 + 0.05
            high = low + np.array(PLATE_M) / 2 - 0.1
            corners = camera.project(np.array([[*low, DISTANCE_M], [*high, DISTANCE_M]]))
            (left, top), (right, bottom) = np.rint(corners).astype(int)
            means[row, column] = seen.radiance_cd_m2[top:bottom, left:right].mean(axis=(0, 1))
    return means
