"""Time and memory of frames, made by warmed-up worker processes and deleted."""

from __future__ import annotations

import os
import tempfile
import time
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.frame_store import FrameStore
from datasets_manifest.storage.reader import read_record_table
from droguekit.batch.frame_task import FrameReport, FrameTask
from droguekit.batch.worker_pool import run_in_own_process, run_tasks

# The first frames of a worker compile kernels.
_WARM_UP_FRAMES = 4


@dataclass(frozen=True)
class MeasuredFrame:
    """Measurements of one frame.

    Attributes:
        report: its time and size.
        noise_over_sensor: the renderer's noise over the sensor's on the drogue, None if it was not measured.
        memory_bytes: resident memory of the process afterwards, None where the system does not report it.
    """

    report: FrameReport
    noise_over_sensor: float | None
    memory_bytes: int | None


def measure_frames(recipe: Recipe, frames: tuple[int, ...]) -> tuple[MeasuredFrame, ...]:
    """Make frames in a temporary folder, in a process of their own with one thread.

    The first frame is made once before, so that loading the engine and compiling its kernels do not count.

    Args:
        recipe: what to make.
        frames: indices of the frames.

    Raises:
        ValueError: the engine cannot be used, or a frame cannot be made.
        OSError: the process died, or the temporary folder cannot be written.
    """
    return run_in_own_process(partial(_measure, recipe, frames))


def _measure(recipe: Recipe, frames: tuple[int, ...]) -> tuple[MeasuredFrame, ...]:
    with tempfile.TemporaryDirectory(prefix="droguekit-") as folder:
        task = FrameTask(recipe, Path(folder))
        task(frames[0])
        return tuple(_measure_frame(task, frame_index) for frame_index in frames)


def frames_per_second(recipe: Recipe, workers: int) -> float:
    """Frames per second of wall time when all frames of a recipe are made, in a temporary folder.

    Starting the workers does not count; that they run out of work one by one at the end does.

    Args:
        recipe: what to make; its first frames, `warm_up(workers)` of them, do not count.
        workers: how many processes.

    Raises:
        ValueError: too few frames, the engine cannot be used, or a frame cannot be made.
        OSError: a process died again and again, or the temporary folder cannot be written.
    """
    uncounted = warm_up_frames(workers)
    if recipe.frames.count <= uncounted:
        raise ValueError(f"frames: {recipe.frames.count} are too few for {workers} workers; {uncounted} do not count")
    ended_s = []
    with tempfile.TemporaryDirectory(prefix="droguekit-") as folder:
        frames = range(recipe.frames.count)
        with closing(run_tasks(FrameTask(recipe, Path(folder)), frames, workers)) as attempts:
            for attempt in attempts:
                if attempt.final and attempt.error is not None:
                    raise attempt.error
                ended_s += [time.monotonic()] * attempt.final
    return (len(ended_s) - uncounted) / (ended_s[-1] - ended_s[uncounted - 1])


def warm_up_frames(workers: int) -> int:
    """Number of frames that `frames_per_second` does not count."""
    return _WARM_UP_FRAMES * workers


def _measure_frame(task: FrameTask, frame_index: int) -> MeasuredFrame:
    report = task(frame_index)
    conditions = read_record_table(FrameStore(task.dataset), frame_index)["conditions"]
    return MeasuredFrame(report, conditions["monte_carlo_over_sensor_noise"], _memory_bytes())


def _memory_bytes() -> int | None:
    """Resident memory of this process."""
    try:
        resident_pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return None
    return resident_pages * os.sysconf("SC_PAGE_SIZE")
