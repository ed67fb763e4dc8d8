"""`python -m studies.render_cost`: cost of a stereo pair by our renderer and by plain Cycles and Mitsuba scripts.

Noise and cost of every renderer at one distance are kept on disk.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.types.frame import FrameSpec
from droguekit.batch.worker_pool import run_in_own_process
from render.camera.sensor import expose
from render.compositing import inside_one_part
from render.engine import load_engine
from render.mitsuba_engine.trace_request import DROGUE_PARTS
from scenes.sky.photometry import REC709_LUMINANCE
from studies.render_cost.cycles_messages import cpu_seconds
from studies.render_cost.noise_search import (
    SCENES,
    STATIONS_M,
    MeasuredView,
    NoiseEstimate,
    RenderCost,
    frame_at,
    recipe_at,
    relative_noise,
    with_seed_offset,
)
from studies.render_cost.plain_renderers import measure_plain_cycles, measure_plain_mitsuba

_PICTURES_FOR_NOISE = 4
OWN, CYCLES, MITSUBA = "own path", "plain Cycles", "plain Mitsuba"
_EXAMPLES = """Examples:

  python -m studies.render_cost

  python -m studies.render_cost --station 10 --station 40 --full-samples 4"""


def measure_own_path(distance_m: float, seed: int, repeat: int) -> tuple[NoiseEstimate, RenderCost, MeasuredView]:
    """Noise and cost of our renderer with default settings.

    Args:
        distance_m: of the drogue. [m]
        seed: of the frame.
        repeat: pairs over which the cost is averaged; fewer than `SCENES`.

    Returns:
        Noise, cost, and the view for the other renderers.
    """
    cv2.setNumThreads(1)
    engine = load_engine("mitsuba")
    settings = recipe_at(distance_m, seed).render
    # Loading the engine and compiling kernels do not count.
    engine.render(frame_at(distance_m, seed, index=repeat), settings)
    spent_s = 0.0
    # Each in a scene of its own, so that no sky is cached; the last one is the view that all renderers draw.
    for index in reversed(range(repeat)):
        began_s = cpu_seconds()
        frame = frame_at(distance_m, seed, index)
        radiance = engine.render(frame, settings)
        expose(frame, radiance)
        spent_s += cpu_seconds() - began_s

    def luminance(drawn: FrameSpec) -> NDArray[np.float64]:
        seen: NDArray[np.float64] = engine.render(drawn, settings).left.radiance_cd_m2 @ REC709_LUMINANCE
        return seen

    drogue = DROGUE_PARTS[radiance.left.part_id] > 0
    inside = drogue & inside_one_part(radiance.left.part_id)
    seen = [luminance(with_seed_offset(frame, by)) for by in range(_PICTURES_FOR_NOISE)]
    pairs = list(zip(seen[::2], seen[1::2], strict=True))
    noise, noise_inside = (
        float(np.sqrt(np.mean([relative_noise(one, other, mask) ** 2 for one, other in pairs])))
        for mask in (drogue, inside)
    )
    mean = float(np.mean(seen, axis=0)[drogue].mean())
    found = NoiseEstimate(samples=settings.samples_per_px, noise=noise, noise_inside=noise_inside, mean_cd_m2=mean)
    view = MeasuredView(frame=frame, settings=settings, drogue=drogue, inside=inside)
    return found, RenderCost(spent_s / repeat), view


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
