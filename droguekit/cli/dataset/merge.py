"""`droguekit merge`."""

from __future__ import annotations

from typing import Annotated

import typer

from datasets_manifest.storage.storage import as_location
from droguekit.batch.progress import human_size, progress_report
from droguekit.cli.arguments import Place, TarOption, places
from droguekit.cli.main import FAULT

EXAMPLES = ("droguekit merge data/demo data/demo-0 data/demo-1",)


def merge(
    out: Annotated[
        Place,
        typer.Argument(
            metavar="OUT", parser=str, callback=as_location, help="The dataset's folder, made if missing, or a URL."
        ),
    ],
    shards: Annotated[
        list[Place],
        typer.Argument(
            metavar="SHARD...", parser=str, callback=places, help="Folders or URLs that `render --shard` made."
        ),
    ],
    tar: TarOption = None,
) -> None:
    """Join shards of one recipe into the dataset that a single run would have made.

    Refuses shards of different recipes, versions or processors, and shards with missing or damaged frames.
    """
    from droguekit.batch.merge_shards import merge_shards

    summary = merge_shards(out, shards, progress_report(), tar)
    size = human_size(summary.totals.size_bytes)
    typer.echo(f"{out}: joined {len(summary.totals.made)} pairs ({size}), kept {summary.kept}")
    typer.echo(f"{summary.pairs} of {summary.planned} pairs are there; dataset sha256 {summary.dataset_sha256}")
    for drop in summary.drops:
        typer.echo(f"frame {drop.frame_index} is missing: {drop.reason}", err=True)
    if summary.drops:
        raise typer.Exit(FAULT)
