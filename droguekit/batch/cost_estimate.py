"""What a whole recipe will take in time and on disk, estimated from a few frames that are rendered and thrown away."""

from __future__ import annotations

import math
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.manifest import Drop
from droguekit.batch.failure_policy import FATAL_ERRORS, make_drop
from droguekit.batch.frame_task import FrameReport, FrameTask
from droguekit.batch.recipe_plan import DrawnFrames, RecipePlan
from droguekit.batch.worker_pool import WorkerLimits, run_in_own_process
from geometry.se3 import Array
from scenes.sampler import scene_of_frame

# Three cannot tell the law from the differences between scenes; more than a dozen hardly better the mean.
_FEWEST_PROBES, _MOST_PROBES = 3, 12


@dataclass(frozen=True)
class ProbeFrames:
    """Frames to make, in this order.

    Attributes:
        warm_up: made first and not counted: engines compile kernels for what they have not met, keep them on disk, and
            so the first dozen frames cost half as much again as the hundreds that follow.
        counted: the frames to reckon from.
    """

    warm_up: tuple[int, ...]
    counted: tuple[int, ...]


@dataclass(frozen=True)
class ProbeResult:
    """What frames cost.

    Attributes:
        warm_up: frames made before the others.
        counted: frames to reckon from.
        repeated: the last frame that was made, once more.
        start_cpu_s: processor time of the process that went into none of the frames. [s]
        drops: frames that cannot be made, and why.
    """

    warm_up: dict[int, FrameReport]
    counted: dict[int, FrameReport]
    repeated: FrameReport
    start_cpu_s: float
    drops: tuple[Drop, ...]


def choose_probe_frames(drawn: DrawnFrames, count: int) -> ProbeFrames:
    """One frame from each of several strata of distance, one without a drogue if there are any, and as many before.

    Nearest and farthest are counted. Within a stratum the family, and then the scene, that has had the fewest comes
    first.

    Args:
        drawn: of the recipe.
        count: of all its pairs.
    """
    shows = np.flatnonzero(np.isfinite(drawn.distances_m))
    order = shows[np.argsort(drawn.distances_m[shows], kind="stable")]
    strata: list[NDArray[np.intp]] = np.array_split(
        order, min(_MOST_PROBES, max(_FEWEST_PROBES, math.isqrt(count)), max(1, len(order)))
    )
    ends: list[NDArray[np.intp]] = [order[[-1]], *strata[1:-1], order[[0]]] if len(strata) > 1 else [order]
    empty = np.flatnonzero(np.isnan(drawn.distances_m))[:1]
    counted = _pick_rarest(drawn, [*ends, empty])
    rest = [stratum[~np.isin(stratum, counted)] for stratum in strata]
    warm_up = _pick_rarest(drawn, rest) or counted[:1]
    return ProbeFrames(*(tuple(drawn.indices[place] for place in places) for places in (warm_up, counted)))


def _pick_rarest(drawn: DrawnFrames, strata: Sequence[NDArray[np.intp]]) -> list[int]:
    """A place in `drawn` from each stratum that has any."""
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


def probe(recipe: Recipe, order: ProbeFrames) -> ProbeResult:
    """Make frames in a temporary folder, in a process of their own with one thread, and throw them away.

    A frame that `render` would drop is one here.

    Raises:
        ValueError: the engine cannot be used, or none of the frames can be made.
        OSError: the process died, or the temporary folder cannot be written.
    """
    return run_in_own_process(partial(_probe, recipe, order))


def _probe(recipe: Recipe, order: ProbeFrames) -> ProbeResult:
    drops = list[Drop]()
    with tempfile.TemporaryDirectory(prefix="droguekit-") as folder:
        task = FrameTask(recipe, Path(folder))
        warm_up, failed_s = make_in_turn(task, order.warm_up, drops, False)
        counted, more_failed_s = make_in_turn(task, order.counted, drops, bool(warm_up))
        if not counted:
            raise ValueError(f"frames: none of {len(order.counted)} can be made, the last because: {drops[-1].reason}")
        repeated = task(next(reversed(counted)))
    reports = [*warm_up.values(), *counted.values(), repeated]
    in_frames_s = sum(cpu_s(report) for report in reports) + failed_s + more_failed_s
    return ProbeResult(warm_up, counted, repeated, max(0.0, time.process_time() - in_frames_s), tuple(drops))


