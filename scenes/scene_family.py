"""Which family of conditions a scene belongs to."""

from __future__ import annotations

import numpy as np

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.recipe import Family, Recipe


def family_of_scene(recipe: Recipe, scene_id: int) -> Family | None:
    """The family of a scene, or None in a recipe without families.

    Every family gets its share of the scenes, rounded by largest remainders, and which ones is drawn, unless they come
    in turn.
    """
    if not recipe.families:
        return None
    if recipe.frames.in_turn:
        return recipe.families[scene_id % len(recipe.families)]
    scenes = recipe.frames.scenes
    place = int(np.flatnonzero(frame_generator(recipe.seed, 0, "families").permutation(scenes) == scene_id)[0])
    ends = np.cumsum(scenes_per_family(recipe))
    return recipe.families[int(np.searchsorted(ends, place, side="right"))]


def scenes_per_family(recipe: Recipe) -> list[int]:
    """How many scenes each family gets."""
    scenes = recipe.frames.scenes
    weights = np.array([family.weight for family in recipe.families])
    shares = weights / weights.sum() * scenes
    counts = np.floor(shares).astype(int)
    largest_first = np.argsort(-(shares - counts), kind="stable")
    counts[largest_first[: scenes - int(counts.sum())]] += 1
    return [int(count) for count in counts]


def recipe_of_scene(recipe: Recipe, scene_id: int) -> Recipe:
    """The recipe as it holds for one scene: with the name and the conditions of its family."""
    family = family_of_scene(recipe, scene_id)
    if family is None:
        return recipe
    changes = {
        "family": family.name,
        "pose": family.pose,
        "target": family.target,
        "environment": family.environment,
        "exposure": family.exposure,
    }
    return recipe.model_copy(update=changes)
