"""Parts and bystanders as Mitsuba shapes with their materials and lamps."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from drogue_models.materials import part_satin
from drogue_models.meshes import bystander_mesh
from drogue_models.parameters import SatinPaint
from drogue_models.parts import FIRST_MARKER_ID, Part
from drogue_models.solids import with_creases
from render.dirt import DIRT_MAP_PX
from render.surfaces import SMOOTH_PARTS, even_reflectance_rgb, lamp_radiance_rgb, surface_condition


def _shape(mesh: trimesh.Trimesh, part: int, folder: Path, look: dict[str, Any]) -> Any:
    """A Mitsuba shape from a mesh; `look` holds its material, and its lamp if it is one."""
    path = folder / f"{part}.ply"
    mesh.export(path)
    shape = {"type": "ply", "filename": str(path), "face_normals": part not in SMOOTH_PARTS, **look}
    return mi.load_dict(shape)


def _even(reflectance_rgb: NDArray[np.float64]) -> dict[str, Any]:
    return {"bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance_rgb.tolist()}}}


def _with_sheen(look: dict[str, Any], satin: SatinPaint | None) -> dict[str, Any]:
    """A look whose material is mixed with mirroring microfacets, if its part has such paint."""
    if satin is None:
        return look
    facets = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": satin.roughness}
    mixed = {"type": "blendbsdf", "weight": satin.sheen_fraction, "paint": look["bsdf"], "facets": facets}
    return look | {"bsdf": mixed}


def _blotched() -> dict[str, Any]:
    """A material whose map every frame replaces."""
    bitmap = mi.Bitmap(np.zeros((DIRT_MAP_PX, DIRT_MAP_PX, 3), dtype=np.float32))
    texture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}
    return {"bsdf": {"type": "diffuse", "reflectance": texture}}


def _lamp(frame: FrameSpec, part: int) -> dict[str, Any]:
    assert frame.drogue is not None
    if part < FIRST_MARKER_ID or frame.drogue.marker_luminance_cd_m2 == 0:
        return {}
    radiance = lamp_radiance_rgb(frame, part).tolist()
    return {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}}}


def _with_map_places(mesh: trimesh.Trimesh, center_m: tuple[float, float], radius_m: float) -> trimesh.Trimesh:
    """The mesh with texture coordinates that map the square around a disc to the unit square."""
    places = (np.asarray(mesh.vertices)[:, :2] - np.asarray(center_m)) / (2 * radius_m) + 0.5
    mesh.vertex_attributes["s"] = places[:, 0].astype(np.float32)
    mesh.vertex_attributes["t"] = places[:, 1].astype(np.float32)
    return mesh


def front_faces(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """What of a flat feature can be seen from the front; its side walls are sunk in the part around it."""
    return mesh.submesh([np.flatnonzero(mesh.face_normals[:, 2] < -0.5)], append=True)


def drogue_shapes(frame: FrameSpec, meshes: dict[int, trimesh.Trimesh]) -> dict[str, Any]:
    """Mitsuba shapes of the drogue's parts by name; parts that are dirty have maps."""
    assert frame.drogue is not None
    shapes: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="droguekit-") as folder:
        for part, mesh in meshes.items():
            look = _with_sheen(_even(even_reflectance_rgb(frame, part)), part_satin(frame.drogue, part))
            if not surface_condition(frame, part).is_clean:
                is_hub = part == Part.HUB
                assert not is_hub or frame.drogue.hub is not None
                center_m = (0.0, 0.0) if is_hub else frame.drogue.marker_positions_m[part - FIRST_MARKER_ID]
                radius_m = frame.drogue.hub.outer_radius_m if is_hub else frame.drogue.marker_radius_m  # type: ignore[union-attr]
                mesh, look = _with_map_places(mesh, center_m, radius_m), _blotched()
            shapes[f"part_{part}"] = _shape(mesh, part, Path(folder), look | _lamp(frame, part))
            shapes[f"part_{part}"].set_id(f"part_{part}")
    return shapes


def bystander_shapes(frame: FrameSpec) -> dict[str, Any]:
    """Mitsuba shapes of the bystanders, in their own frames for the time being."""
    shapes: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="droguekit-") as folder:
        for index, bystander in enumerate(frame.bystanders):
            part = int(Part[bystander.kind.upper()])
            name = bystander_name(index, part)
            look = _even(np.array(bystander.reflectance_rgb))
            shapes[name] = _shape(with_creases(bystander_mesh(bystander.shape)), part, Path(folder), look)
            shapes[name].set_id(name)
    return shapes


def bystander_name(index: int, part: int) -> str:
    """Name of the shape of a frame's bystander."""
    return f"part_{part}_{index}"
