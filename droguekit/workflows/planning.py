"""What a recipe will make, how long it will take and how large it will get: as lines and as a page."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from droguekit.batch.progress import duration, human_size
from droguekit.workflows.rendering import open_recipe

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from datasets_manifest.recipe.recipe import Recipe
    from datasets_manifest.storage.manifest import Drop
    from droguekit.batch.execution import ExecutionOptions
    from droguekit.batch.frame_cost import CostEstimate
    from droguekit.batch.recipe_plan import LawCheck, RecipePlan

_BAR_LENGTH = 40
_HISTOGRAM_BINS = 10
_MOST_LINES = 20
# Above this a machine is worth a word; less is the probe's own writing to disk.
_BUSY = 1.25


def plan_lines(
    name_or_path: str,
    seed: int | None,
    engine: str | None,
    probes: int | None,
    execution: ExecutionOptions,
    html: Path | None,
) -> Iterator[str]:
    """Plan a recipe, and give the lines that describe it as soon as they are known.

    Args:
        name_or_path: of the recipe.
        seed: replaces the recipe's, or None.
        engine: replaces the recipe's, or None.
        probes: frames with a drogue that are rendered to estimate time and size; 0 renders none, None as many as usual.
        execution: workers for which the time is estimated, and the device that the frames are rendered on.
        html: page to write with the plan's plots, or None.

    Raises:
        ValueError: no such recipe or engine, a wrong number, or none of the first frames can be made.
        OSError: the page or the temporary folder cannot be written.
    """
    from droguekit.batch.recipe_plan import frame_timeout_s, plan_recipe

    if execution.workers is not None and (probes == 0 or execution.workers < 1):
        raise ValueError("--workers: must be at least 1, and goes with the probe; leave it or --no-probe out")
    recipe = open_recipe(name_or_path, seed, engine).recipe
    plan = plan_recipe(recipe)
    lines = [*_counts(recipe, plan), *_distances(recipe, plan), *_laws(recipe, plan)]
    lines.append(f"a frame that is at work for {duration(frame_timeout_s(recipe))} counts as hung and is tried again")
    yield from lines
    if probes != 0:
        costs = list(_probed_lines(recipe, plan, probes, execution))
        yield from costs
        lines += costs
    if html is not None:
        from droguekit.visualization.plan_page import write_plan_page

        write_plan_page(recipe, plan, lines, html)
        yield f"wrote {html}"


def _probed_lines(recipe: Recipe, plan: RecipePlan, probes: int | None, execution: ExecutionOptions) -> Iterator[str]:
    """The lines of time and size, from frames that are rendered now, or were before on this machine."""
    from droguekit.batch.frame_cost import estimate_cost, probe_recipe
    from droguekit.batch.remembered_probes import remember_probe, remembered_probe

    remembered = remembered_probe(recipe, execution.device) if probes is None else None
    if remembered is None:
        result = probe_recipe(recipe, plan, execution.device, probes)
        remember_probe(recipe, execution.device, result)
    else:
        result = remembered.result
    day = None if remembered is None else remembered.day
    return cost_lines(estimate_cost(recipe, plan, result), execution.worker_count(), day)


def _counts(recipe: Recipe, plan: RecipePlan) -> Iterator[str]:
    camera = recipe.rig.camera
    yield (
        f"{recipe.name}: {recipe.frames.count} pairs of 2 x {camera.width_px} x {camera.height_px}, "
        f"seed {recipe.seed}, drogue {recipe.drogue.name}, sensor {recipe.sensor.name}, engine {recipe.render.engine}"
    )
    yield "by split: " + ", ".join(f"{name} {plan.by_split.get(name, 0)}" for name in ("train", "val", "test"))
    for name, (family_scenes, pairs) in plan.by_family.items():
        yield f"  {name:<16} {family_scenes:4d} scenes {pairs:7d} pairs"
    scenes = list(plan.by_scene.items())
    shown = ", ".join(f"{scene_id}: {pairs}" for scene_id, pairs in scenes[:_MOST_LINES])
    more = f" and {len(scenes) - _MOST_LINES} more" if len(scenes) > _MOST_LINES else ""
    yield f"by scene: {shown}{more}"
    yield f"without a drogue: {100 * plan.empty_fraction:.1f} %"
    yield from _drops(recipe, plan.drawn.drops, plan.dropped_fraction)


def _drops(recipe: Recipe, drops: Sequence[Drop], fraction: float) -> Iterator[str]:
    if not drops:
        return
    drawn = round(len(drops) / fraction)
    of = "" if drawn == recipe.frames.count else f" of {drawn} that were drawn"
    yield f"cannot be made, and will be missing: {len(drops)} pairs{of}, {100 * fraction:.1f} %"
    for drop in drops[:_MOST_LINES]:
        yield f"  frame {drop.frame_index}: {drop.reason}"
    if len(drops) > _MOST_LINES:
        yield f"  and {len(drops) - _MOST_LINES} more"


def _distances(recipe: Recipe, plan: RecipePlan) -> Iterator[str]:
    import numpy as np

    distances = plan.drawn.distances_m[np.isfinite(plan.drawn.distances_m)]
    if len(distances) == 0:
        return
    if recipe.distance.stations_m is not None:
        stations = sorted(set(recipe.distance.stations_m))
        near = np.abs(distances[:, None] - np.array(stations)).argmin(axis=1)
        counts = np.bincount(near, minlength=len(stations))
        names = [f"{station:8.2f} m       " for station in stations]
    else:
        edges = np.geomspace(distances.min(), max(distances.max(), distances.min() * 1.001), _HISTOGRAM_BINS + 1)
        counts = np.histogram(distances, edges)[0]
        names = [f"{low:6.2f} - {high:6.2f} m" for low, high in pairwise(edges)]
    count = len(plan.drawn.indices) + len(plan.drawn.drops)
    yield f"distance of the rim centre{'' if count == recipe.frames.count else f', of {count} drawn frames'}:"
    for name, pairs in zip(names, counts, strict=True):
        yield f"  {name} {pairs:6d} {'#' * round(_BAR_LENGTH * pairs / max(counts.max(), 1))}".rstrip()


def _laws(recipe: Recipe, plan: RecipePlan) -> Iterator[str]:
    from droguekit.batch.recipe_plan import check_places, check_sizes

    sizes = check_sizes(plan.drawn, recipe)
    if sizes is not None:
        check, edges = sizes
        yield f"box sizes, side of the square with the box's area, law {recipe.distance.law}:"
        for low, high, count, expected in zip(edges, edges[1:], check.counts, check.expected, strict=False):
            yield f"  {low:6.1f} - {high:6.1f} px {count:6.0f}, intended {expected:8.1f}"
        yield f"  {_verdict(check)}"
    places = check_places(plan.drawn, recipe.rig.camera)
    if places is not None:
        yield (
            "places of the box's middle in the left image, cell by cell; law: anywhere that both views hold all of it, "
            "all places equally likely (intended in brackets):"
        )
        for counts, intended in zip(places.counts, places.expected, strict=True):
            yield "  " + " ".join(f"{n:5.0f} {f'({e:.0f})':<6}" for n, e in zip(counts, intended, strict=True)).rstrip()
        yield f"  {_verdict(places)}"


def _verdict(check: LawCheck) -> str:
    if check.degrees == 0:
        return "too few pairs for a chi-square"
    return (
        f"chi-square {check.statistic:.1f} with {check.degrees} degrees of freedom: chance of as much or more if the "
        f"law holds {check.p_value:.2g}"
    )


def cost_lines(cost: CostEstimate, workers: int, day: str | None = None) -> Iterator[str]:
    """The estimated time and size of a run by so many workers, and the measurements behind it.

    Args:
        cost: the estimate.
        workers: of the run.
        day: of the measurements, or None where they were made just now.
    """
    from droguekit.batch.frame_cost import cpu_s

    when = "" if day is None else f" on {day} (`--probe N` measures anew)"
    yield f"measured{when}, with one worker, once it was warm:"
    for frame_index, report in cost.probed.items():
        where = "no drogue" if report.distance_m is None else f"{report.distance_m:.2f} m"
        size = human_size(report.size_bytes)
        yield f"  frame {frame_index} ({where}): {cpu_s(report):.2f} s of processor time, {size}"
    for drop in cost.drops:
        yield f"  frame {drop.frame_index} cannot be made, and will be missing: {drop.reason}"
    kind = "sequence" if cost.sequences else "scene"
    yield f"a worker needs {cost.start_s:.1f} s to start, and {cost.scene_s:.2f} s more for each {kind} it meets"
    work_s, run_s = cost.work_s(workers), cost.run_s(workers)
    scatter = ""
    if cost.error_s is not None:
        scatter = f", give or take {100 * cost.error_s / work_s:.0f} % by how the measured ones scatter"
    yield f"all pairs: {duration(work_s)} of processor time{scatter}"
    size = human_size(cost.size_bytes)
    yield f"all: about {duration(run_s)} with {workers} workers that have a core each, {size} without the records"
    if cost.wall_over_cpu > _BUSY and day is not None:
        yield "the machine was busy then: work may cost a quarter more than on an idle one"
    elif cost.wall_over_cpu > _BUSY:
        yield (
            f"the machine is busy: a second of work took {cost.wall_over_cpu:.1f} s, and work may cost a quarter "
            f"more than on an idle one; if it stays so, the run takes about {duration(run_s * cost.wall_over_cpu)}"
        )
