"""The Mitsuba scene of a drogue: parts, hose, tanker and other objects, with sky and sun as lights.

The drogue's axes are the stage, where it stands still; camera, sun and sky move around it, so that its geometry is
never rebuilt. Without a drogue the stage is the left camera's own frame.
"""

from __future__ import annotations

import tempfile
from collections import OrderedDict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from drogue_models.meshes import drogue_meshes, hose_mesh, obstacle_mesh
from drogue_models.parameters import SatinPaint
from drogue_models.parts import FIRST_MARKER_ID, Part, part_satin
from drogue_models.solids import with_creases
from drogue_models.tankers.wing_with_pod import tanker_mesh
from geometry.se3 import RigidTransform
from render.mitsuba_engine.jit_arrays import jit_array, jit_tensor
from render.surfaces import (
    DIRT_MAP_PX,
    SMOOTH_PARTS,
    clean_reflectance_rgb,
    dirty_parts,
    lamp_radiance_rgb,
    missing_parts,
    reflectance_map,
    surface_condition,
)
from scenes.environment_radiance import EnvironmentRadiance
from scenes.sky.photometry import Radiance

# Scenes that an engine caches; the least recently used one is dropped first.
KEPT_SCENES = 8
_OBSTACLE_PARTS = (Part.PROBE, Part.OBSTACLE, Part.DISTRACTOR)
# Mitsuba's map has +y up; its first column looks along -z and the next ones turn towards +x. Our map starts in the east
# (+x) and turns towards north (+y), the other way round: so the columns are reversed and the axes exchanged.
_MAP_FROM_WORLD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])


