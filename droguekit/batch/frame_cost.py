"""What frames cost in time, memory and on disk, measured on frames that are rendered and thrown away.

The cost of a whole recipe is estimated from a few of its frames.
"""

from __future__ import annotations

import math
import os
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls

from datasets_manifest.atomic import scratch_folder
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.frame_store import FrameStore
from datasets_manifest.storage.manifest import Drop
from datasets_manifest.storage.reader import read_record_table
from droguekit.batch.frame_task import FATAL_ERRORS, FrameReport, FrameTask, make_drop
from droguekit.batch.recipe_plan import DrawnFrames, RecipePlan, family_index
from droguekit.batch.worker_pool import WorkerLimits, run_in_own_process, run_tasks
from geometry.se3 import Array
from render.device import Device
from render.engine import has_compiled
from scenes.sampler import scene_of_frame

PROBES = 5
"""Measured frames with a drogue at most, unless another number is asked for."""
# Processor time of measured frames after which no more follow, unless their number was asked for. [s]
_ENOUGH_S = 20.0
# Fewer cannot separate distance from scene.
_FEWEST_PROBES = 3
# Processor time of the first frame above which it alone warms up where kernels are on disk already: a near frame would
# take several times as long, while to load the kernels that are missing takes about a second. [s]
_LONG_WARM_UP_S = 2.0
# Constant, inverse and inverse square of the distance.
_TERMS = 3
# The stages that make a scene's sky, ground and objects, most of it once for all its frames, which are made in a row.
_SCENE_STAGES = ("sample", "sky", "scene")


@dataclass(frozen=True)
class ProbeFrames:
    """The frames that a probe makes.

    Attributes:
        warm_up: a far and a near one, made before the counted ones: engines compile kernels for new content and keep
            them on disk. They are left out where there are kernels on disk and frames take long.
        counted: the frames from which the cost is estimated: one without a drogue, the farthest and a near one, then
            those between, from the middle outwards. The first one is made twice, and counts the second time.
        fewest: so many of them are made in any case, the others while they take little time.
    """

    warm_up: tuple[int, ...]
    counted: tuple[int, ...]
    fewest: int


@dataclass(frozen=True)
class ProbeResult:
    """What the probed frames cost.

    Attributes:
        warm_up: frames made before the others; the first of them was made again and counts too.
        counted: frames from which the cost is estimated.
        later_scene_s: processor time of a frame in the stages that make its scene, when the scene exists. [s]
        start_cpu_s: processor time of the process outside the frames. [s]
        drops: frames that cannot be made, and why.
    """

    warm_up: dict[int, FrameReport]
    counted: dict[int, FrameReport]
    later_scene_s: float
    start_cpu_s: float
    drops: tuple[Drop, ...]


def choose_probe_frames(drawn: DrawnFrames, count: int, most: int | None = None) -> ProbeFrames:
    """One frame without a drogue if there are any, one from each of several strata of distance, and two to warm up.

    The farthest frame is among the counted ones, and one from the middle of the nearest stratum: the very nearest takes
    several times as long as most, and stands for few. Within a stratum, families and then scenes that were chosen least
    often come first.

    Args:
        drawn: of the recipe.
        count: number of all pairs of the recipe.
        most: counted frames with a drogue, at most; None for `PROBES`, and fewer where they take long.
    """
    shows = np.flatnonzero(np.isfinite(drawn.distances_m))
    order = shows[np.argsort(drawn.distances_m[shows], kind="stable")]
    strata: list[NDArray[np.intp]] = np.array_split(
        order, min(PROBES if most is None else most, max(_FEWEST_PROBES, math.isqrt(count)), max(1, len(order)))
    )
    ends: list[NDArray[np.intp]] = [order[[-1]], *strata[1:-1], strata[0]] if len(strata) > 1 else [order]
    empty = np.flatnonzero(np.isnan(drawn.distances_m))[:1]
    counted = _pick_rarest(drawn, [*ends, empty])
    inner = counted[1 : len(ends) - 1]
    middle_first = sorted(range(len(inner)), key=lambda k: abs(2 * k - len(inner) + 1))
    counted = [
        *counted[len(ends) :],
        counted[0],
        *counted[1 + len(inner) : len(ends)],
        *(inner[k] for k in middle_first),
    ]
    fewest = len(counted) if most is not None else len(counted) - max(0, len(inner) - (_FEWEST_PROBES - 2))
    far_and_near = [strata[-1], strata[0]] if len(strata) > 1 else strata
    warm_up = _pick_rarest(drawn, [stratum[~np.isin(stratum, counted)] for stratum in far_and_near])
    first, then = (tuple(drawn.indices[place] for place in places) for places in (warm_up, counted))
    return ProbeFrames(warm_up=first, counted=then, fewest=fewest)


