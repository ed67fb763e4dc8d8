"""`droguekit benchmark`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from datasets_manifest.storage.layout import BLIND_FILE
from datasets_manifest.storage.storage import Location, open_storage
from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import DatasetArgument, output_option
from droguekit.workflows.benchmarking import benchmark_dataset, check_blind_dataset
from droguekit.workflows.detection import DetectionOptions, benchmark_detections

if TYPE_CHECKING:
    from droguekit.benchmark.blind_check import BlindCheck
    from droguekit.benchmark.pose_benchmark import BenchmarkResult

EXAMPLES = (
    "droguekit benchmark data/demo --estimates estimates.jsonl --json benchmark.json --html report.html",
    "droguekit benchmark data/demo --estimates somebody-elses.jsonl",
    "droguekit benchmark data/corpus --detections ours.json --detections theirs.json --html detectors.html",
    "droguekit benchmark data/corpus --detector color-blob --json detectors.json",
)


def benchmark(
    dataset: DatasetArgument,
    estimates: Annotated[
        Path | None,
        typer.Option("--estimates", metavar="FILE.jsonl", help="Of `navigate`, or anybody's in that format."),
    ] = None,
    detections: Annotated[
        list[Path] | None,
        typer.Option("--detections", metavar="FILE.json", help="Of `detect`, or anybody's COCO results. Repeatable."),
    ] = None,
    detector: Annotated[
        list[str] | None,
        typer.Option("--detector", metavar="NAME|FILE.onnx", help="Runs a detector and scores it. Repeatable."),
    ] = None,
    split: Annotated[
        str | None,
        typer.Option("--split", metavar="NAME", help="Detectors: train, val, test or all; by default test if there."),
    ] = None,
    threshold: Annotated[
        float | None,
        typer.Option("--threshold", help="Detectors: score from which a box counts in recall and false alarms."),
    ] = None,
    json_: Annotated[Path | None, output_option("--json", "FILE", "Gets the numbers.")] = None,
    html: Annotated[Path | None, output_option("--html", "FILE", "Gets the report, one page.")] = None,
) -> None:
    """Compare pose estimates, or a detector's boxes, with the truth of a dataset.

    An imported dataset has none: there, estimates are compared with their own measurements, and both with boxes if any.
    """
    options = DetectionOptions(detections or (), detector or (), split, threshold)
    for line in _lines(dataset, estimates, options, json_, html):
        typer.echo(line)
    for path in (json_, html):
        if path is not None:
            typer.echo(f"wrote {path}")


def _lines(
    dataset: Location, estimates: Path | None, options: DetectionOptions, json_out: Path | None, html_out: Path | None
) -> Iterator[str]:
    wants_detections = bool(options.files or options.detectors)
    if (estimates is not None) == wants_detections:
        raise ValueError("--estimates: give either estimates, or detections (--detections, --detector)")
    if estimates is None:
        from droguekit.benchmark.detection.detection_tables import detector_lines

        return detector_lines(benchmark_detections(dataset, options, json_out, html_out, progress_report()))
    if options.split is not None or options.threshold is not None:
        raise ValueError("--split, --threshold: are for detections, not for estimates")
    if open_storage(dataset).exists(BLIND_FILE):
        return _blind_lines(check_blind_dataset(dataset, estimates, json_out, html_out))
    return _error_lines(benchmark_dataset(dataset, estimates, json_out, html_out))


def _error_lines(result: BenchmarkResult) -> Iterator[str]:
    yield f"{'method':<16} {'fixes':>7} {'mean':>9} {'rmse':>9} {'p95':>9}   position error [mm]"
    for name, scores in result.methods.items():
        row = scores.overall
        errors = (row.position_mean_m, row.position_rmse_m, row.position_p95_m)
        shown = " ".join(f"{'-':>9}" if error is None else f"{1e3 * error:9.1f}" for error in errors)
        yield f"{name:<16} {100 * row.fix_fraction:6.1f}% {shown}"


def _blind_lines(check: BlindCheck) -> Iterator[str]:
    from droguekit.benchmark.blind_check import COLUMNS, row_cells

    yield f"{check.dataset.name} has no true poses: estimates are compared with their own measurements and with boxes"
    yield " ".join([f"{'method':<16}", *(f"{column:>16}" for column in COLUMNS)])
    for name in check.methods:
        yield " ".join([f"{name:<16}", *(f"{cell:>16}" for cell in row_cells(check, name))])
