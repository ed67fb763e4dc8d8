"""Criteria on whole flights: their arithmetic on estimates of known errors, and the data that they use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import load_recipe
from drogue_models.marker_layout import marker_layout
from drogue_models.presets import load_drogue
from droguekit.scoring.poses.drogue_truth import DrogueTruth
from geometry.se3 import RigidTransform
from geometry.stereo import paper_rig
from scenes.drogue_appearance import drogue_of_scene
from scenes.sampler import recipe_of_scene, scene_of_frame
from studies.acceptance.acceptance_table import AcceptanceRow
from studies.acceptance.rendered.flight_tiers import (
    FLIGHT_TIERS,
    approach_rows,
    bench_rows,
    bound_ratio,
    condition_rows,
    lost_rows,
    part_length,
    processing_time_rows,
    with_parts,
)
from studies.acceptance.rendered.scored_frames import BEST, CHAIN
from studies.acceptance.rendered.sequence_pairs import FILTERED, ScoredPair, TruePair
from tests.support.recipe_builder import RecipeTable, build_recipe, stations

DROGUE, RIG = load_drogue("red-8"), paper_rig()
LAYOUT = marker_layout(DROGUE)


def true_pair(index: int, **changes: object) -> TruePair:
    distance_m = changes.pop("distance_m", 5.0)
    truth = DrogueTruth(
        left_from_drogue=RigidTransform(np.eye(3), np.array([0.0, 0.0, distance_m])),
        rig=RIG,
        layout=LAYOUT,
        centers_px=np.zeros((2, 9, 2)),
        visible=np.ones((2, 9), dtype=bool),
    )
    return replace(TruePair(index, index // 50, "sky", truth, DROGUE.rim_radius_m, True, "seen"), **changes)  # type: ignore[arg-type]


def answer(pair: TruePair, error_mm: float | None = 0.3, sd_m: float = 1e-3, **changes: object) -> ScoredPair:
    if error_mm is None:
        return replace(ScoredPair(pair, None, None, None, "nothing there", 0.02), **changes)  # type: ignore[arg-type]
    error = np.array([0.0, 0.0, 1e-3 * error_mm, 0.1, -0.2])
    return replace(ScoredPair(pair, error, sd_m, error / 1e-3, "", 0.02), **changes)  # type: ignore[arg-type]


def flight(count: int = 200, **changes: object) -> list[ScoredPair]:
    return [answer(true_pair(index, **changes)) for index in range(count)]


def by_bar(rows: list[AcceptanceRow]) -> dict[str, list[AcceptanceRow]]:
    found: dict[str, list[AcceptanceRow]] = {}
    for row in rows:
        found.setdefault(row.bar, []).append(row)
    return found


def test_an_approach_within_its_bars_meets_them() -> None:
    rows = by_bar(approach_rows("data", {BEST: flight(800), CHAIN: flight(800)}, False))
    assert [row.measured for row in rows["17"]] == pytest.approx([0.3])
    assert [row.measured for row in rows["18"]] == pytest.approx([0.3])
    assert [row.measured for row in rows["19"]] == pytest.approx([0.1, 0.2])
    assert rows["20"][0].measured == 0 and rows["20"][0].met
    assert all(row.met for bar in ("17", "18", "19", "20") for row in rows[bar])
    assert (rows["21"][0].met, rows["21"][0].n) == (True, 0)
    # Those of another method, or of another rig, have no number.
    assert len(rows["beside"]) == 6
    assert set(by_bar(approach_rows("data", {BEST: flight()}, True))) == {"beside"}


def test_failures_count_as_failures() -> None:
    pairs = [answer(p.pair, None) if p.pair.frame_index % 50 == 0 else p for p in flight(800)]
    rows = by_bar(approach_rows("data", {BEST: pairs}, False))
    assert rows["20"][0].measured == pytest.approx(0.02) and not rows["20"][0].met
    assert "16 of 800 pairs without a pose" in rows["17"][0].note
    nothing = by_bar(approach_rows("data", {BEST: [answer(true_pair(k), None) for k in range(5)]}, False))
    assert not any(row.met for bar in ("17", "18", "19", "20") for row in nothing[bar])


@pytest.mark.parametrize(
    ("others", "bold"),
    [
        ([(None, {}), (None, {})], 0),
        ([(None, {"reason": ""})], 1),
        ([(50.0, {"sd_m": 1.1e-3})], 0),
        ([(50.0, {"sd_m": 0.9e-3})], 1),
        ([(50.0, {"sd_m": None})], 1),
        ([(1.0, {"sd_m": 0.9e-3})], 0),
    ],
)
def test_what_is_out_of_view_must_be_reasoned_modest_or_exact(
    others: list[tuple[float | None, dict[str, object]]], bold: int
) -> None:
    out = [
        replace(answer(true_pair(1000 + k, in_view=False), error_mm), **changes)  # type: ignore[arg-type]
        for k, (error_mm, changes) in enumerate(others)
    ]
    (row,) = by_bar(approach_rows("data", {BEST: flight() + out}, False))["21"]
    assert (row.measured, row.n, row.met) == (bold, len(others), bold == 0)


def test_a_pose_of_a_hidden_drogue_is_never_exact() -> None:
    hidden = answer(true_pair(1000, in_view=False, visibility="hidden"), 0.1, sd_m=0.9e-3)
    (row,) = by_bar(approach_rows("data", {BEST: [*flight(), hidden]}, False))["21"]
    assert row.measured == 1


def test_conditions_have_bars_of_their_own() -> None:
    pairs = [
        replace(p, pair=replace(p.pair, family=name))
        for name, p in zip(["sky", "cloud", "low-light", "ground"] * 200, flight(800), strict=True)
    ]
    # Two in a hundred without a pose are too many for sky and cloud alone.
    pairs = [answer(p.pair, None) if p.pair.frame_index // 4 % 50 == 0 else p for p in pairs]
    rows = by_bar(condition_rows("data", {BEST: pairs}, False))
    assert [(row.measured, row.high) for row in rows["22"]] == [(0.02, 0.01)] * 2 + [(0.02, 0.03)] * 2
    # The worst component: yaw, 0.2 over 0.001.
    assert [row.measured for row in rows["23"]] == pytest.approx([200.0] * 4)
    assert rows["23"][0].note.startswith("yaw")
    (unfixed, _) = rows["beside"]
    assert "8 markers" in unfixed.quantity and (unfixed.measured, unfixed.n) == (0.02, 800)


def test_the_bound_is_that_of_the_worst_component() -> None:
    pairs = [replace(p, over_bound=np.array([0.5, 0.5, 1.4, 1.0, 1.0])) for p in flight()]
    name, (value, limit), n = bound_ratio(pairs) or ("", (0.0, 0.0), 0)
    assert (name, n) == ("z", 200) and (value, limit) == pytest.approx((1.4, 1.4))
    assert bound_ratio([replace(p, over_bound=None) for p in flight()]) is None


@pytest.mark.parametrize(("delay", "poses", "late"), [(0, 0, 0), (3, 0, 0), (4, 0, 1), (0, 2, 0)])
def test_losing_the_drogue(delay: int, poses: int, late: int) -> None:
    pairs = []
    for index in range(100):
        hidden = 20 <= index % 50 < 40
        found = not hidden and not (40 <= index % 50 < 40 + delay)
        pair = true_pair(index, visibility="hidden" if hidden else "seen")
        pairs.append(answer(pair, 0.3 if found or index in range(25, 25 + poses) else None))
    rows = by_bar(lost_rows("data", {BEST: pairs, FILTERED: pairs, CHAIN: pairs}, False))
    # A filter is judged as well.
    for row in rows["24"]:
        assert (row.measured, row.n) == (2 * late, 2)
    for row in rows["25"]:
        assert (row.measured, row.n) == (poses, 40)
    assert [len(rows[bar]) for bar in ("21", "24", "25", "beside")] == [2, 2, 2, 3]


@pytest.mark.parametrize("visibility", ["dazzled", "partly"])
def test_a_wrong_pose_beside_the_sun_or_of_a_part_is_counted(visibility: str) -> None:
    wrong = answer(true_pair(1000, in_view=False, visibility=visibility), 50.0, sd_m=0.9e-3)
    (row,) = by_bar(lost_rows("data", {FILTERED: [*flight(), wrong]}, False))["21"]
    assert (row.measured, row.n, row.met) == (1, 1, False)


@pytest.mark.parametrize("distance_m", [2.0, 10.0])
@pytest.mark.parametrize(("error_mm", "late"), [(320.0, 0), (340.0, 1)])
def test_a_pose_farther_off_than_the_rim_has_not_found_the_drogue_again(
    distance_m: float, error_mm: float, late: int
) -> None:
    assert DROGUE.rim_radius_m == 0.33
    pairs = [
        answer(
            true_pair(k, distance_m=distance_m, visibility="hidden" if k < 5 else "seen"),
            None if k < 5 else error_mm if k < 20 else 1.0,
        )
        for k in range(30)
    ]
    assert by_bar(lost_rows("data", {BEST: pairs}, False))["24"][0].measured == late


def test_the_bench_is_judged_at_its_worst_station() -> None:
    pairs = []
    for k in range(90):
        pair = true_pair(k, distance_m=2.0 + k % 9, sequence_id=k)
        error = np.array([1e-3, 2e-3 * (1 + (k % 9 == 4)), -1e-3 * pair.distance_m, 0.0, 0.0])
        pairs.append(ScoredPair(pair, error, 1e-3, None, "", None))
    rows = bench_rows("bench", {BEST: pairs}, False)
    assert [row.measured for row in rows] == pytest.approx([1.0, 4.0, 0.1, 0.0])
    # None of 90 without a pose: 1 - 0.05^(1/90) by Clopper and Pearson, above 0.005.
    assert rows[3].limit_high == pytest.approx(0.0327, abs=1e-4)
    assert [row.met for row in rows] == [True, True, True, False]
    assert rows[1].note == "6 m" and all(row.bar == "26" for row in rows)


@pytest.mark.parametrize("fixes", [0, 1])
def test_a_station_of_the_bench_without_poses_is_not_left_out(fixes: int) -> None:
    pairs = [answer(true_pair(k, distance_m=2.0 + k % 9, sequence_id=k)) for k in range(90)]
    at_4_m = [k for k in range(90) if k % 9 == 2]
    for k in at_4_m[fixes:]:
        pairs[k] = answer(pairs[k].pair, None)
    *errors, share = bench_rows("bench", {BEST: pairs}, False)
    assert [(row.measured, row.met, row.note) for row in errors] == [(None, False, "too few poses at 4 m")] * 3
    assert share.measured == pytest.approx((10 - fixes) / 90) and not share.met


def test_speed_is_the_median_by_distance_without_or_with_a_pose() -> None:
    far = [answer(true_pair(k, distance_m=7.0), work_s=0.025) for k in range(30)]
    near = [answer(true_pair(k, distance_m=2.0), None, work_s=0.090) for k in range(30)]
    rows = processing_time_rows("data", far + near, False)
    assert [(row.measured, row.met) for row in rows] == [(pytest.approx(25.0), True), (pytest.approx(90.0), False)]
    assert processing_time_rows("data", far, True)[1].measured is None
    # What is independent is a flight: one of four that is slow throughout.
    flights = [answer(true_pair(k, distance_m=7.0), work_s=0.025 if k < 150 else 0.050) for k in range(200)]
    assert processing_time_rows("data", flights, False)[0].limit_high == pytest.approx(50.0)


def test_tiers_name_recipes_that_ship_and_can_have_as_many_parts() -> None:
    for tier in FLIGHT_TIERS.values():
        for data in tier:
            recipe = load_recipe(data.recipe).recipe
            assert data.follows == (recipe.sequence is not None)
            longer = with_parts(recipe, data.parts)
            assert longer.frames.count >= data.parts * part_length(recipe)
            assert longer.frames.scenes >= recipe.frames.scenes
    recipe = load_recipe("docking-10m").recipe
    assert with_parts(recipe, 2) is recipe
    assert (with_parts(recipe, 5).frames.count, with_parts(recipe, 5).frames.scenes) == (2250, 5)


@pytest.mark.parametrize("seed", [1, 99])
def test_docking_conditions_has_every_combination_whatever_the_seed(seed: int) -> None:
    recipe = load_recipe("docking-conditions", seed).recipe
    assert recipe.sequence is not None
    flown = []
    for sequence in range(12):
        scene = scene_of_frame(recipe, sequence * recipe.sequence.frames_per_sequence)
        own = recipe_of_scene(recipe, scene)
        air = recipe.sequence.turbulence[sequence % 3]
        flown.append((own.family, drogue_of_scene(own, scene).marker_count, air))
    assert len({(family, markers) for family, markers, _ in flown}) == 12
    assert len({(family, air) for family, _, air in flown}) == 12
    assert {family for family, _, _ in flown[:4]} == {"sky", "cloud", "low-light", "ground"}
    assert {markers for _, markers, _ in flown} == {5, 7, 8}


def test_in_turn_needs_families_of_equal_weight() -> None:

    base: RecipeTable = {
        "name": "turns",
        "frames": {"count": 4, "scenes": 4, "in_turn": True},
        "distance": stations(5),
    }
    drawn = build_recipe(base, families=[{"name": "a"}, {"name": "b"}])
    assert [recipe_of_scene(drawn, scene_of_frame(drawn, k)).family for k in range(4)] == ["a", "b", "a", "b"]
    with pytest.raises(ValueError, match=r"families: have equal weights where frames.in_turn is true"):
        build_recipe(base, families=[{"name": "a", "weight": 2}, {"name": "b"}])
    variants = [{"drogue": "red-8", "weight": 4}, {"drogue": "red-5"}]
    with pytest.raises(ValueError, match=r"target.variants: have equal weights where frames.in_turn is true"):
        build_recipe(base, families=[{"name": "a"}, {"name": "b"}], target={"variants": variants})
