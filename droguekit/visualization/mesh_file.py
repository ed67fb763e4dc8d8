"""The drogue as a mesh file for viewers of 3-D models."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drogue_models.parameters import DrogueParameters

FORMATS = (".glb", ".ply", ".stl", ".obj")


def write_mesh_file(preset_or_file: str, out: Path) -> str:
    """Write a drogue in metres, z from the mouth to the hose.

    GLB keeps one node per part with its colour, PLY and OBJ have coloured vertices, STL has the shape only.

    Args:
        preset_or_file: a shipped drogue, or a TOML file.
        out: its ending is one of `FORMATS`.

    Returns:
        What was written, on one line: name, bounds and number of triangles.

    Raises:
        ValueError: no such drogue or format, or the file cannot be written.
    """
    from drogue_models.parts import part_name
    from drogue_models.presets import load_drogue

    if out.suffix.lower() not in FORMATS:
        raise ValueError(f"--out: must end in one of {', '.join(FORMATS)}, got {str(out)!r}")
    drogue = load_drogue(preset_or_file)
    from drogue_models.meshes import drogue_meshes

    meshes = drogue_meshes(drogue)
    _write(_encode(drogue, {part_name(part): (part, mesh) for part, mesh in meshes.items()}, out.suffix.lower()), out)
    low = [min(float(mesh.bounds[0][axis]) for mesh in meshes.values()) for axis in range(3)]
    high = [max(float(mesh.bounds[1][axis]) for mesh in meshes.values()) for axis in range(3)]
    bounds = ", ".join(f"{axis} {a:.3f} to {b:.3f} m" for axis, a, b in zip("xyz", low, high, strict=True))
    triangles = sum(len(mesh.faces) for mesh in meshes.values())
    return f"{drogue.name}, {bounds}, {triangles} triangles in {len(meshes)} parts"


def _encode(drogue: DrogueParameters, parts: dict[str, tuple[int, Any]], suffix: str) -> bytes:
    """The file's contents."""
    import trimesh

    from drogue_models.parts import part_reflectance_rgb

    scene = trimesh.Scene()
    colored = []
    for name, (part, mesh) in parts.items():
        linear = part_reflectance_rgb(drogue, part)
        if suffix == ".glb":
            # glTF's base colour is linear; its materials are metals unless told otherwise.
            material = trimesh.visual.material.PBRMaterial(
                name=name, baseColorFactor=[*linear, 1.0], metallicFactor=0.0, roughnessFactor=1.0
            )
            # Flat shading needs each triangle's own vertices.
            mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(mesh.triangles), process=False)
            mesh.visual = trimesh.visual.TextureVisuals(material=material)
            scene.add_geometry(mesh, node_name=name, geom_name=name)
        else:
            mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=[_srgb(value) for value in linear] + [255])
            colored.append(mesh)
    data = (scene if suffix == ".glb" else trimesh.util.concatenate(colored)).export(file_type=suffix[1:])
    return data.encode() if isinstance(data, str) else bytes(data)


def _srgb(linear: float) -> int:
    """A linear value as viewers of vertex colours expect it (IEC 61966-2-1)."""
    return round(255 * (12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055))


def _write(data: bytes, out: Path) -> None:
    """The file, whole or not at all."""
    from datasets_manifest.atomic import part_path, sync_folder

    part = part_path(out)
    try:
        with part.open("xb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(out)
        sync_folder(out.parent)
    except OSError as error:
        raise ValueError(f"--out: {out} cannot be written: {error.strerror}") from error
    finally:
        part.unlink(missing_ok=True)
