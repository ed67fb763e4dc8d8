"""Chi-square of a plan's places and sizes against the laws that the recipe intends."""

from __future__ import annotations

from typing import Unpack

import numpy as np
import pytest
from scipy.stats import chisquare, kstest

from datasets_manifest.recipe.drogue_ranges import DistanceLaw
from datasets_manifest.recipe.recipe import Recipe, load_recipe
from droguekit.batch.recipe_plan import check_places, check_sizes, chi_square, distance_share, draw_frames, plan_recipe
from scenes.framing import distance_at, sample_distance_m
from tests.support.recipe_builder import RecipeTable, between, build_recipe


def lawful(law: str = "log-uniform", count: int = 1500, **changes: Unpack[RecipeTable]) -> Recipe:
    base: RecipeTable = {"name": "lawful", "seed": 3, "frames": {"count": count}, "distance": between(2.0, 40.0, law)}
    return build_recipe(base, **changes)


def test_with_one_law_for_all_it_is_the_textbooks_statistic() -> None:
    shares = np.array([0.1, 0.2, 0.3, 0.4])
    cells = np.random.default_rng(1).choice(4, 500, p=shares)
    found = chi_square(np.eye(4)[cells], np.tile(shares, (500, 1)))
    expected = chisquare(np.bincount(cells, minlength=4), 500 * shares)
    assert found.statistic == pytest.approx(expected.statistic, rel=1e-9)  # float64 eigenvalues
    assert found.p_value == pytest.approx(expected.pvalue, rel=1e-9)
    assert found.degrees == 3


def test_with_a_law_for_each_draw_chances_are_even() -> None:
    rng = np.random.default_rng(2)
    laws = rng.dirichlet(np.full(6, 0.4), 400)
    edges = laws.cumsum(axis=1)
    chances = []
    for _ in range(300):
        cells = (rng.random((400, 1)) > edges).sum(axis=1).clip(0, 5)
        chances.append(chi_square(np.eye(6)[cells], laws).p_value)
    # Kolmogorov-Smirnov at 1 %; the plain sum of squares over expectations fails it by far.
    assert kstest(chances, "uniform").pvalue > 0.01


def test_cells_in_which_few_are_expected_count_as_one() -> None:
    shares = np.array([0.49, 0.49, 0.01, 0.01])
    cells = np.random.default_rng(3).choice(4, 300, p=shares)
    assert chi_square(np.eye(4)[cells], np.tile(shares, (300, 1))).degrees == 2


@pytest.mark.parametrize("law", ["uniform", "log-uniform", "uniform-image-size"])
def test_shares_are_those_of_the_sampler(law: str) -> None:
    distance = DistanceLaw.model_validate({"law": law, "low_m": 2.0, "high_m": 40.0})
    rng = np.random.default_rng(4)
    drawn = np.array([sample_distance_m(rng, distance, 0) for _ in range(2000)])
    # Under the law the shares below the draws are uniform: Kolmogorov-Smirnov at 1 %.
    assert kstest(distance_share(distance, drawn), "uniform").pvalue > 0.01


@pytest.mark.parametrize("law", ["uniform", "log-uniform", "uniform-image-size"])
@pytest.mark.parametrize("weights", [None, (1.0, 9.0, 0.0, 2.5)])
def test_shares_are_the_inverse_of_the_sampler(law: str, weights: tuple[float, ...] | None) -> None:
    edges_m = None if weights is None else (2.0, 3.0, 8.0, 9.0, 40.0)
    distance = DistanceLaw.model_validate(
        {"law": law, "low_m": 2.0, "high_m": 40.0, "edges_m": edges_m, "weights": weights}
    )
    draws = np.linspace(0.001, 0.999, 500)
    drawn_m = np.array([distance_at(distance, draw) for draw in draws])
    expected = draws
    if law == "uniform-image-size":
        # Within a bin this law draws the far end first.
        ends = np.concatenate([[0.0], np.cumsum(weights or (1.0,)) / sum(weights or (1.0,))])
        place = np.searchsorted(ends, draws, side="right") - 1
        expected = ends[place] + ends[place + 1] - draws
    # float64 logarithms and reciprocals
    np.testing.assert_allclose(distance_share(distance, drawn_m), expected, atol=1e-12)
    outside = distance_share(distance, np.array([1.0, 2.0, 40.0, 50.0]))
    np.testing.assert_array_equal(outside, [0.0, 0.0, 1.0, 1.0])


def test_weighted_distances_follow_their_law() -> None:
    weighted = {"law": "log-uniform", "low_m": 4.0, "high_m": 16.0, "edges_m": [4.0, 8.0, 16.0], "weights": [1.0, 9.0]}
    recipe = lawful(count=400, distance=weighted)
    sizes = check_sizes(plan_recipe(recipe).drawn, recipe)
    assert sizes is not None
    # The first bins are the small, far boxes, which have nine tenths of the pairs.
    assert sizes[0].expected[:4].sum() > 250
    # One seed; at 1 in 1000 the test would fail for one of 500 such seeds.
    assert sizes[0].p_value > 1e-3


@pytest.mark.parametrize("law", ["uniform", "log-uniform"])
def test_sizes_and_places_of_a_recipe_follow_its_own_law(law: str) -> None:
    recipe = lawful(law)
    drawn = plan_recipe(recipe, most_sampled=1500).drawn
    sizes, places = check_sizes(drawn, recipe), check_places(drawn, recipe.rig.camera)
    assert sizes is not None and places is not None
    assert sizes[0].counts.sum() == places.counts.sum() == 1500
    # One seed; at 1 in 1000 the test would fail for one of 250 such seeds.
    assert min(sizes[0].p_value, places.p_value) > 1e-3


def test_another_law_is_found_out() -> None:
    drawn = plan_recipe(lawful("uniform")).drawn
    sizes = check_sizes(drawn, lawful("log-uniform"))
    assert sizes is not None
    assert sizes[0].p_value < 1e-12


def test_places_that_keep_to_one_side_are_found_out() -> None:
    recipe = lawful(count=400)
    drawn = plan_recipe(recipe).drawn
    drawn.centers_px[:, 0] = 0.7 * drawn.centers_px[:, 0] + 0.3 * drawn.rooms_px[:, 0]
    places = check_places(drawn, recipe.rig.camera)
    assert places is not None
    assert places.p_value < 1e-3


def test_what_is_not_drawn_is_not_judged() -> None:
    recipe = load_recipe("demo").recipe
    assert check_sizes(plan_recipe(recipe).drawn, recipe) is None
    on_axis = lawful("uniform", count=20, seed=1, pose={"on_axis": True})
    assert check_places(plan_recipe(on_axis).drawn, on_axis.rig.camera) is None
    empty = lawful("uniform", seed=1, frames={"count": 20, "empty_fraction": 1.0})
    assert check_sizes(plan_recipe(empty).drawn, empty) is None


def test_too_few_pairs_say_nothing() -> None:
    recipe = lawful(count=3)
    sizes = check_sizes(draw_frames(recipe, (0, 1, 2)), recipe)
    assert sizes is not None
    assert (sizes[0].degrees, sizes[0].p_value) == (0, 1.0)
