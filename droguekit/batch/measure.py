"""What frames of a recipe cost, measured in one warm worker process and thrown away."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path

from datasets_manifest.recipe import Recipe
from droguekit.batch.frame_task import FrameReport, FrameTask
from droguekit.batch.workers import run_alone


def measure_frames(recipe: Recipe, frames: tuple[int, ...]) -> tuple[FrameReport, ...]:
    """Make frames in a temporary folder, in a process of their own with one thread.

    The first frame is made once more before, so that loading the engine and compiling its kernels does not count.

    Args:
        recipe: what to make.
        frames: indices of the frames.

    Raises:
        ValueError: the engine cannot be used, or a frame cannot be made.
        OSError: the process died, or the temporary folder cannot be written.
    """
    return run_alone(partial(_measure, recipe, frames))


def _measure(recipe: Recipe, frames: tuple[int, ...]) -> tuple[FrameReport, ...]:
    with tempfile.TemporaryDirectory(prefix="droguekit-") as folder:
        task = FrameTask(recipe, Path(folder))
        task(frames[0])
        return tuple(task(frame_index) for frame_index in frames)
