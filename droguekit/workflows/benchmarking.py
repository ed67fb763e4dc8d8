"""Estimates against the truth of a dataset, or against its images alone where it has none."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from datasets_manifest.storage.storage import Location
    from droguekit.benchmark.blind_check import BlindCheck
    from droguekit.benchmark.pose_benchmark import BenchmarkResult


def benchmark_dataset(
    dataset: Location, estimates: Path, json_out: Path | None, html_out: Path | None
) -> BenchmarkResult:
    """Compare estimates with the truth, and write the numbers and the report where a place is given for them.

    Raises:
        ValueError: a dataset or estimates that cannot be read.
        OSError: a result cannot be written.
    """
    from datasets_manifest.atomic import write_text_atomic
    from droguekit.benchmark.pose_benchmark import run_benchmark
    from droguekit.benchmark.report.pose_report import write_report
    from droguekit.numerical_threads import one_thread

    with one_thread():
        result = run_benchmark(dataset, estimates)
        if json_out is not None:
            write_text_atomic(json_out, result.to_json())
        if html_out is not None:
            write_report(dataset, estimates, result, html_out)
    return result


def check_blind_dataset(dataset: Location, estimates: Path, json_out: Path | None, html_out: Path | None) -> BlindCheck:
    """The same without truth: compare estimates with their own measurements, and with boxes if there are any.

    Raises:
        ValueError: a dataset or estimates that cannot be read.
        OSError: a result cannot be written.
    """
    from datasets_manifest.atomic import write_text_atomic
    from droguekit.benchmark.blind_check import check_blind, write_blind_report
    from droguekit.numerical_threads import one_thread

    with one_thread():
        check = check_blind(dataset, estimates)
        if json_out is not None:
            write_text_atomic(json_out, check.to_json())
        if html_out is not None:
            write_blind_report(dataset, estimates, check, html_out)
    return check
