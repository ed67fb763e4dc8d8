"""`python -m studies.render_cost`: cost of a stereo pair by our renderer and by plain Cycles and Mitsuba scripts.

The numbers of each distance are kept on disk, and used again for the same options, code and machine.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from droguekit.batch.progress import ProgressReport, progress_report
from droguekit.batch.worker_pool import run_in_own_process
from studies.render_cost.noise_search import (
    SCENES,
    STATIONS_M,
    NoiseEstimate,
    RenderCost,
)
from studies.render_cost.renderers import measure_own_path, measure_plain_cycles, measure_plain_mitsuba
from studies.stored_figures import read_results, rendering_build, write_results
from studies.wrong_input import wrong_input_ends

OWN, CYCLES, MITSUBA = "own path", "plain Cycles", "plain Mitsuba"
_EXAMPLES = """Examples:

  python -m studies.render_cost

  python -m studies.render_cost --station 10 --station 40 --full-samples 4"""


@dataclass(frozen=True)
class CostOptions:
    """What the figures of a distance depend on besides code and machine.

    Attributes:
        seed: of the frames.
        repeat: number of pairs over which our own cost is averaged.
        full_samples: most samples of Cycles over every pixel, or None without a limit.
    """

    seed: int
    repeat: int
    full_samples: int | None


def compare_at(distance_m: float, options: CostOptions, report: ProgressReport) -> dict[str, Any]:
    """Noise and cost of a pair by all renderers at one distance.

    Args:
        distance_m: of the drogue. [m]
        options: of the measurement.
        report: is told of the progress.

    Raises:
        ValueError: Mitsuba or Blender is missing.
        OSError: a process ended.
    """
    report.say(f"{distance_m:g} m: {OWN}")
    own, own_cost, view = run_in_own_process(partial(measure_own_path, distance_m, options.seed, options.repeat))
    rows = {OWN: _row(own, own_cost)}
    report.say(f"{distance_m:g} m: {MITSUBA}, to reach a noise of {own.noise:.1%}")
    rows[MITSUBA] = _row(*run_in_own_process(partial(measure_plain_mitsuba, view, own.noise)))
    report.say(f"{distance_m:g} m: {CYCLES}, to reach a noise of {own.noise:.1%}")
    rows[CYCLES] = _row(*measure_plain_cycles(view, own.noise, options.full_samples))
    return {"distance_m": distance_m, "renderers": rows}


def _row(noise: NoiseEstimate, cost: RenderCost) -> dict[str, Any]:
    return asdict(noise) | asdict(cost)


def stored_station(out: Path, distance_m: float, options: CostOptions, report: ProgressReport) -> dict[str, Any]:
    """The figures at a distance, measured unless the same options, code and machine measured them before.

    Raises:
        ValueError: Mitsuba or Blender is missing, or stored figures are damaged.
        OSError: a process ended, or a file cannot be written.
    """
    file, name = out / f"{distance_m:g}m.json", f"{distance_m:g} m"
    made_by = {"options": asdict(options), **rendering_build(("studies.render_cost",))}
    known = read_results(file, made_by, report)
    if name not in known:
        known[name] = compare_at(distance_m, options, report)
        write_results(file, known, made_by)
    return known[name]


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
        Path,
        typer.Option("--out", help="Folder for the numbers; those of the same options, code and machine are kept."),
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
    options = CostOptions(seed, repeat, full_samples)
    with wrong_input_ends("render_cost"):
        stations = [stored_station(out, metres, options, progress_report()) for metres in station or STATIONS_M]
    typer.echo("\n".join(table_lines(stations)))
    typer.echo(f"samples after each cost; * by the square-root law from fewer; numbers are in {out}")


if __name__ == "__main__":
    app = typer.Typer(add_completion=False)
    app.command(epilog=_EXAMPLES)(main)
    app()
