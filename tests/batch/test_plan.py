"""What a plan says, against the frames themselves."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from datasets_manifest.recipe import parse_recipe
from droguekit.batch.plan import fit_inverse_square, plan_recipe, probe_cost
from scenes.sampler import sample_frame, scene_of_frame, split_of_scene

RECIPE = """
name = "planned"
[frames]
count = 23
scenes = 5
empty_fraction = 0.3
[distance]
law = "log-uniform"
low_m = 2.0
high_m = 30.0
[split]
train = 0.6
val = 0.2
test = 0.2
"""


def test_counts_are_those_of_the_frames() -> None:
    recipe = parse_recipe(RECIPE)
    plan = plan_recipe(recipe)
    scenes = [scene_of_frame(recipe, index) for index in range(23)]
    assert plan.by_scene == Counter(scenes)
    assert plan.by_split == Counter(split_of_scene(recipe, scene) for scene in scenes)
    assert plan.sampled == tuple(range(23))


def test_distances_are_those_of_the_frames_and_empty_ones_have_none() -> None:
    recipe = parse_recipe(RECIPE)
    plan = plan_recipe(recipe)
    poses = [sample_frame(recipe, index).left_from_drogue for index in range(23)]
    expected = [np.nan if pose is None else pose.translation_m[2] for pose in poses]
    np.testing.assert_array_equal(plan.distances_m, expected)
    assert plan.empty_fraction == sum(pose is None for pose in poses) / 23


def test_a_large_recipe_is_drawn_in_part_but_counted_in_full() -> None:
    recipe = parse_recipe(RECIPE.replace("count = 23", "count = 1000003"))
    plan = plan_recipe(recipe)
    assert sum(plan.by_scene.values()) == 1_000_003
    assert len(plan.sampled) == 1000
    assert plan.sampled[0] == 0
    assert plan.sampled[-1] == 1_000_002


def test_the_fit_goes_through_what_follows_the_law() -> None:
    distance_m = np.array([2.0, 8.0, 40.0])
    at_m = np.array([3.0, 20.0, np.nan])
    fitted = fit_inverse_square(distance_m, 0.7 + 28 / distance_m**2, at_m)
    np.testing.assert_allclose(fitted, [0.7 + 28 / 9, 0.7 + 28 / 400, 0.7], rtol=1e-12)  # float64 least squares


def test_the_fit_never_says_less_than_nothing() -> None:
    fitted = fit_inverse_square(np.array([2.0, 8.0, 40.0]), np.array([1.0, 2.0, 3.0]), np.array([1.0, 100.0]))
    assert (fitted >= 0).all()


@pytest.mark.mitsuba
def test_the_probe_measures_the_nearest_the_middle_and_the_farthest(tiny_recipe: str) -> None:
    recipe = parse_recipe(tiny_recipe)
    plan = plan_recipe(recipe)
    cost = probe_cost(recipe, plan)
    order = np.argsort(plan.distances_m)
    assert set(cost.probed) == {order[0], order[2], order[3]}
    sizes = [report.size_bytes for report in cost.probed.values()]
    # All pairs lie between the probed ones in distance, and the fit is a line through three points of one slope.
    assert 4 * min(sizes) * 0.8 <= cost.size_bytes <= 4 * max(sizes) * 1.2
    assert cost.worker_s > 0
