"""`droguekit preview`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.cli.arguments import DatasetArgument

EXAMPLES = (
    "droguekit preview data/demo --out sheet.png",
    "droguekit preview data/demo --out sheet.jpg --count 6 --columns 2 --tile-width 640",
    "droguekit preview data/world --out sheet.jpg --by-family --count 30   (no labels, a row for each family)",
)


def preview(
    dataset: DatasetArgument,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="A .png or .jpg file.")],
    count: Annotated[int, typer.Option("--count", help="How many pairs, spread evenly over the dataset.")] = 20,
    columns: Annotated[int, typer.Option("--columns", help="Tiles in a row, or families side by side.")] = 4,
    tile_width: Annotated[int, typer.Option("--tile-width", metavar="PX", help="Width of a tile.")] = 400,
    by_family: Annotated[
        bool, typer.Option("--by-family", help="A row for each family of conditions, without labels.")
    ] = False,
) -> None:
    """Draw a contact sheet of left images with the drogue's box, the features' centres and the distance."""
    import cv2
    import numpy as np

    from datasets_manifest.reader import Dataset
    from droguekit.cli.contact_sheet import draw_contact_sheet, draw_family_sheet

    for name, value, low, high in (
        ("count", count, 1, 400),
        ("columns", columns, 1, 40),
        ("tile-width", tile_width, 64, 4096),
    ):
        if not low <= value <= high:
            raise ValueError(f"--{name}: must be from {low} to {high}, got {value}")
    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise ValueError(f"--out: must end in .png or .jpg, got {out}")
    source = Dataset(dataset)
    if not source.frame_indices:
        raise ValueError(f"{dataset}: holds no pairs yet")
    if by_family:
        sheet, shown = draw_family_sheet(source, count, columns, tile_width)
    else:
        places = np.linspace(0, len(source.frame_indices) - 1, min(count, len(source.frame_indices))).round()
        frames = [source.frame_indices[int(place)] for place in places]
        sheet, shown = draw_contact_sheet(source, frames, min(columns, len(frames)), tile_width), len(frames)
    _, data = cv2.imencode(out.suffix.lower(), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    _write_whole(out, data.tobytes())
    typer.echo(f"wrote {out}: {shown} of {len(source.frame_indices)} pairs")


def _write_whole(path: Path, data: bytes) -> None:
    from datasets_manifest.atomic import part_path

    part = part_path(path)
    try:
        part.write_bytes(data)
        part.replace(path)
    except OSError as error:
        raise OSError(error.errno, f"{path}: cannot be written: {error.strerror}") from error
    finally:
        part.unlink(missing_ok=True)
