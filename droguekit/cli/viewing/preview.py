"""`droguekit preview`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from droguekit.cli.arguments import DatasetArgument, output_option

if TYPE_CHECKING:
    from datasets_manifest.storage.reader import Dataset
    from datasets_manifest.storage.storage import Location
    from droguekit.benchmark.report.label_drawing import Picture

EXAMPLES = (
    "droguekit preview data/demo --out sheet.png",
    "droguekit preview data/demo --out sheet.jpg --count 6 --columns 2 --tile-width 640",
    "droguekit preview data/world --out sheet.jpg --by-family --count 30   (no labels, a row for each family)",
    "droguekit preview data/docking-10m --animate docking.gif --sequence 1   (the flight from the side)",
    "droguekit preview data/docking-10m --overlay overlay.mp4 --estimates estimates.jsonl --method joint --sequence 0",
)
_COLUMNS, _TILE_WIDTH_PX = 4, 400


def preview(
    dataset: DatasetArgument,
    out: Annotated[Path | None, output_option("--out", "FILE", "A .png or .jpg file.")] = None,
    count: Annotated[
        int | None,
        typer.Option(
            "--count", help="How many pairs, spread evenly; 20, or 150 of an animation or overlay.", show_default=False
        ),
    ] = None,
    columns: Annotated[int, typer.Option("--columns", help="Tiles in a row, or families side by side.")] = _COLUMNS,
    tile_width: Annotated[int, typer.Option("--tile-width", metavar="PX", help="Width of a tile.")] = _TILE_WIDTH_PX,
    by_family: Annotated[
        bool, typer.Option("--by-family", help="A row for each family of conditions, without labels.")
    ] = False,
    animate: Annotated[
        Path | None, output_option("--animate", "FILE", "A .gif or .mp4 file: the flight from the side, in time.")
    ] = None,
    overlay: Annotated[
        Path | None,
        output_option(
            "--overlay", "FILE", "An .mp4 or .gif file: left images with boxes, outlines, estimates, errors."
        ),
    ] = None,
    estimates: Annotated[
        Path | None, typer.Option("--estimates", metavar="FILE.jsonl", help="Poses to draw in an overlay.")
    ] = None,
    method: Annotated[
        str | None, typer.Option("--method", metavar="NAME", help="Whose, where the file holds several methods.")
    ] = None,
    sequence: Annotated[
        int | None, typer.Option("--sequence", help="Only this sequence, in an animation or overlay.")
    ] = None,
) -> None:
    """Draw a contact sheet of left images with the drogue's box, the features' centres and the distance.

    A dataset without truth, such as an imported one, is drawn without them. Instead of a sheet: --animate makes a film
    of the flight from the side, --overlay one of the left images with truth and estimates; both need a dataset with
    its truth.
    """
    from datasets_manifest.storage.reader import Dataset

    if sum(file is not None for file in (out, animate, overlay)) != 1:
        raise ValueError("--out, --animate, --overlay: give one of them, a file for a sheet or for a film")
    if out is None and (by_family or columns != _COLUMNS or tile_width != _TILE_WIDTH_PX):
        raise ValueError("--by-family, --columns, --tile-width: go with --out; leave them out of a film")
    if sequence is not None and out is not None:
        raise ValueError("--sequence: goes with --animate or --overlay; leave it out for a sheet")
    if overlay is None and (estimates is not None or method is not None):
        raise ValueError("--estimates, --method: go with --overlay")
    if method is not None and estimates is None:
        raise ValueError("--method: goes with --estimates, a file that holds it")
    if animate is not None:
        _animate(Dataset(dataset), animate, 150 if count is None else count, sequence)
    if overlay is not None:
        _overlay(Dataset(dataset), overlay, 150 if count is None else count, sequence, (estimates, method))
    if out is not None:
        _check_sheet(out, 20 if count is None else count, columns, tile_width)
        sheet, shown, pairs = _draw_sheet(dataset, 20 if count is None else count, columns, tile_width, by_family)
        _write_picture(out, sheet)
        typer.echo(f"wrote {out}: {shown} of {pairs} pairs")


def _animate(source: Dataset, path: Path, count: int, sequence: int | None) -> None:
    from droguekit.visualization.side_view import write_animation

    _check_film("--animate", path, count)
    shown, length_s = write_animation(source, path, count, sequence)
    typer.echo(f"wrote {path}: {shown} of {len(source.frame_indices)} pairs, {length_s:.1f} s")


def _overlay(
    source: Dataset, path: Path, count: int, sequence: int | None, chosen: tuple[Path | None, str | None]
) -> None:
    from droguekit.visualization.overlay_video import read_method, write_overlay_video

    _check_film("--overlay", path, count)
    estimates, method = chosen
    answers = ("", {}) if estimates is None else read_method(estimates, source, method)
    shown, length_s = write_overlay_video(source, path, count, sequence, answers)
    typer.echo(f"wrote {path}: {shown} of {len(source.frame_indices)} pairs, {length_s:.1f} s")


def _check_film(option: str, path: Path, count: int) -> None:
    from droguekit.visualization.video_file import SUFFIXES

    if not 1 <= count <= 2000:
        raise ValueError(f"--count: must be from 1 to 2000 in a film, got {count}")
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{option}: must end in {' or '.join(SUFFIXES)}, got {path}")


def _check_sheet(out: Path, count: int, columns: int, tile_width: int) -> None:
    for name, value, low, high in (
        ("count", count, 1, 400),
        ("columns", columns, 1, 40),
        ("tile-width", tile_width, 64, 4096),
    ):
        if not low <= value <= high:
            raise ValueError(f"--{name}: must be from {low} to {high}, got {value}")
    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise ValueError(f"--out: must end in .png or .jpg, got {out}")


def _draw_sheet(
    dataset: Location, count: int, columns: int, tile_width: int, by_family: bool
) -> tuple[Picture, int, int]:
    """The sheet, how many pairs it shows, and how many there are."""
    import numpy as np

    from datasets_manifest.storage.blind import BlindDataset
    from datasets_manifest.storage.layout import BLIND_FILE
    from datasets_manifest.storage.reader import Dataset
    from datasets_manifest.storage.storage import open_storage
    from droguekit.visualization.contact_sheet import draw_blind_sheet, draw_contact_sheet, draw_family_sheet

    is_blind = open_storage(dataset).exists(BLIND_FILE)
    if is_blind and by_family:
        raise ValueError(f"--by-family: {dataset} has no truth, and so no families")
    source = BlindDataset(dataset) if is_blind else Dataset(dataset)
    pairs = len(source.frame_indices)
    if not pairs:
        raise ValueError(f"{dataset}: holds no pairs yet")
    if by_family and isinstance(source, Dataset):
        sheet, shown = draw_family_sheet(source, count, columns, tile_width)
        return sheet, shown, pairs
    places = np.linspace(0, pairs - 1, min(count, pairs)).round()
    frames = [source.frame_indices[int(place)] for place in places]
    columns = min(columns, len(frames))
    if isinstance(source, BlindDataset):
        return draw_blind_sheet(source, frames, columns, tile_width), len(frames), pairs
    return draw_contact_sheet(source, frames, columns, tile_width), len(frames), pairs


def _write_picture(path: Path, picture: Picture) -> None:
    import cv2

    from datasets_manifest.atomic import write_bytes_atomic

    _, data = cv2.imencode(path.suffix.lower(), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    write_bytes_atomic(path, data.tobytes())
