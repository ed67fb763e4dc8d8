"""Layers of cloud below the camera stay over the ground."""

from __future__ import annotations

import pytest

from datasets_manifest.types.environment import Environment
from scenes.environment_sampling import environment_of_scene
from tests.support.recipe_builder import RecipeTable, between, build_recipe

BASE: RecipeTable = {"name": "low-clouds", "frames": {"count": 40, "scenes": 40}, "distance": between(3.0, 10.0)}


def scenes(altitude_m: list[float], height_m: list[float]) -> list[Environment]:
    """Forty scenes above a layer of stratus."""
    deck = {"kind": "stratus", "scene_fraction": 1.0, "height_above_camera_m": height_m}
    recipe = build_recipe(BASE, environment={"altitude_m": altitude_m, "clouds": deck})
    return [environment_of_scene(1, scene, recipe.environment) for scene in range(40)]


def test_a_layer_is_cut_off_at_the_ground() -> None:
    high, low = (scenes([altitude_m, altitude_m], [-1600, -400]) for altitude_m in (6000.0, 1500.0))
    kinds = set()
    for whole, cut in zip(high, low, strict=True):
        layer = whole.clouds[0]
        room_m = 1500.0 + layer.height_above_camera_m
        cut_layer = layer.model_copy(update={"thickness_m": min(layer.thickness_m, room_m)})
        want = (cut_layer,) if room_m >= 10.0 else ()
        assert cut == whole.model_copy(update={"altitude_m": 1500.0, "clouds": want})
        kinds.add("gone" if not cut.clouds else "thinner" if cut.clouds[0] != layer else "whole")
    assert kinds == {"gone", "thinner", "whole"}


def test_a_layer_that_is_always_in_the_ground_is_refused() -> None:
    with pytest.raises(ValueError, match=r"height_above_camera_m up to -1500 .* altitude_m up to 1000"):
        scenes([500, 1000], [-3000, -1500])
