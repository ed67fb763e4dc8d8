from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from drogue_models.tankers.tanker import Tanker
from scenes.sampler import sample_frame
from scenes.tanker_sampling import tanker_at, tanker_of_scene
from tests.support.recipe_builder import RecipeTable, between, build_recipe

BASE: RecipeTable = {"name": "tankers", "frames": {"count": 40, "scenes": 20}, "distance": between(3.0, 30.0)}


def _recipe(**tanker: object) -> Recipe:
    return build_recipe(BASE, tanker=tanker)


def test_recipes_without_the_section_have_frames_without_the_field() -> None:
    plain = sample_frame(build_recipe(BASE), 3)
    assert plain.tanker is None
    assert "tanker" not in plain.model_dump()
    assert "tanker" not in build_recipe(BASE).model_dump()


def test_a_tanker_changes_nothing_else_of_a_frame() -> None:
    plain = sample_frame(build_recipe(BASE), 3)
    with_tanker = sample_frame(_recipe(variants=[{"type": "four-jet"}]), 3)
    assert with_tanker.model_copy(update={"tanker": None}).model_dump_json() == plain.model_dump_json()


def test_frames_of_a_scene_have_one_tanker() -> None:
    recipe = _recipe(variants=[{"type": "fighter"}, {"type": "four-turboprop"}, {"type": "twin-jet-wide"}])
    by_scene: dict[int, set[str]] = {}
    for index in range(recipe.frames.count):
        frame = sample_frame(recipe, index)
        assert frame.tanker is not None
        same = frame.tanker.model_copy(update={"blade_phase_deg": 0.0, "blade_sweep_deg": 0.0})
        by_scene.setdefault(frame.scene_id, set()).add(same.model_dump_json())
    assert len(by_scene) == 20 and all(len(tankers) == 1 for tankers in by_scene.values())


def test_types_and_paints_come_in_the_shares_of_their_weights() -> None:
    recipe = _recipe(
        variants=[
            {"type": "four-jet", "weight": 3, "station": "centreline"},
            {"type": "unmanned", "paints": [{"scheme": "trainer"}]},
        ],
        paints=[{"scheme": "navy", "weight": 4}, {"scheme": "desert"}],
        nav_light_scene_fraction=0.25,
        pod_lights=["red"],
        flaps_deg=[5, 15],
    )
    tankers = [tanker_of_scene(recipe, scene_id) for scene_id in range(2000)]
    drawn = [tanker for tanker in tankers if tanker is not None]
    assert len(drawn) == 2000
    kinds = Counter((tanker.type, tanker.station, tanker.paint) for tanker in drawn)
    # Three standard deviations of a binomial share of 2000 are at most 0.034.
    for kind, share in (
        (("four-jet", "centreline", "navy"), 0.6),
        (("four-jet", "centreline", "desert"), 0.15),
        (("unmanned", "buddy-store", "trainer"), 0.25),
    ):
        assert kinds[kind] / 2000 == pytest.approx(share, abs=0.035)
    assert len(kinds) == 3
    assert np.mean([tanker.nav_lights for tanker in drawn]) == pytest.approx(0.25, abs=0.035)
    assert {tanker.pod_light for tanker in drawn} == {"red"}
    assert {tanker.flaps_deg for tanker in drawn} == {5.0, 10.0, 15.0}
    assert len({tanker.seed for tanker in drawn}) > 1990


