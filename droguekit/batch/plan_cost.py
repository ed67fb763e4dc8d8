"""What a whole recipe will take in time and on disk, reckoned from a few frames that are rendered and thrown away."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import nnls

from datasets_manifest.recipe import Recipe
from droguekit.batch.frame_task import FrameReport
from droguekit.batch.measure import measure_frames
from droguekit.batch.plan import DrawnFrames, Plan
from droguekit.batch.workers import Limits
from geometry.se3 import Array

# Three cannot tell the law from the differences between scenes; more than a dozen hardly better the mean.
_FEWEST_PROBES, _MOST_PROBES = 3, 12
# In which the environment of a scene is made; every process does it once for each of its scenes.
_SCENE_STAGE = "sample"


@dataclass(frozen=True)
class Cost:
    """What a whole run is expected to take, in seconds of a processor unless it says otherwise.

    Attributes:
        probed: the measured frames by index.
        start_s: until a worker process is ready for its first frame. [s]
        scene_s: for a process to make the environment of a scene. [s]
        frames_s: for all pairs, their environments at hand. [s]
        wall_over_cpu: how long a second of a processor took: 1 on an idle machine, more where others work too, or where
            the engine waits for another device.
        size_bytes: of all pairs on disk, without the records.
        count, scenes: of the recipe.
    """

    probed: dict[int, FrameReport]
    start_s: float
    scene_s: float
    frames_s: float
    wall_over_cpu: float
    size_bytes: float
    count: int
    scenes: int

    def run_s(self, workers: int) -> float:
        """Time of a run in which every worker has a core to itself. [s]"""
        workers = max(1, min(workers, self.count))
        processes = max(workers, math.ceil(self.count / Limits().tasks_per_process))
        visits = min(self.count, processes * self.scenes)
        return (processes * self.start_s + visits * self.scene_s + self.frames_s) / workers


def probe_cost(recipe: Recipe, plan: Plan) -> Cost:
    """Render a few frames, spread over distances and families, and reckon from them.

    Raises:
        ValueError: the engine cannot be used, or a frame cannot be made.
        OSError: the temporary folder cannot be written.
    """
    chosen = probe_frames(plan.drawn, recipe.frames.count)
    began_s = time.monotonic()
    reports = dict(zip(chosen, measure_frames(recipe, chosen), strict=True))
    whole_s = time.monotonic() - began_s
    walls_s = [report.wall_s for report in reports.values()]
    wall_over_cpu = max(1.0, sum(walls_s) / sum(sum(report.stage_s.values()) for report in reports.values()))
    share = recipe.frames.count / len(plan.drawn.indices)

    def total(value: Callable[[FrameReport], float]) -> float:
        values = [value(report) for report in reports.values()]
        at_m = [math.nan if report.distance_m is None else report.distance_m for report in reports.values()]
        return share * float(fit_over_distance(at_m, values, plan.drawn.distances_m).sum())

    return Cost(
        probed=reports,
        # The first frame is made once more before all others.
        start_s=max(0.0, whole_s - sum(walls_s) - walls_s[0]) / wall_over_cpu,
        scene_s=_scene_s(plan.drawn, reports),
        frames_s=total(lambda report: sum(report.stage_s.values()) - report.stage_s.get(_SCENE_STAGE, 0.0)),
        wall_over_cpu=wall_over_cpu,
        size_bytes=total(lambda report: report.size_bytes),
        count=recipe.frames.count,
        scenes=recipe.frames.scenes,
    )


def probe_frames(drawn: DrawnFrames, count: int) -> tuple[int, ...]:
    """Which frames to measure: one from each of several strata of distance, one without a drogue if there are any.

    Nearest and farthest are among them. Within a stratum the family, and then the scene, that has had the fewest comes
    first.

    Args:
        drawn: of the recipe.
        count: of all its pairs.
    """
    shows = np.flatnonzero(np.isfinite(drawn.distances_m))
    order = shows[np.argsort(drawn.distances_m[shows], kind="stable")]
    strata = np.array_split(order, min(_MOST_PROBES, max(_FEWEST_PROBES, math.isqrt(count)), max(1, len(order))))
    families, scenes, chosen = Counter[int](), Counter[int](), list[int]()

    def take(place: int) -> None:
        families[int(drawn.families[place])] += 1
        scenes[int(drawn.scenes[place])] += 1
        chosen.append(drawn.indices[place])

    # The farthest first: it is made twice, and is the cheapest.
    ends = [order[[-1]], *strata[1:-1], order[[0]]] if len(strata) > 1 else strata
    for stratum in ends:
        if len(stratum):
            rarity = [(families[int(drawn.families[p])], scenes[int(drawn.scenes[p])]) for p in stratum]
            middle = [abs(k - len(stratum) // 2) for k in range(len(stratum))]
            take(int(stratum[min(range(len(stratum)), key=lambda k: (*rarity[k], middle[k]))]))
    empty = np.flatnonzero(np.isnan(drawn.distances_m))
    if len(empty):
        take(int(empty[0]))
    return tuple(chosen)


def _scene_s(drawn: DrawnFrames, reports: dict[int, FrameReport]) -> float:
    """What a scene's first frame takes more than its later ones. [s]"""
    scene_of = dict(zip(drawn.indices, map(int, drawn.scenes), strict=True))
    times_s = {index: report.stage_s.get(_SCENE_STAGE, 0.0) for index, report in reports.items()}
    again = next(iter(times_s))
    known, first_s = {scene_of[again]}, list[float]()
    for index, seconds in times_s.items():
        if scene_of[index] not in known:
            first_s.append(seconds - times_s[again])
        known.add(scene_of[index])
    return max(0.0, float(np.mean(first_s))) if first_s else 0.0


def fit_over_distance(distance_m: ArrayLike, values: ArrayLike, at_m: ArrayLike) -> Array:
    """The law `a + b / distance + c / distance^2` that fits given values best, at other distances.

    The drogue's area in the image goes with the inverse square of its distance, and its outline with the inverse.
    Frames without a drogue have a value of their own. No term is negative.

    Args:
        distance_m: (N,) of the given values, NaN without a drogue. [m]
        values: (N,) given.
        at_m: (M,) where the law is wanted, NaN without a drogue. [m]

    Returns:
        (M,) values of the law.
    """
    terms, _ = nnls(_terms(distance_m), np.asarray(values, dtype=np.float64))
    result: Array = _terms(at_m) @ terms
    return result


def _terms(distance_m: ArrayLike) -> Array:
    """(N, 4) of each distance: 1, then 1, 1 / distance and 1 / distance^2 with a drogue and 0 without."""
    distance = np.asarray(distance_m, dtype=np.float64)
    shows = np.isfinite(distance)
    inverse = np.divide(1.0, distance, out=np.zeros_like(distance), where=shows)
    return np.stack([np.ones_like(distance), shows, inverse, inverse**2], axis=1)
