"""Render a recipe, estimate poses, and write the report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from droguekit.batch.execution import ExecutionOptions
from droguekit.workflows.benchmarking import benchmark_dataset
from droguekit.workflows.navigation import navigate_dataset
from droguekit.workflows.rendering import open_recipe, render_frames

if TYPE_CHECKING:
    from droguekit.batch.progress import ProgressReport
    from droguekit.batch.render_dataset import RunSummary


@dataclass(frozen=True)
class DemoFiles:
    """The files of a demo."""

    dataset: Path
    estimates: Path
    benchmark: Path
    report: Path


def run_demo(recipe_name: str, out: Path, workers: int | None, report: ProgressReport) -> tuple[DemoFiles, RunSummary]:
    """Render a recipe, estimate poses by every method, and compare them with the truth; existing pairs are kept.

    Raises:
        ValueError: the folder holds another dataset, or the engine cannot be used.
        OSError: the folder cannot be written.
    """
    files = DemoFiles(out / "dataset", out / "estimates.jsonl", out / "benchmark.json", out / "report.html")
    source = open_recipe(recipe_name, None, None)
    count = source.recipe.frames.count
    report.say(f"1 of 3: rendering {count} stereo pairs into {files.dataset}")
    summary = render_frames(source, files.dataset, range(count), ExecutionOptions(workers), report)
    report.say("2 of 3: estimating poses by every method, without the truth")
    navigate_dataset(files.dataset, (), files.estimates, report)
    report.say("3 of 3: comparing the estimates with the truth")
    benchmark_dataset(files.dataset, files.estimates, files.benchmark, files.report)
    return files, summary
