"""`droguekit demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from datasets_manifest.storage.manifest import read_manifest
from droguekit.batch.execution import ExecutionOptions
from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import DeviceOption, RecipeArgument, WorkersOption
from droguekit.cli.main import FAULT
from droguekit.cli.outputs import output_option
from droguekit.workflows.benchmarking import benchmark_dataset
from droguekit.workflows.navigation import navigate_dataset
from droguekit.workflows.rendering import open_recipe, render_frames

EXAMPLES = {
    "demo": (
        "droguekit demo",
        "droguekit demo --out /tmp/look --workers 1",
        "droguekit demo smoke --out out/smoke   (another recipe: six small pairs, in seconds)",
    ),
}

# Once at each of the demo's ten distances, and a little more.
_FIRST_PAIRS = 12


def demo(
    recipe: RecipeArgument = "demo",
    out: Annotated[Path, output_option("--out", "DIR", "Where everything goes.")] = Path("out/demo"),
    workers: WorkersOption = None,
    device: DeviceOption = "cpu",
) -> None:
    """Render a small dataset of a drogue from 40 m down to 1.7 m, estimate poses without the truth, and write a report.

    Writes dataset/, estimates.jsonl, benchmark.json and report.html. The first 12 pairs get a report at once, if one of
    them has a drogue; then all. Run again, it keeps pairs that exist.
    """
    dataset, estimates, numbers, page = (
        out / name for name in ("dataset", "estimates.jsonl", "benchmark.json", "report.html")
    )
    source, show = open_recipe(recipe, None, None), progress_report()
    count = source.recipe.frames.count
    for pairs in sorted({min(_FIRST_PAIRS, count), count}):
        show.say(f"1 of 3: rendering {pairs} stereo pairs into {dataset}")
        summary = render_frames(source, dataset, range(pairs), ExecutionOptions(workers, device=device), show)
        if summary.pairs > pairs:
            continue  # an earlier run went further
        counts = read_manifest(dataset).counts
        if pairs < count and counts.pairs == counts.empty:
            show.say(f"no drogue in the first {pairs} pairs, so there is no first report; going on to {count}")
            continue
        show.say("2 of 3: estimating poses by every method, without the truth")
        navigate_dataset(dataset, (), estimates, show)
        show.say("3 of 3: comparing the estimates with the truth")
        benchmark_dataset(dataset, estimates, numbers, page)
        if pairs < count:
            show.say(f"{page} has a first report, of {summary.pairs} pairs; going on to {count}")
    typer.echo(f"{summary.pairs} pairs in {dataset}, dataset sha256 {summary.dataset_sha256}")
    typer.echo(f"numbers in {numbers}")
    typer.echo(f"open {page} in a browser to see how accurate the pose is at each distance")
    if summary.drops:
        typer.echo(f"{len(summary.drops)} pairs could not be made; {dataset}/manifest.json says why", err=True)
        raise typer.Exit(FAULT)