class DrogueScene:
    """The scene of one drogue, or of other objects alone; `set_frame` sets it up for each frame.

    Attributes:
        scene: everything.
        features: markers and hub alone, for their amodal pixel counts.
        features_m: (V, 3) points in the stage's axes whose convex hull holds all of `features`. [m]
        object_corners_m: such points for each object in the frame. [m]
        sun: direction towards the sun in the stage's axes, and its illuminance of a facing plane [lux].
    """

    def __init__(self, frame: FrameSpec) -> None:
        self.features_m = self._drogue_m = np.zeros((0, 3))
        self._has_context = frame.hose_nodes_left_m is not None and frame.left_from_tanker is not None
        self._tanker = with_creases(tanker_mesh())
        shapes, features = obstacle_shapes(frame), {}
        if frame.drogue is not None:
            gone = missing_parts(frame)
            meshes = {part: mesh for part, mesh in drogue_meshes(frame.drogue).items() if part not in gone}
            fronts = {
                part: front_faces(mesh)
                for part, mesh in meshes.items()
                if part == int(Part.HUB) or part >= FIRST_MARKER_ID
            }
            self.features_m, self._drogue_m = _corners_m(fronts.values()), _corners_m(meshes.values())
            if self._has_context:
                meshes[int(Part.HOSE)] = hose_mesh(self._hose_nodes(frame), frame.drogue.hose_radius_m)
                meshes[int(Part.TANKER)] = self._tanker
            shapes |= drogue_shapes(frame, meshes)
            features = drogue_shapes(frame, fronts)
        # Merging meshes would lose the parts' identity. Embree's fast mode lets one ray in 10,000 pass between the
        # triangles of a marker.
        watertight = {"type": "scene", "embree_use_robust_intersections": True}
        self.scene = mi.load_dict({**watertight, **shapes, **_lights()}, optimize=False)
        self.features = mi.load_dict({**watertight, **features}, optimize=False)
        self._parameters = mi.traverse(self.scene)
        self._aged = False

    @staticmethod
    def _hose_nodes(frame: FrameSpec) -> NDArray[np.float64]:
        assert frame.left_from_drogue is not None and frame.hose_nodes_left_m is not None
        nodes: NDArray[np.float64] = frame.left_from_drogue.inverse().apply(frame.hose_nodes_left_m)
        return nodes

    def set_frame(self, frame: FrameSpec, ambient: EnvironmentRadiance) -> None:
        """Set poses, materials, lamps, sky and sun as this frame has them."""
        stage_from_left = frame.left_from_stage_at(0.0).inverse()
        self.object_corners_m = [self._drogue_m]
        if self._has_context:
            assert frame.left_from_tanker is not None and frame.drogue is not None
            hose = hose_mesh(self._hose_nodes(frame), frame.drogue.hose_radius_m)
            self._set_vertices(f"part_{int(Part.HOSE)}", np.asarray(hose.vertices), np.asarray(hose.vertex_normals))
            self.object_corners_m.append(np.asarray(hose.vertices))
            self._set_moved(f"part_{int(Part.TANKER)}", stage_from_left @ frame.left_from_tanker, self._tanker)
        self._set_obstacles(frame, stage_from_left)
        self._set_materials(frame)
        self._set_lights(stage_from_left @ frame.world_from_left.inverse(), ambient)
        self._parameters.update()

    def _set_obstacles(self, frame: FrameSpec, stage_from_left: RigidTransform) -> None:
        for index, obstacle in enumerate(frame.bystanders):
            name = obstacle_name(index, int(Part[obstacle.kind.upper()]))
            stage_from_object = stage_from_left @ obstacle.left_from_object
            self._set_moved(name, stage_from_object, with_creases(obstacle_mesh(obstacle.shape)))
            self._parameters[f"{name}.bsdf.reflectance.value"] = mi.Color3f(list(obstacle.reflectance_rgb))

    def _set_materials(self, frame: FrameSpec) -> None:
        """Set paints and lamps by the condition of this frame's drogue."""
        if frame.condition is None and not self._aged:
            return
        self._aged = True
        for name in (shape.id() for shape in self.scene.shapes()):
            part = int(name.split("_")[1])
            if part in _OBSTACLE_PARTS:
                continue
            if f"{name}.bsdf.reflectance.data" in self._parameters:
                self._parameters[f"{name}.bsdf.reflectance.data"] = jit_tensor(reflectance_map(frame, part))
            else:
                paint = clean_reflectance_rgb(frame, part).tolist()
                place = "bsdf" if f"{name}.bsdf.reflectance.value" in self._parameters else "bsdf.bsdf_0"
                self._parameters[f"{name}.{place}.reflectance.value"] = mi.Color3f(paint)
            if f"{name}.emitter.radiance.value" in self._parameters:
                light = lamp_radiance_rgb(frame, part).tolist()
                self._parameters[f"{name}.emitter.radiance.value"] = mi.Color3f(light)

    def _set_lights(self, stage_from_world: RigidTransform, ambient: EnvironmentRadiance) -> None:
        rotation = stage_from_world.rotation @ _MAP_FROM_WORLD.T
        self._parameters["sky.to_world"] = mi.Transform4f(_homogeneous(rotation).tolist())
        self._parameters["sky.data"] = _map_tensor(ambient.light_map)
        to_sun = stage_from_world.rotate(ambient.beam_direction)
        self.sun = (_opaque(mi.Vector3f, to_sun), _opaque(mi.Color3f, ambient.beam_illuminance_lux))
        away_from_sun = -to_sun
        self._parameters["sun.to_world"] = mi.Transform4f().look_at(
            origin=[0.0, 0.0, 0.0], target=away_from_sun.tolist(), up=_any_up(away_from_sun)
        )
        self._parameters["sun.irradiance.value"] = mi.Color3f(ambient.beam_illuminance_lux.tolist())

    def _set_moved(self, name: str, stage_from_mesh: RigidTransform, mesh: trimesh.Trimesh) -> None:
        self.object_corners_m.append(stage_from_mesh.apply(_corners_m([mesh])))
        vertices_m, normals = stage_from_mesh.apply(mesh.vertices), stage_from_mesh.rotate(mesh.vertex_normals)
        self._set_vertices(name, vertices_m, normals)

    def _set_vertices(self, name: str, vertices_m: NDArray[np.float64], normals: NDArray[np.float64]) -> None:
        self._set_buffer(f"{name}.vertex_positions", vertices_m)
        self._set_buffer(f"{name}.vertex_normals", normals)

    def _set_buffer(self, key: str, rows: NDArray[np.float64]) -> None:
        # The buffer's type depends on the variant.
        self._parameters[key] = jit_array(type(self._parameters[key]), rows.ravel())


