"""Sequences that lose the drogue for a while: what hides it hides all of it, and nothing else changes."""

from __future__ import annotations

from typing import Unpack

import numpy as np
import pytest

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.recipe import Recipe, load_recipe
from datasets_manifest.recipe.sequence_ranges import DropoutRanges
from datasets_manifest.types.appearance import Obstacle
from datasets_manifest.types.frame import FrameSpec
from drogue_models.marker_layout import marker_layout
from drogue_models.parts import Part
from geometry.se3 import log_twist
from geometry.stereo import EYES
from labelgen.part_pixels import drogue_hull_m
from scenes.flight.dropouts import DropoutEvent, formation_displacement_m, sample_dropout
from scenes.sampler import sample_frame
from scenes.sky.photometry import direction_from_angles
from tests.support.recipe_builder import RIG_160_PX, RIG_320_PX, RecipeTable, Section, build_recipe, change_recipe

FRAMES = 40
BASE: RecipeTable = {
    "name": "loss-test",
    "seed": 2,
    "frames": {"count": 40},
    "pose": {"camera_pitch_deg": 10},
    "exposure": {"time_s": 0.002},
    "sequence": {
        "frames_per_sequence": 40,
        "frame_rate_hz": 20,
        "release_m": [13.8, 0.5, -5],
        "receiver": {"manoeuvres": ["station"], "start_m": 6.0},
        "losses": {"begins_s": 0.6, "lasts_s": 0.5, "onset_s": 0.4},
    },
}


def recipe(kind: str, **changes: Unpack[RecipeTable]) -> Recipe:
    """With dropouts of this kind."""
    return build_recipe(change_recipe(BASE, sequence={"losses": {"kinds": [kind]}}), **changes)


def event(drawn: Recipe) -> DropoutEvent:
    return sample_dropout(frame_generator(drawn.seed, 0, "loss"), drawn.sequence.losses, 0)


def lost(drawn: Recipe) -> list[int]:
    """Frames of the stretch itself, without coming and going."""
    happens = event(drawn)
    return [k for k in range(FRAMES) if happens.begin_s <= k / 20 <= happens.end_s]


def lines_of_sight(frame: FrameSpec) -> tuple[np.ndarray, np.ndarray]:
    """(2 N, 3) origins and unit directions from both eyes to all corners of the drogue. [m]"""
    points = frame.left_from_drogue.apply(drogue_hull_m(frame.drogue))
    origins = np.repeat([frame.rig.eye_offset_m(eye) for eye in EYES], len(points), axis=0)
    ways = np.tile(points, (2, 1)) - origins
    return origins, ways / np.linalg.norm(ways, axis=1, keepdims=True)


