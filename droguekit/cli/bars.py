"""`droguekit bars`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import WorkersOption
from droguekit.cli.main import FAULT
from droguekit.cli.pipelines import BarsOrder, run_bars

EXAMPLES = (
    "droguekit bars c --out out/bars/c",
    "droguekit bars a --out out/bars/a --pairs-per-station 20   (a first look; the full number later goes on from it)",
    "droguekit bars d --out /tmp/d --draws 50 --seed 7",
    "droguekit bars speed --out /tmp/speed",
)
_IMAGE_TIERS = ("a", "b")


def bars(
    tier: Annotated[
        str,
        typer.Argument(
            metavar="TIER",
            help="a: analytic images, b: path-traced images, c: centroid noise and tolerances, d: bad markers, speed.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Keeps what is finished; gets bars.json, bars.md.")],
    pairs_per_station: Annotated[
        int | None, typer.Option("--pairs-per-station", help="Tiers a and b: pairs at each distance; all by default.")
    ] = None,
    draws: Annotated[
        int | None, typer.Option("--draws", help="Tiers c and d: frames a cell; the protocol's by default.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of everything drawn; 1 is for development.")] = 1,
    workers: WorkersOption = None,
) -> None:
    """Measure the accuracy bars of a tier: bar, measured value, its 95 % limit, met or not.

    Stopped and started again, it goes on with what is finished; results of other code are made again. Exit code 1 says
    that a bar is missed.
    """
    images = tier in _IMAGE_TIERS
    if images and draws is not None:
        raise ValueError("--draws: is for tiers c and d and speed; tiers a and b take --pairs-per-station")
    if not images and pairs_per_station is not None:
        raise ValueError("--pairs-per-station: is for tiers a and b; the others take --draws")
    if draws is not None and draws < 2:
        raise ValueError(f"--draws: must be at least 2, got {draws}")
    table = run_bars(BarsOrder(tier, seed, pairs_per_station, draws, workers), out, progress_report())
    for line in table.to_lines():
        typer.echo(line)
    typer.echo(f"wrote {out / 'bars.json'} and {out / 'bars.md'}")
    if table.missed:
        typer.echo(f"{table.missed} bars are missed", err=True)
        raise typer.Exit(FAULT)
