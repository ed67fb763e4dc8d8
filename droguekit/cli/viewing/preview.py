"""`droguekit preview`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from droguekit.cli.arguments import DatasetArgument, output_option

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
        Path | None, output_option("--overlay", "FILE", "An .mp4 or .gif file: left images with truth and estimates.")
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

    A dataset without truth, such as an imported one, is drawn without labels. Instead of a sheet, --animate makes a
    video of the flight from the side, and --overlay one of the left images with truth and estimates; both need truth.
    MP4 needs the extra `video`.
    """
    if sum(file is not None for file in (out, animate, overlay)) != 1:
        raise ValueError("--out, --animate, --overlay: give one of them, a file for a sheet or for a video")
    if out is None and (by_family or columns != _COLUMNS or tile_width != _TILE_WIDTH_PX):
        raise ValueError("--by-family, --columns, --tile-width: go with --out; leave them out of a video")
    if sequence is not None and out is not None:
        raise ValueError("--sequence: goes with --animate or --overlay; leave it out for a sheet")
    if overlay is None and (estimates is not None or method is not None):
        raise ValueError("--estimates, --method: go with --overlay")
    if method is not None and estimates is None:
        raise ValueError("--method: goes with --estimates, a file that holds it")
    if out is not None:
        from droguekit.visualization.contact_sheet import write_contact_sheet

        shown, pairs = write_contact_sheet(dataset, out, 20 if count is None else count, columns, tile_width, by_family)
        typer.echo(f"wrote {out}: {shown} of {pairs} pairs")
        return
    from datasets_manifest.storage.reader import Dataset

    source, most = Dataset(dataset), 150 if count is None else count
    if animate is not None:
        from droguekit.visualization.side_view import write_animation

        shown, length_s = write_animation(source, animate, most, sequence)
    elif overlay is not None:
        from droguekit.visualization.overlay_video import read_estimates_of_method, write_overlay_video

        chosen = ("", {}) if estimates is None else read_estimates_of_method(estimates, source, method)
        shown, length_s = write_overlay_video(source, overlay, most, sequence, chosen)
    typer.echo(f"wrote {animate or overlay}: {shown} of {len(source.frame_indices)} pairs, {length_s:.1f} s")