def make_in_turn(
    task: Callable[[int], FrameReport], frames: tuple[int, ...], drops: list[Drop], is_loaded: bool
) -> tuple[dict[int, FrameReport], float]:
    """Make frames one after the other.

    Args:
        task: makes one.
        frames: which.
        drops: those that cannot be made are added to it.
        is_loaded: the engine is; before, its loading is part of the first frame's time.

    Returns:
        Those that can be made, and processor time that went into the others, the engine being loaded. [s]

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


# Of the law: constant, inverse and inverse square of the distance.
_TERMS = 3
# In which the environment of a scene is made; every process does it once for each of its scenes.
_SCENE_STAGE = "sample"


@dataclass(frozen=True)
class CostEstimate:
    """What a whole run is expected to take, in seconds of a processor unless it says otherwise.

    Attributes:
        probed: the measured frames by index.
        drops: frames that were to be measured and cannot be made, and why.
        start_s: until a worker process is ready for its first frame. [s]
        scene_s: for a process to make the environment of a scene, or to fly a sequence. [s]
        frames_s: for all pairs, their environments at hand. [s]
        error_s: standard error of `frames_s`, or None where too few were measured to tell. [s]
        wall_over_cpu: how long a second of a processor took: 1 on an idle machine, more where others work too, or where
            the engine waits for another device.
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
        """Processor time of all frames of a run, without the starts of its processes. [s]"""
        processes, workers = self._processes(workers), max(1, min(workers, self.count))
        # Pairs go through the scenes in turn, and so does every process; sequences come one after the other.
        visits = processes * self.scenes if self.sequences == 0 else self.sequences * workers + processes - workers
        return min(self.count, visits) * self.scene_s + self.frames_s

    def run_s(self, workers: int) -> float:
        """Time of a run in which every worker has a core to itself. [s]"""
        return (self._processes(workers) * self.start_s + self.work_s(workers)) / max(1, min(workers, self.count))

    def _processes(self, workers: int) -> int:
        return max(1, min(workers, self.count), math.ceil(self.count / WorkerLimits().tasks_per_process))


def probe_cost(recipe: Recipe, plan: RecipePlan) -> CostEstimate:
    """Render a few frames, spread over distances and families, and reckon from them.

    Raises:
        ValueError: the engine cannot be used, or none of the frames can be made.
        OSError: the temporary folder cannot be written.
    """
    return estimate_cost(recipe, plan, probe(recipe, choose_probe_frames(plan.drawn, recipe.frames.count)))


def estimate_cost(recipe: Recipe, plan: RecipePlan, probed: ProbeResult) -> CostEstimate:
    """What measured frames say of all pairs of a recipe."""
    reports = list(probed.counted.values())
    every = [*probed.warm_up.values(), *reports, probed.repeated]
    count = recipe.frames.count * (1 - plan.dropped_fraction)
    law = _DistanceFit(plan.drawn, probed.counted)
    # What that stage takes of every pair is what it takes of one whose environment is at hand.
    at_hand_s = _scene_stage_s(probed.repeated)
    frames_s, error_s = law.total([cpu_s(report) - _scene_stage_s(report) + at_hand_s for report in reports], count)
    return CostEstimate(
        probed=probed.counted,
        drops=probed.drops,
        start_s=probed.start_cpu_s,
        scene_s=_scene_s(recipe, probed),
        frames_s=frames_s,
        error_s=error_s,
        wall_over_cpu=max(1.0, sum(report.wall_s for report in every) / sum(cpu_s(report) for report in every)),
        size_bytes=law.total([report.size_bytes for report in reports], count)[0],
        count=recipe.frames.count,
        scenes=recipe.frames.scenes,
        sequences=0 if recipe.sequence is None else -(-recipe.frames.count // recipe.sequence.frames_per_sequence),
    )


class _DistanceFit:
    """How measured values go with the distance, each family of frames counting by its share of the recipe."""

    def __init__(self, drawn: DrawnFrames, reports: dict[int, FrameReport]) -> None:
        rows = [drawn.indices.index(frame_index) for frame_index in reports]
        self._measured_m, self._drawn_m = drawn.distances_m[rows], drawn.distances_m
        shows, families = np.isfinite(self._measured_m), drawn.families[rows]
        # A family of which none was measured counts as the others do on average.
        shares = np.bincount(drawn.families[np.isfinite(self._drawn_m)], minlength=int(drawn.families.max()) + 1)
        probes = np.bincount(families[shows], minlength=len(shares))
        # Those without a drogue have a law of their own, a constant.
        self._weights = np.where(shows, (shares / np.maximum(probes, 1))[families], 1.0)

    def total(self, values: ArrayLike, count: float) -> tuple[float, float | None]:
        """Sum over all pairs, and its standard error by how the measured values scatter about the law.

        The error is None where the law has as many terms as there are values with a drogue: none scatters then.
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
    """What the first frame of a scene, or of a sequence, takes more than its later ones. [s]"""
    first_s: dict[int, float] = {}
    for frame_index, report in (probed.warm_up | probed.counted).items():
        length = None if recipe.sequence is None else recipe.sequence.frames_per_sequence
        unit = scene_of_frame(recipe, frame_index) if length is None else frame_index // length
        first_s.setdefault(unit, _scene_stage_s(report))
    # Tables that serve all scenes are made in the first frame of all.
    later_s = list(first_s.values())[1:] or list(first_s.values())
    return max(0.0, float(np.mean(later_s)) - _scene_stage_s(probed.repeated))


def _scene_stage_s(report: FrameReport) -> float:
    return report.stage_s.get(_SCENE_STAGE, 0.0)


def fit_over_distance(distance_m: ArrayLike, values: ArrayLike, at_m: ArrayLike, weights: ArrayLike = 1.0) -> Array:
    """The law `a + b / distance + c / distance^2` that fits given values best, at other distances.

    The drogue's area in the image goes with the inverse square of its distance, and its outline with the inverse.
    Frames without a drogue have a value of their own. No term is negative.

    Args:
        distance_m: (N,) of the given values, NaN without a drogue. [m]
        values: (N,) given.
        at_m: (M,) where the law is wanted, NaN without a drogue. [m]
        weights: (N,) how much each value counts.

    Returns:
        (M,) values of the law.
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
