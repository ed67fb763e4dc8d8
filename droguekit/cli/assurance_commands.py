"""Commands that tell what datasets and photographs cover, and what to render next: coverage, diff, mine, real-check."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from pydantic import BaseModel

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import DatasetArgument, OtherDatasetArgument, Place, exit_with_fault, named_place
from droguekit.cli.main import FAULT
from droguekit.cli.outputs import output_option

EXAMPLES = {
    "coverage": (
        "droguekit coverage data/world --html coverage.html",
        "droguekit coverage data/world --odd my-domain.toml --json coverage.json",
        "droguekit coverage data/world --estimates estimates.jsonl --detections boxes.json --html coverage.html",
    ),
    "mine": (
        "droguekit mine data/world --detections boxes.json --out mined.toml",
        "droguekit mine data/world --estimates estimates.jsonl --method joint-hub --kept 0.7 --out mined.toml",
    ),
    "real-check": (
        "droguekit real-check photographs --html check.html",
        "droguekit real-check photographs --boxes boxes.json --known data/world --html check.html",
        "droguekit real-check photographs --detector my-network.onnx --boxes boxes.json --json check.json",
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

    Exits with 1 where labels or pixels differ, and where there are too few scenes or pairs to tell any difference.
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
    if found.differs or not found.can_tell:
        raise typer.Exit(FAULT)


def mine(
    dataset: DatasetArgument,
    out: Annotated[Path, output_option("--out", "FILE.toml", "Write the new recipe; its name is the file's.")],
    estimates: Annotated[
        Path | None, typer.Option("--estimates", metavar="FILE.jsonl", help="Poses whose failures count.")
    ] = None,
    detections: Annotated[
        Path | None, typer.Option("--detections", metavar="FILE.json", help="Boxes whose failures count.")
    ] = None,
    method: Annotated[
        str | None, typer.Option("--method", metavar="NAME", help="Whose failures, where there are several.")
    ] = None,
    kept: Annotated[
        float, typer.Option("--kept", metavar="SHARE", help="Share of the frames that follow the old laws.")
    ] = 0.5,
    distance_bins: Annotated[
        int, typer.Option("--distance-bins", metavar="N", help="Bins of distance, with equally many frames before.")
    ] = 8,
    position_error: Annotated[
        float, typer.Option("--position-error", metavar="SHARE", help="Of the distance, up to which a pose is solved.")
    ] = 0.01,
    count: Annotated[int | None, typer.Option("--count", metavar="N", help="Pairs of the new recipe.")] = None,
    seed: Annotated[int | None, typer.Option("--seed", metavar="N", help="Its seed; the old one plus 1.")] = None,
    recipe: Annotated[
        Path | None,
        typer.Option("--recipe", metavar="FILE.toml", help="The recipe that the dataset was rendered from."),
    ] = None,
    json_: Annotated[Path | None, output_option("--json", "FILE", "Write the shares.")] = None,
) -> None:
    """Write a recipe that draws more of what a detector or an estimator fails at.

    A share of the frames (--kept) follows the laws of before, the others the failures under them: by family, by drogue
    and by distance.
    """
    from datasets_manifest.atomic import write_text_atomic
    from datasets_manifest.recipe.recipe import parse_recipe
    from droguekit.assurance.hard_example_mining import MiningChoices, mine_recipe, mined_lines

    if out.suffix != ".toml":
        raise ValueError(f"--out: must be a .toml file, which `render` takes, got {out}")
    choices = MiningChoices(method, kept, distance_bins, position_error, seed, count, recipe)
    boxes = () if detections is None else (detections,)
    mined = mine_recipe(dataset, out, choices, estimates, boxes, progress_report())
    out.parent.mkdir(parents=True, exist_ok=True)  # files are named as seen from there
    parse_recipe(mined.text, out.parent)
    for line in mined_lines(mined):
        typer.echo(line)
    write_text_atomic(out, mined.text)
    typer.echo(f"wrote {out}")
    _write_numbers(mined, json_)


def real_check(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR", help="Folder of pictures of any sizes, with the folders in it.", show_default=False
        ),
    ],
    boxes: Annotated[
        Path | None,
        typer.Option("--boxes", metavar="FILE.json", help="COCO boxes; a picture that is listed without shows none."),
    ] = None,
    box_category: Annotated[
        str | None, typer.Option("--box-category", metavar="NAME", help="Of the boxes that count; drogue by default.")
    ] = None,
    detector: Annotated[
        str,
        typer.Option(
            "--detector", metavar="NAME|FILE.onnx", help="Network to look with, perhaps with @HEIGHTxWIDTH behind it."
        ),
    ] = "mobile-s",
    least_score: Annotated[
        float | None,
        typer.Option("--least-score", help="Boxes with a lower score do not count; the detector's own by default."),
    ] = None,
    known: Annotated[
        Place | None,
        typer.Option(
            "--known",
            metavar="DATASET",
            parser=str,
            callback=named_place,
            help="Rendered dataset whose conditions the pictures are compared with.",
        ),
    ] = None,
    json_: Annotated[Path | None, output_option("--json", "FILE", "Write the boxes and numbers.")] = None,
    html: Annotated[Path | None, output_option("--html", "FILE", "Write one page with all pictures and boxes.")] = None,
) -> None:
    """Look for drogues in photographs, one by one, and show hits, misses and false alarms.

    With --known, also which conditions of a dataset each picture looks like, and which look like none of them.

    Exits with 1 where a picture cannot be read.
    """
    from droguekit.assurance.photograph_check import check_lines, check_photographs
    from droguekit.visualization.photograph_page import write_photograph_page

    found = check_photographs(
        folder,
        detector,
        progress_report(),
        boxes=boxes,
        category=box_category,
        known=known,
        least_score=least_score,
    )
    for line in check_lines(found):
        typer.echo(line)
    _write_numbers(found, json_)
    if html is not None:
        write_photograph_page(found, folder, html)
        typer.echo(f"wrote {html}")
    exit_with_fault(found.fault)


def _write_numbers(found: BaseModel, out: Path | None) -> None:
    from datasets_manifest.atomic import write_text_atomic

    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_text_atomic(out, found.model_dump_json(indent=1) + "\n")
