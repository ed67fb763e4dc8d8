"""The recipes and the table by which the speed of rendering is measured."""

from __future__ import annotations

import pytest

from datasets_manifest.recipe.recipe import recipe_names
from droguekit.batch.frame_task import FrameReport
from droguekit.workflows.render_timing import QUALITIES, _stations_table, open_stations_recipe, open_uniform_recipe


def test_every_distance_has_as_many_pairs_as_asked() -> None:
    recipe = open_stations_recipe(3, "analytic")
    assert recipe.distance.stations_m == (2.0, 5.0, 10.0, 20.0, 40.0)
    assert (recipe.frames.count, recipe.frames.scenes, recipe.render.engine) == (15, 1, "analytic")


@pytest.mark.parametrize(("pairs", "scenes"), [(1, 1), (5, 5), (40, 8)])
def test_pairs_over_all_distances_are_in_up_to_eight_scenes(pairs: int, scenes: int) -> None:
    for quality in QUALITIES:
        recipe = open_uniform_recipe(pairs, quality, None)
        assert (recipe.frames.count, recipe.frames.scenes) == (pairs, scenes)
        assert (recipe.distance.low_m, recipe.distance.high_m) == (2.0, 40.0)


def test_the_qualities_differ_in_nothing_but_samples_and_noise() -> None:
    corpus, benchmark = (open_uniform_recipe(40, quality, None).model_dump(mode="json") for quality in QUALITIES)
    assert (corpus["render"]["samples_per_px"], benchmark["render"]["samples_per_px"]) == (16, 64)
    differing = {name for name in corpus if corpus[name] != benchmark[name]}
    assert differing == {"name", "description", "render"}


def test_they_are_not_among_the_recipes_of_users() -> None:
    assert [name for name in recipe_names() if name.startswith("bench")] == []


def test_wrong_numbers_name_the_option() -> None:
    with pytest.raises(ValueError, match="--repeat: must be at least 1, got 0"):
        open_stations_recipe(0, None)
    with pytest.raises(ValueError, match="--pairs: must be at least 1, got 0"):
        open_uniform_recipe(0, "corpus", None)


def report(distance_m: float | None, **stage_s: float) -> FrameReport:
    return FrameReport(host="here", wall_s=1.0, stage_s=stage_s, distance_m=distance_m, size_bytes=0)


def test_the_table_has_mean_times_and_shares_of_the_pairs_at_each_distance() -> None:
    reports = (report(2.0, trace=3.0, write=1.0), report(2.0, trace=1.0, write=1.0), report(5.0, trace=0.5))
    _, names, *rows = _stations_table(open_stations_recipe(2, "analytic"), reports)
    assert names.split() == ["trace", "write"]
    assert rows[0].split() == ["2", "m", "3.00", "66.7", "33.3"]
    assert rows[1].split() == ["5", "m", "0.50", "100.0", "0.0"]


def test_a_distance_without_a_measured_pair_has_no_numbers() -> None:
    # An empty frame has no distance; a clock may be too coarse for a quick pair.
    reports = (report(2.0, trace=3.0), report(None, trace=3.0), report(5.0, trace=0.0))
    rows = list(_stations_table(open_stations_recipe(1, "analytic"), reports))[2:]
    assert [row.split() for row in rows] == [
        ["2", "m", "3.00", "100.0"],
        ["5", "m", "0.00", "-"],
        ["10", "m", "-", "-"],
        ["20", "m", "-", "-"],
        ["40", "m", "-", "-"],
    ]
