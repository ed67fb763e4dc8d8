"""`droguekit model`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.visualization.mesh_file import FORMATS, write_mesh_file

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
    typer.echo(f"wrote {out}: {write_mesh_file(preset_or_file, out)}")
