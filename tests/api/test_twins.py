"""Twins: the same frames by another engine, camera, weather or shutter, and without blur or noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import droguekit
from datasets_manifest.types.frame import FrameSpec
from scenes.sampler import sample_frame

SMALL = {"preset": "rgb-ideal", "width_px": 160, "height_px": 120, "focal_px": 266.0, "output_bits": 12}
BASE: dict[str, Any] = {"rig": SMALL, "render": {"engine": "analytic"}, "pose": {"speed_m_s": 2.0, "rate_deg_s": 20.0}}
MONO = {**SMALL, "preset": "mono"}
# What is done to the recipe, and what of a frame it changes.
TWINS: dict[str, tuple[dict[str, Any], set[str]]] = {
    "engine": ({"render": {"engine": "mitsuba"}}, set()),
    "passes": ({"outputs": {"exr": True}}, set()),
    "noise-free": ({"rig": {**SMALL, "noise_free": True}}, {"sensor"}),
    "camera": ({"rig": MONO}, {"sensor"}),
    "sharp": ({"pose": {"speed_m_s": 0.0, "rate_deg_s": 0.0}}, {"left_twist_per_s", "drogue_twist_per_s"}),
    "shutter": ({"exposure": {"time_s": 0.004}}, {"exposure"}),
    "weather": ({"environment": {"visibility_m": 3000.0}}, {"environment", "exposure"}),
    "light": ({"environment": {"sun_elevation_deg": 5.0}}, {"environment", "exposure"}),
}


def changed(change: dict[str, Any]) -> dict[str, Any]:
    return {key: {**BASE.get(key, {}), **change.get(key, {})} for key in {*BASE, *change}}


def frames(recipe_name: str, change: dict[str, Any]) -> list[FrameSpec]:
    recipe = droguekit.load_recipe(recipe_name, **change)
    return [sample_frame(recipe, index) for index in (0, 3)]


@pytest.mark.parametrize("twin", TWINS)
def test_a_twin_changes_what_it_names_and_no_bit_of_the_rest(twin: str) -> None:
    change, expected = TWINS[twin]
    for plain, other in zip(frames("demo", changed({})), frames("demo", changed(change)), strict=True):
        before, after = (frame.model_dump(mode="json") for frame in (plain, other))
        assert {key for key in before.keys() | after.keys() if before.get(key) != after.get(key)} <= expected
        for name in ("left_from_drogue", "world_from_left", "left_from_tanker"):
            assert getattr(plain, name).as_matrix().tobytes() == getattr(other, name).as_matrix().tobytes()


def pair(change: dict[str, Any]) -> droguekit.StereoPair:
    return droguekit.render_pair(droguekit.load_recipe("demo", **changed(change)), 3)


def test_labels_of_noise_free_and_sharp_twins_are_the_same_bit_for_bit() -> None:
    plain, quiet, sharp = (pair(TWINS[name][0] if name else {}) for name in ("", "noise-free", "sharp"))
    records = [one.record.model_dump(mode="json", exclude={"file_sha256"}) for one in (plain, quiet)]
    assert records[1]["frame"]["sensor"].pop("noise_free") is True
    assert records[0] == records[1]
    for eye in ("left", "right"):
        for one, other in zip(
            getattr(plain.record.views, eye).markers, getattr(sharp.record.views, eye).markers, strict=True
        ):
            # Motion takes contrast from small markers, and changes nothing else.
            assert one.model_copy(update={"signal_to_noise": 0.0}) == other.model_copy(update={"signal_to_noise": 0.0})
        assert np.array_equal(plain.part_ids[eye], quiet.part_ids[eye])
        assert np.array_equal(plain.part_ids[eye], sharp.part_ids[eye])
    noise = plain.left.astype(float) - quiet.left.astype(float)
    assert noise.std() > 5 * abs(noise.mean())
