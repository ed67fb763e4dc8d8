"""Command line of the acceptance study."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import WorkersOption
from droguekit.cli.main import FAULT, run
from studies.acceptance.acceptance_run import (
    DEFAULT_RIG,
    DEFAULT_TRACKER,
    AcceptanceOptions,
    FlightOptions,
    measure_tier,
)
from studies.acceptance.rendered.image_tiers import LightLevel

EXAMPLES = (
    "python -m studies.acceptance c --out out/bars/c",
    "python -m studies.acceptance a --out out/bars/a --pairs-per-station 20   (a first look)",
    "python -m studies.acceptance b --out out/bars/b --light day   (the other one can follow)",
    "python -m studies.acceptance d --out /tmp/d --draws 50 --seed 7",
    "python -m studies.acceptance speed --out /tmp/speed",
    "python -m studies.acceptance e --out out/bars/e",
    "python -m studies.acceptance b --out out/bars/b --engine blender",
    "python -m studies.acceptance docking --out out/bars/docking --engine mitsuba --engine blender",
    "python -m studies.acceptance docking --out /tmp/docking --recipe docking-10m --sequences 1 --rig rgb-ideal",
)
_IMAGE_TIERS, _FLIGHT_TIERS = ("a", "b"), ("e", "docking")


def acceptance(
    tier: Annotated[
        str,
        typer.Argument(
            metavar="TIER",
            help="a: analytic images, b: path-traced images, c: centroid noise and tolerances, d: bad markers, "
            "e: swing sequences, docking: whole flights and the paper's bench, speed.",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Gets bars.json and bars.md, and keeps finished results.")
    ],
    pairs_per_station: Annotated[
        int | None, typer.Option("--pairs-per-station", help="Tiers a and b: pairs at each distance; all by default.")
    ] = None,
    light: Annotated[
        list[LightLevel] | None, typer.Option("--light", help="Tiers a and b: only this light level; both by default.")
    ] = None,
    draws: Annotated[
        int | None, typer.Option("--draws", help="Tiers c and d: frames a cell; the protocol's by default.")
    ] = None,
    recipe: Annotated[
        list[str] | None,
        typer.Option("--recipe", metavar="NAME", help="Tiers e and docking: only this recipe; may be repeated."),
    ] = None,
    sequences: Annotated[
        int | None,
        typer.Option(
            "--sequences",
            help="Tiers e and docking: of each recipe, or parts of 90 pairs of a bench; a full measurement by default.",
        ),
    ] = None,
    engine: Annotated[
        list[str] | None,
        typer.Option(
            "--engine", metavar="NAME", help="Tiers b, e and docking: instead of the recipe's; may be repeated."
        ),
    ] = None,
    rig: Annotated[
        list[str] | None,
        typer.Option(
            "--rig",
            metavar="NAME",
            help=f"Tiers e and docking: may be repeated; by default {DEFAULT_RIG}. Others are for comparison.",
        ),
    ] = None,
    tracker: Annotated[
        str | None,
        typer.Option(
            "--tracker", metavar="NAME", help=f"Tiers e and docking: in the loop; {DEFAULT_TRACKER} by default."
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of all draws; 1 is for development.")] = 1,
    workers: WorkersOption = None,
) -> None:
    """Measure the acceptance criteria of a tier: required value, measured value, its 95 % limit, met or not.

    A run that was stopped continues from its finished results; results of other code are measured again. Exit code 1
    means that a criterion is missed.
    """
    has_images, has_flights = tier in _IMAGE_TIERS, tier in _FLIGHT_TIERS
    if (has_images or has_flights) and draws is not None:
        raise ValueError("--draws: is for tiers c and d and speed; the others take --pairs-per-station or --sequences")
    if not has_images and pairs_per_station is not None:
        raise ValueError("--pairs-per-station: is for tiers a and b; the others take --draws or --sequences")
    if not has_images and light is not None:
        raise ValueError("--light: is for tiers a and b; the others have no day and dusk")
    if not has_flights and any(value is not None for value in (recipe, sequences, rig, tracker)):
        raise ValueError("--recipe, --sequences, --rig, --tracker: are for tiers e and docking")
    if engine is not None and not (has_flights or tier == "b"):
        raise ValueError("--engine: is for tiers b, e and docking; tier a is of analytic images")
    if draws is not None and draws < 2:
        raise ValueError(f"--draws: must be at least 2, got {draws}")
    flights = FlightOptions(
        recipes=tuple(dict.fromkeys(recipe or ())),
        rigs=tuple(dict.fromkeys(rig or (DEFAULT_RIG,))),
        sequences=sequences,
        tracker=tracker or DEFAULT_TRACKER,
    )
    options = AcceptanceOptions(
        tier=tier,
        seed=seed,
        pairs_per_station=pairs_per_station,
        draws=draws,
        engines=tuple(dict.fromkeys(engine or ())),
        lights=tuple(dict.fromkeys(light or LightLevel)),
        workers=workers,
        flights=flights,
    )
    table = measure_tier(options, out, progress_report())
    for line in table.to_lines():
        typer.echo(line)
    typer.echo(f"wrote {out / 'bars.json'} and {out / 'bars.md'}")
    if table.missed:
        typer.echo(f"{table.missed} criteria are missed", err=True)
        raise typer.Exit(FAULT)


def run_command(arguments: list[str]) -> int:
    """Run the command line of the acceptance study, and return its exit code."""
    command = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    command.command(epilog="\n".join(["\b", "Examples:", *(f"  {line}" for line in EXAMPLES)]))(acceptance)
    return run(arguments, command, "python -m studies.acceptance")


if __name__ == "__main__":
    sys.exit(run_command(sys.argv[1:]))
