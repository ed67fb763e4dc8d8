"""`python -m studies.render_cost`: cost of a stereo pair by our renderer and by plain Cycles and Mitsuba scripts.

The numbers of each distance are kept on disk.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from datasets_manifest.atomic import write_text_atomic
from droguekit.batch.worker_pool import run_in_own_process
from studies.render_cost.noise_search import (
    SCENES,
    STATIONS_M,
    NoiseEstimate,
    RenderCost,
)
from studies.render_cost.renderers import measure_own_path, measure_plain_cycles, measure_plain_mitsuba

OWN, CYCLES, MITSUBA = "own path", "plain Cycles", "plain Mitsuba"
_EXAMPLES = """Examples:

  python -m studies.render_cost

  python -m studies.render_cost --station 10 --station 40 --full-samples 4"""


def compare_at(
    distance_m: float, seed: int, repeat: int, full_samples: int | None, say: Callable[[str], None]
) -> dict[str, Any]:
    """Noise and cost of a pair by all renderers at one distance.

    Args:
        distance_m: of the drogue. [m]
        seed: of the frames.
        repeat: number of pairs over which our own cost is averaged.
        full_samples: most samples of Cycles over every pixel, or None without a limit.
        say: called with a line about progress.

    Raises:
        ValueError: Mitsuba or Blender is missing.
        OSError: a process ended.
    """
    say(f"{distance_m:g} m: {OWN}")
    own, own_cost, view = run_in_own_process(partial(measure_own_path, distance_m, seed, repeat))
    rows = {OWN: _row(own, own_cost)}
    say(f"{distance_m:g} m: {MITSUBA}, to reach a noise of {own.noise:.1%}")
    rows[MITSUBA] = _row(*run_in_own_process(partial(measure_plain_mitsuba, view, own.noise)))
    say(f"{distance_m:g} m: {CYCLES}, to reach a noise of {own.noise:.1%}")
    rows[CYCLES] = _row(*measure_plain_cycles(view, own.noise, full_samples))
    return {"schema": 1, "distance_m": distance_m, "seed": seed, "full_samples": full_samples, "renderers": rows}


def _row(noise: NoiseEstimate, cost: RenderCost) -> dict[str, Any]:
    return asdict(noise) | asdict(cost)


def station_file(out: Path, distance_m: float) -> Path:
    """File of the results at a distance."""
    return out / f"{distance_m:g}m.json"


def write_station(out: Path, found: dict[str, Any]) -> None:
    """Store the results at a distance; the file is written completely or not at all."""
    write_text_atomic(station_file(out, found["distance_m"]), json.dumps(found, indent=1) + "\n")


def read_station(out: Path, distance_m: float, seed: int, full_samples: int | None) -> dict[str, Any] | None:
    """Stored results at a distance with this seed and limit, or None."""
    file = station_file(out, distance_m)
    if not file.exists():
        return None
    found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return found if (found["seed"], found["full_samples"]) == (seed, full_samples) else None


def table_lines(stations: list[dict[str, Any]]) -> list[str]:
    """One table row per distance: the cost of each renderer, and the ratios to our own."""
    lines = [
        "| distance | noise | own path | plain Mitsuba | plain Cycles, OIDN | Mitsuba / own | Cycles / own |",
        "|---|---|---|---|---|---|---|",
    ]
    for station in stations:
        own, mitsuba, cycles = (station["renderers"][name] for name in (OWN, MITSUBA, CYCLES))
        lines.append(
            f"| {station['distance_m']:g} m | {own['noise']:.1%} | {own['cpu_s']:.2f} s | {_cost(mitsuba)} | "
            f"{_cost(cycles)} | {_ratio(mitsuba, own)} | {_ratio(cycles, own)} |"
        )
    return lines


def _cost(row: dict[str, Any]) -> str:
    mark = "*" if row["is_carried_on"] else ""
    return f"{'at least ' if row['is_least'] else ''}{row['cpu_s']:.0f} s at {row['samples']}{mark}"


def _ratio(row: dict[str, Any], own: dict[str, Any]) -> str:
    return f"{'at least ' if row['is_least'] else ''}{row['cpu_s'] / own['cpu_s']:.0f}"


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
