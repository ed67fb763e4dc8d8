"""The objects of a frame as plain arrays, in the axes of the stage, in which they stand still."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datasets_manifest.types.frame import FrameSpec
from drogue_models.painted_mesh import PaintedMesh
from drogue_models.parts import RECEIVER_PARTS
from geometry.se3 import Array, RigidTransform
from render.blender_engine.messages import (
    FrameSetup,
    MovedMesh,
    PartMesh,
    StageLight,
    StageObjects,
    SurfaceAppearance,
)
from render.hidden_features import feature_triangles
from render.surfaces import NEIGHBOUR_GROUP, FrameSurfaces, Surface, feature_surfaces, frame_surfaces
from scenes.environment_radiance import EnvironmentRadiance


class Stage:
    """The objects of the last frame: meshes that stay the same are sent to Blender once.

    Attributes:
        drogue_m: (V, 3) vertices of the drogue's own parts. [m]
        context_m: (V, 3) vertices of each other thing. [m]
        triangles_m: of markers and hub, by part id; see `feature_triangles`.
        neighbours_m: those among them that are drogues, too. [m]
    """

    def __init__(self) -> None:
        self._key: tuple[object, ...] | None = None
        self._paint: dict[str, NDArray[np.floating[Any]]] = {}
        self.drogue_m: NDArray[np.float32] = np.zeros((0, 3), dtype=np.float32)
        self.triangles_m: dict[int, Array] = {}
        self.context_m: list[NDArray[np.float32]] = []
        self.neighbours_m: list[NDArray[np.float32]] = []

    def set_frame(self, frame: FrameSpec, ambient: EnvironmentRadiance) -> FrameSetup:
        """The setup that Blender needs for this frame."""
        surfaces = frame_surfaces(frame, frame.left_from_stage_at(0.0).inverse())
        moved = {name: _moved_mesh(surface) for name, surface in surfaces.moved.items()}
        key = (frame.drogue, *((name, surface.kind) for name, surface in surfaces.all.items()))
        stage = None
        if key != self._key:
            fronts = feature_surfaces(surfaces.fixed)
            stage = _stage_objects(surfaces, fronts, moved)
            corners = [stage.objects[name].vertices_m for name in surfaces.fixed]
            self.drogue_m = np.concatenate(corners) if corners else np.zeros((0, 3), dtype=np.float32)
            self.triangles_m = feature_triangles(surfaces.fixed, fronts)
            self._key, self._paint = key, {}
        things: dict[str, list[NDArray[np.float32]]] = {}
        for name, surface in surfaces.moved.items():
            things.setdefault(surface.group, []).append(moved[name].vertices_m)
        self.context_m = [np.concatenate(vertices) for vertices in things.values()]
        self.neighbours_m = [
            np.concatenate(vertices) for group, vertices in things.items() if group.startswith(NEIGHBOUR_GROUP)
        ]
        appearances = {name: self._appearance(name, surface) for name, surface in surfaces.all.items()}
        return FrameSetup(stage=stage, moved=moved, appearances=appearances, light=_light(frame, ambient))

    def _appearance(self, name: str, surface: Surface) -> SurfaceAppearance:
        """What is new about a surface's look."""
        paint, sheen = surface.reflectance, surface.painted.sheen
        before = self._paint.get(name)
        is_new = before is not paint and (before is None or not np.array_equal(before, paint))
        self._paint[name] = paint
        return SurfaceAppearance(
            reflectance=paint if is_new else None,
            emission_cd_m2=surface.emission_cd_m2,
            sheen=None if sheen is None else (sheen.fraction, sheen.roughness),
            lights_others=surface.lights_others or not surface.is_lamp,
        )

    def forget(self) -> None:
        """Send everything again with the next frame, because Blender's process is a new one."""
        self._key = None


def _stage_objects(
    surfaces: FrameSurfaces, fronts: dict[str, trimesh.Trimesh], moved: dict[str, MovedMesh]
) -> StageObjects:
    objects = {name: _part_mesh(surface, _placed(surface)) for name, surface in surfaces.fixed.items()}
    objects |= {name: _part_mesh(surface, moved[name]) for name, surface in surfaces.moved.items()}
    features = {f"alone_{name}": _bare_mesh(surfaces.fixed[name].part_id, mesh) for name, mesh in fronts.items()}
    return StageObjects(objects=objects, features=features)


def _placed(surface: Surface) -> MovedMesh:
    return _vertices(surface, np.asarray(surface.painted.mesh.vertices), RigidTransform.identity())


def _moved_mesh(surface: Surface) -> MovedMesh:
    pose = surface.axes_from_mesh
    vertices_m = trimesh.transform_points(surface.painted.mesh.vertices, pose.as_matrix())
    return _vertices(surface, vertices_m, pose)


def _vertices(surface: Surface, vertices_m: Array, pose: RigidTransform) -> MovedMesh:
    uv, normals = surface.uv, None
    if uv is not None and surface.painted.smooth:
        # Texture coordinates cut the mesh, and Blender's own normals would show the cut.
        normals = pose.rotate(surface.painted.mesh.vertex_normals).astype(np.float32)
    return MovedMesh(
        vertices_m=vertices_m.astype(np.float32), map_uv=None if uv is None else uv.astype(np.float32), normals=normals
    )


def _part_mesh(surface: Surface, placed: MovedMesh) -> PartMesh:
    painted: PaintedMesh = surface.painted
    return PartMesh(
        part_id=surface.part_id,
        vertices_m=placed.vertices_m,
        faces=np.asarray(painted.mesh.faces, dtype=np.int32),
        smooth=painted.smooth,
        map_uv=placed.map_uv,
        normals=placed.normals,
        flies_with_camera=surface.part_id in RECEIVER_PARTS,
    )


def _bare_mesh(part_id: int, mesh: trimesh.Trimesh) -> PartMesh:
    """A mesh for the passes alone."""
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float32), np.asarray(mesh.faces, dtype=np.int32)
    return PartMesh(part_id=part_id, vertices_m=vertices, faces=faces, smooth=False)


def _light(frame: FrameSpec, ambient: EnvironmentRadiance) -> StageLight:
    world_from_stage = (frame.world_from_left @ frame.left_from_stage_at(0.0)).rotation
    light_map = ambient.light_map
    unit_cd_m2 = max(float(light_map.mean()), 1e-12)
    stage_from_sun, _ = Rotation.align_vectors([world_from_stage.T @ ambient.beam_direction], [[0.0, 0.0, 1.0]])
    return StageLight(
        sky=(light_map / np.float32(unit_cd_m2)).astype(np.float32),
        world_from_stage_rad=Rotation.from_matrix(world_from_stage).as_euler("xyz"),
        stage_from_sun=stage_from_sun.as_quat(scalar_first=True),
        sun=ambient.beam_illuminance_lux / unit_cd_m2,
        unit_cd_m2=unit_cd_m2,
    )
