"""What the commands do that takes more than one room: the only place where rooms are put together.

Rooms are imported where they are used: a command loads only what it needs, and those that need no renderer work
without one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from droguekit.workflows.interrupts import interrupts_wait
from droguekit.workflows.navigation import navigate_dataset

if TYPE_CHECKING:
    from datasets_manifest.recipe.recipe import Recipe
    from datasets_manifest.storage.storage import Location
    from droguekit.batch.progress import ProgressReport
    from droguekit.batch.render_dataset import RunSummary
    from droguekit.benchmark.benchmark import BenchmarkResult
    from droguekit.benchmark.blind_check import BlindCheck


def open_recipe(name_or_path: str, seed: int | None, engine: str | None) -> tuple[Recipe, str]:
    """A recipe and its text as given, with seed and engine replaced where they are not None.

    Raises:
        ValueError: no such recipe, wrong keys, or no such engine.
    """
    from pydantic import ValidationError

    from datasets_manifest.recipe.recipe import Recipe, load_recipe
    from drogue_models.presets import explain
    from render.engine import EngineUnavailableError, engine_names

    recipe, text = load_recipe(name_or_path, seed)
    if engine is not None:
        settings = recipe.render.model_copy(update={"engine": engine})
        try:
            # Checked anew, for not every engine can draw everything.
            recipe = Recipe.model_validate(dict(recipe) | {"render": settings})
        except ValidationError as error:
            raise ValueError(f"--engine {engine}: {explain(error)}") from error
    if recipe.render.engine not in engine_names():
        raise EngineUnavailableError(
            f"engine: no engine named {recipe.render.engine!r}; there are {', '.join(engine_names())}"
        )
    return recipe, text


@dataclass(frozen=True)
class RenderOrder:
    """Who makes frames, and how long each may take.

    Attributes:
        workers: processes of this machine, as many as it holds when None.
        timeout_s: for one frame, by the recipe when None. [s]
        scheduler: address of a Dask scheduler whose workers do it instead, or None.
        pairs_per_tar: how many frames come into a tar file; None leaves that as it is, folders at first.
    """

    workers: int | None = None
    timeout_s: float | None = None
    scheduler: str | None = None
    pairs_per_tar: int | None = None


def render_frames(
    recipe: Recipe, text: str, out: Location, frames: Sequence[int], order: RenderOrder, report: ProgressReport
) -> RunSummary:
    """Make frames of a recipe into a dataset.

    Raises:
        ValueError: a folder of another recipe, or an engine that cannot be used.
        OSError: the folder cannot be written or the disk is full; finished frames stay.
    """
    with interrupts_wait():
        from droguekit.batch.execution import Spread
        from droguekit.batch.machine import default_workers
        from droguekit.batch.render_dataset import render_dataset
        from render.engine import engine_notice

    workers = default_workers() if order.workers is None else order.workers
    if workers < 0:
        raise ValueError(f"workers: must not be negative, got {workers}")
    if order.timeout_s is not None and not order.timeout_s > 0:
        raise ValueError(f"--timeout: must be above 0 s, got {order.timeout_s:g}")
    if order.scheduler is not None and order.workers is not None:
        raise ValueError("--workers: means processes of this machine; with --scheduler leave it out")
    if str(out).startswith("memory:") and workers != 0:
        raise ValueError(f"--out: {out} is the memory of one process; give --workers 0, or another place")
    notice = engine_notice(recipe.render.engine)
    if notice is not None:
        report.say(notice)
    spread = Spread(workers, order.timeout_s, order.scheduler, order.pairs_per_tar)
    return render_dataset(recipe, text, out, frames, spread, report)


def benchmark_dataset(
    dataset: Location, estimates: Path, json_out: Path | None, html_out: Path | None
) -> BenchmarkResult:
    """Compare estimates with the truth, and write the numbers and the report where a place is given for them.

    Raises:
        ValueError: a dataset or estimates that cannot be read.
        OSError: a result cannot be written.
    """
    from datasets_manifest.atomic import write_text_atomic
    from droguekit.benchmark.benchmark import run_benchmark
    from droguekit.benchmark.report.report import write_report
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
    from droguekit.benchmark.blind_check import check_blind
    from droguekit.benchmark.blind_report import write_blind_report
    from droguekit.numerical_threads import one_thread

    with one_thread():
        check = check_blind(dataset, estimates)
        if json_out is not None:
            write_text_atomic(json_out, check.to_json())
        if html_out is not None:
            write_blind_report(dataset, estimates, check, html_out)
    return check


@dataclass(frozen=True)
class DemoFiles:
    """What a demo leaves in its folder."""

    dataset: Path
    estimates: Path
    benchmark: Path
    report: Path


def run_demo(recipe_name: str, out: Path, workers: int | None, report: ProgressReport) -> tuple[DemoFiles, RunSummary]:
    """From a recipe to a report; pairs that are there already are kept.

    Raises:
        ValueError: the folder holds another dataset, or the engine cannot be used.
        OSError: the folder cannot be written.
    """
    files = DemoFiles(out / "dataset", out / "estimates.jsonl", out / "benchmark.json", out / "report.html")
    recipe, text = open_recipe(recipe_name, None, None)
    count = recipe.frames.count
    report.say(f"1 of 3: rendering {count} stereo pairs into {files.dataset}")
    summary = render_frames(recipe, text, files.dataset, range(count), RenderOrder(workers), report)
    report.say("2 of 3: navigating on them, without the truth, by every method")
    navigate_dataset(files.dataset, (), files.estimates, report)
    report.say("3 of 3: comparing the estimates with the truth")
    benchmark_dataset(files.dataset, files.estimates, files.benchmark, files.report)
    return files, summary


_BENCH_STATIONS_M = (2.0, 5.0, 10.0, 20.0, 40.0)
_BENCH_SCENES = 8


_BENCH_SAMPLES: dict[str, dict[str, float]] = {
    "corpus": {"samples_per_px": 16, "open_samples_per_px": 4, "edge_samples_per_px": 324},
    "benchmark": {
        "samples_per_px": 64,
        "open_samples_per_px": 8,
        "edge_samples_per_px": 400,
        "noise_over_sensor": 0.3,
    },
}
BENCH_QUALITIES = tuple(_BENCH_SAMPLES)


def open_bench_recipe(repeat: int, engine: str | None) -> Recipe:
    """The recipe by which speed is measured: `repeat` full-size pairs at each of five distances.

    Raises:
        ValueError: fewer than one pair, or no such engine.
    """
    if repeat < 1:
        raise ValueError(f"--repeat: must be at least 1, got {repeat}")
    distance: dict[str, object] = {"law": "stations", "stations_m": _BENCH_STATIONS_M}
    return _bench_recipe({"count": repeat * len(_BENCH_STATIONS_M)}, distance, "corpus", engine)


def open_uniform_bench_recipe(pairs: int, quality: str, engine: str | None) -> Recipe:
    """The recipe by which a corpus's mean speed and noise are measured: distances uniform from 2 to 40 m, some scenes.

    Raises:
        ValueError: fewer than one pair, or no such engine.
    """
    if pairs < 1:
        raise ValueError(f"--pairs: must be at least 1, got {pairs}")
    distance: dict[str, object] = {"law": "uniform", "low_m": _BENCH_STATIONS_M[0], "high_m": _BENCH_STATIONS_M[-1]}
    # One sky has up to two and a half times the noise of another.
    frames = {"count": pairs, "scenes": min(pairs, _BENCH_SCENES)}
    return _bench_recipe(frames, distance, quality, engine)


def _bench_recipe(frames: dict[str, int], distance: dict[str, object], quality: str, engine: str | None) -> Recipe:
    from datasets_manifest.recipe.recipe import Recipe

    demo, _ = open_recipe("demo", None, engine)
    changes = {
        "frames": frames,
        "distance": distance,
        "render": {**demo.render.model_dump(), **_BENCH_SAMPLES[quality]},
    }
    return Recipe.model_validate({**demo.model_dump(), **changes})
