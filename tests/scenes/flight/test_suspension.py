"""What a recipe's `[hose]` draws: lengths and paint by scene, the hang by frame, and nothing of other streams."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from datasets_manifest.recipe.aircraft_ranges import HoseRanges
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.frame import FrameSpec
from drogue_models.meshes import drogue_meshes
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import Part
from drogue_models.presets import load_drogue
from geometry.se3 import Array
from scenes.flight.suspension import hose_look_of_scene, hose_of_scene, hose_tail_m
from scenes.sampler import sample_frame
from tests.support.recipe_builder import RecipeTable, between, build_recipe

BASE: RecipeTable = {
    "name": "hose-test",
    "seed": 5,
    "frames": {"count": 200, "scenes": 200},
    "distance": between(3, 20),
}


def recipe(**hose: Any) -> Recipe:
    return build_recipe(BASE, hose=hose)


def length_m(frame: FrameSpec) -> float:
    nodes: Array = np.asarray(frame.hose_nodes_left_m)
    return float(np.linalg.norm(np.diff(nodes, axis=0), axis=1).sum())


def test_without_the_section_nothing_is_new() -> None:
    frame = sample_frame(build_recipe(BASE), 0)
    assert frame.hose_look is None and "hose_look" not in frame.model_dump_json()
    assert 'hose"' not in build_recipe(BASE).model_dump_json()


def test_the_section_changes_nothing_but_hose_and_tanker() -> None:
    plain, hung = sample_frame(build_recipe(BASE), 3), sample_frame(recipe(), 3)
    changed = {"left_from_tanker", "hose_nodes_left_m", "hose_look"}
    before, after = (frame.model_dump(mode="json") for frame in (plain, hung))
    assert {key for key in after if after[key] != before.get(key)} == changed


def test_retracted_and_trailed_hoses_come_in_their_shares() -> None:
    ranges = HoseRanges(retracted_scene_fraction=0.2, trailed_scene_fraction=0.5)
    hoses = [hose_of_scene(1, scene, ranges, recipe().drogue) for scene in range(400)]
    # Four standard errors of a binomial share of 400.
    assert np.mean([hose.retracted for hose in hoses]) == pytest.approx(0.2, abs=0.08)
    assert np.mean([hose.parameters.length_m == 25 for hose in hoses]) == pytest.approx(0.5, abs=0.1)
    assert all(0.15 <= hose.parameters.length_m <= 0.4 for hose in hoses if hose.retracted)
    assert all(5 <= hose.parameters.length_m <= 25 for hose in hoses if not hose.retracted)


def test_a_thicker_hose_weighs_more_and_a_wider_drogue_drags_more() -> None:
    drogue = recipe().drogue
    double = drogue.model_copy(update={"hose_radius_m": 2 * drogue.hose_radius_m, "rim_radius_m": 0.66})
    thin, thick = (hose_of_scene(1, 0, HoseRanges(), kind).parameters for kind in (drogue, double))
    assert thick.mass_per_length_kg_m == pytest.approx(4 * thin.mass_per_length_kg_m)
    assert thick.drogue_diameter_m == pytest.approx(1.32)
    assert thick.drogue_mass_kg == pytest.approx(4 * thin.drogue_mass_kg)


@pytest.mark.parametrize("preset", ["red-8", "cone-orange"])
@pytest.mark.parametrize("length_m", [0.004, 0.02, 0.035, 0.06])
def test_the_hose_ends_in_the_solid_part_of_the_coupling(preset: str, length_m: float) -> None:
    whole = load_drogue(preset).model_dump()
    if "body" in whole:
        # As deep a mouth as such a coupling may have.
        whole["body"]["coupling"]["guide_length_m"] = 0.53 * length_m
    drogue = DrogueParameters.model_validate(whole | {"coupling_length_m": length_m})
    corners = np.asarray(drogue_meshes(drogue)[int(Part.COUPLING)].vertices)
    on_axis_m = corners[np.hypot(corners[:, 0], corners[:, 1]) < 1e-9, 2]
    assert on_axis_m.min() < hose_tail_m(drogue) < on_axis_m.max()


@pytest.mark.parametrize("index", range(6))
def test_the_hose_leads_from_the_coupling_to_the_exit_of_a_level_tanker(index: int) -> None:
    drawn = recipe(retracted_scene_fraction=0)
    frame = sample_frame(drawn, index)
    assert frame.left_from_drogue is not None and frame.left_from_tanker is not None and frame.drogue is not None
    nodes = np.asarray(frame.hose_nodes_left_m)
    tail = frame.left_from_drogue.apply([0.0, 0.0, hose_tail_m(frame.drogue)])
    np.testing.assert_allclose(nodes[0], tail, atol=1e-12)
    np.testing.assert_allclose(nodes[-1], frame.left_from_tanker.translation_m, atol=1e-12)
    scene_hose = hose_of_scene(drawn.seed, frame.scene_id, HoseRanges(retracted_scene_fraction=0), frame.drogue)
    assert length_m(frame) == pytest.approx(scene_hose.parameters.length_m, rel=1e-9)
    # Level: the tanker's z axis is the world's.
    up = (frame.world_from_left.rotation @ frame.left_from_tanker.rotation)[:, 2]
    np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=1e-12)
    from_exit = frame.left_from_tanker.inverse().apply(nodes)
    first, last = from_exit[-2] - from_exit[-1], nodes[1] - nodes[0]
    # The last link points along the drogue's axis; the first, aft out of the exit.
    np.testing.assert_allclose(first / np.linalg.norm(first), [1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(last / np.linalg.norm(last), frame.left_from_drogue.rotation[:, 2], atol=1e-9)
    drop_deg = np.degrees(np.arcsin(-from_exit[0, 2] / np.linalg.norm(from_exit[0])))
    assert 5 - 1e-6 <= drop_deg <= 20 + 1e-6
    assert abs(np.degrees(np.arctan2(from_exit[0, 1], from_exit[0, 0]))) <= 3 + 1e-6


def test_a_retracted_drogue_sits_straight_behind_the_exit() -> None:
    frame = sample_frame(recipe(retracted_scene_fraction=1, trailed_scene_fraction=0), 1)
    assert frame.left_from_tanker is not None and frame.left_from_drogue is not None
    np.testing.assert_allclose(
        frame.left_from_tanker.rotation[:, 0], -frame.left_from_drogue.rotation[:, 2], atol=1e-12
    )
    assert 0.15 <= length_m(frame) <= 0.4
    # No bank: the right wing stays level.
    right = (frame.world_from_left.rotation @ frame.left_from_tanker.rotation)[:, 1]
    assert right[2] == pytest.approx(0.0, abs=1e-12)


def test_bands_come_in_their_share_and_in_order() -> None:
    looks = [hose_look_of_scene(2, scene, HoseRanges(banded_scene_fraction=0.6)) for scene in range(300)]
    assert np.mean([bool(look.bands) for look in looks]) == pytest.approx(0.6, abs=0.12)
    for look in looks:
        ends = [end for band in look.bands for end in (band.start_m, band.end_m)]
        assert ends == sorted(ends)
    assert len({look.model_dump_json() for look in looks}) == 300


def test_a_family_may_have_hoses_of_its_own() -> None:
    families = [{"name": "short", "hose": {"length_m": [5, 6]}}, {"name": "plain"}]
    drawn = build_recipe(BASE, hose={"retracted_scene_fraction": 0, "trailed_scene_fraction": 0}, families=families)
    lengths = {frame.family: length_m(frame) for frame in (sample_frame(drawn, index) for index in range(12))}
    assert 5 <= lengths["short"] <= 6
    assert drawn.families[1].hose is not None and drawn.families[1].hose.length_m.high == 25


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hose": {"length_m": [1, 5]}}, r"length_m: must lie in \[2, 40\]"),
        ({"hose": {"trailed_scene_fraction": 0.7, "retracted_scene_fraction": 0.7}}, "must add up to at most 1"),
        ({"hose": {}, "render": {"engine": "analytic"}}, "hose: the engine analytic draws none; leave it out"),
        ({"hose": {"longer_m": 3}}, "longer_m"),
    ],
)
def test_wrong_sections_are_refused_in_one_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build_recipe(BASE, **changes)
