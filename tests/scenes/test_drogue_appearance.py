"""What is drawn of a scene's target: shares, what always holds, and that nothing of it reaches other streams."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.appearance import DrogueCondition
from drogue_models.parameters import DrogueParameters
from render.surfaces import DIRT_MAP_PX, dirt_map
from scenes.drogue_appearance import condition_of_scene, drogue_of_scene
from scenes.sampler import sample_frame
from tests.support.recipe_builder import RecipeTable, between, build_recipe

BASE: RecipeTable = {
    "name": "target-test",
    "seed": 4,
    "rig": {"preset": "rgb-ideal", "probe_tip_body_m": [2.6, 0.5, 0.35]},
    "frames": {"count": 300, "scenes": 300},
    "distance": between(3, 20),
}


def recipe(empty_fraction: float = 0.0, **target: Any) -> Recipe:
    """With these keys in its section `target`."""
    return build_recipe(BASE, frames={"empty_fraction": empty_fraction}, target=target)


def within_chance(share: float, expected: float, count: int) -> bool:
    # Four standard errors of a binomial share.
    return abs(share - expected) < 4 * np.sqrt(expected * (1 - expected) / count)


def test_without_the_section_the_drogue_is_as_new_and_alone() -> None:
    frame = sample_frame(recipe(), 0)
    assert frame.condition is None and frame.bystanders == () and frame.sought is None


def test_variants_come_in_their_shares() -> None:
    drawn = recipe(variants=[{"drogue": "red-8", "weight": 3}, {"drogue": "white-5"}])
    names = [drogue_of_scene(drawn, scene).name for scene in range(300)]
    assert set(names) == {"red-8", "white-5"}
    assert within_chance(names.count("white-5") / 300, 0.25, 300)


def test_an_empty_frame_says_what_is_sought_where_there_are_several() -> None:
    drawn = recipe(1.0, variants=[{"drogue": "red-7"}])
    frame = sample_frame(drawn, 0)
    assert frame.drogue is None and frame.condition is None
    assert frame.sought is not None and frame.sought.name == "red-7"


def test_faults_come_in_their_shares_and_three_markers_stay() -> None:
    drawn = recipe(missing_marker_fraction=0.9, dirty_marker_fraction=0.3, failed_lamp_fraction=0.2)
    states = [condition_of_scene(drawn, scene, drawn.drogue) for scene in range(300)]
    assert all(sum(not marker.missing for marker in state.markers) >= 3 for state in states)
    # Of eight markers three are spared, the others go with a chance of 0.9.
    gone = np.mean([marker.missing for state in states for marker in state.markers])
    assert within_chance(gone, 0.9 * 5 / 8, 2400)
    assert within_chance(np.mean([s.hub.dirt_fraction > 0 for s in states]), 0.3, 300)
    assert within_chance(np.mean([m.lamp_fraction == 0 for s in states for m in s.markers]), 0.2, 2400)


def test_wear_has_a_stream_of_its_own_and_stays_within_its_ranges() -> None:
    plain = recipe(missing_marker_fraction=0.3)
    worn = recipe(missing_marker_fraction=0.3, wear={"soot": {"low": 0.2, "high": 0.3}})
    states = [condition_of_scene(worn, scene, worn.drogue) for scene in range(100)]
    for scene, state in enumerate(states):
        without = condition_of_scene(plain, scene, plain.drogue)
        assert state.model_copy(update={"wear": None}) == (without or state.model_copy(update={"wear": None}))
    soot = np.array([state.wear.soot for state in states])
    assert 0.2 <= soot.min() < 0.21 and 0.29 < soot.max() <= 0.3
    assert len({state.wear.seed for state in states}) == 100
    assert condition_of_scene(worn, 3, worn.drogue) == states[3]


def test_a_condition_without_wear_is_written_as_before() -> None:
    state = condition_of_scene(recipe(missing_marker_fraction=0.9), 0, recipe().drogue)
    assert "wear" not in state.model_dump_json()
    worn = condition_of_scene(recipe(wear={}), 0, recipe().drogue)
    assert DrogueCondition.model_validate_json(worn.model_dump_json()) == worn


def test_the_analytic_engine_refuses_wear_in_one_line() -> None:
    with pytest.raises(ValueError, match=r"target\.wear: analytic draws even paint only"):
        build_recipe(BASE, target={"wear": {}}, render={"engine": "analytic"})


def test_wear_beyond_1_is_refused() -> None:
    with pytest.raises(ValueError, match=r"wear\.oil"):
        recipe(wear={"oil": {"low": 0.5, "high": 1.5}})


def test_bystanders_do_not_change_the_rest_of_a_frame() -> None:
    alone = sample_frame(recipe(), 5)
    among = sample_frame(recipe(probe=True, obstacle_frame_fraction=1, distractor_frame_fraction=1), 5)
    assert among.model_copy(update={"bystanders": ()}).model_dump_json() == alone.model_dump_json()
    assert [bystander.kind for bystander in among.bystanders[:2]] == ["probe", "obstacle"]


def test_the_probe_ends_where_the_rig_has_its_tip() -> None:
    frame = sample_frame(recipe(probe=True), 0)
    (probe,) = frame.bystanders
    tip_m = frame.rig.body_from_left.inverse().apply(frame.rig.probe_tip_body_m)
    assert probe.left_from_object.translation_m == pytest.approx(tip_m, abs=1e-12)
    # Its body runs back towards the receiver: behind the tip, along the body's own axis.
    assert frame.rig.body_from_left.rotate(probe.left_from_object.rotation[:, 2]) == pytest.approx(
        [-1, 0, 0], abs=1e-12
    )


def test_distractors_stay_behind_the_drogue() -> None:
    drawn = recipe(distractor_frame_fraction=1)
    for index in range(50):
        frame = sample_frame(drawn, index)
        depths_m = [bystander.left_from_object.translation_m[2] for bystander in frame.bystanders]
        assert depths_m and min(depths_m) >= frame.left_from_drogue.translation_m[2] + 1.0


def test_distractors_have_the_forms_that_are_named_as_often_as_they_are() -> None:
    drawn = recipe(1.0, distractor_frame_fraction=1, distractor_forms=["ring", "ring", "ring", "disc"])
    forms = [each.shape.form for index in range(60) for each in sample_frame(drawn, index).bystanders]
    assert set(forms) == {"ring", "disc"}
    assert within_chance(forms.count("ring") / len(forms), 0.75, len(forms))
    # Recipes that name none are written as they were before there were names.
    assert "distractor_forms" not in recipe(distractor_frame_fraction=1).model_dump_json()


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
def test_dirt_covers_the_share_that_is_asked_for(share: float) -> None:
    dirt = dirt_map(7, share)
    assert dirt.shape == (DIRT_MAP_PX, DIRT_MAP_PX) and dirt.min() >= 0 and dirt.max() <= 1 + 1e-6
    # Softening keeps the mean; one texel is the resolution of the share.
    assert dirt.mean() == pytest.approx(share, abs=1.5 / DIRT_MAP_PX**2 + 1e-6)


@pytest.mark.parametrize(
    ("target", "fault"),
    [
        ({"missing_marker_fraction": 1.5}, "target.missing_marker_fraction"),
        ({"dirt_fraction": [0, 2]}, "dirt_fraction: must lie in"),
        ({"variants": [{"drogue": "red-9"}]}, "red-9"),
        ({"variants": [{"weight": 1}]}, "target.variants.0.drogue"),
        ({"probe_radius_m": 0}, "target.probe_radius_m"),
        ({"distractor_forms": []}, "target.distractor_forms"),
        ({"distractor_forms": ["cube"]}, "target.distractor_forms.0"),
    ],
)
def test_a_wrong_section_is_named(target: dict[str, Any], fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        recipe(**target)


def test_the_frame_says_which_lamps_are_lit() -> None:
    lamps = {"marker_luminance_cd_m2": 20_000.0, "marker_code": {"slot_s": 0.04, "patterns": ["10", "1"] * 4}}
    plain = recipe(failed_lamp_fraction=0.3, lamp_fraction=[0.5, 0.9])
    coded = plain.model_copy(update={"drogue": DrogueParameters(**(plain.drogue.model_dump() | lamps))})
    for index in (0, 1):
        drawn, shown = sample_frame(plain, index), sample_frame(coded, index)
        assert drawn.condition is not None and shown.condition is not None and shown.drogue is not None
        shares = shown.drogue.lit_fractions(shown.time_s, shown.exposure.time_s)
        assert set(shares[1::2]) == {1.0} and set(shares[::2]) == {1.0 - index}
        for before, after, share in zip(drawn.condition.markers, shown.condition.markers, shares, strict=True):
            assert after == before.model_copy(update={"lamp_fraction": before.lamp_fraction * share})
