"""`droguekit bench`."""

from __future__ import annotations

from typing import Annotated

import typer

from droguekit.cli.arguments import DeviceOption, EngineOption, WorkersOption
from droguekit.workflows.render_timing import render_timing_lines

EXAMPLES = ("droguekit bench", "droguekit bench --repeat 5 --workers 8", "droguekit bench --pairs 500")


def bench(
    repeat: Annotated[int, typer.Option("--repeat", help="Pairs at each distance.")] = 2,
    pairs: Annotated[
        int, typer.Option("--pairs", help="Pairs at distances uniform from 2 to 40 m, for each quality.")
    ] = 40,
    workers: WorkersOption = None,
    engine: EngineOption = None,
    device: DeviceOption = "cpu",
) -> None:
    """Measure the CPU time of a full-size pair by distance and stage, everything included.

    First at five distances, in one process with one thread and with 16 samples a pixel; the first pair does not count.
    Then the mean over distances uniform from 2 to 40 m in eight scenes, with 16 and with 64 samples, the renderer's
    noise on the drogue relative to the sensor's (root mean square over pairs), and by how much the process's memory
    grows from the first fifth of the pairs to the last pair. Last, how many of these pairs all workers make a second.
    """
    for line in render_timing_lines(repeat, pairs, workers, engine, device):
        typer.echo(line)
