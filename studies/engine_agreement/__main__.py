"""`python -m studies.engine_agreement`: compare two render engines."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import cv2
import typer

from droguekit.batch.progress import PlainProgress
from studies.engine_agreement.agreement import (
    Requirement,
    centroid_offset,
    frame_requirements,
    navigation_requirements,
    plate_requirements,
)
from studies.engine_agreement.agreement_report import (
    cost_line,
    frame_figures,
    frame_head,
    frame_line,
    navigation_lines,
    offset_line,
    plate_line,
    requirement_lines,
    write_json,
)
from studies.engine_agreement.comparison_run import ComparisonRun, Engines
from studies.engine_agreement.measures import agreement_from_row
from studies.engine_agreement.navigation_agreement import (
    METHOD,
    RECIPE,
    navigation_table,
    paired_errors,
    pairs_by_station,
    render_paired,
)
from studies.engine_agreement.navigation_agreement import (
    STATIONS_M as NAVIGATION_STATIONS_M,
)
from studies.engine_agreement.paired_frames import FAMILIES, STATIONS_M, paired_frames, write_sky_recipe

_EXAMPLES = """Examples:

  python -m studies.engine_agreement

  python -m studies.engine_agreement --part frames --family world-89/dusk --station 5 --count 1"""


class ComparisonPart(StrEnum):
    """A part of the comparison."""

    FRAMES = "frames"
    PLATES = "plates"
    COST = "cost"
    NAVIGATION = "navigation"


def main(
    out: Annotated[
        Path, typer.Option("--out", help="Folder for numbers and pictures; results that are there are kept.")
    ] = Path("out/engine-agreement"),
    part: Annotated[
        list[ComparisonPart] | None, typer.Option("--part", help="Part of the comparison; repeatable; default all.")
    ] = None,
    engine: Annotated[tuple[str, str], typer.Option("--engines", help="The two engines.")] = ("mitsuba", "blender"),
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of all frames.")] = 20,
    count: Annotated[
        int | None, typer.Option("--count", min=1, help="Number of frames; default one of each family.")
    ] = None,
    family: Annotated[
        list[str] | None, typer.Option("--family", help="A recipe, or recipe/family; repeatable.")
    ] = None,
    station: Annotated[list[float] | None, typer.Option("--station", help="Distance in metres; repeatable.")] = None,
    samples: Annotated[int, typer.Option("--samples", min=4, help="Most samples per pixel of a frame.")] = 64,
    plate_samples: Annotated[int, typer.Option("--plate-samples", min=1, help="Samples per pixel of a plate.")] = 256,
    pairs: Annotated[int, typer.Option("--pairs", min=14, help="Number of pairs for navigation.")] = 100,
) -> None:
    """Render the same frames by two engines, and report their differences.

    Exits with 1 when a requirement is missed. A run that was stopped resumes where it was.
    """
    cv2.setNumThreads(1)
    chosen = part or [*ComparisonPart]
    run = ComparisonRun(out, Engines(engine), seed, typer.echo)
    tables: dict[str, Any] = {}
    requirements: list[Requirement] = []
    try:
        if ComparisonPart.FRAMES in chosen:
            families = family or [*FAMILIES, str(write_sky_recipe(out / "own-sky"))]
            frames = paired_frames(families, station or STATIONS_M, count or len(families), samples, seed)
            typer.echo(frame_head())
            rows = run.frames(frames, lambda row: frame_line(_figures(row)))
            tables["frames"] = [_figures(row) for row in rows]
            agreements = [agreement_from_row(row["agreement"]) for row in rows]
            offset = centroid_offset(agreements)
            if offset is not None:
                tables["centroid_offset"] = asdict(offset)
                typer.echo(offset_line(offset))
            requirements += frame_requirements(agreements, [f.distance_m for f in frames])
        if ComparisonPart.PLATES in chosen:
            plates = run.plates(plate_samples, plate_line)
            tables["plates"] = [vars(plate) for plate in plates]
            requirements += plate_requirements(plates)
        if ComparisonPart.COST in chosen:
            tables["costs"] = [cost.row() for cost in run.costs(cost_line)]
        if ComparisonPart.NAVIGATION in chosen:
            requirements += _navigation(out / "navigation", engine, seed, pairs, tables)
        write_json(out, tables, requirements)
    except (ValueError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error
    typer.echo("\n".join([*requirement_lines(requirements), f"numbers and pictures are in {out}"]))
    raise typer.Exit(0 if all(requirement.reached for requirement in requirements) else 1)


def _figures(row: dict[str, Any]) -> dict[str, Any]:
    return frame_figures(row, agreement_from_row(row["agreement"]))


def _navigation(
    out: Path, engines: tuple[str, str], seed: int, pairs: int, tables: dict[str, Any]
) -> Sequence[Requirement]:
    """Render and navigate at every distance; fills in the table."""
    stations = []
    for station_m, count in pairs_by_station(NAVIGATION_STATIONS_M, pairs).items():
        paired = render_paired(out, engines, station_m, count, seed, PlainProgress(sys.stdout))
        stations.append(paired_errors(paired))
    typer.echo("\n".join(navigation_lines(stations)))
    tables["navigation"] = {"method": METHOD, "recipe": RECIPE} | navigation_table(stations)
    return navigation_requirements(stations)


if __name__ == "__main__":
    app = typer.Typer(add_completion=False)
    app.command(epilog=_EXAMPLES)(main)
    app()