def test_a_multirotor_carries_the_drogue_behind_and_below_on_a_short_line() -> None:
    recipe = _recipe(variants=[{"type": "multirotor"}], line_m=[1.5, 3.0], line_drop_deg=[30, 60])
    for index in range(recipe.frames.count):
        frame = sample_frame(recipe, index)
        assert frame.left_from_tanker is not None and frame.left_from_drogue is not None and frame.drogue is not None
        assert frame.hose_nodes_left_m is not None
        tail_z_m = frame.drogue.hub_depth_m + frame.drogue.coupling_length_m - 0.02
        coupling = frame.left_from_tanker.inverse().apply(frame.left_from_drogue.apply([0.0, 0.0, tail_z_m]))
        length_m = float(np.linalg.norm(coupling))
        assert 1.5 <= length_m <= 3.0
        assert 30.0 <= np.degrees(np.arcsin(-coupling[2] / length_m)) <= 60.0 and coupling[0] > 0
        nodes = frame.left_from_tanker.inverse().apply(frame.hose_nodes_left_m)
        np.testing.assert_allclose(nodes[0], coupling, rtol=0, atol=1e-9)
        np.testing.assert_allclose(nodes[-1], 0.0, rtol=0, atol=1e-9)
        # The multirotor hovers level.
        up = frame.world_from_left.rotate(frame.left_from_tanker.rotation[:, 2])
        np.testing.assert_allclose(up, [0.0, 0.0, 1.0], rtol=0, atol=1e-9)


def test_propellers_sweep_with_the_exposure_and_turn_with_time() -> None:
    still = Tanker(type="four-turboprop", station="left-pod", blade_phase_deg=10.0)
    assert tanker_at(None, 0.0, 1.0) is None
    jet = Tanker(type="four-jet", station="left-pod")
    assert tanker_at(jet, 1.0, 1.0) == jet
    short, middle, long = (tanker_at(still, 0.0, exposure_s) for exposure_s in (0.0002, 0.0033, 0.5))
    assert short is not None and middle is not None and long is not None
    # 1020 rpm are 6120 degrees a second: 1.2, 20.2 and 3060 degrees, in steps of 5 up to a sixth of a turn.
    assert (short.blade_sweep_deg, middle.blade_sweep_deg, long.blade_sweep_deg) == (0.0, 20.0, 60.0)
    later = tanker_at(still, 1 / 17 / 4, 0.001)
    assert later is not None and later.blade_phase_deg == pytest.approx(100.0)


def test_the_hose_of_a_sequence_starts_at_the_tanker() -> None:
    recipe = build_recipe(
        name="sequences",
        frames={"count": 1000, "scenes": 2},
        sequence={"frames_per_sequence": 500},
        tanker={"variants": [{"type": "fighter"}, {"type": "four-jet", "station": "right-pod"}]},
    )
    for index in (0, 1, 499, 500, 999):
        frame = sample_frame(recipe, index)
        assert frame.tanker is not None and frame.left_from_tanker is not None and frame.hose_nodes_left_m is not None
        np.testing.assert_allclose(frame.hose_nodes_left_m[-1], frame.left_from_tanker.translation_m, rtol=0, atol=1e-9)


def test_families_may_have_their_own_tankers() -> None:
    recipe = build_recipe(
        BASE,
        families=[
            {"name": "high"},
            {"name": "low", "tanker": {"variants": [{"type": "multirotor"}]}},
        ],
        tanker={"variants": [{"type": "four-jet"}], "nav_light_scene_fraction": 1.0},
    )
    kinds = {
        (frame.family, frame.tanker.type, frame.tanker.nav_lights)
        for frame in (sample_frame(recipe, index) for index in range(20))
        if frame.tanker is not None
    }
    assert kinds == {("high", "four-jet", True), ("low", "multirotor", True)}


def test_tankers_that_cannot_be_drawn_or_flown_are_refused() -> None:
    with pytest.raises(ValueError, match="tanker: the engine analytic draws none"):
        build_recipe(BASE, render={"engine": "analytic"}, tanker={"variants": [{"type": "fighter"}]})
    with pytest.raises(ValueError, match=r"tanker.variants: a multirotor carries at most 5 m of hose.*has 15 m"):
        build_recipe(
            name="sequences",
            frames={"count": 500},
            sequence={"frames_per_sequence": 500},
            tanker={"variants": [{"type": "multirotor"}]},
        )
    with pytest.raises(ValueError, match="station: four-turboprop has left-pod, right-pod, got 'belly'"):
        _recipe(variants=[{"type": "four-turboprop", "station": "belly"}])
    with pytest.raises(ValueError, match=r"line_m: .*\[0.5, 5\]"):
        _recipe(variants=[{"type": "multirotor"}], line_m=[2, 9])
