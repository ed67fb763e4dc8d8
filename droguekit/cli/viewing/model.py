"""`droguekit model`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from datasets_manifest.atomic import part_path, sync_folder

FORMATS = (".glb", ".ply", ".stl", ".obj")
EXAMPLES = (
    "droguekit model red-8 --out drogue.glb",
    "droguekit model my-drogue.toml --out my-drogue.ply",
)


def model(
    preset_or_file: Annotated[
        str, typer.Argument(metavar="PRESET|FILE.toml", help="A shipped drogue, or one described in a TOML file.")
    ] = "red-8",
    *,
    out: Annotated[
        Path,
        typer.Option("--out", metavar="FILE", help=f"The mesh to write; its ending says how: {', '.join(FORMATS)}."),
    ],
) -> None:
    """Write the drogue as a mesh, in metres, z from the mouth to the hose.

    GLB keeps one node per part with its colour, PLY and OBJ have coloured vertices, STL has the shape only.
    """
    from drogue_models.presets import load_drogue

    if out.suffix.lower() not in FORMATS:
        raise ValueError(f"--out: must end in one of {', '.join(FORMATS)}, got {str(out)!r}")
    drogue = load_drogue(preset_or_file)
    from drogue_models.drogue_surfaces import drogue_surfaces, encode_mesh_file

    surfaces = drogue_surfaces(drogue)
    _write(encode_mesh_file(surfaces, out.suffix.lower()), out)
    meshes = {part: surface.mesh for part, surface in surfaces.items()}
    low = [min(float(mesh.bounds[0][axis]) for mesh in meshes.values()) for axis in range(3)]
    high = [max(float(mesh.bounds[1][axis]) for mesh in meshes.values()) for axis in range(3)]
    bounds = ", ".join(f"{axis} {a:.3f} to {b:.3f} m" for axis, a, b in zip("xyz", low, high, strict=True))
    triangles = sum(len(mesh.faces) for mesh in meshes.values())
    typer.echo(f"wrote {out}: {drogue.name}, {bounds}, {triangles} triangles in {len(meshes)} parts")


def _write(data: bytes, out: Path) -> None:
    """The file, whole or not at all; a folder that is missing is an error, where `write_bytes_atomic` makes it."""
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
