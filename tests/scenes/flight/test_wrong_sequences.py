"""Sequences that cannot be flown or seen are refused with a clear error."""

from __future__ import annotations

import pytest

from scenes.sampler import sample_frame
from tests.support.recipe_builder import RecipeTable, Section, build_recipe, stations
from tests.support.small_datasets import STATION_KEEPING


@pytest.mark.parametrize(
    ("sequence", "fault"),
    [
        ({"release_m": [15.5, 0, -3]}, r"hose.length_m: a hose of 15 m is shorter than the 15.8 m from the pod"),
        ({"hose": "long"}, r"no hose named 'long'; there are full-size, small-uav"),
        ({"turbulence": "wild"}, r"sequence.turbulence"),
        ({"frame_rate_hz": 0}, r"sequence.frame_rate_hz"),
        (
            {"frame_rate_hz": 1e-3},
            r"sequence: frame_rate_hz: \d+ frames at 0.001 Hz last [\d.e+]+ s, at most 7200 s can be flown",
        ),
        ({"frame_rate_hz": 600}, r"exposure: up to 0.002 s are longer than the 0.00166667 s"),
        ({"receiver": {"offset_right_m": [0, 2]}}, r"station leaves the visible volume at 4 m"),
        ({"receiver": {"hold_s": -1}}, r"sequence.receiver.hold_s"),
        ({"receiver": {"follower": {"delay_s": -1}}}, r"sequence.receiver.follower.delay_s"),
    ],
)
def test_wrong_sequences_are_named_on_one_line(sequence: Section, fault: str) -> None:
    with pytest.raises(ValueError, match=fault) as caught:
        build_recipe(STATION_KEEPING, sequence=sequence)
    assert "\n" not in str(caught.value)


def test_distances_that_no_manoeuvre_flies_to_do_not_matter() -> None:
    build_recipe(STATION_KEEPING, sequence={"receiver": {"end_m": 5.0, "abort_m": 1}})


@pytest.mark.parametrize(
    ("receiver", "frames", "fault"),
    [
        ({"end_m": 1.2}, 900, r"docking leaves the visible volume at 1.2 m.*1\.4[0-9] m"),
        ({"end_m": 6}, 900, r"end_m: must be below start_m, 4 m, got 6"),
        ({}, 20, r"frames_per_sequence: docking takes 6.033 s, which is 152 frames, got 20"),
    ],
)
def test_wrong_runs_are_named_on_one_line(receiver: dict[str, float], frames: int, fault: str) -> None:
    docking = {"manoeuvres": ["docking"], **receiver}
    with pytest.raises(ValueError, match=fault) as caught:
        build_recipe(STATION_KEEPING, sequence={"frames_per_sequence": frames, "receiver": docking})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"pose": {"speed_m_s": 1}}, r"pose.speed_m_s: in a recipe with \[sequence\] the motion decides"),
        ({"distance": stations(5)}, r"distance: in a recipe with \[sequence\]"),
        ({"target": {"distractor_frame_fraction": 0.5}}, r"target.distractor_frame_fraction"),
    ],
)
def test_what_only_single_pairs_have_is_refused(changes: RecipeTable, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        build_recipe(STATION_KEEPING, **changes)


@pytest.mark.parametrize("time_s", [0, -0.001])
def test_an_exposure_must_last(time_s: float) -> None:
    with pytest.raises(ValueError, match=r"exposure.time_s: .*greater than 0"):
        build_recipe(STATION_KEEPING, exposure={"time_s": time_s})


def test_a_drogue_that_hangs_down_is_not_looked_at_from_the_side() -> None:
    still = {"hose": {"preset": "small-uav", "airspeed_m_s": 0}, "turbulence": "none"}
    drawn = build_recipe(STATION_KEEPING, sequence=still)
    with pytest.raises(
        ValueError, match=r"sequence 0: leaves the visible volume at 0.00 s: the drogue's axis is .* deg"
    ):
        sample_frame(drawn, 0)


def test_a_drogue_that_comes_to_the_lens_is_refused() -> None:
    drawn = build_recipe(STATION_KEEPING)
    # No recipe asks for it; a swing may bring it about, here a drogue that has grown.
    grown = drawn.model_copy(update={"drogue": drawn.drogue.model_copy(update={"rim_radius_m": 4.2})})
    with pytest.raises(ValueError, match=r"sequence 0: leaves the visible volume at 0.00 s: the drogue's rim comes to"):
        sample_frame(grown, 0)
