"""The objects of a frame as plain arrays, in the axes of the stage, in which they stand still."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from drogue_models.meshes import drogue_meshes, hose_mesh, obstacle_mesh
from drogue_models.parts import FIRST_MARKER_ID, Part, part_name, part_satin
from drogue_models.solids import with_creases
from drogue_models.tankers.wing_with_pod import tanker_mesh
from render.blender_engine.messages import FrameSetup, PartMesh, StageLight, StageObjects, SurfaceAppearance
from render.surfaces import (
    SMOOTH_PARTS,
    clean_reflectance_rgb,
    dirty_parts,
    lamp_radiance_rgb,
    missing_parts,
    reflectance_map,
    surface_condition,
)
from scenes.environment_radiance import EnvironmentRadiance


class Stage:
    """The objects of the last frame: meshes that stay the same are sent to Blender once.

    Attributes:
        drogue_m: (V, 3) vertices of the drogue's own parts. [m]
        context_m: (V, 3) vertices of each other object. [m]
    """

    def __init__(self) -> None:
        self._key: str | None = None
        self.drogue_m: NDArray[np.float32] = np.zeros((0, 3), dtype=np.float32)
        self.context_m: list[NDArray[np.float32]] = []

    def set_frame(self, frame: FrameSpec, ambient: EnvironmentRadiance) -> FrameSetup:
        """The setup that Blender needs for this frame."""
        moved = _moved_meshes(frame)
        key = _stage_key(frame, moved)
        stage = None
        if key != self._key:
            fixed = _fixed_meshes(frame)
            stage = StageObjects(
                objects={name: _part_mesh(frame, part, mesh) for name, (part, mesh) in (fixed | moved).items()},
                features={
                    f"alone_{name}": _part_mesh(frame, part, _front_faces(mesh))
                    for name, (part, mesh) in fixed.items()
                    if part == Part.HUB or part >= FIRST_MARKER_ID
                },
            )
            corners = [stage.objects[name].vertices_m for name in fixed]
            self.drogue_m = np.concatenate(corners) if corners else np.zeros((0, 3), dtype=np.float32)
            self._part_of_name = {name: part for name, (part, _) in fixed.items()}
            self._key = key
        vertices = {name: np.asarray(mesh.vertices, dtype=np.float32) for name, (_, mesh) in moved.items()}
        self.context_m = [*vertices.values()]
        appearances = {
            name: _appearance(frame, part) for name, part in self._part_of_name.items()
        } | _moved_appearances(frame, moved)
        return FrameSetup(stage=stage, moved_m=vertices, appearances=appearances, light=_light(frame, ambient))

    def forget(self) -> None:
        """Send everything again with the next frame, because Blender's process is a new one."""
        self._key = None


_Meshes = dict[str, tuple[int, trimesh.Trimesh]]


def _moved_meshes(frame: FrameSpec) -> _Meshes:
    """Hose, tanker and other objects in the stage's axes, by name with their part ids. [m]"""
    stage_from_left = frame.left_from_stage_at(0.0).inverse()
    meshes: _Meshes = {}
    if frame.drogue is not None and frame.hose_nodes_left_m is not None and frame.left_from_tanker is not None:
        nodes = stage_from_left.apply(frame.hose_nodes_left_m)
        meshes["hose"] = int(Part.HOSE), hose_mesh(nodes, frame.drogue.hose_radius_m)
        meshes["tanker"] = int(Part.TANKER), with_creases(tanker_mesh())
        meshes["tanker"][1].apply_transform((stage_from_left @ frame.left_from_tanker).as_matrix())
    for index, obstacle in enumerate(frame.bystanders):
        mesh = with_creases(obstacle_mesh(obstacle.shape))
        mesh.apply_transform((stage_from_left @ obstacle.left_from_object).as_matrix())
        meshes[f"obstacle_{index}"] = int(Part[obstacle.kind.upper()]), mesh
    return meshes


def _fixed_meshes(frame: FrameSpec) -> _Meshes:
    """The drogue's own parts that have not come off."""
    if frame.drogue is None:
        return {}
    gone = missing_parts(frame)
    return {part_name(part): (part, mesh) for part, mesh in drogue_meshes(frame.drogue).items() if part not in gone}


def _stage_key(frame: FrameSpec, moved: _Meshes) -> str:
    """Equal for frames that can share meshes and kinds of surface."""
    drogue = "" if frame.drogue is None else frame.drogue.model_dump_json()
    sizes = [(name, part, len(mesh.vertices), len(mesh.faces)) for name, (part, mesh) in moved.items()]
    return f"{drogue} {sorted(dirty_parts(frame))} {sorted(missing_parts(frame))} {sizes}"


def _front_faces(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The front of a flat feature; its side walls are sunk in the part around it."""
    return mesh.submesh([np.flatnonzero(mesh.face_normals[:, 2] < -0.5)], append=True)


def _part_mesh(frame: FrameSpec, part: int, mesh: trimesh.Trimesh) -> PartMesh:
    vertices = np.asarray(mesh.vertices, dtype=np.float32)
    map_uv = None
    if not surface_condition(frame, part).is_clean:
        assert frame.drogue is not None
        if part == Part.HUB:
            assert frame.drogue.hub is not None
            center_m, radius_m = np.zeros(2), frame.drogue.hub.outer_radius_m
        else:
            center_m = np.asarray(frame.drogue.marker_positions_m[part - FIRST_MARKER_ID])
            radius_m = frame.drogue.marker_radius_m
        map_uv = ((vertices[:, :2] - center_m) / (2 * radius_m) + 0.5).astype(np.float32)
    return PartMesh(
        part_id=part,
        vertices_m=vertices,
        faces=np.asarray(mesh.faces, dtype=np.int32),
        smooth=part in SMOOTH_PARTS,
        map_uv=map_uv,
    )


def _appearance(frame: FrameSpec, part: int) -> SurfaceAppearance:
    clean = surface_condition(frame, part).is_clean
    reflectance = clean_reflectance_rgb(frame, part) if clean else reflectance_map(frame, part)
    satin = None if frame.drogue is None else part_satin(frame.drogue, part)
    sheen = None if satin is None else (satin.sheen_fraction, satin.roughness)
    return SurfaceAppearance(reflectance=reflectance, emission_cd_m2=lamp_radiance_rgb(frame, part), sheen=sheen)


def _moved_appearances(frame: FrameSpec, moved: _Meshes) -> dict[str, SurfaceAppearance]:
    appearances = {name: _appearance(frame, part) for name, (part, _) in moved.items() if name in ("hose", "tanker")}
    for index, obstacle in enumerate(frame.bystanders):
        appearances[f"obstacle_{index}"] = SurfaceAppearance(
            reflectance=np.array(obstacle.reflectance_rgb), emission_cd_m2=np.zeros(3)
        )
    return appearances


def _light(frame: FrameSpec, ambient: EnvironmentRadiance) -> StageLight:
    world_from_stage = (frame.world_from_left @ frame.left_from_stage_at(0.0)).rotation
    light_map = ambient.light_map
    unit_cd_m2 = max(float(light_map.mean()), 1e-12)
    return StageLight(
        sky=(light_map / np.float32(unit_cd_m2)).astype(np.float32),
        world_from_stage=world_from_stage,
        to_sun=world_from_stage.T @ ambient.beam_direction,
        sun=ambient.beam_illuminance_lux / unit_cd_m2,
        unit_cd_m2=unit_cd_m2,
    )