def _pick_rarest(drawn: DrawnFrames, strata: Sequence[NDArray[np.intp]]) -> list[int]:
    """An index into `drawn` from each stratum that is not empty."""
    families, scenes, chosen = Counter[int](), Counter[int](), list[int]()
    for stratum in strata:
        if len(stratum):
            rarity = [(families[int(drawn.families[place])], scenes[int(drawn.scenes[place])]) for place in stratum]
            middle = [abs(k - len(stratum) // 2) for k in range(len(stratum))]
            place = int(stratum[min(range(len(stratum)), key=lambda k: (*rarity[k], middle[k]))])
            families[int(drawn.families[place])] += 1
            scenes[int(drawn.scenes[place])] += 1
            chosen.append(place)
    return chosen


def probe(recipe: Recipe, frames: ProbeFrames, device: Device = "cpu") -> ProbeResult:
    """Make frames in a temporary folder, in a process of their own with one thread, and delete them.

    Frames that `render` would drop are reported as drops.

    Raises:
        ValueError: the engine cannot be used, or none of the frames can be made.
        OSError: the process died, or the temporary folder cannot be written.
    """
    return run_in_own_process(partial(_probe, recipe, frames, device))


def _probe(recipe: Recipe, frames: ProbeFrames, device: Device) -> ProbeResult:
    drops, failed_s = list[Drop](), 0.0
    is_compiled = has_compiled(recipe.render.engine, device)
    with scratch_folder() as folder:
        task = FrameTask(recipe, folder, device=device)

        def make(indices: tuple[int, ...]) -> dict[int, FrameReport]:
            nonlocal failed_s
            made, seconds = make_in_turn(task, indices, drops, bool(warm_up))
            failed_s += seconds
            return made

        warm_up = dict[int, FrameReport]()
        possible = list(frames.counted)
        while possible and not (warm_up := make((possible[0],))):
            possible.pop(0)
        if not possible:
            raise ValueError(f"frames: none of {len(frames.counted)} can be made, the last because: {drops[-1].reason}")
        # Its scene exists now, and so the second time tells what a later frame of a scene takes.
        counted = make((possible[0],))
        later_scene_s = sum(_in_scene_stages_s(report.stage_s) for report in counted.values())
        if not is_compiled or all(cpu_s(report) < _LONG_WARM_UP_S for report in warm_up.values()):
            warm_up |= make(frames.warm_up)
        for frame_index in possible[1:]:
            if len(counted) < frames.fewest or sum(map(cpu_s, counted.values())) < _ENOUGH_S:
                counted |= make((frame_index,))
    in_frames_s = sum(cpu_s(report) for report in [*warm_up.values(), *counted.values()])
    start_s = time.process_time() - in_frames_s - failed_s
    return ProbeResult(warm_up, counted, later_scene_s, max(0.0, start_s), tuple(drops))


def make_in_turn(
    task: Callable[[int], FrameReport], frames: tuple[int, ...], drops: list[Drop], is_loaded: bool
) -> tuple[dict[int, FrameReport], float]:
    """Make frames one after the other.

    Args:
        task: makes a frame.
        frames: indices.
        drops: gets the frames that cannot be made.
        is_loaded: whether the engine is loaded; if not, loading it is part of the first frame's time.

    Returns:
        Reports of the frames, and processor time spent on failed frames after the engine was loaded. [s]

    Raises:
        ValueError: the engine cannot be used.
        OSError: the temporary folder cannot be written.
    """
    made, failed_s = dict[int, FrameReport](), 0.0
    for frame_index in frames:
        began_s = time.process_time()
        try:
            made[frame_index] = task(frame_index)
        except FATAL_ERRORS:
            raise
        except Exception as error:
            drops.append(make_drop(frame_index, error))
            if is_loaded or made:
                failed_s += time.process_time() - began_s
    return made, failed_s


def cpu_s(report: FrameReport) -> float:
    """Processor time of all stages of a frame. [s]"""
    return sum(report.stage_s.values())


@dataclass(frozen=True)
class CostEstimate:
    """The expected cost of a whole run; times are processor time unless stated otherwise.

    Attributes:
        probed: the measured frames by index.
        drops: frames that were to be measured and cannot be made, and why.
        start_s: until a worker process is ready for its first frame. [s]
        scene_s: for a process to make a scene, or to simulate the flight of a sequence. [s]
        frames_s: for all pairs, without making their scenes. [s]
        error_s: standard error of `frames_s`, or None where too few frames were measured. [s]
        wall_over_cpu: wall time per processor time: 1 on an idle machine, more on a busy one or where the engine waits
            for another device.
        size_bytes: of all pairs on disk, without the records.
        count, scenes, sequences: of the recipe; 0 sequences where pairs are single.
    """

    probed: dict[int, FrameReport]
    drops: tuple[Drop, ...]
    start_s: float
    scene_s: float
    frames_s: float
    error_s: float | None
    wall_over_cpu: float
    size_bytes: float
    count: int
    scenes: int
    sequences: int

    def work_s(self, workers: int) -> float:
        """Processor time of all frames of a run, without starting its processes. [s]"""
        # A process stays at a scene or a sequence until its pairs are made. The last ones are shared, and a process
        # that replaces another begins where that one stopped.
        visits = (self.sequences or self.scenes) + self._processes(workers) - 1
        return min(self.count, visits) * self.scene_s + self.frames_s

    def run_s(self, workers: int) -> float:
        """Time of a run in which every worker has a core to itself. [s]"""
        return (self._processes(workers) * self.start_s + self.work_s(workers)) / max(1, min(workers, self.count))

    def _processes(self, workers: int) -> int:
        return max(1, min(workers, self.count), math.ceil(self.count / WorkerLimits().tasks_per_process))


def probe_recipe(recipe: Recipe, plan: RecipePlan, device: Device = "cpu", probes: int | None = None) -> ProbeResult:
    """Render a few frames, spread over distances and families, from which `estimate_cost` tells the cost of all.

    Args:
        recipe: whose cost is estimated.
        plan: of the recipe.
        device: that the frames are rendered on.
        probes: measured frames with a drogue, at most; None for `PROBES`, and fewer where they take long.

    Raises:
        ValueError: the engine cannot be used, or none of the frames can be made.
        OSError: the temporary folder cannot be written.
    """
    return probe(recipe, choose_probe_frames(plan.drawn, recipe.frames.count, probes), device)


def estimate_cost(recipe: Recipe, plan: RecipePlan, probed: ProbeResult) -> CostEstimate:
    """Extrapolate from measured frames to all pairs of a recipe."""
    reports = list(probed.counted.values())
    every = [*probed.warm_up.values(), *reports]
    count = recipe.frames.count * (1 - plan.dropped_fraction)
    fit = _DistanceFit(recipe, plan.drawn, probed.counted)
    # Every pair takes in these stages what one takes whose scene exists already.
    rest_s = [cpu_s(report) - _in_scene_stages_s(report.stage_s) for report in reports]
    frames_s, error_s = fit.total([seconds + probed.later_scene_s for seconds in rest_s], count)
    return CostEstimate(
        probed=probed.counted,
        drops=probed.drops,
        start_s=probed.start_cpu_s,
        scene_s=_scene_s(recipe, probed),
        frames_s=frames_s,
        error_s=error_s,
        wall_over_cpu=max(1.0, sum(report.wall_s for report in every) / sum(cpu_s(report) for report in every)),
        size_bytes=fit.total([report.size_bytes for report in reports], count)[0],
        count=recipe.frames.count,
        scenes=recipe.frames.scenes,
        sequences=0 if recipe.sequence is None else -(-recipe.frames.count // recipe.sequence.frames_per_sequence),
    )


class _DistanceFit:
    """A fit of measured values over distance, in which each family counts by its share of the recipe."""

    def __init__(self, recipe: Recipe, drawn: DrawnFrames, reports: dict[int, FrameReport]) -> None:
        distances_m = [math.nan if report.distance_m is None else report.distance_m for report in reports.values()]
        self._measured_m, self._drawn_m = np.array(distances_m), drawn.distances_m
        # Measured frames need not be among the drawn ones of a recipe that has another number of pairs.
        families = np.array([family_index(recipe, scene_of_frame(recipe, index)) for index in reports], dtype=np.intp)
        shows = np.isfinite(self._measured_m)
        # A family without a measured frame is represented by the average of the others.
        count = max(1, len(recipe.families))
        shares = np.bincount(drawn.families[np.isfinite(self._drawn_m)], minlength=count)
        probes = np.bincount(families[shows], minlength=count)
        # Frames without a drogue have a constant of their own.
        self._weights = np.where(shows, (shares / np.maximum(probes, 1))[families], 1.0)

    def total(self, values: ArrayLike, count: float) -> tuple[float, float | None]:
        """Sum over all pairs, and its standard error from the residuals of the fit.

        The error is None where the fit has as many terms as there are values with a drogue: it has no residuals then.
        """
        measured = np.asarray(values, dtype=np.float64)
        fitted = fit_over_distance(self._measured_m, measured, self._drawn_m, self._weights)
        left = measured - fit_over_distance(self._measured_m, measured, self._measured_m, self._weights)
        shows = np.isfinite(self._measured_m)
        n, share = int(shows.sum()), float(np.isfinite(self._drawn_m).mean())
        total = count * float(fitted.mean())
        if n <= _TERMS:
            return total, None
        return total, count * share * math.sqrt(float(np.square(left[shows]).sum()) / (n - _TERMS) / n)


def _scene_s(recipe: Recipe, probed: ProbeResult) -> float:
    """Extra time of the first frame of a scene or of a sequence over its later ones. [s]"""
    first_s: dict[int, float] = {}
    for frame_index, report in [*probed.warm_up.items(), *probed.counted.items()]:
        length = None if recipe.sequence is None else recipe.sequence.frames_per_sequence
        unit = scene_of_frame(recipe, frame_index) if length is None else frame_index // length
        first_s.setdefault(unit, _in_scene_stages_s(report.stage_s))
    # The very first frame also makes tables that all scenes share.
    later_s = list(first_s.values())[1:] or list(first_s.values())
    return max(0.0, float(np.mean(later_s)) - probed.later_scene_s)


def _in_scene_stages_s(stage_s: Mapping[str, float]) -> float:
    return sum(stage_s.get(stage, 0.0) for stage in _SCENE_STAGES)


def fit_over_distance(distance_m: ArrayLike, values: ArrayLike, at_m: ArrayLike, weights: ArrayLike = 1.0) -> Array:
    """Fit `a + b / distance + c / distance^2` to values with non-negative terms, and evaluate it at other distances.

    The drogue's area in the image is proportional to the inverse square of its distance, its outline to the inverse.
    Frames without a drogue have a value of their own.

    Args:
        distance_m: (N,) distances of the values, NaN without a drogue. [m]
        values: (N,) to fit.
        at_m: (M,) distances at which the fit is evaluated, NaN without a drogue. [m]
        weights: (N,) of the values.

    Returns:
        (M,) fitted values.
    """
    root = np.sqrt(np.broadcast_to(weights, np.shape(values)))
    terms, _ = nnls(_terms(distance_m) * root[:, None], np.asarray(values, dtype=np.float64) * root)
    result: Array = _terms(at_m) @ terms
    return result


def _terms(distance_m: ArrayLike) -> Array:
    """(N, 4) of each distance: 1, then 1, 1 / distance and 1 / distance^2 with a drogue and 0 without."""
    distance = np.asarray(distance_m, dtype=np.float64)
    shows = np.isfinite(distance)
    inverse = np.divide(1.0, distance, out=np.zeros_like(distance), where=shows)
    return np.stack([np.ones_like(distance), shows, inverse, inverse**2], axis=1)


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


def measure_frames(recipe: Recipe, frames: tuple[int, ...], device: Device = "cpu") -> tuple[MeasuredFrame, ...]:
    """Make frames in a temporary folder, in a process of their own with one thread.

    The first frame is made once before, so that loading the engine and compiling its kernels do not count.

    Args:
        recipe: what to make.
        frames: indices of the frames.
        device: that the engine renders on.

    Raises:
        ValueError: the engine cannot be used, or a frame cannot be made.
        OSError: the process died, or the temporary folder cannot be written.
    """
    return run_in_own_process(partial(_measure, recipe, frames, device))


def _measure(recipe: Recipe, frames: tuple[int, ...], device: Device) -> tuple[MeasuredFrame, ...]:
    with scratch_folder() as folder:
        task = FrameTask(recipe, folder, device=device)
        task(frames[0])
        return tuple(_measure_frame(task, frame_index) for frame_index in frames)


def frames_per_second(recipe: Recipe, workers: int, device: Device = "cpu") -> float:
    """Frames per second of wall time when all frames of a recipe are made, in a temporary folder.

    Starting the workers does not count; that they run out of work one by one at the end does.

    Args:
        recipe: what to make; its first frames, `warm_up(workers)` of them, do not count.
        workers: how many processes.
        device: that the engine renders on.

    Raises:
        ValueError: too few frames, the engine cannot be used, or a frame cannot be made.
        OSError: a process died again and again, or the temporary folder cannot be written.
    """
    uncounted = warm_up_frames(workers)
    if recipe.frames.count <= uncounted:
        raise ValueError(f"frames: {recipe.frames.count} are too few for {workers} workers; {uncounted} do not count")
    ended_s = []
    with scratch_folder() as folder:
        frames = range(recipe.frames.count)
        with closing(run_tasks(FrameTask(recipe, folder, device=device), frames, workers)) as attempts:
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
