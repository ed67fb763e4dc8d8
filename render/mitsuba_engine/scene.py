"""The Mitsuba scene of a drogue: parts, hose, tanker and other objects, with sky and sun as lights.

The drogue's axes are the stage, where it stands still; camera, sun and sky move around it, so that its geometry is
never rebuilt. Without a drogue the stage is the left camera's own frame.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray

from datasets_manifest.atomic import scratch_folder
from datasets_manifest.types.frame import FrameSpec
from drogue_models.painted_mesh import Sheen
from geometry.se3 import RigidTransform
from render.hidden_features import feature_triangles
from render.mitsuba_engine.jit_arrays import jit_array, jit_tensor
from render.surfaces import FrameSurfaces, Surface, feature_surfaces, frame_surfaces
from scenes.environment_radiance import EnvironmentRadiance
from scenes.sky.photometry import Radiance

# Embree's fast mode lets one ray in 10,000 pass between the triangles of a marker.
_WATERTIGHT = {"type": "scene", "embree_use_robust_intersections": True}
# Scenes that an engine caches; the least recently used one is dropped first.
KEPT_SCENES = 8
# The map of one tanker takes 25 MB.
_MOST_MAP_BYTES = 100_000_000
# Mitsuba's map has +y up; its first column looks along -z and the next ones turn towards +x. Our map starts in the east
# (+x) and turns towards north (+y), the other way round: so the columns are reversed and the axes exchanged.
_MAP_FROM_WORLD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])

_Key = tuple[object, ...]
# Key of the front of a feature, before that of the whole feature.
_FRONT = "front"


class SharedShape:
    """A Mitsuba shape, which all scenes with such a surface have in common.

    Args:
        name: of the surface.
        surface: gives its mesh, material and lamp.
        mesh: the surface's own, or a part of it.
        file: to write the mesh to.

    Attributes:
        shape: in Mitsuba.
        paint: the reflectance that was set last, None where it is the loaded one.
        map_bytes: size of its reflectance map.
    """

    def __init__(self, name: str, surface: Surface, mesh: trimesh.Trimesh, file: Path) -> None:
        self.shape = _shape(name, surface, mesh, file)
        self.paint: NDArray[Any] | None = None
        whole = mesh is surface.painted.mesh
        self.map_bytes = surface.reflectance.nbytes if whole and surface.uv is not None else 0


class DrogueScene:
    """The scene of one drogue, or of other objects alone; `set_frame` sets it up for each frame.

    Args:
        surfaces: of a frame; moved ones are where they are in it.
        keys: `_shape_keys` of the surfaces.
        shared: shapes of other scenes by their keys.

    Attributes:
        scene: everything.
        features: markers and hub alone, for their amodal pixel counts.
        features_m: (V, 3) points in the stage's axes whose convex hull holds all of `features`. [m]
        triangles_m: of `features`, by part id; see `feature_triangles`.
        object_corners_m: such points for each object in the frame. [m]
        lamp_corners_m: such points for each lamp among the moved objects. [m]
        uneven_parts: ids of the drogue's parts whose paint has edges of its own.
        emits: whether any surface may shine.
        glowing: everything without sky and sun, or None where nothing emits; only for the scalar variant.
        shiny_parts: ids of parts with a sheen.
        surfaces: all of the frame, in the stage's axes.
        shapes: of all surfaces and fronts of features, by their keys.
        sun: direction towards the sun in the stage's axes, and its illuminance of a facing plane [lux].
    """

    def __init__(self, surfaces: FrameSurfaces, keys: dict[str, _Key], shared: dict[_Key, SharedShape]) -> None:
        fronts = feature_surfaces(surfaces.fixed)
        self.features_m = _corners_m(fronts.values())
        self.triangles_m = feature_triangles(surfaces.fixed, fronts)
        self._drogue_m = _corners_m(surface.painted.mesh for surface in surfaces.fixed.values())
        self.shapes: dict[_Key, SharedShape] = {}
        with scratch_folder() as folder:
            file = folder / "mesh.ply"

            def shape_of(key: _Key, name: str, mesh: trimesh.Trimesh) -> SharedShape:
                self.shapes[key] = shared.get(key) or SharedShape(name, surfaces.all[name], mesh, file)
                return self.shapes[key]

            self._shape_of = {
                name: shape_of(keys[name], name, each.painted.mesh) for name, each in surfaces.all.items()
            }
            features = {name: shape_of((_FRONT, *keys[name]), name, mesh).shape for name, mesh in fronts.items()}
        # Before the scene is made of them, which otherwise would have to be made again.
        for name, surface in surfaces.moved.items():
            parameters = mi.traverse(self._shape_of[name].shape)
            _set_moved(parameters, "", surface)
            parameters.update()
        self._placed: FrameSurfaces | None = surfaces
        shapes = {name: found.shape for name, found in self._shape_of.items()}
        # Merging meshes would lose the parts' identity.
        self.scene = mi.load_dict({**_WATERTIGHT, **shapes, **_lights()}, optimize=False)
        self.features = mi.load_dict({**_WATERTIGHT, **features}, optimize=False)
        self.emits = any(surface.is_lamp for surface in surfaces.all.values())
        self.shiny_parts = {surface.part_id for surface in surfaces.all.values() if surface.painted.sheen is not None}
        self._dark = {name for name, surface in surfaces.all.items() if surface.is_lamp and not surface.lights_others}
        self.glowing: Any = None
        self._parameters = mi.traverse(self.scene)

    def set_frame(
        self, surfaces: FrameSurfaces, stage_from_world: RigidTransform, ambient: EnvironmentRadiance
    ) -> None:
        """Set poses, materials, lamps, sky and sun as a frame has them."""
        self.object_corners_m = [self._drogue_m, *(surface.hull_m() for surface in surfaces.moved.values())]
        self.lamp_corners_m = [surface.hull_m() for surface in surfaces.moved.values() if surface.is_lamp]
        self.uneven_parts = surfaces.uneven_parts
        self.surfaces = list(surfaces.all.values())
        if surfaces is not self._placed:
            for name, surface in surfaces.moved.items():
                _set_moved(self._parameters, f"{name}.", surface)
        self._placed = None
        for name, surface in surfaces.all.items():
            self._set_material(name, surface)
        self._set_lights(stage_from_world, ambient)
        self._parameters.update()
        if self.emits and mi.variant() == "scalar_rgb":
            # Another scene of the same shapes does not notice that they move.
            shapes = {shape.id(): shape for shape in self.scene.shapes()}
            self.glowing = mi.load_dict({**_WATERTIGHT, **shapes}, optimize=False)

    def lights_others(self) -> NDArray[np.float32] | None:
        """By a shape's registry number, 0 for lamps that no other surface sees, else 1; None without such lamps."""
        if not self._dark:
            return None
        return _by_number(self.scene, lambda name: float(name not in self._dark)).astype(np.float32)

    def _set_material(self, name: str, surface: Surface) -> None:
        """Set paint and lamp of a surface, if they are not as they were."""
        paint, shared = surface.reflectance, self._shape_of[name]
        if not _equal(shared.paint, paint):
            shared.paint = paint
            place = "bsdf" if surface.painted.sheen is None else "bsdf.bsdf_0"
            if paint.ndim == 3:
                self._parameters[f"{name}.{place}.reflectance.data"] = jit_tensor(paint)
            else:
                self._parameters[f"{name}.{place}.reflectance.value"] = mi.Color3f(paint.tolist())
        if surface.is_lamp:
            self._parameters[f"{name}.emitter.radiance.value"] = mi.Color3f(surface.emission_cd_m2.tolist())

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


