"""The corpora that ship: what their names promise, from the recipes and the draws alone."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import load_recipe, recipe_names
from droguekit.batch.recipe_plan import draw_frames, plan_recipe
from scenes.sampler import sample_frame, sample_left_from_drogue


@pytest.mark.parametrize("name", recipe_names())
def test_every_recipe_can_be_read_and_carries_its_name(name: str) -> None:
    recipe = load_recipe(name).recipe
    assert recipe.name == name
    assert recipe.description


@pytest.mark.parametrize("name", recipe_names())
def test_every_recipe_says_what_its_pictures_are_for(name: str) -> None:
    source = load_recipe(name)
    recipe = source.recipe
    says = "linear, for measuring" if recipe.sensor.encoding == "linear" else "sRGB, for looking and training"
    if any(part.camera is not None for part in (recipe, *recipe.families)):
        says = "drawn cameras, for looking and training"
    assert f"# Pictures: {says}." in source.text.splitlines()


@pytest.mark.parametrize(("name", "markers"), [("semi-physical-5", 5), ("semi-physical-7", 7)])
def test_semi_physical_has_100_sets_at_stations_1_m_apart(name: str, markers: int) -> None:
    recipe = load_recipe(name).recipe
    assert recipe.drogue.marker_count == markers
    distances = draw_frames(recipe, tuple(range(0, 900, 7))).distances_m
    np.testing.assert_allclose(distances, [2 + index % 9 for index in range(0, 900, 7)], rtol=1e-12)
    assert recipe.frames.count == 100 * 9
    assert recipe.rangefinder is not None


def test_any_prefix_of_a_station_recipe_covers_all_its_distances() -> None:
    for name in ("semi-physical-5", "semi-physical-7", "low-light", "cloud"):
        recipe = load_recipe(name).recipe
        stations = recipe.distance.stations_m
        assert stations is not None
        poses = [sample_left_from_drogue(recipe, index) for index in range(len(stations))]
        assert [round(float(pose.translation_m[2]), 9) for pose in poses if pose is not None] == list(stations)


def test_paper_corpus_counts_as_the_paper_does() -> None:
    recipe = load_recipe("paper-corpus").recipe
    plan = plan_recipe(recipe, most_sampled=400)
    assert 2 * sum(plan.by_scene.values()) == 14_298
    assert len(plan.by_scene) == 89
    assert set(plan.by_family) == {"sky", "cloud", "low-light", "ground", "semi-physical"}
    shares = np.array([plan.by_split[name] for name in ("train", "val", "test")]) / 7149
    # Whole scenes: each end of a split is off by half a scene of 89 at most.
    np.testing.assert_allclose(shares, [0.7, 0.1, 0.2], atol=1.0 / 89)
    assert plan.empty_fraction == 0
    assert (plan.drawn.distances_m >= 2).all() and (plan.drawn.distances_m <= 40).all()


def test_detector_small_has_empty_frames_and_things_that_are_no_drogue() -> None:
    recipe = load_recipe("detector-small").recipe
    plan = plan_recipe(recipe)
    # 1200 draws at 12.5 %: a standard deviation of 1 %.
    assert abs(plan.empty_fraction - 0.125) < 0.03
    empty = np.flatnonzero(np.isnan(plan.drawn.distances_m))
    bystanders = [sample_frame(recipe, int(k)).bystanders for k in empty[:30]]
    negatives = sum(any(found.kind == "distractor" for found in frame) for frame in bystanders)
    # 30 draws at 40 %: a standard deviation of 2.7.
    assert 3 <= negatives <= 21
