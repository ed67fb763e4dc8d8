"""Commands that tell what datasets cover, and how they differ: coverage, diff."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from drogue_models.frozen_model import FrozenModel
from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import DatasetArgument, OtherDatasetArgument, output_option
from droguekit.cli.main import FAULT

EXAMPLES = {
    "coverage": (
        "droguekit coverage data/world --html coverage.html",
        "droguekit coverage data/world --odd my-domain.toml --json coverage.json",
        "droguekit coverage data/world --estimates estimates.jsonl --detections boxes.json --html coverage.html",
    ),
    "diff": (
        "droguekit diff data/world data/world-2",
        "droguekit diff data/world s3://bucket/world --html diff.html --json diff.json",
        "droguekit diff data/before data/after --pairs 0   (labels alone)",
    ),
}


def coverage(
    dataset: DatasetArgument,
    odd: Annotated[
        str, typer.Option("--odd", metavar="NAME", help="Operational design domain: a shipped one, or a .toml file.")
    ] = "probe-and-drogue",
    estimates: Annotated[
        Path | None, typer.Option("--estimates", metavar="FILE.jsonl", help="Poses to score in each cell.")
    ] = None,
    detections: Annotated[
        list[Path] | None, typer.Option("--detections", metavar="FILE.json", help="Boxes to score in each cell.")
    ] = None,
    json_: Annotated[Path | None, output_option("--json", "FILE", "Write the numbers.")] = None,
    html: Annotated[
        Path | None, output_option("--html", "FILE", "Write one page with a table of each crossing.")
    ] = None,
) -> None:
    """Count a dataset's pairs in the cells of an operational design domain, and show which cells have too few.

    With estimates or detections, also how many of the pairs in each cell are solved.

    Exits with 1 where a cell has fewer pairs than the domain asks for.
    """
    from droguekit.assurance.coverage import coverage_lines, measure_coverage
    from droguekit.assurance.design_domain import load_domain
    from droguekit.visualization.coverage_page import write_coverage_page

    domain = load_domain(odd)
    found = measure_coverage(dataset, domain, estimates, detections or (), progress_report())
    for line in coverage_lines(found):
        typer.echo(line)
    _write_numbers(found, json_)
    if html is not None:
        write_coverage_page(found, domain, html)
        typer.echo(f"wrote {html}")
    if not found.is_complete:
        raise typer.Exit(FAULT)


def diff(
    a: DatasetArgument,
    b: OtherDatasetArgument,
    pairs: Annotated[
        int, typer.Option("--pairs", metavar="N", help="Compare the pixels of at most N pairs, each of another scene.")
    ] = 24,
    json_: Annotated[Path | None, output_option("--json", "FILE", "Write the numbers.")] = None,
    html: Annotated[
        Path | None, output_option("--html", "FILE", "Write one page with pictures of all laws and of some pairs.")
    ] = None,
) -> None:
    """Compare two datasets: recipes, software, laws of the labels, and statistics of the pixels.

    The last line tells what differs more than draws of one law do.

    Exits with 1 where labels or pixels differ.
    """
    from droguekit.assurance.dataset_diff import FALSE_ALARMS, diff_datasets, diff_lines
    from droguekit.visualization.diff_page import write_diff_page

    found = diff_datasets(a, b, pairs, progress_report())
    for line in diff_lines(found):
        typer.echo(line)
    _write_numbers(found, json_)
    if html is not None:
        write_diff_page(found, (a, b), html, FALSE_ALARMS)
        typer.echo(f"wrote {html}")
    if found.differs:
        raise typer.Exit(FAULT)


def _write_numbers(found: FrozenModel, out: Path | None) -> None:
    from datasets_manifest.atomic import write_text_atomic

    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_text_atomic(out, found.model_dump_json(indent=1) + "\n")
