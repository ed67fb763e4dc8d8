"""What a recipe will make: counts, distances, and from a few measured frames time and size."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import nnls

from datasets_manifest.recipe import Recipe
from droguekit.batch.frame_task import FrameReport
from droguekit.batch.measure import measure_frames
from geometry.se3 import Array
from scenes.families import family_of_scene
from scenes.sampler import sample_left_from_drogue, scene_of_frame, split_of_scene

# A worker may have to load its engine and compile kernels within its first frame.
_START_S = 300.0
# Our choice, far above what an engine takes for one sample of one pixel.
_S_PER_SAMPLE = 20e-6
# Enough for shares to within 2 % and a histogram without holes; more only takes time.
_MOST_SAMPLED = 1000


@dataclass(frozen=True)
class Plan:
    """What a recipe will make.

    Attributes:
        by_split: pairs in each split.
        by_scene: pairs in each scene.
        by_family: scenes and pairs of each family, in the recipe's order; empty without families.
        sampled: indices of the frames that were drawn for the distances.
        distances_m: of those with a drogue, NaN for those without. [m]
    """

    by_split: dict[str, int]
    by_scene: dict[int, int]
    by_family: dict[str, tuple[int, int]]
    sampled: tuple[int, ...]
    distances_m: Array

    @property
    def empty_fraction(self) -> float:
        """Share of the drawn frames without a drogue."""
        return float(np.isnan(self.distances_m).mean())


@dataclass(frozen=True)
class Cost:
    """What a whole run is expected to take.

    Attributes:
        probed: the measured frames by index.
        worker_s: working time of one worker for all pairs. [s]
        size_bytes: of all pairs on disk.
    """

    probed: dict[int, FrameReport]
    worker_s: float
    size_bytes: float


def plan_recipe(recipe: Recipe) -> Plan:
    """Draw the frames of a recipe without rendering them."""
    count = recipe.frames.count
    rounds, rest = divmod(count, recipe.frames.scenes)
    # Every run of as many frames as there are scenes visits each scene once.
    by_scene = Counter(dict.fromkeys(range(recipe.frames.scenes), rounds))
    by_scene.update(scene_of_frame(recipe, frame_index) for frame_index in range(count - rest, count))
    by_split: Counter[str] = Counter()
    for scene_id, pairs in by_scene.items():
        by_split[split_of_scene(recipe, scene_id)] += pairs
    by_family = {family.name: (0, 0) for family in recipe.families}
    for scene_id, pairs in by_scene.items():
        family = family_of_scene(recipe, scene_id)
        if family is not None:
            scenes, total = by_family[family.name]
            by_family[family.name] = scenes + 1, total + pairs
    sampled = tuple(sorted({int(index) for index in np.linspace(0, count - 1, min(count, _MOST_SAMPLED))}))
    distances = []
    for frame_index in sampled:
        pose = sample_left_from_drogue(recipe, frame_index)
        distances.append(np.nan if pose is None else float(pose.translation_m[2]))
    return Plan(dict(by_split), dict(by_scene), by_family, sampled, np.array(distances))


def frame_timeout_s(recipe: Recipe) -> float:
    """How long a frame may take before it counts as hung: far more than any engine needs here. [s]"""
    camera = recipe.rig.camera
    samples = 2 * camera.width_px * camera.height_px * recipe.render.samples_per_px
    return _START_S + float(round(_S_PER_SAMPLE * samples))


def probe_cost(recipe: Recipe, plan: Plan) -> Cost:
    """Render the nearest, the middle and the farthest of the drawn frames, and reckon from them.

    The area of the drogue in the image, and with it the work, goes with the inverse square of its distance.

    Raises:
        ValueError: the engine cannot be used, or a frame cannot be made.
        OSError: the temporary folder cannot be written.
    """
    order = np.argsort(plan.distances_m)[: max(1, int(np.isfinite(plan.distances_m).sum()))]
    # The farthest first: it is made twice, and is the cheapest.
    chosen = dict.fromkeys(plan.sampled[order[place]] for place in (-1, len(order) // 2, 0))
    reports = dict(zip(chosen, measure_frames(recipe, tuple(chosen)), strict=True))
    measured_m = [_distance_m(report) for report in reports.values()]
    share = recipe.frames.count / len(plan.sampled)
    seconds = fit_inverse_square(measured_m, [report.wall_s for report in reports.values()], plan.distances_m)
    size = fit_inverse_square(measured_m, [report.size_bytes for report in reports.values()], plan.distances_m)
    return Cost(reports, share * float(seconds.sum()), share * float(size.sum()))


def _distance_m(report: FrameReport) -> float:
    return np.inf if report.distance_m is None else report.distance_m


def fit_inverse_square(distance_m: ArrayLike, values: ArrayLike, at_m: ArrayLike) -> Array:
    """The law `a + b / distance^2` with a, b >= 0 that fits given values best, at other distances.

    Args:
        distance_m: (N,) of the given values, inf without a drogue. [m]
        values: (N,) given.
        at_m: (M,) where the law is wanted, NaN without a drogue. [m]

    Returns:
        (M,) values of the law.
    """
    inverse = 1.0 / np.square(np.asarray(distance_m, dtype=np.float64))
    (base, slope), _ = nnls(np.stack([np.ones_like(inverse), inverse], axis=1), np.asarray(values, dtype=np.float64))
    result: Array = base + slope * np.nan_to_num(1.0 / np.square(np.asarray(at_m, dtype=np.float64)))
    return result
