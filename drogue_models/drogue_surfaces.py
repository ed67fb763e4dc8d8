"""The painted surfaces of a drogue."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from drogue_models.drogue_families.body_paint import body_part
from drogue_models.meshes import drogue_meshes
from drogue_models.painted_mesh import PaintedMesh, Sheen, texels_at
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import FIRST_MARKER_ID, Part, part_name, part_reflectance_rgb, part_satin
from drogue_models.ring_wear import worn_part
from drogue_models.solids import with_creases
from drogue_models.surface_wear import SurfaceWear
from geometry.se3 import Array


@lru_cache(maxsize=16)
def drogue_surfaces(drogue: DrogueParameters, wear: SurfaceWear | None = None) -> dict[int, PaintedMesh]:
    """The surface of every part of a drogue by part id, in the drogue frame; nobody may change it.

    Markers and hub have texture coordinates over the square around them, with v along y.

    Raises:
        ValueError: the user's body mesh is missing, changed, or not fit for use.
    """
    return {part: _painted(drogue, part, mesh, wear) for part, mesh in _meshes(drogue).items()}


@lru_cache(maxsize=16)
def _meshes(drogue: DrogueParameters) -> dict[int, trimesh.Trimesh]:
    meshes = drogue_meshes(drogue)
    if drogue.body is None:
        return meshes
    # Cloth and other curved parts have rounded shading, with creases where they fold.
    return {part: with_creases(mesh) if _is_rounded(part) else mesh for part, mesh in meshes.items()}


def _is_rounded(part: int) -> bool:
    """Whether a part of a body has interpolated normals; the rim's torus has no creases."""
    return part < FIRST_MARKER_ID and part not in (Part.RIM, Part.HUB)


def _painted(drogue: DrogueParameters, part: int, mesh: trimesh.Trimesh, wear: SurfaceWear | None) -> PaintedMesh:
    satin, lamps = part_satin(drogue, part), None if drogue.body is None else drogue.body.lamps
    rgb = np.array(part_reflectance_rgb(drogue, part))
    # Markers have dirt of their own, see `datasets_manifest.types.appearance.SurfaceCondition`.
    worn = wear is not None and part < FIRST_MARKER_ID
    painted, uv, reflectance = mesh, _square_uv(drogue, part, mesh), rgb
    if drogue.body is not None and part < FIRST_MARKER_ID:
        own = body_part(drogue, part, mesh, rgb, wear)
        painted, uv, reflectance = (mesh, uv, rgb) if own is None else own
    elif worn and wear is not None:
        painted, uv, reflectance = worn_part(drogue, part, mesh, rgb, wear)
    return PaintedMesh(
        mesh=painted,
        reflectance=reflectance,
        uv=uv,
        emission_cd_m2=np.array(lamps.radiance_rgb if lamps is not None and part == Part.LAMPS else (0.0, 0.0, 0.0)),
        smooth=part == Part.RIM or (drogue.body is not None and _is_rounded(part)),
        sheen=None if satin is None else Sheen(satin.sheen_fraction, satin.roughness),
    )


def _square_uv(drogue: DrogueParameters, part: int, mesh: trimesh.Trimesh) -> Array | None:
    """(V, 2) coordinates over the square around a marker or the hub, None for other parts."""
    if part == Part.HUB and drogue.hub is not None:
        center_m, radius_m = (0.0, 0.0), drogue.hub.outer_radius_m
    elif part >= FIRST_MARKER_ID:
        center_m, radius_m = drogue.marker_positions_m[part - FIRST_MARKER_ID], drogue.marker_radius_m
    else:
        return None
    uv: Array = (np.asarray(mesh.vertices)[:, :2] - np.asarray(center_m)) / (2 * radius_m) + 0.5
    return uv


def encode_mesh_file(surfaces: Mapping[int, PaintedMesh], suffix: str) -> bytes:
    """Contents of a file for viewers of 3-D models.

    GLB keeps one node per part with its colour or map, PLY and OBJ have coloured vertices, STL has the shape only.

    Args:
        surfaces: by part id, see `drogue_surfaces`.
        suffix: `.glb`, `.ply`, `.stl` or `.obj`.
    """
    scene = trimesh.Scene()
    colored = []
    for part, painted in surfaces.items():
        if suffix == ".glb":
            name = part_name(part)
            scene.add_geometry(_textured(painted, name), node_name=name, geom_name=name)
        else:
            mesh = painted.mesh.copy()
            texels = painted.reflectance[None] if painted.uv is None else texels_at(painted, painted.uv)
            rgb = np.broadcast_to(_srgb(texels.astype(np.float64)), (len(mesh.vertices), 3))
            opaque = np.full((len(rgb), 1), 255, dtype=np.uint8)
            mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=np.hstack([rgb, opaque]))
            colored.append(mesh)
    data = (scene if suffix == ".glb" else trimesh.util.concatenate(colored)).export(file_type=suffix[1:])
    return data.encode() if isinstance(data, str) else bytes(data)


def _textured(painted: PaintedMesh, name: str) -> trimesh.Trimesh:
    """The mesh with a glTF material; flat shading needs each triangle's own vertices."""
    # glTF's base colour is linear, its texture is not; its materials are metals unless told otherwise.
    material = trimesh.visual.material.PBRMaterial(name=name, metallicFactor=0.0, roughnessFactor=1.0)
    if painted.has_map:
        # glTF's row 0 is at v = 0 too, but trimesh counts v from the other end.
        material.baseColorTexture = Image.fromarray(_srgb(painted.reflectance.astype(np.float64))[::-1])
    else:
        material.baseColorFactor = [*painted.reflectance.tolist(), 1.0]
    flat = trimesh.Trimesh(**trimesh.triangles.to_kwargs(painted.mesh.triangles), process=False)
    uv = None if painted.uv is None or not painted.has_map else painted.uv[painted.mesh.faces.ravel()]
    flat.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return flat


def _srgb(linear: Array) -> NDArray[np.uint8]:
    """Linear values as viewers of vertex colours and textures expect them (IEC 61966-2-1)."""
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    levels: NDArray[np.uint8] = np.rint(255 * encoded).astype(np.uint8)
    return levels
