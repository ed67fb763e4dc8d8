"""The Mitsuba scene of one drogue: its parts in the drogue frame, hose and tanker around it, sky and sun as lights.

The drogue stands still; camera, sun and sky move around it, so that no geometry of it is ever rebuilt.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray

from datasets_manifest.frame import FrameSpec
from drogue_models.materials import part_reflectance_rgb
from drogue_models.meshes import drogue_meshes, hose_mesh, tanker_mesh
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import FIRST_MARKER_ID, Part
from scenes.sky import REC709_LUMINANCE
from scenes.surroundings import Surroundings

# Curved parts get interpolated normals; the others have flat faces and sharp edges.
_SMOOTH_PARTS = (Part.RIM, Part.HOSE)
# Mitsuba's map has +y up, its first column looks along -z and the next ones turn towards +x; ours starts in the east
# (+x) and turns towards north (+y), the other way round: the columns are reversed and the axes follow.
_MAP_FROM_WORLD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])


def _material(reflectance_rgb: tuple[float, float, float]) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(reflectance_rgb)}}


def _shapes(meshes: dict[int, trimesh.Trimesh], drogue: DrogueParameters) -> dict[str, Any]:
    """Mitsuba shapes named `part_ID`."""
    shapes: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="droguekit-") as folder:
        for part, mesh in meshes.items():
            path = Path(folder) / f"{part}.ply"
            mesh.export(path)
            shape = {
                "type": "ply",
                "filename": str(path),
                "face_normals": part not in _SMOOTH_PARTS,
                "bsdf": _material(part_reflectance_rgb(drogue, part)),
            }
            if part >= FIRST_MARKER_ID and drogue.marker_luminance_cd_m2 > 0:
                shape["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": _lamp_radiance(drogue)}}
            shapes[f"part_{part}"] = mi.load_dict(shape)
            shapes[f"part_{part}"].set_id(f"part_{part}")
    return shapes


def _lamp_radiance(drogue: DrogueParameters) -> list[float]:
    color = np.array(drogue.marker_emission_rgb)
    radiance: list[float] = (drogue.marker_luminance_cd_m2 * color / (color @ REC709_LUMINANCE)).tolist()
    return radiance


def _front_faces(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """What of a flat feature can be seen from the front; its side walls are sunk in the part around it."""
    return mesh.submesh([np.flatnonzero(mesh.face_normals[:, 2] < -0.5)], append=True)


class DrogueScene:
    """The scene of one drogue, set up anew for each frame.

    Attributes:
        scene: everything.
        features: markers and hub alone, for their amodal pixels.
        sun: direction towards the sun in the drogue frame, and its illuminance of a facing plane [lux].
    """

    def __init__(self, drogue: DrogueParameters, frame: FrameSpec) -> None:
        self._hose_radius_m = drogue.hose_radius_m
        self._has_surround = frame.hose_nodes_left_m is not None and frame.left_from_tanker is not None
        self._tanker_vertices = np.asarray(tanker_mesh().vertices)
        meshes = drogue_meshes(drogue)
        if self._has_surround:
            meshes[int(Part.HOSE)] = hose_mesh(np.asarray(self._hose_nodes(frame)), drogue.hose_radius_m)
            meshes[int(Part.TANKER)] = tanker_mesh()
        fronts = {
            part: _front_faces(mesh)
            for part, mesh in meshes.items()
            if part == int(Part.HUB) or part >= FIRST_MARKER_ID
        }
        # Merging meshes would lose the parts' identity.
        self.scene = mi.load_dict({"type": "scene", **_shapes(meshes, drogue), **_lights()}, optimize=False)
        self.features = mi.load_dict({"type": "scene", **_shapes(fronts, drogue)}, optimize=False)
        self._parameters = mi.traverse(self.scene)

    @staticmethod
    def _hose_nodes(frame: FrameSpec) -> NDArray[np.float64]:
        assert frame.left_from_drogue is not None and frame.hose_nodes_left_m is not None
        nodes: NDArray[np.float64] = frame.left_from_drogue.inverse().apply(frame.hose_nodes_left_m)
        return nodes

    def set_frame(self, frame: FrameSpec, around: Surroundings) -> None:
        """Put hose, tanker, sky and sun where this frame has them."""
        assert frame.left_from_drogue is not None
        drogue_from_left = frame.left_from_drogue.inverse()
        drogue_from_world = drogue_from_left @ frame.world_from_left.inverse()
        if self._has_surround:
            assert frame.left_from_tanker is not None
            hose = hose_mesh(self._hose_nodes(frame), self._hose_radius_m)
            self._set_vertices(Part.HOSE, np.asarray(hose.vertices), np.asarray(hose.vertex_normals))
            drogue_from_tanker = drogue_from_left @ frame.left_from_tanker
            self._set_vertices(Part.TANKER, drogue_from_tanker.apply(self._tanker_vertices), None)
        self._parameters["sky.to_world"] = mi.Transform4f(
            _homogeneous(drogue_from_world.rotation @ _MAP_FROM_WORLD.T).tolist()
        )
        self._parameters["sky.data"] = _map_tensor(around.light_map)
        to_sun = drogue_from_world.rotate(around.sky.sun_direction)
        self.sun = (_opaque(mi.Vector3f, to_sun), _opaque(mi.Color3f, around.sky.sun_illuminance_lux))
        away_from_sun = -to_sun
        self._parameters["sun.to_world"] = mi.Transform4f().look_at(
            origin=[0.0, 0.0, 0.0], target=away_from_sun.tolist(), up=_any_up(away_from_sun)
        )
        self._parameters["sun.irradiance.value"] = mi.Color3f(around.sky.sun_illuminance_lux.tolist())
        self._parameters.update()

    def _set_vertices(self, part: Part, vertices_m: NDArray[np.float64], normals: NDArray[np.float64] | None) -> None:
        self._set_buffer(f"part_{int(part)}.vertex_positions", vertices_m)
        if normals is not None:
            self._set_buffer(f"part_{int(part)}.vertex_normals", normals)

    def _set_buffer(self, key: str, rows: NDArray[np.float64]) -> None:
        # The buffer's type depends on the variant.
        self._parameters[key] = type(self._parameters[key])(rows.astype(np.float32).ravel())


def _opaque(kind: Any, values: NDArray[np.float64]) -> Any:
    """Numbers that do not become part of a compiled kernel, so that the next frame can use the same one."""
    result = kind(*values.tolist())
    dr.make_opaque(result)
    return result


def _lights() -> dict[str, Any]:
    """Sky and sun with contents that every frame replaces; the map's size is fixed."""
    return {
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(np.ones((128, 256, 3), dtype=np.float32))},
        "sun": {
            "type": "directional",
            "direction": [0.0, 0.0, 1.0],
            "irradiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]},
        },
    }


