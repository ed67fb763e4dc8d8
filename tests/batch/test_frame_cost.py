"""The cost that a plan estimates from a few frames."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe, parse_recipe
from datasets_manifest.storage.manifest import Drop
from droguekit.batch import frame_cost
from droguekit.batch.frame_cost import (
    CostEstimate,
    ProbeResult,
    choose_probe_frames,
    estimate_cost,
    fit_over_distance,
    make_in_turn,
    probe_recipe,
)
from droguekit.batch.frame_task import FrameReport, make_drop
from droguekit.batch.recipe_plan import RecipePlan, plan_recipe
from droguekit.batch.remembered_probes import remember_probe, remembered_probe
from droguekit.batch.worker_pool import WorkerLimits
from droguekit.cli.main import DONE, run
from droguekit.workflows.planning import cost_lines
from tests.support.batch_datasets import ANALYTIC_RECIPE, QUICK_RECIPE
from tests.support.recipe_builder import RIG_160_PX, RecipeTable, between, build_recipe

BASE: RecipeTable = {
    "name": "spread",
    "frames": {"count": 200, "scenes": 10, "empty_fraction": 0.2},
    "distance": between(2.0, 40.0, "log-uniform"),
    "families": [{"name": "day"}, {"name": "dusk", "environment": {"sun_elevation_deg": 0}}],
}


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


def test_weighted_values_pull_the_fit() -> None:
    # Two values at one distance: the fit there is their weighted mean.
    at_m = np.full(2, 5.0)
    fitted = fit_over_distance(at_m, np.array([1.0, 4.0]), at_m, np.array([2.0, 1.0]))
    np.testing.assert_allclose(fitted, 2.0, rtol=1e-9)  # float64 least squares


def test_probed_frames_are_spread_over_distances_families_and_scenes() -> None:
    recipe = build_recipe(BASE)
    drawn = plan_recipe(recipe).drawn
    order = choose_probe_frames(drawn, 200)
    chosen = order.counted
    assert len(chosen) == len(set(chosen)) == 6
    distances = drawn.distances_m[list(chosen)]
    shown = distances[np.isfinite(distances)]
    assert len(shown) == 5
    # The nearest one is from the middle of the nearest of five strata.
    assert shown.max() == np.nanmax(drawn.distances_m)
    assert 2 * 20**0.06 < shown.min() < 2 * 20**0.14
    # A stratum of five has a factor of 20^(1/5) = 1.82 between its ends, and so have not two of them a gap of two.
    assert (np.diff(np.log(np.sort(shown))) < 2 * np.log(20) / 5).all()
    assert np.bincount(drawn.families[list(chosen)]).tolist() == [3, 3]
    assert len(set(drawn.scenes[list(chosen)][np.isfinite(distances)])) == 5


def test_more_frames_are_probed_where_more_are_asked_for() -> None:
    drawn = plan_recipe(build_recipe(BASE)).drawn
    chosen = choose_probe_frames(drawn, 200, most=12).counted
    assert np.isfinite(drawn.distances_m[[drawn.indices.index(index) for index in chosen]]).sum() == 12


def test_a_near_and_a_far_frame_warm_up() -> None:
    drawn = plan_recipe(build_recipe(BASE)).drawn
    order = choose_probe_frames(drawn, 200)
    assert not set(order.warm_up) & set(order.counted)
    distances = drawn.distances_m[list(order.warm_up)]
    # Of the first and of the last of five strata of 2 to 40 m.
    assert distances.min() < 2 * 20**0.2 and distances.max() > 40 / 20**0.2
    assert len(distances) == 2


def test_near_far_and_middle_frames_are_probed_in_any_case_and_all_that_are_asked_for() -> None:
    drawn = plan_recipe(build_recipe(BASE)).drawn
    order = choose_probe_frames(drawn, 200)
    distances = drawn.distances_m[[drawn.indices.index(index) for index in order.counted]]
    # One without a drogue, which takes the least time, comes first, and the middle one of five last.
    assert np.isnan(distances[0]) and distances[3] == np.nanmedian(distances)
    assert (distances[1], distances[2]) == (np.nanmax(distances), np.nanmin(distances))
    assert order.fewest == 4
    asked = choose_probe_frames(drawn, 200, most=5)
    assert (asked.counted, asked.fewest) == (order.counted, 6)


@pytest.mark.parametrize(("longest_s", "made"), [(0.0, (1, 4)), (1e9, (3, 6))])
def test_frames_that_take_long_are_few(
    longest_s: float, made: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frame_cost, "_ENOUGH_S", longest_s)
    monkeypatch.setattr(frame_cost, "_LONG_WARM_UP_S", longest_s)
    recipe = build_recipe(BASE, rig=RIG_160_PX, frames={"scenes": 2}, render={"engine": "analytic"})
    found = frame_cost._probe(recipe, choose_probe_frames(plan_recipe(recipe).drawn, 200), "cpu")
    assert (len(found.warm_up), len(found.counted)) == made
    # The first one is made twice, and the second time its scene is there already.
    (first, report), *_ = found.counted.items()
    assert first == next(iter(found.warm_up))
    assert found.later_scene_s == sum(report.stage_s.get(stage, 0.0) for stage in ("sample", "sky", "scene"))


def test_few_frames_are_probed_where_there_are_few() -> None:
    drawn = plan_recipe(build_recipe(BASE, frames={"count": 2, "empty_fraction": 0.0})).drawn
    order = choose_probe_frames(drawn, 2)
    assert sorted(order.counted) == [0, 1]
    assert order.warm_up == ()


def test_only_empty_frames_are_probed_where_there_are_no_others() -> None:
    drawn = plan_recipe(build_recipe(BASE, frames={"empty_fraction": 1.0})).drawn
    assert len(choose_probe_frames(drawn, 200).counted) == 1


def synthetic(recipe: Recipe, plan: RecipePlan, rest_s: Callable[[int], float], first_s: float = 0.0) -> ProbeResult:
    """A probe in which a frame takes `rest_s` and 0.2 s to set up its scene, and `first_s` more to make a new one."""
    drawn, met = plan.drawn, set[int]()

    def report(index: int) -> FrameReport:
        place = drawn.indices.index(index)
        scene_id, distance_m = int(drawn.scenes[place]), float(drawn.distances_m[place])
        new_s = first_s if scene_id not in met else 0.0
        met.add(scene_id)
        stage_s = {
            "sample": 0.1 + new_s / 2,
            "sky": 0.05 + new_s / 4,
            "scene": 0.05 + new_s / 4,
            "paths": rest_s(index),
        }
        return FrameReport("here", sum(stage_s.values()), stage_s, None if np.isnan(distance_m) else distance_m, 1000)

    order = choose_probe_frames(drawn, recipe.frames.count)
    warm_up = {index: report(index) for index in order.warm_up}
    counted = {index: report(index) for index in order.counted}
    return ProbeResult(warm_up, counted, 0.2, 3.0, ())


def test_setting_up_a_scene_counts_for_every_pair_and_making_it_once() -> None:
    recipe = build_recipe(BASE)
    plan = plan_recipe(recipe)
    found = estimate_cost(recipe, plan, synthetic(recipe, plan, lambda _: 1.0, first_s=0.7))
    assert found.frames_s == pytest.approx(200 * (1.0 + 0.2), rel=1e-9)  # float64 least squares
    assert found.scene_s == pytest.approx(0.7, rel=1e-9)
    # One process makes each of ten scenes once.
    assert found.work_s(1) == pytest.approx(200 * 1.2 + 10 * 0.7, rel=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_families_without_a_measured_frame_count_as_the_others(seed: int) -> None:
    # Three frames are measured of six families: the last ones may well have none.
    recipe = build_recipe(
        name="six",
        seed=seed,
        frames={"count": 12, "scenes": 6},
        distance=between(2, 20),
        families=[{"name": f"f{number}"} for number in range(6)],
    )
    plan = plan_recipe(recipe)
    found = estimate_cost(recipe, plan, synthetic(recipe, plan, lambda _: 1.0))
    assert len(found.probed) == 3
    assert found.frames_s == pytest.approx(12 * 1.2, rel=1e-9)
    assert found.size_bytes == pytest.approx(12 * 1000, rel=1e-9)


def test_a_probed_family_that_is_not_drawn_counts_for_nothing() -> None:
    """Measurements may be of another number of pairs, in which a rare family's frame was drawn."""
    families = [{"name": "day", "weight": 1}, {"name": "fog", "weight": 1}, {"name": "dusk", "weight": 1}]
    recipe = build_recipe(name="rare", frames={"count": 60, "scenes": 60}, distance=between(2, 20), families=families)
    plan = plan_recipe(recipe)
    drawn = plan.drawn
    keep = [place for place, family in enumerate(drawn.families) if family == 0]
    fewer = replace(
        drawn,
        indices=tuple(drawn.indices[place] for place in keep),
        distances_m=drawn.distances_m[keep],
        families=drawn.families[keep],
        scenes=drawn.scenes[keep],
    )
    dear = {index for index, family in zip(drawn.indices, drawn.families, strict=True) if family == 2}
    probed = synthetic(recipe, plan, lambda index: 100.0 if index in dear else 1.0)
    assert dear & set(probed.counted)
    assert set(fewer.indices) & set(probed.counted)
    found = estimate_cost(recipe, replace(plan, drawn=fewer), probed)
    assert found.frames_s == pytest.approx(60 * 1.2, rel=1e-9)


