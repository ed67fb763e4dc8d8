"""From a recipe to a dataset.

Packages are imported where they are used: a command loads only what it needs, and those that need no renderer work
without one.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

from droguekit.batch.progress import duration, human_size

MOST_TIMEOUT_S = 1e6
"""Longest time for a frame, some twelve days; what waits for a process takes no longer ones."""

if TYPE_CHECKING:
    from datasets_manifest.recipe.recipe import RecipeSource
    from datasets_manifest.storage.storage import Location
    from droguekit.batch.execution import ExecutionOptions
    from droguekit.batch.progress import ProgressReport
    from droguekit.batch.render_dataset import RunSummary


def open_recipe(name_or_path: str, seed: int | None, engine: str | None) -> RecipeSource:
    """A recipe with its text, its seed and engine replaced where they are not None.

    Raises:
        ValueError: no such recipe, wrong keys, or no such engine.
    """
    from pydantic import ValidationError

    from datasets_manifest.recipe.recipe import Recipe, RecipeSource, load_recipe
    from drogue_models.presets import explain
    from render.engine import EngineUnavailableError, engine_names

    source = load_recipe(name_or_path, seed)
    recipe = source.recipe
    if engine is not None:
        settings = recipe.render.model_copy(update={"engine": engine})
        try:
            # Validated again, since not every engine can render everything.
            recipe = Recipe.model_validate(dict(recipe) | {"render": settings})
        except ValidationError as error:
            raise ValueError(f"--engine {engine}: {explain(error)}") from error
    if recipe.render.engine not in engine_names():
        raise EngineUnavailableError(
            f"engine: no engine named {recipe.render.engine!r}; there are {', '.join(engine_names())}"
        )
    return RecipeSource(recipe, source.text)


def render_frames(
    source: RecipeSource, out: Location, frames: Sequence[int], options: ExecutionOptions, report: ProgressReport
) -> RunSummary:
    """Render frames of a recipe into a dataset.

    Raises:
        ValueError: a folder of another recipe, wrong options, or an engine or device that cannot be used.
        OSError: the folder cannot be written or the disk is full; finished frames stay.
    """
    with delay_interrupts():
        from droguekit.batch.render_dataset import render_dataset

    if options.workers is not None and options.workers < 0:
        raise ValueError(f"workers: must not be negative, got {options.workers}")
    if options.timeout_s is not None and not 0 < options.timeout_s <= MOST_TIMEOUT_S:
        raise ValueError(f"--timeout: must be above 0 s and at most {MOST_TIMEOUT_S:g} s, got {options.timeout_s:g}")
    if options.scheduler is not None and options.workers is not None:
        raise ValueError("--workers: are processes of this machine; omit it with --scheduler")
    if str(out).startswith("memory:") and options.worker_count() != 0:
        raise ValueError(f"--out: {out} is the memory of one process; give --workers 0 or another place")
    return render_dataset(source, out, frames, options, report)


def run_lines(out: Location, summary: RunSummary) -> Iterator[str]:
    """A run's result as lines: pairs made and kept, CPU time, memory, hash."""
    totals = summary.totals
    cpu_s, retries = sum(totals.stage_s.values()), f", {totals.retries} attempts repeated" if totals.retries else ""
    yield (
        f"{out}: made {len(totals.made)} pairs ({duration(cpu_s)} of CPU time, {human_size(totals.size_bytes)}"
        f"{retries}), kept {summary.kept}"
    )
    if totals.made:
        stages = ", ".join(f"{stage} {duration(seconds)}" for stage, seconds in totals.stage_s.most_common())
        yield f"CPU time by stage: {stages}"
    if totals.peak_gib:
        yield f"workers held up to {totals.peak_gib:.1f} GiB together"
    yield f"{summary.pairs} of {summary.planned} pairs are there; dataset sha256 {summary.dataset_sha256}"


@contextmanager
def delay_interrupts() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the end of the block, and then raise the first one again.

    Mesh libraries catch every exception of optional imports, so a `KeyboardInterrupt` in the middle would be lost.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard: list[int] = []

    def hear(number: int, frame: FrameType | None) -> None:
        heard.append(number)

    before = {number: signal.signal(number, hear) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if heard:
        signal.raise_signal(heard[0])
