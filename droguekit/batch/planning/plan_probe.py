"""Which few frames of a recipe tell what the others will cost, and what making them costs in a process of their own."""

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
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.manifest import Drop
from droguekit.batch.failure_policy import ERRORS_OF_THE_PLACE, drop_of
from droguekit.batch.frame_task import FrameReport, FrameTask
from droguekit.batch.planning.recipe_plan import DrawnFrames
from droguekit.batch.workers import run_alone

# Three cannot tell the law from the differences between scenes; more than a dozen hardly better the mean.
_FEWEST_PROBES, _MOST_PROBES = 3, 12


@dataclass(frozen=True)
class ProbeOrder:
    """Frames to make, in this order.

    Attributes:
        warm_up: made first and not counted: engines compile kernels for what they have not met, keep them on disk, and
            so the first dozen frames cost half as much again as the hundreds that follow.
        counted: the frames to reckon from.
    """

    warm_up: tuple[int, ...]
    counted: tuple[int, ...]


@dataclass(frozen=True)
class Probe:
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


def choose_frames(drawn: DrawnFrames, count: int) -> ProbeOrder:
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
    counted = _rarest(drawn, [*ends, empty])
    rest = [stratum[~np.isin(stratum, counted)] for stratum in strata]
    warm_up = _rarest(drawn, rest) or counted[:1]
    return ProbeOrder(*(tuple(drawn.indices[place] for place in places) for places in (warm_up, counted)))


def _rarest(drawn: DrawnFrames, strata: Sequence[NDArray[np.intp]]) -> list[int]:
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


def probe(recipe: Recipe, order: ProbeOrder) -> Probe:
    """Make frames in a temporary folder, in a process of their own with one thread, and throw them away.

    A frame that `render` would drop is one here.

    Raises:
        ValueError: the engine cannot be used, or none of the frames can be made.
        OSError: the process died, or the temporary folder cannot be written.
    """
    return run_alone(partial(_probe, recipe, order))


def _probe(recipe: Recipe, order: ProbeOrder) -> Probe:
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
    return Probe(warm_up, counted, repeated, max(0.0, time.process_time() - in_frames_s), tuple(drops))


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
        except ERRORS_OF_THE_PLACE:
            raise
        except Exception as error:
            drops.append(drop_of(frame_index, error))
            if is_loaded or made:
                failed_s += time.process_time() - began_s
    return made, failed_s


def cpu_s(report: FrameReport) -> float:
    """Processor time of all stages of a frame. [s]"""
    return sum(report.stage_s.values())
