"""`python -m droguekit.engine_agreement`: do two engines agree?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import cv2
import typer

from datasets_manifest.recipe import recipe_names
from droguekit.engine_agreement.agreement import bars, compared_frames
from droguekit.engine_agreement.paired_frames import STATIONS_M, paired_frames
from droguekit.engine_agreement.plates import compare_plates
from droguekit.engine_agreement.report import (
    bar_lines,
    frame_row,
    plate_lines,
    table_lines,
    write_json,
    write_picture,
)
from render.engine import load_engine


def main(
    out: Annotated[Path, typer.Option("--out", help="Folder for numbers and pictures.")] = Path("out/engine-agreement"),
    count: Annotated[int, typer.Option("--count", min=1, help="Frames.")] = 20,
    family: Annotated[list[str] | None, typer.Option("--family", help="A recipe; repeatable.")] = None,
    engine: Annotated[tuple[str, str], typer.Option("--engines", help="Which two.")] = ("mitsuba", "blender"),
    station: Annotated[list[float] | None, typer.Option("--station", help="A distance in metres; repeatable.")] = None,
    samples: Annotated[int, typer.Option("--samples", min=4, help="Most samples through a pixel.")] = 64,
    seed: Annotated[int, typer.Option("--seed", help="Of all that is drawn.")] = 20,
    plate_samples: Annotated[int, typer.Option("--plate-samples", min=0, help="0 leaves the plates out.")] = 256,
) -> None:
    """Render the same frames by two engines, before the sensor, and report what differs.

    Exits with 1 when a bar is missed.
    """
    cv2.setNumThreads(1)
    try:
        frames = paired_frames(family or recipe_names(), station or STATIONS_M, count, samples, seed)
        one, other = (load_engine(name) for name in engine)
    except ValueError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error
    (out / "frames").mkdir(parents=True, exist_ok=True)
    rows, agreements = [], []
    for index, compared in enumerate(compared_frames(frames, one, other)):
        rows.append(frame_row(compared))
        agreements.append(compared.agreement)
        write_picture(out / "frames" / f"{index:03d}.png", compared)
        typer.echo("\n".join(table_lines(rows[-1:])[index > 0 :]))
    plates = compare_plates(one, other, plate_samples) if plate_samples else []
    found = bars(agreements, [paired.distance_m for paired in frames], plates)
    write_json(out, rows, found, plates)
    typer.echo("\n".join([*plate_lines(plates), *bar_lines(found), f"numbers and pictures are in {out}"]))
    raise typer.Exit(0 if all(bar.reached for bar in found) else 1)


if __name__ == "__main__":
    typer.run(main)
