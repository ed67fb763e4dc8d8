"""`python -m studies.render_cost`: cost of a stereo pair by our renderer and by plain Cycles and Mitsuba scripts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.render_cost.comparison import compare_at, read_station, table_lines, write_station
from studies.render_cost.noise_search import SCENES, STATIONS_M

_EXAMPLES = """Examples:

  python -m studies.render_cost

  python -m studies.render_cost --station 10 --station 40 --full-samples 4"""


def main(
    out: Annotated[
        Path, typer.Option("--out", help="Folder for the numbers; distances that are there are kept.")
    ] = Path("out/peer-comparison"),
    station: Annotated[list[float] | None, typer.Option("--station", help="A distance in metres; repeatable.")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the frames.")] = 1,
    repeat: Annotated[
        int, typer.Option("--repeat", min=1, max=SCENES - 1, help="Number of pairs for our own cost.")
    ] = 3,
    full_samples: Annotated[
        int | None,
        typer.Option(
            "--full-samples", min=1, help="Most samples of Cycles over all pixels; costs are then lower bounds."
        ),
    ] = None,
) -> None:
    """Measure CPU seconds of a stereo pair by our renderer, plain Cycles with OIDN and plain Mitsuba at equal noise."""
    stations = []
    try:
        for distance_m in station or STATIONS_M:
            found = read_station(out, distance_m, seed, full_samples)
            if found is None:
                found = compare_at(distance_m, seed, repeat, full_samples, lambda line: typer.echo(line, err=True))
                write_station(out, found)
            stations.append(found)
    except (ValueError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error
    typer.echo("\n".join(table_lines(stations)))
    typer.echo(f"samples after each cost; * by the square-root law from fewer; numbers are in {out}")


if __name__ == "__main__":
    app = typer.Typer(add_completion=False)
    app.command(epilog=_EXAMPLES)(main)
    app()