def test_the_standard_error_is_how_much_the_total_scatters() -> None:
    recipe = build_recipe(BASE)
    plan = plan_recipe(recipe)
    rng = np.random.default_rng(5)
    distances = dict(zip(plan.drawn.indices, plan.drawn.distances_m, strict=True))

    def noisy_s(index: int) -> float:
        distance_m = distances[index]
        # Terms far above the noise, so that none is held at zero.
        return 5.0 if np.isnan(distance_m) else 20 + 20 / distance_m + 20 / distance_m**2 + rng.normal(0, 0.1)

    costs = [estimate_cost(recipe, plan, synthetic(recipe, plan, noisy_s)) for _ in range(400)]
    errors = [found.error_s for found in costs if found.error_s is not None]
    assert len(errors) == 400
    told_s = np.sqrt(np.square(errors).mean())
    # Five values of 0.1 s about three terms tell the sum over all pairs with a drogue. The root of 400 mean squares
    # with two degrees of freedom scatters by 2.5 %, of which this is four.
    assert told_s == pytest.approx(np.isfinite(plan.drawn.distances_m).sum() * 0.1 / np.sqrt(5), rel=0.1)
    # The standard deviation of 400 draws is known to 3.5 %; distances of the measured ones are not quite those of all.
    assert np.std([found.frames_s for found in costs]) == pytest.approx(told_s, rel=0.15)


