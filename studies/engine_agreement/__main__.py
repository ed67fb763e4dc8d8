"""`python -m studies.engine_agreement`: do two engines agree?"""

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
from studies.engine_agreement.agreement import Requirement, centroid_offset, frame_bars, navigation_bars, plate_bars
from studies.engine_agreement.agreement_report import (
    bar_lines,
    cost_line,
    frame_figures,
    frame_head,
    frame_line,
    navigation_lines,
    offset_line,
    plate_line,
    write_json,
)
from studies.engine_agreement.comparison_run import ComparisonRun, Engines
from studies.engine_agreement.measures import agreement_of
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
from studies.engine_agreement.paired_frames import FAMILIES, STATIONS_M, paired_frames, write_own_sky

_EXAMPLES = """Examples:

  python -m studies.engine_agreement

  python -m studies.engine_agreement --part frames --family world-89/dusk --station 5 --count 1"""


class ComparisonPart(StrEnum):
    """What is compared."""

    FRAMES = "frames"
    PLATES = "plates"
    COST = "cost"
    NAVIGATION = "navigation"


def main(
    out: Annotated[
        Path, typer.Option("--out", help="Folder for numbers and pictures; what is found there stands.")
    ] = Path("out/engine-agreement"),
    part: Annotated[
        list[ComparisonPart] | None, typer.Option("--part", help="What to compare; repeatable, or all.")
    ] = None,
    engine: Annotated[tuple[str, str], typer.Option("--engines", help="Which two.")] = ("mitsuba", "blender"),
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of all that is drawn.")] = 20,
    count: Annotated[int | None, typer.Option("--count", min=1, help="Frames, or one of each family.")] = None,
    family: Annotated[
        list[str] | None, typer.Option("--family", help="A recipe, or recipe/family; repeatable.")
    ] = None,
    station: Annotated[
        list[float] | None, typer.Option("--station", help="A frame's distance in metres; repeatable.")
    ] = None,
    samples: Annotated[int, typer.Option("--samples", min=4, help="Most samples through a pixel of a frame.")] = 64,
    plate_samples: Annotated[int, typer.Option("--plate-samples", min=1, help="Through a plate's pixel.")] = 256,
    pairs: Annotated[int, typer.Option("--pairs", min=14, help="Pairs to navigate on.")] = 100,
) -> None:
    """Render the same frames by two engines, and report what differs.

    Exits with 1 when a bar is missed. A run that was stopped goes on where it was.
    """
    cv2.setNumThreads(1)
    chosen = part or [*ComparisonPart]
    work = ComparisonRun(out, Engines(engine), seed, typer.echo)
    tables: dict[str, Any] = {}
    bars: list[Requirement] = []
    try:
        if ComparisonPart.FRAMES in chosen:
            families = family or [*FAMILIES, str(write_own_sky(out / "own-sky"))]
            frames = paired_frames(families, station or STATIONS_M, count or len(families), samples, seed)
            typer.echo(frame_head())
            rows = work.frames(frames, lambda row: frame_line(_figures(row)))
            tables["frames"] = [_figures(row) for row in rows]
            agreements = [agreement_of(row["agreement"]) for row in rows]
            offset = centroid_offset(agreements)
            if offset is not None:
                tables["centroid_offset"] = asdict(offset)
                typer.echo(offset_line(offset))
            bars += frame_bars(agreements, [f.distance_m for f in frames])
        if ComparisonPart.PLATES in chosen:
            plates = work.plates(plate_samples, plate_line)
            tables["plates"] = [vars(plate) for plate in plates]
            bars += plate_bars(plates)
        if ComparisonPart.COST in chosen:
            tables["costs"] = [cost.row() for cost in work.costs(cost_line)]
        if ComparisonPart.NAVIGATION in chosen:
            bars += _navigation(out / "navigation", engine, seed, pairs, tables)
        write_json(out, tables, bars)
    except (ValueError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error
    typer.echo("\n".join([*bar_lines(bars), f"numbers and pictures are in {out}"]))
    raise typer.Exit(0 if all(bar.reached for bar in bars) else 1)


def _figures(row: dict[str, Any]) -> dict[str, Any]:
    return frame_figures(row, agreement_of(row["agreement"]))


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
    return navigation_bars(stations)


if __name__ == "__main__":
    app = typer.Typer(add_completion=False)
    app.command(epilog=_EXAMPLES)(main)
    app()
