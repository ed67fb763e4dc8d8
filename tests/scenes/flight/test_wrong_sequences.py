"""Sequences that cannot be flown or seen: what is said of them."""

from __future__ import annotations

import pytest

from datasets_manifest.recipe.recipe import parse_recipe
from scenes.sampler import sample_frame
from tests.support.sequence_recipe import BASE, recipe


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (("release_m = [15.5, 0, -3]", ""), r"hose.length_m: a hose of 15 m is shorter than the 15.8 m from the pod"),
        (('hose = "long"', ""), r"no hose named 'long'; there are full-size, small-uav"),
        (('turbulence = "wild"', ""), r"sequence.turbulence"),
        (("frame_rate_hz = 0", ""), r"sequence.frame_rate_hz"),
        (("frame_rate_hz = 600", ""), r"exposure: up to 0.002 s are longer than the 0.00166667 s"),
        (("", "offset_right_m = [0, 2]"), r"station leaves the visible volume at 4 m"),
        (("", "end_m = 5.0\nabort_m = 1"), None),
        (("", 'hold_s = -1'), r"sequence.receiver.hold_s"),
        (("", 'follower.delay_s = -1'), r"sequence.receiver.follower.delay_s"),
    ],
)  # fmt: skip
def test_wrong_sequences_are_named_on_one_line(text, fault):
    if fault is None:
        recipe(*text)  # distances that no manoeuvre flies to do not matter
        return
    with pytest.raises(ValueError, match=fault) as caught:
        recipe(*text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("manoeuvre", "fault"),
    [
        ('["docking"]\nend_m = 1.2', r"docking leaves the visible volume at 1.2 m.*1\.4[0-9] m"),
        ('["docking"]\nend_m = 6', r"end_m: must be below start_m, 4 m, got 6"),
        ('["docking"]', r"frames_per_sequence: docking takes 6.033 s, which is 152 frames, got 20"),
    ],
)
def test_wrong_runs_are_named_on_one_line(manoeuvre, fault):
    text = (BASE % ("", "")).replace('["station"]', manoeuvre)
    text = text if "152" in fault else text.replace("frames_per_sequence = 20", "frames_per_sequence = 900")
    with pytest.raises(ValueError, match=fault) as caught:
        parse_recipe(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("section", "fault"),
    [
        ("[pose]\nspeed_m_s = 1", r"pose.speed_m_s: in a recipe with \[sequence\] the motion decides"),
        ("[distance]\nlaw = 'stations'\nstations_m = [5]", r"distance: in a recipe with \[sequence\]"),
        ("[target]\ndistractor_frame_fraction = 0.5", r"target.distractor_frame_fraction"),
    ],
)
def test_what_only_single_pairs_have_is_refused(section, fault):
    with pytest.raises(ValueError, match=fault):
        recipe(more=section)


@pytest.mark.parametrize("time_s", ["0", "-0.001"])
def test_an_exposure_must_last(time_s):
    with pytest.raises(ValueError, match=r"exposure.time_s: .*greater than 0"):
        parse_recipe((BASE % ("", "")).replace("time_s = 0.002", f"time_s = {time_s}"))


def test_a_drogue_that_hangs_down_is_not_looked_at_from_the_side():
    drawn = recipe('hose = { preset = "small-uav", airspeed_m_s = 0 }\nturbulence = "none"')
    with pytest.raises(
        ValueError, match=r"sequence 0: leaves the visible volume at 0.00 s: the drogue's axis is .* deg"
    ):
        sample_frame(drawn, 0)


def test_a_drogue_that_comes_to_the_lens_is_refused():
    drawn = recipe()
    # No recipe asks for it; a swing may bring it about, here a drogue that has grown.
    grown = drawn.model_copy(update={"drogue": drawn.drogue.model_copy(update={"rim_radius_m": 4.2})})
    with pytest.raises(ValueError, match=r"sequence 0: leaves the visible volume at 0.00 s: the drogue's rim comes to"):
        sample_frame(grown, 0)