def test_as_many_frames_as_terms_say_nothing_of_scatter() -> None:
    recipe = build_recipe(BASE, frames={"count": 9})
    plan = plan_recipe(recipe)
    found = estimate_cost(recipe, plan, synthetic(recipe, plan, float))
    assert len([index for index, report in found.probed.items() if report.distance_m is not None]) == 3
    assert found.error_s is None


@pytest.mark.parametrize("error_s", [None, 50.0])
def test_a_scatter_is_told_only_where_it_is_known(error_s: float | None) -> None:
    lines = list(cost_lines(replace(cost(24, 1), error_s=error_s), 1))
    # One process and one scene: 1000.5 s.
    told = "" if error_s is None else ", give or take 5 % by how the measured ones scatter"
    assert f"all pairs: 16 min 40 s of processor time{told}" in lines


def test_an_error_without_words_is_told_by_its_kind() -> None:
    assert make_drop(3, ValueError()) == Drop(frame_index=3, reason="ValueError")
    assert make_drop(3, ValueError("two\n lines")) == Drop(frame_index=3, reason="two lines")


def test_time_that_failed_frames_took_is_no_start() -> None:
    def made_unless_odd(index: int) -> FrameReport:
        began_s = time.process_time()
        while time.process_time() < began_s + 0.02:
            pass
        if index % 2:
            raise RuntimeError("odd")
        return FrameReport("here", 0.02, {"paths": 0.02}, None, 10)

    drops = list[Drop]()
    # The first one may have loaded the engine, and so is part of the start.
    made, failed_s = make_in_turn(made_unless_odd, (1, 2, 3, 5), drops, False)
    assert tuple(made) == (2,)
    assert [drop.frame_index for drop in drops] == [1, 3, 5]
    assert failed_s >= 0.04
    assert make_in_turn(made_unless_odd, (1,), [], True)[1] >= 0.02
    assert make_in_turn(made_unless_odd, (1,), [], False)[1] == 0


def cost(count: int, scenes: int, sequences: int = 0) -> CostEstimate:
    return CostEstimate(
        probed={},
        drops=(),
        start_s=10.0,
        scene_s=0.5,
        frames_s=1000.0,
        error_s=50.0,
        wall_over_cpu=1.5,
        size_bytes=0.0,
        count=count,
        scenes=scenes,
        sequences=sequences,
    )


