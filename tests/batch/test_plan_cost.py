"""The cost that a plan reckons from a few frames."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.recipe import parse_recipe
from droguekit.batch.plan import plan_recipe
from droguekit.batch.plan_cost import Cost, fit_over_distance, probe_cost, probe_frames

RECIPE = """
name = "spread"
[frames]
count = 200
scenes = 10
empty_fraction = 0.2
[distance]
law = "log-uniform"
low_m = 2.0
high_m = 40.0
[[families]]
name = "day"
[[families]]
name = "dusk"
[families.environment]
sun_elevation_deg = 0
"""


def test_the_fit_goes_through_what_follows_the_law() -> None:
    distance_m = np.array([2.0, 4.0, 8.0, 40.0, np.nan])
    at_m = np.array([3.0, 20.0, np.nan])
    values = np.where(np.isnan(distance_m), 0.4, 0.7 + 3 / distance_m + 28 / distance_m**2)
    fitted = fit_over_distance(distance_m, values, at_m)
    expected = [0.7 + 1 + 28 / 9, 0.7 + 3 / 20 + 28 / 400, 0.4]
    np.testing.assert_allclose(fitted, expected, rtol=1e-9)  # float64 least squares


def test_the_fit_never_says_less_than_nothing() -> None:
    fitted = fit_over_distance(np.array([2.0, 8.0, 40.0]), np.array([1.0, 2.0, 3.0]), np.array([1.0, 100.0, np.nan]))
    assert (fitted >= 0).all()


def test_probed_frames_are_spread_over_distances_families_and_scenes() -> None:
    recipe = parse_recipe(RECIPE)
    drawn = plan_recipe(recipe).drawn
    chosen = probe_frames(drawn, 200)
    assert len(chosen) == len(set(chosen)) == 13
    distances = drawn.distances_m[list(chosen)]
    shown = distances[np.isfinite(distances)]
    assert len(shown) == 12
    assert {shown.min(), shown.max()} == {np.nanmin(drawn.distances_m), np.nanmax(drawn.distances_m)}
    # A stratum of twelve has a factor of 20^(1/12) = 1.28 between its ends, and so have not two of them a gap of three.
    assert (np.diff(np.log(np.sort(shown))) < 3 * np.log(20) / 12).all()
    families = np.bincount(drawn.families[list(chosen)])
    assert families.min() >= 5
    assert len(set(drawn.scenes[list(chosen)])) == 10


def test_few_frames_are_probed_where_there_are_few() -> None:
    drawn = plan_recipe(parse_recipe(RECIPE.replace("count = 200", "count = 2").replace("= 0.2", "= 0.0"))).drawn
    assert sorted(probe_frames(drawn, 2)) == [0, 1]


def test_only_empty_frames_are_probed_where_there_are_no_others() -> None:
    drawn = plan_recipe(parse_recipe(RECIPE.replace("empty_fraction = 0.2", "empty_fraction = 1.0"))).drawn
    assert len(probe_frames(drawn, 200)) == 1


def test_time_counts_starts_and_scenes_of_every_process() -> None:
    cost = Cost(
        probed={},
        start_s=10.0,
        scene_s=0.5,
        frames_s=1000.0,
        wall_over_cpu=1.5,
        size_bytes=0.0,
        count=1000,
        scenes=60,
    )
    # A process makes 200 pairs: five processes, each of which meets 60 scenes.
    assert cost.run_s(2) == (5 * 10 + 5 * 60 * 0.5 + 1000) / 2
    # Each of twenty processes makes 50 pairs, so that no more than 1000 scenes are met.
    assert cost.run_s(20) == (20 * 10 + 1000 * 0.5 + 1000) / 20


def test_the_probe_reckons_from_what_it_measures(analytic_recipe: str) -> None:
    recipe = parse_recipe(analytic_recipe)
    plan = plan_recipe(recipe)
    cost = probe_cost(recipe, plan)
    order = np.argsort(plan.drawn.distances_m)
    assert {order[0], order[-1]} < set(cost.probed)
    assert len(cost.probed) == 3
    sizes = [report.size_bytes for report in cost.probed.values()]
    # All pairs lie between the nearest and the farthest, and the fit goes through or between the measured sizes.
    assert 8 * min(sizes) * 0.8 <= cost.size_bytes <= 8 * max(sizes) * 1.2
    slowest_s = max(sum(report.stage_s.values()) for report in cost.probed.values())
    assert 0 < cost.frames_s <= 8 * slowest_s * 1.2


@pytest.mark.parametrize("workers", [1, 3])
def test_no_more_workers_than_pairs_share_the_time(workers: int) -> None:
    cost = Cost({}, 1.0, 0.0, 10.0, 1.0, 0.0, count=workers, scenes=1)
    assert cost.run_s(100) == cost.run_s(workers)
