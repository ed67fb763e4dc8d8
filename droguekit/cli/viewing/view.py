"""`droguekit view`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from droguekit.cli.arguments import DatasetArgument, output_option, parse_frames
from droguekit.cli.main import FAULT

EXAMPLES = (
    "droguekit view data/docking-10m --estimates estimates.jsonl",
    "droguekit view data/docking-10m --frames 0:200 --save docking.rrd   (for `rerun docking.rrd` on another machine)",
)
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
    from droguekit.visualization.rerun_viewer.recording import open_pairs
    from droguekit.visualization.rerun_viewer.session import view_pairs

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
