"""`droguekit new`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from droguekit.cli.arguments import output_option
from droguekit.workflows.new_files import FileChoices, write_new_file

EXAMPLES = (
    "droguekit new drogue --out basket.toml --markers 12 --marker-radius 0.01 --luminance 20000",
    "droguekit new rig --out acme-rig.toml --size 1920x1200 --focal-px 1739 --baseline 0.25 --bits 12",
    "droguekit new recipe --out acme.toml --drogue basket.toml --rig acme-rig.toml --distance 5:60",
)


def new(
    kind: Annotated[Literal["drogue", "rig", "recipe"], typer.Argument(help="What to write.")],
    out: Annotated[Path, output_option("--out", "FILE.toml", "File to write; must not exist yet.")],
    rim_radius: Annotated[float, typer.Option("--rim-radius", metavar="M", help="Drogue: outermost radius.")] = 0.305,
    markers: Annotated[int, typer.Option("--markers", help="Drogue: number of markers in an even ring.")] = 8,
    marker_radius: Annotated[float, typer.Option("--marker-radius", metavar="M", help="Drogue: of a marker.")] = 0.01,
    luminance: Annotated[
        float, typer.Option("--luminance", metavar="CD/M2", help="Drogue: of lit markers; 0 for paint.")
    ] = 0.0,
    preset: Annotated[str, typer.Option("--preset", help="Rig: the shipped one to start from.")] = "mono",
    size: Annotated[
        str, typer.Option("--size", metavar="WIDTHxHEIGHT", help="Rig: of an image in pixels.")
    ] = "1280x960",
    focal_px: Annotated[float, typer.Option("--focal-px", help="Rig: focal length over pixel pitch.")] = 2133.3,
    baseline: Annotated[float, typer.Option("--baseline", metavar="M", help="Rig: distance of the cameras.")] = 0.12,
    bits: Annotated[int, typer.Option("--bits", help="Rig: of an image, 8 or 12.")] = 8,
    drogue: Annotated[str, typer.Option("--drogue", help="Recipe: a shipped drogue or a .toml file.")] = "red-8",
    rig: Annotated[str, typer.Option("--rig", help="Recipe: a shipped rig or a .toml file.")] = "mono",
    distance: Annotated[
        str, typer.Option("--distance", metavar="NEAR:FAR", help="Recipe: distances in metres.")
    ] = "5:40",
    pairs: Annotated[int, typer.Option("--pairs", help="Recipe: number of stereo pairs.")] = 100,
) -> None:
    """Write a commented drogue, rig or recipe with your numbers, to change and to use.

    The file is checked before it is written: numbers that do not fit together are told.
    """
    choices = FileChoices(
        rim_radius_m=rim_radius,
        markers=markers,
        marker_radius_m=marker_radius,
        luminance_cd_m2=luminance,
        preset=preset,
        size=size,
        focal_px=focal_px,
        baseline_m=baseline,
        bits=bits,
        drogue=drogue,
        rig=rig,
        distance=distance,
        pairs=pairs,
    )
    write_new_file(kind, out, choices)
    typer.echo(f"wrote {out}")
