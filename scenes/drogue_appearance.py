"""Sampling a scene's drogue and its condition."""

from __future__ import annotations

import numpy as np

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.drogue_ranges import AppearanceRanges, WearRanges
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.appearance import DrogueCondition, SurfaceCondition
from drogue_models.parameters import DrogueParameters
from drogue_models.surface_looks import SurfaceWear
from scenes.environment_sampling import sample_uniform

# Three markers determine a pose; fewer could not be distinguished from other things.
_FEWEST_MARKERS = 3


def drogue_of_scene(recipe: Recipe, scene_id: int) -> DrogueParameters:
    """The drogue of a scene, which frames without a drogue have in common."""
    variants = recipe.target.variants
    if not variants:
        return recipe.drogue
    if recipe.frames.in_turn:
        return variants[scene_id // max(len(recipe.families), 1) % len(variants)].drogue
    shares = np.cumsum([variant.weight for variant in variants])
    place = frame_generator(recipe.stream_seed, scene_id, "drogue variant").random() * shares[-1]
    return variants[int(np.searchsorted(shares, place, side="right"))].drogue


def condition_of_scene(recipe: Recipe, scene_id: int, drogue: DrogueParameters) -> DrogueCondition | None:
    """The condition of a scene's drogue, or None when it is as new."""
    rng, ranges = frame_generator(recipe.stream_seed, scene_id, "drogue condition"), recipe.target
    missing = rng.random(drogue.marker_count) < ranges.missing_marker_fraction
    spared = rng.permutation(drogue.marker_count)[:_FEWEST_MARKERS]
    missing[spared] = False
    markers = tuple(_sample_surface(rng, ranges, bool(gone)) for gone in missing)
    hub = _sample_surface(rng, ranges, False)
    condition = DrogueCondition(
        markers=markers,
        hub=hub,
        body_reflectance_fraction=sample_uniform(rng, ranges.body_reflectance_fraction),
        wear=None if ranges.wear is None else _wear_of_scene(recipe.stream_seed, scene_id, ranges.wear),
    )
    as_new = DrogueCondition(markers=(SurfaceCondition(),) * drogue.marker_count)
    return None if condition == as_new else condition


def blinking_condition(
    condition: DrogueCondition | None, drogue: DrogueParameters, time_s: float, exposure_s: float
) -> DrogueCondition | None:
    """The condition of a drogue in one exposure: lamps that blink shine for a share of it.

    A lamp that is lit for a part of the exposure only is drawn with that share of its light all along.

    Args:
        condition: in its scene; None for a new drogue.
        drogue: with its code.
        time_s: mid-exposure. [s]
        exposure_s: exposure time. [s]
    """
    if drogue.marker_code is None:
        return condition
    known = condition or DrogueCondition()
    states = [known.of_marker(index) for index in range(drogue.marker_count)]
    shares = drogue.lit_fractions(time_s, exposure_s)
    markers = tuple(
        state.model_copy(update={"lamp_fraction": state.lamp_fraction * lit})
        for state, lit in zip(states, shares, strict=True)
    )
    return known.model_copy(update={"markers": markers})


def _wear_of_scene(seed: int, scene_id: int, ranges: WearRanges) -> SurfaceWear:
    rng = frame_generator(seed, scene_id, "surface wear")
    pattern = int(rng.integers(2**31))
    shares = {name: sample_uniform(rng, getattr(ranges, name)) for name in WearRanges.model_fields}
    return SurfaceWear(seed=pattern, **shares)


def _sample_surface(rng: np.random.Generator, ranges: AppearanceRanges, missing: bool) -> SurfaceCondition:
    dirty, failed = rng.random(2) < (ranges.dirty_marker_fraction, ranges.failed_lamp_fraction)
    dirt, lamp = sample_uniform(rng, ranges.dirt_fraction), sample_uniform(rng, ranges.lamp_fraction)
    seed, reflectance = int(rng.integers(2**31)), sample_uniform(rng, ranges.marker_reflectance_fraction)
    return SurfaceCondition(
        missing=missing,
        reflectance_fraction=reflectance,
        dirt_fraction=dirt if dirty else 0.0,
        dirt_seed=seed if dirty else 0,
        lamp_fraction=0.0 if failed else lamp,
    )