@pytest.mark.parametrize("sequences", [0, 60])
def test_each_scene_or_sequence_is_made_once_and_once_more_where_a_process_begins_in_its_midst(sequences: int) -> None:
    count, scenes = 5 * WorkerLimits().tasks_per_process, 7 if sequences else 60
    assert cost(count, scenes, sequences).work_s(2) == (60 + 4) * 0.5 + 1000
    assert cost(count, scenes, sequences).run_s(2) == (5 * 10 + (60 + 4) * 0.5 + 1000) / 2
    # No more scenes are made than there are pairs.
    assert cost(62, scenes, sequences).run_s(20) == (20 * 10 + 62 * 0.5 + 1000) / 20
    assert cost(24, 1, sequences=1).work_s(1) == 0.5 + 1000


def test_the_probe_reckons_from_what_it_measures() -> None:
    recipe = parse_recipe(ANALYTIC_RECIPE)
    plan = plan_recipe(recipe)
    found = estimate_cost(recipe, plan, probe_recipe(recipe, plan))
    assert np.argmax(plan.drawn.distances_m) in found.probed
    assert len(found.probed) == 3
    sizes = [report.size_bytes for report in found.probed.values()]
    # Few pairs are nearer than the nearest measured one, and the fit goes through or between the measured sizes.
    assert 8 * min(sizes) * 0.8 <= found.size_bytes <= 8 * max(sizes) * 1.3
    slowest_s = max(sum(report.stage_s.values()) for report in found.probed.values())
    assert 0 < found.frames_s <= 8 * slowest_s * 1.3
    assert found.start_s > 0
    assert found.drops == ()


def test_a_recipe_that_was_planned_before_is_not_probed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    recipe = parse_recipe(ANALYTIC_RECIPE)
    assert remembered_probe(recipe, "cpu") is None
    plan = plan_recipe(recipe)
    result = probe_recipe(recipe, plan)
    remember_probe(recipe, "cpu", result)
    found = remembered_probe(recipe, "cpu")
    assert found is not None and found.result == result
    assert remembered_probe(recipe, "cuda") is None
    # What one GPU took tells nothing of another.
    model = "NVIDIA H100"
    monkeypatch.setattr("droguekit.batch.remembered_probes.gpu_model", lambda: model)
    remember_probe(recipe, "cuda", result)
    assert remembered_probe(recipe, "cuda") is not None
    model = "NVIDIA L4"
    assert remembered_probe(recipe, "cuda") is None
    assert remembered_probe(recipe.model_copy(update={"seed": recipe.seed + 1}), "cpu") is None

    # Of another number of pairs, whose drawn frames are others, the same measurements tell as well.
    more = recipe.model_copy(update={"frames": recipe.frames.model_copy(update={"count": 4000})})
    again = remembered_probe(more, "cpu")
    assert again is not None and again.result == result
    few_s, many_s = (estimate_cost(each, plan_recipe(each), result).frames_s for each in (recipe, more))
    assert many_s / few_s == pytest.approx(4000 / recipe.frames.count, rel=0.5)

    fewer = recipe.model_copy(update={"frames": recipe.frames.model_copy(update={"count": max(result.counted)})})
    assert remembered_probe(fewer, "cpu") is None

    file = tmp_path / "recipe.toml"
    file.write_text(ANALYTIC_RECIPE)
    monkeypatch.setattr("droguekit.batch.frame_cost.probe", pytest.fail)
    assert run(["plan", str(file)]) == DONE
    assert f"measured on {found.day} (`--probe N` measures anew), with one worker" in capsys.readouterr().out
    for damaged in tmp_path.rglob("*.json"):
        damaged.write_text(damaged.read_text()[:-20])
    assert remembered_probe(recipe, "cpu") is None


def test_a_frame_that_the_engine_refuses_is_a_drop_of_the_probe(troubled: Callable[..., Path]) -> None:
    recipe = parse_recipe(QUICK_RECIPE)
    plan = plan_recipe(recipe)
    order = choose_probe_frames(plan.drawn, 8)
    # The first two, so that the third one loads the engine.
    troubled(refuse=order.counted[:2])
    result = probe_recipe(recipe, plan)
    assert next(iter(result.warm_up)) == order.counted[2]
    found = estimate_cost(recipe, plan, result)
    assert tuple(drop.frame_index for drop in found.drops) == order.counted[:2]
    assert found.drops[0].reason == f"frame {order.counted[0]} is beyond me"
    assert tuple(found.probed) == (order.counted[2],)
    troubled(refuse=list(range(8)))
    with pytest.raises(ValueError, match=r"none of 3 can be made, the last because: frame \d is beyond me"):
        probe_recipe(recipe, plan)


@pytest.mark.parametrize("workers", [1, 3])
def test_no_more_workers_than_pairs_share_the_time(workers: int) -> None:
    few = cost(workers, 1)
    assert few.run_s(100) == few.run_s(workers)