def _set_moved(parameters: Any, prefix: str, surface: Surface) -> None:
    """Set where a surface is, in parameters whose names begin with a prefix."""

    def put(key: str, rows: NDArray[np.float64]) -> None:
        # The buffer's type depends on the variant.
        parameters[prefix + key] = jit_array(type(parameters[prefix + key]), rows.ravel())
        # Another scene may have put it here, and equal values are no change to the scalar variant.
        parameters.set_dirty(prefix + key)

    mesh, pose = surface.painted.mesh, surface.axes_from_mesh
    put("vertex_positions", pose.apply(mesh.vertices))
    if surface.painted.smooth:
        put("vertex_normals", pose.rotate(mesh.vertex_normals))
    if surface.uv is not None:
        put("vertex_texcoords", surface.uv)


def by_shape(scene: Any, of_part: NDArray[Any]) -> NDArray[Any]:
    """A table by the shapes' registry numbers from one by part ids."""
    return _by_number(scene, lambda name: of_part[int(name.split("_")[1])]).astype(of_part.dtype)


def _by_number(scene: Any, of_name: Callable[[str], Any]) -> NDArray[Any]:
    """A table by the shapes' registry numbers, 0 for numbers of other scenes."""
    registry: Any = dr.reinterpret_array(mi.UInt32, scene.shapes_dr())
    numbers = np.array(registry)
    table = np.zeros(int(numbers.max()) + 1)
    for number, shape in zip(numbers, scene.shapes(), strict=True):
        table[number] = of_name(shape.id())
    return table


