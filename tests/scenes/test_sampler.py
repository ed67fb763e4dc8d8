from __future__ import annotations

from collections.abc import Callable
from typing import Any, Unpack

import numpy as np
import pytest

from datasets_manifest.random_streams import bulk_frame_generator, frame_generator, stream_seed
from datasets_manifest.recipe.drogue_ranges import DistanceLaw
from datasets_manifest.recipe.recipe import Recipe, load_recipe, parse_recipe
from geometry.circles import disc_outline
from geometry.stereo import EYES
from scenes.framing import distance_at, sample_distance_m
from scenes.sampler import sample_frame, sample_left_from_drogue, scene_of_frame, split_of_scenes
from tests.support.recipe_builder import RecipeTable, between, build_recipe, stations

BASE: RecipeTable = {
    "name": "sampler-test",
    "frames": {"count": 400, "scenes": 10},
    "distance": stations(1.7, 3.0, 10.0, 40.0),
    "split": {"train": 0.7, "val": 0.2, "test": 0.1},
}


def recipe(**changes: Unpack[RecipeTable]) -> Recipe:
    return build_recipe(BASE, **changes)


def test_frames_depend_on_seed_and_index_alone() -> None:
    first = [sample_frame(recipe(), index).model_dump_json() for index in (3, 0, 7)]
    again = [sample_frame(recipe(), index).model_dump_json() for index in (7, 3, 0)]
    assert first == [again[1], again[2], again[0]]
    assert sample_frame(recipe(seed=2), 3).model_dump_json() != first[0]


def positions(drawn: Recipe) -> np.ndarray:
    return np.array([sample_left_from_drogue(drawn, index).translation_m[:2] for index in range(400)]).ravel()


def test_recipes_of_other_names_draw_other_scenes_and_poses() -> None:
    same_place = stations(10.0)
    names = {name: build_recipe(BASE, frames={"stream": name}, distance=same_place) for name in ("cloud", "low-light")}
    one, other = (positions(drawn) for drawn in names.values())
    # Four standard errors of a correlation of independent draws.
    assert abs(np.corrcoef(one, other)[0, 1]) < 4 / np.sqrt(800)
    assert len({sample_frame(drawn, 0).seed for drawn in names.values()}) == 2
    assert len({tuple(sorted(split_of_scenes(drawn).items())) for drawn in names.values()}) == 2


def test_shipped_recipes_of_one_seed_do_not_share_poses() -> None:
    one, other = (load_recipe(name).recipe for name in ("cloud", "low-light"))
    assert one.seed == other.seed and one.frames.stream == "cloud"
    poses = [sample_left_from_drogue(drawn, 0).translation_m[:2].tolist() for drawn in (one, other)]
    assert poses[0] != poses[1]


def test_a_recipe_of_another_name_may_keep_the_streams_of_the_first() -> None:
    text = 'name = "{}"\ndistance = {{ law = "stations", stations_m = [10] }}\n[frames]\ncount = 400{}\n'
    first, named, renamed = (
        parse_recipe(text.format(*parts)) for parts in (("first", ""), ("second", '\nstream = "first"'), ("second", ""))
    )
    one, same, other = (sample_frame(drawn, 3).model_dump_json() for drawn in (first, named, renamed))
    assert one == same != other
    # As Python's interface renames them.
    assert parse_recipe(text.format("first", ""), changes={"name": "second"}).frames.stream == "second"
    assert parse_recipe(text.format("first", ""), changes={"frames": {"count": 9}}).frames.stream == "first"


def test_streams_of_datasets_from_before_stay_as_they_were() -> None:
    """Their recipes name no stream: the seed alone keys them, and the key is not written."""
    drawn = build_recipe(BASE)
    assert "stream" not in drawn.model_dump(mode="json")["frames"]
    assert Recipe.model_validate_json(drawn.model_dump_json()).stream_seed == drawn.seed
    named = build_recipe(BASE, frames={"stream": "cloud"})
    assert Recipe.model_validate_json(named.model_dump_json()).stream_seed == named.stream_seed != named.seed


def test_stream_seeds_differ_by_seed_and_name() -> None:
    seeds = {stream_seed(seed, name) for seed in (0, 1, 2**63 - 1) for name in ("a", "b", "1 a", "")}
    assert len(seeds) == 12
    assert all(0 <= seed < 2**53 for seed in seeds)
    assert stream_seed(1, "cloud") == 3_758_288_172_986_834
    with pytest.raises(ValueError, match="must not be negative"):
        stream_seed(-1, "a")


