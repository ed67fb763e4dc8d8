"""What the commands do that takes more than one room: the only place where rooms are put together.

Rooms are imported where they are used: a command loads only what it needs, and those that need no renderer work
without one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from droguekit.cli.interrupts import interrupts_wait

if TYPE_CHECKING:
    from datasets_manifest.estimates import Estimate
    from datasets_manifest.recipe import Recipe
    from datasets_manifest.storage import Location
    from droguekit.bars.image_tiers import TierData
    from droguekit.bars.table import BarTable
    from droguekit.batch.local import RunSummary
    from droguekit.batch.progress import ProgressReport
    from droguekit.benchmark.benchmark import BenchmarkResult
    from droguekit.benchmark.blind_check import BlindCheck


def open_recipe(name_or_path: str, seed: int | None, engine: str | None) -> tuple[Recipe, str]:
    """A recipe and its text as given, with seed and engine replaced where they are not None.

    Raises:
        ValueError: no such recipe, wrong keys, or no such engine.
    """
    from pydantic import ValidationError

    from datasets_manifest.recipe import Recipe, load_recipe
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
        from droguekit.batch.local import render_dataset
        from droguekit.batch.machine import default_workers
        from droguekit.batch.making import Spread
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


@dataclass(frozen=True)
class Fixes:
    """How many poses a method found in how many pairs."""

    method: str
    fixes: int
    pairs: int


def navigate_dataset(
    dataset: Location,
    methods: Sequence[str],
    out: Path,
    report: ProgressReport,
    centroids: str = "own",
    detector: str | None = None,
) -> list[Fixes]:
    """Estimate poses in every pair without the truth, and write them; all methods when `methods` is empty.

    Raises:
        ValueError: no such dataset, method, detector or way to measure centroids, or an image that cannot be read.
        OSError: the estimates cannot be written.
    """
    from datasets_manifest.blind import BlindDataset
    from datasets_manifest.estimates import write_estimates
    from nav.detector.registry import DEFAULT_DETECTOR
    from nav.runner import CENTROID_CHOICES, method_names, navigate

    choice = next((name for name in CENTROID_CHOICES if name == centroids), None)
    if choice is None:
        raise ValueError(f"--centroids: must be one of {', '.join(CENTROID_CHOICES)}, got {centroids!r}")
    chosen = list(dict.fromkeys(methods)) or list(method_names())
    blind = BlindDataset(dataset)
    estimates = navigate(blind, chosen, choice, DEFAULT_DETECTOR if detector is None else detector)
    fixes: Counter[str] = Counter()

    def counted() -> Iterator[Estimate]:
        for number, estimate in enumerate(estimates, start=1):
            fixes[estimate.method] += estimate.status == "fix"
            yield estimate
            if number % len(chosen) == 0:
                report.advance()

    out.parent.mkdir(parents=True, exist_ok=True)
    report.begin("pairs", len(blind.frame_indices))
    try:
        write_estimates(out, counted())
    finally:
        report.end()
    return [Fixes(method, fixes[method], len(blind.frame_indices)) for method in chosen]


def benchmark_dataset(
    dataset: Location, estimates: Path, json_out: Path | None, html_out: Path | None
) -> BenchmarkResult:
    """Compare estimates with the truth, and write the numbers and the report where a place is given for them.

    Raises:
        ValueError: a dataset or estimates that cannot be read.
        OSError: a result cannot be written.
    """
    from datasets_manifest.writer import write_text_atomic
    from droguekit.benchmark.benchmark import run_benchmark
    from droguekit.benchmark.report import write_report

    result = run_benchmark(dataset, estimates)
    if json_out is not None:
        write_text_atomic(json_out, result.to_json())
    if html_out is not None:
        html_out.parent.mkdir(parents=True, exist_ok=True)
        write_report(dataset, estimates, result, html_out)
    return result


def check_blind_dataset(dataset: Location, estimates: Path, json_out: Path | None, html_out: Path | None) -> BlindCheck:
    """The same without truth: compare estimates with their own measurements, and with boxes if there are any.

    Raises:
        ValueError: a dataset or estimates that cannot be read.
        OSError: a result cannot be written.
    """
    from datasets_manifest.writer import write_text_atomic
    from droguekit.benchmark.blind_check import check_blind
    from droguekit.benchmark.blind_report import write_blind_report

    check = check_blind(dataset, estimates)
    if json_out is not None:
        write_text_atomic(json_out, check.to_json())
    if html_out is not None:
        html_out.parent.mkdir(parents=True, exist_ok=True)
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


_BENCH_SAMPLES = {
    "corpus": {"samples_per_px": 16, "open_samples_per_px": 4, "edge_samples_per_px": 256},
    "benchmark": {"samples_per_px": 64, "open_samples_per_px": 8, "edge_samples_per_px": 400},
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
    return _bench_recipe(repeat * len(_BENCH_STATIONS_M), distance, "corpus", engine)


def open_uniform_bench_recipe(pairs: int, quality: str, engine: str | None) -> Recipe:
    """The recipe by which a corpus's mean speed is measured: distances uniform from 2 to 40 m.

    Raises:
        ValueError: fewer than one pair, or no such engine.
    """
    if pairs < 1:
        raise ValueError(f"--pairs: must be at least 1, got {pairs}")
    distance: dict[str, object] = {"law": "uniform", "low_m": _BENCH_STATIONS_M[0], "high_m": _BENCH_STATIONS_M[-1]}
    return _bench_recipe(pairs, distance, quality, engine)


def _bench_recipe(count: int, distance: dict[str, object], quality: str, engine: str | None) -> Recipe:
    from datasets_manifest.recipe import Recipe

    demo, _ = open_recipe("demo", None, engine)
    changes = {
        "frames": {"count": count},
        "distance": distance,
        "render": {**demo.render.model_dump(), **_BENCH_SAMPLES[quality]},
    }
    return Recipe.model_validate({**demo.model_dump(), **changes})


@dataclass(frozen=True)
class BarsOrder:
    """Which bars to measure, and how much to spend on them.

    Attributes:
        tier: `a`, `b`, `c`, `d` or `speed`.
        seed: of everything drawn.
        pairs_per_station: rendered pairs at each distance, the recipe's when None; tiers a and b.
        draws: frames of a cell, the protocol's when None; tiers c and d, and speed.
        workers: that render, as many as the machine holds when None.
    """

    tier: str
    seed: int
    pairs_per_station: int | None
    draws: int | None
    workers: int | None


def run_bars(order: BarsOrder, out: Path, report: ProgressReport) -> BarTable:
    """Measure the bars of a tier and write bars.json and bars.md; what an earlier run finished is kept.

    Raises:
        ValueError: no such tier, a wrong number, or a folder of something else.
        OSError: the folder cannot be written.
    """
    from importlib.metadata import version

    from datasets_manifest.writer import write_text_atomic
    from droguekit.bars.image_tiers import IMAGE_TIERS, LIGHTS
    from droguekit.bars.speed import bars_speed
    from droguekit.bars.table import BarRow, BarTable
    from droguekit.bars.tier_c import bars_tier_c
    from droguekit.bars.tier_d import bars_tier_d

    drawn = {"c": bars_tier_c, "d": bars_tier_d, "speed": bars_speed}
    rows: list[BarRow] = []
    if order.tier in IMAGE_TIERS:
        for light in LIGHTS:
            rows += IMAGE_TIERS[order.tier](_tier_data(order, light, out, report))
    elif order.tier in drawn:
        rows += drawn[order.tier](out, order.seed, order.draws, report)
    else:
        raise ValueError(f"tier: there is none named {order.tier!r}; there are a, b, c, d, speed")
    table = BarTable(tier=order.tier, seed=order.seed, code_version=version("droguekit"), rows=tuple(rows))
    write_text_atomic(out / "bars.json", table.to_json())
    write_text_atomic(out / "bars.md", table.to_markdown())
    return table


def _tier_data(order: BarsOrder, light: Literal["day", "dusk"], out: Path, report: ProgressReport) -> TierData:
    """Render, navigate and benchmark one dataset of a tier."""
    from droguekit.bars.image_tiers import METHODS, TierData, recipe_of
    from droguekit.bars.navigated import is_navigated, mark_navigated

    recipe, text = open_recipe(recipe_of(order.tier, light), order.seed, None)
    stations = len(recipe.distance.stations_m or ())
    most = recipe.frames.count // stations
    pairs = most if order.pairs_per_station is None else order.pairs_per_station
    if not 1 <= pairs <= most:
        raise ValueError(f"--pairs-per-station: must be from 1 to {most}, got {pairs}")
    folder = out / light
    estimates = folder / "estimates.jsonl"
    report.say(f"{light}: rendering {stations * pairs} pairs of {recipe.name} into {folder / 'dataset'}")
    summary = render_frames(
        recipe, text, folder / "dataset", range(stations * pairs), RenderOrder(order.workers), report
    )
    if is_navigated(estimates, summary.dataset_sha256, METHODS):
        report.say(f"{light}: {estimates} is there already")
    else:
        navigate_dataset(folder / "dataset", METHODS, estimates, report)
        mark_navigated(estimates, summary.dataset_sha256, METHODS)
    report.say(f"{light}: comparing with the truth")
    result = benchmark_dataset(folder / "dataset", estimates, folder / "benchmark.json", folder / "report.html")
    return TierData(light, folder / "dataset", estimates, result)
