"""Commands that show datasets and models: preview, browse, view, model."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from datasets_manifest.atomic import part_path, sync_folder
from droguekit.cli.arguments import DatasetArgument, WorkersOption, parse_frames
from droguekit.cli.main import FAULT
from droguekit.cli.outputs import output_option

EXAMPLES = {
    "preview": (
        "droguekit preview data/demo --out sheet.png",
        "droguekit preview data/demo --out sheet.jpg --count 6 --columns 2 --tile-width 640",
        "droguekit preview data/world --out sheet.jpg --by-family --count 30   (no labels, a row for each family)",
        "droguekit preview data/docking-10m --animate docking.gif --sequence 1   (the flight from the side)",
        "droguekit preview data/docking-10m --overlay out.mp4 --estimates estimates.jsonl --method joint --sequence 0",
    ),
    "browse": (
        "droguekit browse data/demo --out demo-page",
        "droguekit browse data/demo --estimates estimates.jsonl --out demo-page",
        "droguekit browse s3://bucket/corpus --out corpus-page --workers 4",
    ),
    "view": (
        "droguekit view data/docking-10m --estimates estimates.jsonl",
        "droguekit view data/docking-10m --frames 0:200 --save docking.rrd   (for `rerun docking.rrd` elsewhere)",
    ),
    "model": (
        "droguekit model red-8 --out drogue.glb",
        "droguekit model my-drogue.toml --out my-drogue.ply",
    ),
}


_TILE_WIDTH_PX = 400


def preview(
    dataset: DatasetArgument,
    out: Annotated[Path | None, output_option("--out", "FILE", "A .png or .jpg file.")] = None,
    count: Annotated[
        int | None,
        typer.Option(
            "--count", help="How many pairs, spread evenly; 20, or 150 of an animation or overlay.", show_default=False
        ),
    ] = None,
    columns: Annotated[
        int | None,
        typer.Option("--columns", help="Tiles in a row, 4; or families side by side, 1.", show_default=False),
    ] = None,
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
    if out is None and (by_family or columns is not None or tile_width != _TILE_WIDTH_PX):
        raise ValueError("--by-family, --columns, --tile-width: go with --out; leave them out of a video")
    if sequence is not None and out is not None:
        raise ValueError("--sequence: goes with --animate or --overlay; leave it out for a sheet")
    if overlay is None and (estimates is not None or method is not None):
        raise ValueError("--estimates, --method: go with --overlay")
    if method is not None and estimates is None:
        raise ValueError("--method: goes with --estimates, a file that holds it")
    if out is not None:
        from droguekit.visualization.contact_sheet import write_contact_sheet

        if columns is None:
            columns = 1 if by_family else 4
        shown, pairs = write_contact_sheet(dataset, out, 20 if count is None else count, columns, tile_width, by_family)
        typer.echo(f"wrote {out}: {shown} of {pairs} pairs")
        return
    from datasets_manifest.storage.reader import Dataset

    source, most = Dataset(dataset), 150 if count is None else count
    if animate is not None:
        from droguekit.visualization.side_view import write_animation

        written = write_animation(source, animate, most, sequence)
    else:
        from droguekit.visualization.overlay_video import read_estimates_of_method, write_overlay_video

        chosen = ("", {}) if estimates is None else read_estimates_of_method(estimates, source, method)
        assert overlay is not None
        written = write_overlay_video(source, overlay, most, sequence, chosen)
    of = f"{written.pairs} of {len(source.frame_indices)} pairs, {written.length_s:.1f} s{written.pace_text}"
    typer.echo(f"wrote {animate or overlay}: {of}")


def browse(
    dataset: DatasetArgument,
    out: Annotated[Path, output_option("--out", "DIR", "The page's folder; open index.html.")],
    estimates: Annotated[
        Path | None, typer.Option("--estimates", metavar="FILE.jsonl", help="Poses to show beside the truth.")
    ] = None,
    workers: WorkersOption = None,
) -> None:
    """Write a page to look through a dataset, with filters, and with labels and estimates drawn over both images.

    The page needs no server and no network. Run again, the command keeps the pictures that are still valid. It exits
    with 1 when some pairs could not be read; it names them, and the page shows the others.
    """
    from droguekit.batch.execution import default_workers
    from droguekit.batch.progress import progress_report
    from droguekit.visualization.browse.page import write_browse

    if workers is not None and workers < 0:
        raise ValueError(f"--workers: must not be negative, got {workers}")
    summary = write_browse(
        dataset, out, estimates, default_workers() if workers is None else workers, progress_report()
    )
    for one in summary.skipped:
        typer.echo(f"frame {one.frame_index} is left out: {one.reason}", err=True)
    kept = f", {summary.kept} of them with the pictures of an earlier run" if summary.kept else ""
    typer.echo(f"wrote {out / 'index.html'}: {summary.shown} pairs{kept}")
    if summary.skipped:
        raise typer.Exit(FAULT)


_SUFFIX = ".rrd"


def view(
    dataset: DatasetArgument,
    estimates: Annotated[
        Path | None, typer.Option("--estimates", metavar="FILE.jsonl", help="Poses to show beside the truth.")
    ] = None,
    frames: Annotated[
        str | None, typer.Option("--frames", metavar="A:B", help="Only frames from A up to B - 1.")
    ] = None,
    save: Annotated[
        Path | None, output_option("--save", "FILE.rrd", "Write a recording instead of opening the viewer.")
    ] = None,
) -> None:
    """Show a dataset in the rerun viewer: both images with boxes and markers, the drogue in 3-D, errors over time.

    Needs the extra `viz`. Exits with 1 when some pairs could not be read; they are named, and the others are shown.
    """
    if save is not None and save.suffix != _SUFFIX:
        raise ValueError(f"--save: must end in {_SUFFIX}, got {save}")
    if save is None and not any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
        raise ValueError("view: there is no screen here to open the viewer on; write a recording with --save FILE.rrd")
    try:
        import rerun  # noqa: F401
    except ImportError as error:
        raise ValueError("view: rerun is not installed; pip install 'droguekit[viz]'") from error
    from datasets_manifest.types.estimates import read_estimates
    from droguekit.batch.progress import progress_report
    from droguekit.scoring.poses.pose_errors import estimates_by_method
    from droguekit.visualization.rerun_viewer import open_pairs, view_pairs

    source = open_pairs(dataset)
    if not source.frame_indices:
        raise ValueError(f"{dataset}: holds no pairs yet")
    wanted = parse_frames(frames, source.frame_indices[-1] + 1)
    chosen = [index for index in source.frame_indices if index in wanted]
    if not chosen:
        raise ValueError(f"--frames: the dataset holds none of these pairs, got {frames}")
    answers = (
        {}
        if estimates is None
        else estimates_by_method(read_estimates(estimates), source.frame_indices, str(estimates))
    )
    summary = view_pairs(source, chosen, answers, save, progress_report())
    for fault in summary.faults:
        typer.echo(fault, err=True)
    if save is not None and summary.shown:
        typer.echo(f"wrote {save}: {len(summary.shown)} pairs")
    if summary.faults:
        raise typer.Exit(FAULT)


FORMATS = (".glb", ".ply", ".stl", ".obj")


def model(
    preset_or_file: Annotated[
        str, typer.Argument(metavar="PRESET|FILE.toml", help="A shipped drogue, or one described in a TOML file.")
    ] = "red-8",
    *,
    out: Annotated[
        Path,
        typer.Option("--out", metavar="FILE", help=f"The mesh to write; its ending says how: {', '.join(FORMATS)}."),
    ],
) -> None:
    """Write the drogue as a mesh, in metres, z from the mouth to the hose.

    GLB keeps one node per part with its colour, PLY and OBJ have coloured vertices, STL has the shape only.
    """
    from drogue_models.presets import load_drogue

    if out.suffix.lower() not in FORMATS:
        raise ValueError(f"--out: must end in one of {', '.join(FORMATS)}, got {str(out)!r}")
    drogue = load_drogue(preset_or_file)
    from drogue_models.drogue_surfaces import drogue_surfaces, encode_mesh_file

    surfaces = drogue_surfaces(drogue)
    _write(encode_mesh_file(surfaces, out.suffix.lower()), out)
    meshes = {part: surface.mesh for part, surface in surfaces.items()}
    low = [min(float(mesh.bounds[0][axis]) for mesh in meshes.values()) for axis in range(3)]
    high = [max(float(mesh.bounds[1][axis]) for mesh in meshes.values()) for axis in range(3)]
    bounds = ", ".join(f"{axis} {a:.3f} to {b:.3f} m" for axis, a, b in zip("xyz", low, high, strict=True))
    triangles = sum(len(mesh.faces) for mesh in meshes.values())
    typer.echo(f"wrote {out}: {drogue.name}, {bounds}, {triangles} triangles in {len(meshes)} parts")


def _write(data: bytes, out: Path) -> None:
    """The file, whole or not at all; a folder that is missing is an error, where `write_bytes_atomic` makes it."""
    part = part_path(out)
    try:
        with part.open("xb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(out)
        sync_folder(out.parent)
    except OSError as error:
        raise ValueError(f"--out: {out} cannot be written: {error.strerror}") from error
    finally:
        # On a read-only file system this fails too, which must not hide the reason.
        with suppress(OSError):
            part.unlink(missing_ok=True)