def clearance_m(bar: Obstacle, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(N,) distance of lines from a bar's surface; negative where they pierce it. [m]"""
    axis, center = bar.left_from_object.rotation[:, 2], bar.left_from_object.translation_m
    normal = np.cross(directions, axis)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.abs(np.einsum("ni,ni->n", origins - center, normal)) - bar.shape.radius_m


@pytest.mark.parametrize("seed", [2, 3, 4, 5])
def test_a_bar_hides_all_of_the_drogue_and_comes_from_outside_the_picture(seed: int) -> None:
    drawn = recipe("occlusion", seed=seed)
    frames = {k: sample_frame(drawn, k) for k in range(FRAMES)}
    for k in lost(drawn):
        (bar,) = frames[k].bystanders
        assert bar.kind == "obstacle"
        assert clearance_m(bar, *lines_of_sight(frames[k])).max() < 0
        assert bar.left_from_object.translation_m[2] + bar.shape.radius_m < frames[k].left_from_drogue.translation_m[2]
    barred = [k for k, frame in frames.items() if frame.bystanders]
    assert barred == [k for k, frame in frames.items() if frame.loss == "occlusion"]
    assert 0 not in barred and FRAMES - 1 not in barred
    # The moment before it comes into sight and after it has gone: beyond every line of sight of either eye.
    happens, flown = event(drawn), frames[barred[0]]
    camera = flown.rig.camera
    edge = np.array([[u, v] for u in (-0.5, camera.width_px - 0.5) for v in (-0.5, camera.height_px - 0.5)])
    rays = camera.rays(edge)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for time_s in (happens.begin_s - happens.onset_s + 1e-6, happens.end_s + happens.onset_s - 1e-6):
        bar = bar_at(drawn, time_s)
        for eye in EYES:
            assert clearance_m(bar, np.tile(flown.rig.eye_offset_m(eye), (4, 1)), rays).min() > -1e-6


def bar_at(drawn: Recipe, time_s: float) -> Obstacle:
    from scenes.flight.sequence import _flight

    flight = _flight(drawn.seed, 0, drawn.sequence, drawn.drogue, drawn.pose, drawn.rig.baseline_m)
    return flight._bar.at(time_s, drawn.rig.camera)


def test_nothing_else_of_a_sequence_changes_with_a_bar() -> None:
    with_bar, without = recipe("occlusion"), recipe("none")
    for k in (0, 10, 16, 39):
        changed = sample_frame(with_bar, k).model_copy(update={"bystanders": (), "loss": None})
        assert changed.model_dump_json() == sample_frame(without, k).model_dump_json()


@pytest.mark.parametrize("seed", [2, 3])
def test_a_turned_receiver_sees_nothing_of_the_drogue_from_the_same_place(seed: int) -> None:
    drawn, plain = recipe("out-of-view", seed=seed), recipe("none", seed=seed)
    inside = lost(drawn)
    for k in range(0, FRAMES, 3):
        receiver_rotation, straight = sample_frame(drawn, k), sample_frame(plain, k)
        places = [frame.left_from_drogue.inverse().translation_m for frame in (receiver_rotation, straight)]
        # Rounding.
        np.testing.assert_allclose(*places, atol=1e-9)
        if receiver_rotation.loss is None:
            np.testing.assert_allclose(
                receiver_rotation.left_from_drogue.as_matrix(), straight.left_from_drogue.as_matrix(), atol=1e-12
            )
    for k in inside:
        frame = sample_frame(drawn, k)
        points = frame.left_from_drogue.apply(drogue_hull_m(frame.drogue))
        for eye in EYES:
            assert not frame.rig.camera.contains(frame.rig.image(points, eye)).any()


def test_the_turn_is_in_the_twists() -> None:
    drawn = recipe(
        "out-of-view",
        frames={"count": 2000},
        exposure={"time_s": 0.0005},
        sequence={"frames_per_sequence": 2000, "frame_rate_hz": 1000},
    )
    happens = sample_dropout(frame_generator(2, 0, "loss"), drawn.sequence.losses, 0)
    middle = round(1000 * (happens.begin_s - happens.onset_s / 2))
    earlier, frame, later = (sample_frame(drawn, middle + step) for step in (-1, 0, 1))
    relative = log_twist(earlier.left_from_drogue.inverse() @ later.left_from_drogue) / 0.002
    at = [frame.left_from_drogue_at(step) for step in (-1e-4, 1e-4)]
    # As for sequences without losses: vibration of 40 Hz at a lever of 6 m.
    np.testing.assert_allclose(log_twist(at[0].inverse() @ at[1]) / 2e-4, relative, atol=8e-3)
    # A half cosine is fastest in the middle, by pi/2 over its mean.
    assert np.linalg.norm(frame.left_twist_per_s[3:]) == pytest.approx(
        np.pi / 2 * happens.turn_rad / happens.onset_s, rel=0.03
    )


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_the_sun_comes_beside_the_drogue_and_goes(seed: int) -> None:
    drawn, plain = recipe("glare", seed=seed), recipe("none", seed=seed)
    happens = event(drawn)
    beside = {}
    for k in range(FRAMES):
        frame = sample_frame(drawn, k)
        environment = frame.environment
        assert environment.sun_elevation_deg > 1
        sun = direction_from_angles(environment.sun_elevation_deg, environment.sun_azimuth_deg)
        to_sun = frame.world_from_left.inverse().rotate(sun)
        middle = frame.left_from_drogue.translation_m
        distance_m = np.linalg.norm(middle)
        angle = np.arccos(to_sun @ middle / distance_m)
        beside[k] = angle - np.arcsin(frame.drogue.rim_radius_m / distance_m)
        np.testing.assert_allclose(
            frame.left_from_drogue.as_matrix(), sample_frame(plain, k).left_from_drogue.as_matrix(), atol=1e-12
        )
    nearest = min(beside, key=lambda k: abs(k / 20 - happens.middle_s))
    # The pair nearest to the middle is half a period off, in which attitude and drogue move by tenths of a degree.
    assert beside[nearest] == pytest.approx(happens.sun_offset_rad, abs=np.radians(0.5))
    phase = [angle for k, angle in beside.items() if abs(happens.phase(k / 20)) == 1]
    # Off by the whole sweep to one side and the other, but for the sun's place on one side of the drogue and the swing.
    half_drogue = np.arcsin(0.33 / 6.0)
    assert min(phase) > 0.95 * happens.sweep_rad - happens.sun_offset_rad - 2 * half_drogue - np.radians(2)
    headings = [happens.heading_rad(k / 20) for k in (0, FRAMES - 1)]
    assert headings[0] == pytest.approx(-headings[1]) and abs(headings[0]) == pytest.approx(happens.sweep_rad)


def test_a_formation_that_turns_flies_where_it_heads() -> None:
    happens = sample_dropout(np.random.default_rng(1), DropoutRanges(kinds=("glare",)), 0)
    time_s, step_s = 2.3, 1e-3
    moved = (
        formation_displacement_m(happens, 120.0, time_s + step_s)
        - formation_displacement_m(happens, 120.0, time_s - step_s)
    ) / (2 * step_s)
    heading = happens.heading_rad(time_s)
    # The middles of 121 pieces of two seconds: (0.02 s)^2 / 24 of the second derivative, 1e-4 of 120 m/s.
    np.testing.assert_allclose(moved, 120.0 * np.array([np.cos(heading), np.sin(heading)]), atol=0.05)


@pytest.mark.parametrize("begin_s", [2.0, 300.0, 30_000.0])
def test_a_formation_flies_as_fast_however_late_it_turns(begin_s: float) -> None:
    happens = DropoutEvent("glare", begin_s, begin_s + 2.0, 1.0, 1, 1.0, 1.0, 0.5, 0.1, 0.25)
    places = np.array([formation_displacement_m(happens, 130.0, begin_s - 2.0 + 0.04 * k) for k in range(200)])
    # Chords of the turn are shorter than its arcs by (0.04 s * 0.4 rad/s)^2 / 24.
    np.testing.assert_allclose(np.linalg.norm(np.diff(places, axis=0), axis=1), 130.0 * 0.04, rtol=1e-4)


def test_it_comes_lasts_and_goes_smoothly() -> None:
    happens = DropoutEvent("occlusion", 2.0, 4.0, 0.5, 1, 1.0, 1.0, 0.5, 0.1, 0.2)
    times = np.linspace(0, 6, 6001)
    phase = np.array([happens.phase(time) for time in times])
    np.testing.assert_array_equal(phase[(times >= 2) & (times <= 4)], 0)
    assert (phase[times <= 1.499] == 1).all() and (phase[times >= 4.501] == -1).all()
    assert (np.diff(phase) <= 1e-12).all()
    # Half a cosine over half a second.
    assert np.abs(np.gradient(phase, times)).max() == pytest.approx(np.pi, rel=1e-3)
    assert [happens.is_active(time) for time in (1.4, 1.6, 3.0, 4.4, 4.6)] == [False, True, True, True, False]


def test_kinds_come_in_turn_and_draws_do_not_depend_on_them() -> None:
    ranges = DropoutRanges(kinds=("occlusion", "none", "glare"))
    drawn = [sample_dropout(frame_generator(1, k, "loss"), ranges, k) for k in range(6)]
    assert [None if one is None else one.kind for one in drawn] == ["occlusion", None, "glare"] * 2
    other = sample_dropout(frame_generator(1, 0, "loss"), DropoutRanges(kinds=("glare",)), 0)
    assert (other.tilt_rad, other.side) == (drawn[0].tilt_rad, drawn[0].side)


@pytest.mark.parametrize(
    ("kind", "losses", "fault"),
    [
        ("occlusion", {"thickness_m": 2}, r"sequence.losses.thickness_m"),
        ("hail", {}, r"sequence.losses.kinds"),
        ("out-of-view", {"turn_deg": 15}, r"turn_deg: 15 degrees leave part of the drogue in view at 6 m"),
        ("glare", {"sun_offset_deg": [0, 9]}, r"look up at the drogue by at least 10.4 degrees"),
    ],
)
def test_wrong_losses_are_named_on_one_line(kind: str, losses: Section, fault: str) -> None:
    with pytest.raises(ValueError, match=fault) as caught:
        recipe(kind, sequence={"losses": losses})
    assert "\n" not in str(caught.value)


def test_an_engine_without_obstacles_is_refused() -> None:
    with pytest.raises(ValueError, match=r"render.engine: analytic draws no obstacles") as caught:
        recipe("occlusion", render={"engine": "analytic"})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"sequence": {"losses": {"begins_s": 0.3}}}, r"begins_s: must be at least onset_s, 0.4 s"),
        ({"sequence": {"losses": {"lasts_s": 5}}}, r"dropouts last until 6 s, which is 122 frames, got 40"),
        ({"pose": {"camera_pitch_deg": 0}}, r"pose.camera_pitch_deg: glare needs the receiver to look up"),
    ],
)
def test_losses_that_do_not_fit_are_refused(changes: RecipeTable, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        recipe("glare", **changes)


def bar_recipe(obstacle_distance_m: float, start_m: float) -> Recipe:
    losses, receiver = {"obstacle_distance_m": obstacle_distance_m}, {"start_m": start_m}
    return recipe("occlusion", sequence={"losses": losses, "receiver": receiver})


def test_a_bar_as_thick_as_its_distance_is_refused() -> None:
    drawn = bar_recipe(0.4, start_m=2.0)
    with pytest.raises(ValueError, match=r"obstacle_distance_m: a bar that hides the drogue throughout"):
        sample_frame(drawn, 0)


@pytest.mark.parametrize(("start_m", "obstacle_m"), [(4.0, 5.0), (4.0, 3.6)])
def test_a_bar_that_does_not_stand_before_the_drogue_is_refused(start_m: float, obstacle_m: float) -> None:
    drawn = bar_recipe(obstacle_m, start_m)
    with pytest.raises(ValueError, match=r"sequence.losses.obstacle_distance_m: .* is not in front of all of"):
        sample_frame(drawn, 0)


def test_a_sun_below_the_horizon_is_refused() -> None:
    low = recipe("glare", pose={"camera_pitch_deg": 5}, sequence={"receiver": {"offset_down_m": 0.9}})
    # The drogue is seen 8.5 degrees below the axis, which is pitched up by 5, and the sun at most 2.8 above it.
    with pytest.raises(ValueError, match=r"sun_offset_deg: the sun beside .* below the horizon"):
        sample_frame(low, 0)


@pytest.mark.parametrize("offset_right_m", [[0, 0.8], [-0.8, 0]])
def test_a_turn_must_lose_a_drogue_that_is_beside_the_axis(offset_right_m: list[float]) -> None:
    def turned(turn_deg: float) -> Recipe:
        losses, receiver = {"turn_deg": turn_deg}, {"offset_right_m": offset_right_m}
        return recipe("out-of-view", sequence={"losses": losses, "receiver": receiver})

    # Half a field of 16.7 degrees, and rim, baseline and offset of 1.25 m in all at 6 m: 28.5 degrees.
    with pytest.raises(ValueError, match=r"turn_deg: 28 degrees leave part .* at 6 m; turn by at least"):
        turned(28)
    turned(40)


def test_a_turn_must_lose_the_drogue_behind_a_barrel_lens() -> None:
    def turned(turn_deg: float, k1: float) -> Recipe:
        rig = RIG_320_PX | {"focal_px": 200.0, "eyes": {"k1": k1}}
        return recipe("out-of-view", rig=rig, sequence={"losses": {"turn_deg": turn_deg}})

    turned(45, 0.0)
    # The barrel sees 46 degrees aside in its corners instead of 38.7.
    with pytest.raises(ValueError, match=r"turn_deg: 45 degrees leave part .* at 6 m; turn by at least 5"):
        turned(45, -0.14)
    drawn = turned(52, -0.14)
    for k in lost(drawn):
        frame = sample_frame(drawn, k)
        points_m = frame.left_from_drogue.apply(marker_layout(frame.drogue).centers_m)
        assert not any(frame.rig.camera.contains(frame.rig.image(points_m, eye)).any() for eye in EYES)


def test_recipes_without_losses_do_not_know_of_them() -> None:
    drawn = load_recipe("docking-10m").recipe
    text = drawn.model_dump_json()
    assert not any(word in text for word in ("losses", "in_turn", "scattered_fraction"))
    assert '"loss"' not in sample_frame(recipe("none"), 0).model_dump_json()


@pytest.mark.mitsuba
def test_records_of_a_hidden_drogue_say_so() -> None:
    from labelgen.frame_labels import label_frame
    from labelgen.validation.label_checks import check_against_passes
    from render.camera.sensor import expose
    from render.engine import load_engine

    drawn = recipe("occlusion", rig=RIG_160_PX, render={"samples_per_px": 1, "edge_samples_per_px": 4})
    for k, hidden in ((0, False), (lost(drawn)[0], True)):
        frame = sample_frame(drawn, k)
        radiance = load_engine("mitsuba").render(frame, drawn.render)
        record = label_frame(frame, radiance, expose(frame, radiance))
        assert check_against_passes(record, radiance) == []
        for view, seen in ((record.views.left, radiance.left), (record.views.right, radiance.right)):
            assert (view.visible_drogue_px == 0) == hidden and (view.box_visible_xywh_px is None) == hidden
            assert {marker.visible_fraction for marker in view.markers} == {0.0 if hidden else 1.0}
            assert (seen.part_id == Part.OBSTACLE).any() == hidden
        # On the image all the same, as occlusion does not count there.
        assert record.conditions.markers_in_view == (8, 8)