def by_shape(scene: Any, of_part: NDArray[Any]) -> NDArray[Any]:
    """A table by the shapes' registry numbers from one by part ids."""
    registry: Any = dr.reinterpret_array(mi.UInt32, scene.shapes_dr())
    numbers = np.array(registry)
    table = np.zeros(int(numbers.max()) + 1, dtype=of_part.dtype)
    for number, shape in zip(numbers, scene.shapes(), strict=True):
        table[number] = of_part[int(shape.id().split("_")[1])]
    return table


def _corners_m(meshes: Iterable[trimesh.Trimesh]) -> NDArray[np.float64]:
    """(8 N, 3) corners of the boxes that hold each of N meshes. [m]"""
    return np.concatenate([np.zeros((0, 3)), *(trimesh.bounds.corners(mesh.bounds) for mesh in meshes)])


def _opaque(kind: Any, values: NDArray[np.float64]) -> Any:
    """Numbers that do not become part of a compiled kernel, so that the next frame can use the same kernel."""
    result = kind(*values.tolist())
    dr.make_opaque(result)
    return result


def _lights() -> dict[str, Any]:
    """Sky and sun, whose contents every frame replaces; the size of the map is fixed."""
    return {
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(np.ones((128, 256, 3), dtype=np.float32))},
        "sun": {
            "type": "directional",
            "direction": [0.0, 0.0, 1.0],
            "irradiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]},
        },
    }


def _map_tensor(light_map: NDArray[np.float32]) -> mi.TensorXf:
    """The map with reversed columns and one wrapped column on either side, as Mitsuba stores it."""
    reversed_map = as_mitsuba_reads(light_map)[:, ::-1]
    return jit_tensor(np.concatenate([reversed_map[:, -1:], reversed_map, reversed_map[:, :1]], axis=1))


def as_mitsuba_reads(light_map: Radiance) -> Radiance:
    """A light map resampled so that its first and last rows are zenith and nadir.

    Ours has texel centres half a texel inside; Mitsuba would render it up to half a texel off.
    """
    height = light_map.shape[0]
    place = np.clip(np.arange(height) * height / (height - 1) - 0.5, 0, height - 1)
    above = np.minimum(place.astype(np.intp), height - 2)
    share = (place - above).astype(np.float32)[:, None, None]
    result: Radiance = light_map[above] * (1 - share) + light_map[above + 1] * share
    return result


def _homogeneous(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return matrix


def _any_up(direction: NDArray[np.float64]) -> list[float]:
    return [0.0, 0.0, 1.0] if abs(direction[2]) < 0.9 else [0.0, 1.0, 0.0]


def _scene_key(frame: FrameSpec) -> str:
    """Equal for frames that can share a scene: same drogue, and same topology and kinds of surface of all objects."""
    drogue = "" if frame.drogue is None else frame.drogue.model_dump_json()
    nodes = 0 if frame.hose_nodes_left_m is None else len(frame.hose_nodes_left_m)
    obstacles = [(obstacle.kind, obstacle.shape.form) for obstacle in frame.bystanders]
    paints = sorted(dirty_parts(frame)), sorted(missing_parts(frame))
    return f"{drogue} {nodes} {frame.left_from_tanker is not None} {paints} {obstacles}"


class SceneCache:
    """Caches the scenes of the last few drogues, conditions and sets of other objects."""

    def __init__(self) -> None:
        self._scenes: OrderedDict[str, DrogueScene] = OrderedDict()

    def scene_of(self, frame: FrameSpec, ambient: EnvironmentRadiance) -> DrogueScene:
        """The scene set up for this frame; built when no cached one fits."""
        key = _scene_key(frame)
        scene = self._scenes.pop(key, None) or DrogueScene(frame)
        self._scenes[key] = scene
        if len(self._scenes) > KEPT_SCENES:
            self._scenes.popitem(last=False)
        scene.set_frame(frame, ambient)
        return scene


def _shape(mesh: trimesh.Trimesh, part: int, folder: Path, look: dict[str, Any]) -> Any:
    """A Mitsuba shape from a mesh; `look` holds its material, and its emitter if it is a lamp."""
    path = folder / f"{part}.ply"
    mesh.export(path)
    shape = {"type": "ply", "filename": str(path), "face_normals": part not in SMOOTH_PARTS, **look}
    return mi.load_dict(shape)


def _matt_material(reflectance_rgb: NDArray[np.float64]) -> dict[str, Any]:
    return {"bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance_rgb.tolist()}}}


def _with_sheen(look: dict[str, Any], satin: SatinPaint | None) -> dict[str, Any]:
    """The same look, its material mixed with specular microfacets if the part has satin paint."""
    if satin is None:
        return look
    facets = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": satin.roughness}
    mixed = {"type": "blendbsdf", "weight": satin.sheen_fraction, "paint": look["bsdf"], "facets": facets}
    return look | {"bsdf": mixed}


def _mapped_material() -> dict[str, Any]:
    """A matt material with a reflectance map, which every frame replaces."""
    bitmap = mi.Bitmap(np.zeros((DIRT_MAP_PX, DIRT_MAP_PX, 3), dtype=np.float32))
    texture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}
    return {"bsdf": {"type": "diffuse", "reflectance": texture}}


def _lamp(frame: FrameSpec, part: int) -> dict[str, Any]:
    assert frame.drogue is not None
    if part < FIRST_MARKER_ID or frame.drogue.marker_luminance_cd_m2 == 0:
        return {}
    radiance = lamp_radiance_rgb(frame, part).tolist()
    return {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}}}


