"""Families of conditions: shares, stability, and what a family changes."""

from __future__ import annotations

from collections import Counter

import pytest

from datasets_manifest.recipe.recipe import Recipe, load_recipe, recipe_names
from droguekit.batch.recipe_plan import plan_recipe
from scenes.drogue_appearance import drogue_of_scene
from scenes.sampler import family_of_scene, recipe_of_scene, sample_frame, scenes_per_family, split_of_scenes
from tests.support.recipe_builder import RecipeTable, Section, build_recipe, stations

BASE: RecipeTable = {
    "name": "families-test",
    "family": "own",
    "frames": {"count": 40, "scenes": 10},
    "distance": stations(10.0),
    "environment": {"ground": "forest", "sun_elevation_deg": [20, 50]},
    "exposure": {"time_s": 1e-3},
    "split": {"train": 0.7, "test": 0.3},
}
DAY = {"name": "day", "weight": 2}
SEA = {"name": "sea", "weight": 1, "environment": {"ground": "sea"}, "exposure": {"time_s": 2e-3}}


def recipe(*families: Section, seed: int = 1) -> Recipe:
    return build_recipe(BASE, families=families, seed=seed)


def test_scenes_are_shared_out_by_largest_remainder() -> None:
    assert scenes_per_family(recipe(DAY, SEA)) == [7, 3]
    assert scenes_per_family(recipe(DAY, SEA | {"weight": 6})) == [3, 7]
    names = [family_of_scene(recipe(DAY, SEA), scene).name for scene in range(10)]
    assert Counter(names) == {"day": 7, "sea": 3}
    assert names != [family_of_scene(recipe(DAY, SEA, seed=2), scene).name for scene in range(10)]


def test_a_family_changes_what_it_names_and_no_more() -> None:
    drawn = recipe(DAY, SEA)
    for index in range(10):
        frame = sample_frame(drawn, index)
        family = family_of_scene(drawn, frame.scene_id)
        assert frame.family == family.name
        assert frame.environment.ground == ("sea" if family.name == "sea" else "forest")
        assert 20 <= frame.environment.sun_elevation_deg <= 50
        assert frame.exposure.time_s == (2e-3 if family.name == "sea" else 1e-3)


def test_splits_and_poses_stay_as_without_families() -> None:
    with_families, without = recipe(DAY, SEA), recipe()
    for index in range(10):
        assert split_of_scenes(with_families)[index] == split_of_scenes(without)[index]
        one, other = sample_frame(with_families, index), sample_frame(without, index)
        assert one.left_from_drogue.as_matrix().tolist() == other.left_from_drogue.as_matrix().tolist()
        assert other.family == "own"


def test_a_recipe_without_families_is_its_own_for_every_scene() -> None:
    drawn = recipe()
    assert recipe_of_scene(drawn, 3) is drawn


def test_the_plan_counts_them() -> None:
    assert plan_recipe(recipe(DAY, SEA)).by_family == {"day": (7, 28), "sea": (3, 12)}
    assert plan_recipe(recipe()).by_family == {}


@pytest.mark.parametrize(
    ("families", "message"),
    [
        ([{"name": "a"}, {"name": "a"}], "each needs a name of its own"),
        ({"name": "a"}, r"each begun by \[\[families\]\]"),
        ([{"name": "a", "weight": 0}], r"families\.0\.weight"),
        ([{"name": "a", "environment": {"fog": 1}}], r"families\.0\.environment\.fog"),
    ],
)
def test_wrong_families_are_named(families: Section | list[Section], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build_recipe(BASE, families=families)


def test_the_paper_count_ships() -> None:
    """89 scenes and 14,298 images, as many as the paper trains on, over all families."""
    world = load_recipe("world-89").recipe
    assert world.frames.scenes == 89 and 2 * world.frames.count == 14_298
    assert scenes_per_family(world) == [round(family.weight) for family in world.families]
    assert len(world.families) >= 12


@pytest.mark.parametrize("name", recipe_names())
def test_a_recipe_knows_all_drogues_that_its_scenes_show(name: str) -> None:
    source = load_recipe(name).recipe
    assert len(set(source.drogues)) == len(source.drogues)
    scenes = min(source.frames.scenes, 300)
    shown = {drogue_of_scene(recipe_of_scene(source, scene), scene) for scene in range(scenes)}
    assert shown <= set(source.drogues)
    if scenes >= 8 * len(source.drogues):
        # Each stands in so many scenes that chance alone hides few.
        assert len(shown) > len(source.drogues) / 2


def test_a_family_without_variants_shows_the_recipes_own_drogue() -> None:
    small = {"drogue": "basket-small-orange"}
    mixed = recipe(DAY, SEA | {"target": {"variants": [small, small]}})
    assert [drogue.name for drogue in mixed.drogues] == ["red-8", "basket-small-orange"]
    alone = recipe(DAY | {"target": {"variants": [small]}})
    assert [drogue.name for drogue in alone.drogues] == ["basket-small-orange"]
    # The nearest distance is that of the largest drogue, not of the variants alone.
    nearest_m = alone.rig.nearest_full_view_m(alone.drogues[0].rim_radius_m)
    at_it = {**BASE, "distance": stations(nearest_m + 0.01)}
    assert build_recipe(at_it, families=[DAY | {"target": {"variants": [small]}}])
    with pytest.raises(ValueError, match="where the whole drogue fits both views"):
        build_recipe(at_it, families=[DAY, SEA | {"target": {"variants": [small]}}])
