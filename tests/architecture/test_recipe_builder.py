"""The builder of the tests' recipes: what it writes is what Python's own reader of TOML gets back."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from tests.support.recipe_builder import (
    RIG_160_PX,
    RecipeTable,
    between,
    build_recipe,
    change_recipe,
    recipe_text,
    stations,
)

BASE: RecipeTable = {
    "name": "built",
    "description": 'quotes " and \\ and é',
    "seed": 0,
    "rig": RIG_160_PX,
    "frames": {"count": 4, "in_turn": True, "stream": ""},
    "distance": stations(2.0, 5),
    "exposure": {"time_s": 1e-6},
    "families": [{"name": "a"}, {"name": "b", "environment": {"sun_elevation_deg": [20, 60.5]}}],
}


def test_text_holds_what_the_table_holds() -> None:
    assert tomllib.loads(recipe_text(BASE)) == BASE
    assert tomllib.loads(recipe_text(seed=np.int64(3), exposure={"time_s": np.float64(0.1)})) == {
        "seed": 3,
        "exposure": {"time_s": 0.1},
    }


def test_changes_reach_into_sections_and_leave_the_base_alone() -> None:
    before = recipe_text(BASE)
    changed = change_recipe(BASE, seed=7, frames={"scenes": 2, "in_turn": None}, families=None)
    assert changed["seed"] == 7 and "families" not in changed
    assert changed["frames"] == {"count": 4, "scenes": 2, "stream": ""}
    assert changed["distance"] is BASE["distance"]
    assert recipe_text(BASE) == before


def test_recipes_are_read_as_those_of_users_are() -> None:
    recipe = build_recipe(BASE, distance=between(2.0, 9.0, "log-uniform"))
    assert (recipe.distance.law, recipe.distance.low_m, recipe.distance.high_m) == ("log-uniform", 2.0, 9.0)
    assert recipe.rig.camera.width_px == 160
    with pytest.raises(ValueError, match=r"frames\.colour"):
        build_recipe(BASE, frames={"colour": 1})