def test_seed_zero_is_a_seed() -> None:
    assert sample_frame(recipe(seed=0), 0).model_dump_json() == sample_frame(recipe(seed=0), 0).model_dump_json()
    assert sample_frame(recipe(seed=0), 0).left_from_drogue.as_matrix().tolist() != (
        sample_frame(recipe(seed=1), 0).left_from_drogue.as_matrix().tolist()
    )


@pytest.mark.parametrize("make", [frame_generator, bulk_frame_generator])
def test_streams_are_independent_of_each_other(make: Callable[..., Any]) -> None:
    draws = {
        key: make(*key).standard_normal(2000)
        for key in [(1, 0, "a"), (1, 0, "b"), (1, 1, "a"), (2, 0, "a"), (2**40 + 1, 0, "a")]
    }
    values = list(draws.values())
    for i, one in enumerate(values):
        for other in values[:i]:
            # Four standard errors of a correlation of independent draws.
            assert abs(np.corrcoef(one, other)[0, 1]) < 4 / np.sqrt(2000)


def test_negative_seed_is_refused() -> None:
    with pytest.raises(ValueError, match="must not be negative"):
        frame_generator(-1, 0, "a")


@pytest.mark.parametrize("distance_m", [1.7, 3.0, 10.0, 40.0])
def test_the_whole_drogue_is_in_both_views(distance_m: float) -> None:
    drawn = recipe(distance=stations(distance_m))
    for index in range(40):
        frame = sample_frame(drawn, index)
        assert frame.left_from_drogue.translation_m[2] == pytest.approx(distance_m)
        rim = disc_outline(frame.left_from_drogue, np.zeros(3), frame.drogue.rim_radius_m, 360)
        for eye in EYES:
            assert frame.rig.camera.contains(frame.rig.project(rim, eye), margin_px=0.5).all()


def test_calibration_boards_show_their_front_to_both_eyes() -> None:
    """Also where the view is so wide that boards turned away fit into it."""
    angles = {"pitch_deg": [-60, 60], "yaw_deg": [-60, 60]}
    drawn = recipe(
        rig={"preset": "rgb-ideal", "focal_px": 600.0},
        board={},
        frames={"empty_fraction": 1, "scenes": 1},
        distance=between(3.0, 6.0),
        pose=angles,
        exposure={"time_s": 1e-3},
        render={"engine": "analytic"},
    )
    for index in range(60):
        frame = sample_frame(drawn, index)
        assert frame.board is not None
        pose = frame.board.left_from_board
        for eye in EYES:
            assert (pose.translation_m - frame.rig.eye_offset_m(eye)) @ pose.rotation[:, 2] > 0


def test_places_fill_the_common_field() -> None:
    drawn = recipe(distance=stations(10.0))
    places = np.array([sample_left_from_drogue(drawn, index).translation_m[:2] for index in range(200)])
    x_low, x_high, y_low, y_high = drawn.rig.common_field_m(10.0, 0.33)
    # Uniform: of 200 draws the extremes lie within 4 % of the ends (0.96^200 = 3e-4).
    assert places[:, 0].min() < x_low + 0.04 * (x_high - x_low) + 0.1
    assert places[:, 0].max() > x_high - 0.04 * (x_high - x_low) - 0.1
    assert places[:, 1].min() < y_low + 0.04 * (y_high - y_low) + 0.1
    assert places[:, 1].max() > y_high - 0.04 * (y_high - y_low) - 0.1


def test_on_axis_stays_on_the_rig_axis() -> None:
    drawn = recipe(pose={"on_axis": True})
    for index in range(8):
        np.testing.assert_allclose(sample_frame(drawn, index).left_from_drogue.translation_m[:2], [0.06, 0.0])


def test_an_attitude_that_never_fits_is_one_clear_error() -> None:
    drawn = recipe(distance=stations(1.47), pose={"pitch_deg": 0, "yaw_deg": [40, 45]})
    with pytest.raises(ValueError, match="no attitude within the recipe's ranges"):
        sample_frame(drawn, 0)