def _map_tensor(light_map: NDArray[np.float32]) -> mi.TensorXf:
    """The map with its columns reversed and one wrapped column on either side, as Mitsuba keeps it."""
    reversed_map = light_map[:, ::-1]
    return mi.TensorXf(np.concatenate([reversed_map[:, -1:], reversed_map, reversed_map[:, :1]], axis=1))


def _homogeneous(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return matrix


def _any_up(direction: NDArray[np.float64]) -> list[float]:
    return [0.0, 0.0, 1.0] if abs(direction[2]) < 0.9 else [0.0, 1.0, 0.0]


def _scene_key(frame: FrameSpec) -> str:
    """Equal for frames that can share a scene: same drogue, same topology of what hangs on it."""
    assert frame.drogue is not None
    nodes = 0 if frame.hose_nodes_left_m is None else len(frame.hose_nodes_left_m)
    return f"{frame.drogue.model_dump_json()} {nodes} {frame.left_from_tanker is not None}"


class SceneCache:
    """Keeps the scene of the last drogue."""

    def __init__(self) -> None:
        self._key: str | None = None
        self._scene: DrogueScene

    def scene_of(self, frame: FrameSpec, around: Surroundings) -> DrogueScene:
        """The scene as this frame has it; built anew when the drogue has changed."""
        assert frame.drogue is not None
        key = _scene_key(frame)
        if key != self._key:
            self._scene, self._key = DrogueScene(frame.drogue, frame), key
        self._scene.set_frame(frame, around)
        return self._scene
