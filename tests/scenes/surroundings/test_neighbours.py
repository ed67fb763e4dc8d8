"""Second drogues: when they are drawn, where they hang, and that the sought one stays the nearest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.frame import FrameSpec
from drogue_models.tankers.tanker_surfaces import tanker_surfaces
from scenes.flight.suspension import hose_tail_m
from scenes.sampler import sample_frame
from tests.support.recipe_builder import RecipeTable, between, build_recipe

BASE: RecipeTable = {
    "name": "neighbours-test",
    "seed": 11,
    "frames": {"count": 40, "scenes": 40},
    "distance": between(4, 20),
    "pose": {"pitch_deg": [2, 12]},
}


def recipe(**keys: Any) -> Recipe:
    return build_recipe(BASE, neighbours={"scene_fraction": 1.0, **keys})


def test_the_section_adds_neighbours_and_changes_nothing_else() -> None:
    before, after = (sample_frame(drawn, 2).model_dump(mode="json") for drawn in (build_recipe(BASE), recipe()))
    assert {key for key in after if after[key] != before.get(key)} == {"neighbours"}
    assert "neighbours" not in before


def test_a_share_of_scenes_has_one() -> None:
    frames = [sample_frame(recipe(scene_fraction=0.5), index) for index in range(40)]
    # Four standard errors of a binomial share of 40, and some scenes without room.
    assert 0.15 < np.mean([len(frame.neighbours) > 0 for frame in frames]) < 0.8


@pytest.fixture(scope="module")
def frames() -> list[FrameSpec]:
    return [sample_frame(recipe(), index) for index in range(12)]


def test_the_sought_drogue_is_the_nearest_and_hides_none(frames: list[FrameSpec]) -> None:
    seen = 0
    for frame in frames:
        assert frame.left_from_drogue is not None
        sought_m = frame.left_from_drogue.translation_m
        for other in frame.neighbours:
            seen += 1
            place_m = other.left_from_drogue.translation_m
            assert place_m[2] >= 1.2 * sought_m[2] - 1e-9
            pixel = frame.rig.image(np.stack([place_m, sought_m]), "left")
            assert ((pixel > 0) & (pixel < [1280, 960])).all()
            apart_px = other.drogue.rim_radius_m * frame.rig.camera.fx_px * (1 / place_m[2] + 1 / sought_m[2])
            assert np.linalg.norm(pixel[0] - pixel[1]) > apart_px
    assert seen >= 10


def test_its_hose_leads_from_the_coupling_to_a_tanker(frames: list[FrameSpec]) -> None:
    for frame in frames:
        for other in frame.neighbours:
            nodes = np.asarray(other.hose_nodes_left_m)
            tail = other.left_from_drogue.apply([0.0, 0.0, hose_tail_m(other.drogue)])
            np.testing.assert_allclose(nodes[0], tail, atol=1e-9)
            last = nodes[1] - nodes[0]
            np.testing.assert_allclose(last / np.linalg.norm(last), other.left_from_drogue.rotation[:, 2], atol=1e-9)
            assert frame.left_from_tanker is not None
            if other.left_from_tanker is not None:
                np.testing.assert_allclose(nodes[-1], other.left_from_tanker.translation_m, atol=1e-9)
                # On the same heading as the first one.
                np.testing.assert_allclose(other.left_from_tanker.rotation, frame.left_from_tanker.rotation, atol=1e-12)
            else:
                station = frame.left_from_tanker.inverse().apply(nodes[-1])
                assert 3 <= abs(station[1]) <= 12


def test_a_second_aircraft_does_not_touch_the_first() -> None:
    drawn = build_recipe(
        BASE,
        tanker={"variants": [{"type": "twin-jet-wide"}]},
        neighbours={"scene_fraction": 1.0, "distance_fraction": [1.2, 8]},
    )
    seen = 0
    for index in range(6):
        frame = sample_frame(drawn, index)
        for other in frame.neighbours:
            assert frame.tanker is not None
            assert frame.left_from_tanker is not None and other.left_from_tanker is not None
            vertices = tanker_surfaces(frame.tanker)[0].mesh.vertices
            away_m = frame.left_from_tanker.inverse().apply(other.left_from_tanker.translation_m)
            low, high = vertices.min(axis=0), vertices.max(axis=0)
            assert ((low + away_m > high) | (high + away_m < low)).any()
            seen += 1
    assert seen >= 2


def test_stations_of_the_same_tanker_are_used_where_they_are_in_view() -> None:
    drawn = recipe(same_tanker_fraction=1.0)
    found = [other for index in range(25) for other in sample_frame(drawn, index).neighbours]
    assert any(other.left_from_tanker is None for other in found)


def test_an_empty_frame_has_none() -> None:
    empty = build_recipe(BASE, frames={"empty_fraction": 1.0}, neighbours={"scene_fraction": 1.0})
    assert sample_frame(empty, 0).neighbours == ()


def test_a_frame_is_read_back_with_its_neighbours(frames: list[FrameSpec]) -> None:
    frame = next(frame for frame in frames if frame.neighbours)
    assert FrameSpec.model_validate_json(frame.model_dump_json()).model_dump_json() == frame.model_dump_json()


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"neighbours": {"distance_fraction": [0.9, 2]}}, r"distance_fraction: must lie in \[1.15, 20\]"),
        ({"neighbours": {}, "render": {"engine": "analytic"}}, "neighbours: the engine analytic draws none"),
    ],
)
def test_wrong_sections_are_refused_in_one_line(sections: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build_recipe(BASE, **sections)


def test_a_neighbour_needs_a_sought_drogue(frames: list[FrameSpec]) -> None:
    frame = next(frame for frame in frames if frame.neighbours)
    table = frame.model_dump() | {"drogue": None, "left_from_drogue": None, "condition": None}
    with pytest.raises(ValueError, match="neighbours: are in view only beside the drogue that is sought"):
        FrameSpec.model_validate(table)
