"""Commands that tell about this machine: bench and doctor."""

from __future__ import annotations

from typing import Annotated

import typer

from droguekit.cli.arguments import DeviceOption, EngineOption, PositiveWorkersOption
from droguekit.cli.main import FAULT

EXAMPLES = {
    "bench": ("droguekit bench", "droguekit bench --repeat 5 --workers 8", "droguekit bench --pairs 500"),
    "doctor": ("droguekit doctor", "droguekit doctor --make-blender"),
}


def bench(
    repeat: Annotated[int, typer.Option("--repeat", help="Pairs at each distance.")] = 2,
    pairs: Annotated[
        int, typer.Option("--pairs", help="Pairs at distances uniform from 2 to 40 m, for each quality.")
    ] = 40,
    workers: PositiveWorkersOption = None,
    engine: EngineOption = None,
    device: DeviceOption = "cpu",
) -> None:
    """Measure the CPU time of a full-size pair by distance and stage, everything included.

    First at five distances, in one process with one thread and with 16 samples a pixel; the first pair does not count.
    Then the mean over distances uniform from 2 to 40 m in eight scenes, with 16 and with 64 samples, the renderer's
    noise on the drogue relative to the sensor's (root mean square over pairs), and by how much the process's memory
    grows from the first fifth of the pairs to the last pair. Last, how many of these pairs all workers make a second.
    """
    from droguekit.workflows.render_timing import render_timing_lines

    for line in render_timing_lines(repeat, pairs, workers, engine, device):
        typer.echo(line)


def doctor(
    make_blender: Annotated[
        bool,
        typer.Option(
            "--make-blender",
            help="First make a virtual environment with Blender (350 MB), for a Python that Blender's package has no "
            "wheel for.",
        ),
    ] = False,
) -> None:
    """Show what is installed here, which engines work, and what is missing.

    Exits with 1 when the path tracer does not work; labels, navigation and benchmark work without any.
    """
    from droguekit.workflows.installation import installation_lines

    if make_blender:
        from droguekit.workflows.installation import make_blender as steps

        for line in steps():
            typer.echo(line)
    lines = installation_lines()
    while True:
        try:
            typer.echo(next(lines))
        except StopIteration as end:
            if not end.value:
                raise typer.Exit(FAULT) from None
            return