def _with_texture_coordinates(mesh: trimesh.Trimesh, center_m: tuple[float, float], radius_m: float) -> trimesh.Trimesh:
    """The mesh with texture coordinates that map the square around a disc to the unit square."""
    places = (np.asarray(mesh.vertices)[:, :2] - np.asarray(center_m)) / (2 * radius_m) + 0.5
    mesh.vertex_attributes["s"] = places[:, 0].astype(np.float32)
    mesh.vertex_attributes["t"] = places[:, 1].astype(np.float32)
    return mesh


def front_faces(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The front of a flat feature; its side walls are sunk in the part around it."""
    return mesh.submesh([np.flatnonzero(mesh.face_normals[:, 2] < -0.5)], append=True)


def drogue_shapes(frame: FrameSpec, meshes: dict[int, trimesh.Trimesh]) -> dict[str, Any]:
    """Mitsuba shapes of the drogue's parts by name; dirty parts have reflectance maps."""
    assert frame.drogue is not None
    shapes: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="droguekit-") as folder:
        for part, mesh in meshes.items():
            look = _with_sheen(_matt_material(clean_reflectance_rgb(frame, part)), part_satin(frame.drogue, part))
            if not surface_condition(frame, part).is_clean:
                is_hub = part == Part.HUB
                assert not is_hub or frame.drogue.hub is not None
                center_m = (0.0, 0.0) if is_hub else frame.drogue.marker_positions_m[part - FIRST_MARKER_ID]
                radius_m = frame.drogue.hub.outer_radius_m if is_hub else frame.drogue.marker_radius_m  # type: ignore[union-attr]
                mesh, look = _with_texture_coordinates(mesh, center_m, radius_m), _mapped_material()
            shapes[f"part_{part}"] = _shape(mesh, part, Path(folder), look | _lamp(frame, part))
            shapes[f"part_{part}"].set_id(f"part_{part}")
    return shapes


def obstacle_shapes(frame: FrameSpec) -> dict[str, Any]:
    """Mitsuba shapes of the other objects, in their own frames until a frame moves them."""
    shapes: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="droguekit-") as folder:
        for index, obstacle in enumerate(frame.bystanders):
            part = int(Part[obstacle.kind.upper()])
            name = obstacle_name(index, part)
            look = _matt_material(np.array(obstacle.reflectance_rgb))
            shapes[name] = _shape(with_creases(obstacle_mesh(obstacle.shape)), part, Path(folder), look)
            shapes[name].set_id(name)
    return shapes


def obstacle_name(index: int, part: int) -> str:
    """Name of the shape of one of a frame's other objects."""
    return f"part_{part}_{index}"