def _equal(before: NDArray[Any] | None, now: NDArray[Any]) -> bool:
    return before is now or (before is not None and np.array_equal(before, now))


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


def _shape_keys(frame: FrameSpec, surfaces: FrameSurfaces) -> dict[str, _Key]:
    """By name, equal for surfaces of frames that can share a shape.

    A fixed one has the drogue's mesh, and texture coordinates of its kind of wear, whose maps are set; of the others
    all is set but their topology and kind.
    """
    fixed = {name: (frame.drogue, name, surface.kind) for name, surface in surfaces.fixed.items()}
    return {**fixed, **{name: (name, surface.kind) for name, surface in surfaces.moved.items()}}


class SceneCache:
    """Caches the scenes of the last few drogues, conditions and sets of other objects."""

    def __init__(self) -> None:
        self._scenes: OrderedDict[_Key, DrogueScene] = OrderedDict()

    def scene_of(self, frame: FrameSpec, ambient: EnvironmentRadiance) -> DrogueScene:
        """The scene set up for this frame; built when no cached one fits.

        It is valid until the next call, which may move or paint what both scenes show.
        """
        stage_from_left = frame.left_from_stage_at(0.0).inverse()
        surfaces = frame_surfaces(frame, stage_from_left)
        keys = _shape_keys(frame, surfaces)
        # Frames share a scene if they have the same drogue, and the same surfaces of the same kinds in the same order.
        key = (frame.drogue, *keys.values())
        scene = self._scenes.pop(key, None)
        if scene is None:
            # Nothing else holds the shapes of a scene that is dropped below.
            scene = DrogueScene(
                surfaces, keys, {each: shape for kept in self._scenes.values() for each, shape in kept.shapes.items()}
            )
        self._scenes[key] = scene
        while len(self._scenes) > KEPT_SCENES or (len(self._scenes) > 1 and self._map_bytes() > _MOST_MAP_BYTES):
            self._scenes.popitem(last=False)
        scene.set_frame(surfaces, stage_from_left @ frame.world_from_left.inverse(), ambient)
        return scene

    def _map_bytes(self) -> int:
        shapes = {id(shape): shape for scene in self._scenes.values() for shape in scene.shapes.values()}
        return sum(shape.map_bytes for shape in shapes.values())


def _shape(name: str, surface: Surface, mesh: trimesh.Trimesh, file: Path) -> Any:
    """A Mitsuba shape from a mesh, with the material of a surface, and its emitter if it is a lamp."""
    uv = surface.uv if mesh is surface.painted.mesh else None
    attributes = {} if uv is None else {"s": uv[:, 0].astype(np.float32), "t": uv[:, 1].astype(np.float32)}
    bare = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_attributes=attributes, process=False)
    # Where texture coordinates cut the mesh, its own normals are smooth across the cut.
    smooth = surface.painted.smooth and uv is not None
    if smooth:
        bare.vertex_normals = mesh.vertex_normals
    bare.export(file, vertex_normal=smooth)
    shape = {"type": "ply", "filename": str(file), "face_normals": not surface.painted.smooth}
    loaded: Any = mi.load_dict(shape | _material(surface, uv is not None) | _lamp(surface))
    loaded.set_id(name)
    return loaded


def _material(surface: Surface, has_map: bool) -> dict[str, Any]:
    """Matt paint, mixed with specular microfacets if the surface has a sheen; every frame sets its reflectance."""
    if has_map:
        bitmap = mi.Bitmap(np.zeros(surface.reflectance.shape, dtype=np.float32))
        # A GPU's own interpolation counts in 256ths of a texel.
        reflectance = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp", "accel": False}
    else:
        reflectance = {"type": "rgb", "value": surface.reflectance.reshape(-1, 3).mean(axis=0).tolist()}
    matt = {"type": "diffuse", "reflectance": reflectance}
    return {"bsdf": matt if surface.painted.sheen is None else _with_sheen(matt, surface.painted.sheen)}


def _with_sheen(matt: dict[str, Any], sheen: Sheen) -> dict[str, Any]:
    facets = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": sheen.roughness}
    return {"type": "blendbsdf", "weight": sheen.fraction, "paint": matt, "facets": facets}


def _lamp(surface: Surface) -> dict[str, Any]:
    if not surface.is_lamp:
        return {}
    radiance = surface.emission_cd_m2.tolist()
    return {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}}}
