"""The numbers of a plan against the frames themselves."""

from __future__ import annotations

from collections import Counter
from typing import Unpack

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from droguekit.batch.recipe_plan import draw_frames, plan_recipe
from geometry.se3 import RigidTransform
from geometry.stereo import EYES
from labelgen.part_pixels import drogue_box
from scenes.sampler import sample_frame, sample_left_from_drogue, scene_of_frame, split_of_scenes
from tests.support.recipe_builder import RecipeTable, between, build_recipe
from tests.support.small_datasets import SWINGING

BASE: RecipeTable = {
    "name": "planned",
    "frames": {"count": 23, "scenes": 5, "empty_fraction": 0.3},
    "distance": between(2.0, 30.0, "log-uniform"),
    "split": {"train": 0.6, "val": 0.2, "test": 0.2},
}


def planned(**changes: Unpack[RecipeTable]) -> Recipe:
    return build_recipe(BASE, **changes)


def test_counts_are_those_of_the_frames() -> None:
    recipe = planned()
    plan = plan_recipe(recipe)
    scenes = [scene_of_frame(recipe, index) for index in range(23)]
    assert plan.by_scene == Counter(scenes)
    assert plan.by_split == Counter(split_of_scenes(recipe)[scene] for scene in scenes)
    assert plan.drawn.indices == tuple(range(23))
    assert plan.drawn.scenes.tolist() == scenes


def test_distances_are_those_of_the_frames_and_empty_ones_have_none() -> None:
    recipe = planned()
    plan = plan_recipe(recipe)
    poses = [sample_frame(recipe, index).left_from_drogue for index in range(23)]
    expected = [np.nan if pose is None else pose.translation_m[2] for pose in poses]
    np.testing.assert_array_equal(plan.drawn.distances_m, expected)
    assert plan.empty_fraction == sum(pose is None for pose in poses) / 23


def test_boxes_are_those_of_the_labels() -> None:
    recipe = planned()
    drawn = plan_recipe(recipe).drawn
    for index, center_px, side_px in zip(drawn.indices, drawn.centers_px, drawn.sides_px, strict=True):
        pose = sample_left_from_drogue(recipe, index)
        if pose is None:
            assert np.isnan([*center_px, side_px]).all()
            continue
        u, v, width, height = drogue_box(recipe.drogue, recipe.rig, pose, "left")
        np.testing.assert_allclose(center_px, [u + width / 2, v + height / 2], rtol=1e-12)  # float64 sums
        np.testing.assert_allclose(side_px**2, width * height, rtol=1e-12)


@pytest.mark.parametrize("rig", ["rgb-ideal", "paper-real"])
def test_a_box_at_the_end_of_its_room_touches_the_edge_of_an_image(rig: str) -> None:
    recipe = planned(rig=rig, frames={"empty_fraction": None})
    camera, drawn = recipe.rig.camera, draw_frames(recipe, tuple(range(12)))
    kept_px = recipe.rig.largest_shift_px()
    last_px = np.array([camera.width_px, camera.height_px]) - 0.5
    for index, center_px, room_px in zip(drawn.indices, drawn.centers_px, drawn.rooms_px, strict=True):
        pose = sample_left_from_drogue(recipe, index)
        assert pose is not None
        for axis, end in ((0, 0), (0, 1), (1, 0), (1, 1)):
            step_m = np.zeros(3)
            shift_px = room_px[2 * axis + end] - center_px[axis]
            step_m[axis] = shift_px * pose.translation_m[2] / camera.fx_px
            moved = RigidTransform(pose.rotation, pose.translation_m + step_m)
            boxes = np.array([drogue_box(recipe.drogue, recipe.rig, moved, eye) for eye in EYES])
            low, high = boxes[:, axis].min() + 0.5, last_px[axis] - (boxes[:, axis] + boxes[:, 2 + axis]).max()
            # The box's ends are nearer or farther than the centre by up to 0.4 m, and move so much more or less; a lens
            # bends the way by up to what is kept free for it.
            within_px = 2 + 0.4 / pose.translation_m[2] * abs(shift_px) + 2 * kept_px
            assert abs((high if end else low) - kept_px) < within_px


def test_places_that_are_not_drawn_have_no_room() -> None:
    drawn = plan_recipe(planned(pose={"on_axis": True})).drawn
    assert np.isnan(drawn.rooms_px).all()
    assert np.isfinite(drawn.centers_px).any()


def test_a_pair_that_cannot_be_made_is_a_drop_with_its_reason_and_the_others_are_drawn() -> None:
    recipe = build_recipe(SWINGING)
    reasons = {}
    for index in range(20):
        try:
            sample_frame(recipe, index)
        except ValueError as error:
            reasons[index] = str(error)
    assert 0 < len(reasons) < 18
    plan = plan_recipe(recipe)
    drawn = plan.drawn
    assert {drop.frame_index: drop.reason for drop in drawn.drops} == reasons
    assert drawn.indices == tuple(index for index in range(20) if index not in reasons)
    assert len(drawn.distances_m) == len(drawn.scenes) == len(drawn.families) == len(drawn.indices)
    assert plan.empty_fraction == 0


def test_a_recipe_of_which_no_pair_can_be_made_is_refused() -> None:
    # In still air the hose hangs straight down, and so the receiver looks at the drogue from the side.
    hanging = build_recipe(SWINGING, sequence={"hose": {"airspeed_m_s": 0}, "release_m": None})
    with pytest.raises(ValueError, match=r"sequence 0: leaves the visible volume at 0\.40 s"):
        plan_recipe(hanging)


def test_a_large_recipe_is_drawn_in_part_but_counted_in_full() -> None:
    plan = plan_recipe(planned(frames={"count": 1_000_003}), most_sampled=50)
    assert sum(plan.by_scene.values()) == 1_000_003
    assert len(plan.drawn.indices) == 50
    assert plan.drawn.indices[0] == 0
    assert plan.drawn.indices[-1] == 1_000_002