@pytest.mark.parametrize("law", ["uniform", "log-uniform", "uniform-image-size"])
def test_bins_of_distance_get_their_weights_and_keep_the_law_inside(law: str) -> None:
    plain = DistanceLaw(law=law, low_m=2.0, high_m=32.0)
    binned = DistanceLaw(law=law, low_m=2.0, high_m=32.0, edges_m=(2.0, 4.0, 16.0, 32.0), weights=(1.0, 0.0, 3.0))
    shares = np.linspace(0.0, 1.0, 4001, endpoint=False)
    drawn = np.array([distance_at(binned, share) for share in shares])
    np.testing.assert_allclose(np.histogram(drawn, (2, 4, 16, 32.001))[0] / 4001, [0.25, 0.0, 0.75], atol=1e-3)
    for low_m, high_m, first, last in ((2.0, 4.0, 0.0, 0.25), (16.0, 32.0, 0.25, 1.0)):
        inside = DistanceLaw(law=law, low_m=low_m, high_m=high_m)
        middle = distance_at(binned, 0.5 * (first + last))
        # Each bin is drawn by the law between its own ends.
        assert middle == pytest.approx(distance_at(inside, 0.5), rel=1e-12)
    whole = DistanceLaw(law=law, low_m=2.0, high_m=32.0, edges_m=(2.0, 32.0), weights=(7.0,))
    assert [distance_at(whole, share) for share in (0.1, 0.7)] == [distance_at(plain, share) for share in (0.1, 0.7)]
    assert "edges_m" not in plain.model_dump_json()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"edges_m": (2.0, 32.0)}, "need each other"),
        ({"edges_m": (2.0, 31.0), "weights": (1.0,)}, "begin with low_m"),
        ({"edges_m": (2.0, 9.0, 8.0, 32.0), "weights": (1.0, 1.0, 1.0)}, "ascend"),
        ({"edges_m": (2.0, 8.0, 32.0), "weights": (1.0,)}, "one for each of 2 bins"),
        ({"edges_m": (2.0, 32.0), "weights": (0.0,)}, "not all be zero"),
    ],
)
def test_wrong_bins_of_distance_are_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        DistanceLaw(law="uniform", low_m=2.0, high_m=32.0, **wrong)


def quantile_error(law: DistanceLaw, transform: Callable[..., Any]) -> float:
    rng = np.random.default_rng(1)
    draws = np.sort([transform(sample_distance_m(rng, law, 0)) for _ in range(4000)])
    ends = sorted([transform(2.0), transform(40.0)])
    return np.abs((draws - ends[0]) / (ends[1] - ends[0]) - (np.arange(4000) + 0.5) / 4000).max()


@pytest.mark.parametrize(
    ("name", "transform"),
    [("uniform", lambda z: z), ("log-uniform", np.log), ("uniform-image-size", lambda z: 1 / z)],
)
def test_distance_laws(name: str, transform: Callable[..., Any]) -> None:
    """Kolmogorov-Smirnov distance to the intended law; 1.95/sqrt(n) is its 0.1 % point."""
    law = recipe(distance=between(2.0, 40.0, name)).distance
    assert quantile_error(law, transform) < 1.95 / np.sqrt(4000)


def test_stations_cycle() -> None:
    drawn = recipe()
    distances = [sample_frame(drawn, index).left_from_drogue.translation_m[2] for index in range(8)]
    np.testing.assert_allclose(distances, [1.7, 3.0, 10.0, 40.0] * 2)


def test_scenes_are_visited_evenly_and_split_whole() -> None:
    drawn = recipe()
    scenes = [scene_of_frame(drawn, index) for index in range(400)]
    assert np.bincount(scenes).tolist() == [40] * 10
    splits = list(split_of_scenes(drawn).values())
    assert sorted(splits) == ["test"] + ["train"] * 7 + ["val"] * 2


def test_empty_frames_have_no_drogue() -> None:
    drawn = recipe(frames={"empty_fraction": 0.25})
    empty = sum(sample_left_from_drogue(drawn, index) is None for index in range(400))
    # Binomial of 400 draws: standard deviation 8.7; four of them.
    assert abs(empty - 100) < 35


def test_a_pose_drawn_alone_is_that_of_the_frame() -> None:
    drawn = recipe(frames={"empty_fraction": 0.25})
    for index in range(12):
        alone, frame = sample_left_from_drogue(drawn, index), sample_frame(drawn, index)
        assert (alone is None) == (frame.drogue is None)
        if alone is not None:
            np.testing.assert_array_equal(alone.translation_m, frame.left_from_drogue.translation_m)
            np.testing.assert_array_equal(alone.rotation, frame.left_from_drogue.rotation)


def test_hose_runs_from_the_coupling_to_the_pod() -> None:
    frame = sample_frame(recipe(), 2)
    nodes = frame.hose_nodes_left_m
    tail = frame.left_from_drogue.apply([0, 0, frame.drogue.hub_depth_m + frame.drogue.coupling_length_m])
    assert np.linalg.norm(nodes[0] - tail) < 0.05
    np.testing.assert_allclose(nodes[-1], frame.left_from_tanker.translation_m)
    along = np.diff(nodes, axis=0)
    cosines = (along[1:] * along[:-1]).sum(axis=1) / np.prod(np.linalg.norm([along[1:], along[:-1]], axis=-1), axis=0)
    assert cosines.min() > 0.9  # no kinks
