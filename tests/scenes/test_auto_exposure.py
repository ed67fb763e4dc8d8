"""The automatic exposure: time within its limits first, then gain within its own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.environment import CloudLayer
from datasets_manifest.types.frame import Exposure
from drogue_models.parameters import WHITE_PAINT
from scenes.environment_radiance import environment_radiance
from scenes.environment_sampling import environment_of_scene
from scenes.sampler import automatic_exposure, sample_frame
from scenes.sky.photometry import infrared_light, luminance
from tests.support.recipe_builder import RecipeTable, build_recipe, stations

BASE: RecipeTable = {
    "name": "meter-test",
    "rig": {"preset": "rgb-ideal", "width_px": 64, "height_px": 48, "focal_px": 107.0},
    "frames": {"count": 1},
    "distance": stations(5.0),
}


def recipe(**exposure: Any) -> Recipe:
    """With these keys in its section `exposure`."""
    return build_recipe(BASE, exposure=exposure)


def exposure_of(**exposure: Any) -> Exposure:
    return sample_frame(recipe(**exposure), 0).exposure


FREE = exposure_of()


def test_time_alone_when_its_limits_suffice() -> None:
    with_gain = exposure_of(auto_gain=[1, 16])
    assert with_gain == FREE
    assert FREE.gain == 1


def test_gain_makes_up_for_a_time_at_its_limit() -> None:
    longest_s = FREE.time_s / 5
    got = exposure_of(auto_time_s=[1e-6, longest_s], auto_gain=[1, 16])
    assert got.time_s == longest_s
    assert got.gain == pytest.approx(5, rel=1e-12)


def test_gain_stays_within_its_limits() -> None:
    got = exposure_of(auto_time_s=[1e-6, FREE.time_s / 5], auto_gain=[1, 3])
    assert got.gain == 3


def test_a_gain_that_must_be_high_shortens_the_time() -> None:
    got = exposure_of(auto_gain=[4, 16])
    assert got.gain == 4
    assert got.time_s == pytest.approx(FREE.time_s / 4, rel=1e-12)


def test_a_low_gain_takes_a_shortest_time_that_is_too_long() -> None:
    got = exposure_of(auto_time_s=[2 * FREE.time_s, 1], auto_gain=[0.1, 1])
    assert got.time_s == 2 * FREE.time_s
    assert got.gain == pytest.approx(0.5, rel=1e-12)


def test_a_gain_below_one_darkens_and_fills_no_site_beyond_its_full_well() -> None:
    assert exposure_of(auto_gain=0.25) == FREE.model_copy(update={"gain": 0.25})
    assert exposure_of(auto_gain=[0.1, 0.5]) == FREE.model_copy(update={"gain": 0.5})
    assert exposure_of(auto_gain=[0.5, 4]) == FREE


def test_a_fixed_time_keeps_its_gain_or_meters_it() -> None:
    time_s = FREE.time_s / 8
    assert exposure_of(time_s=time_s).gain == 1
    assert exposure_of(time_s=time_s, auto_gain=6).gain == 6
    assert exposure_of(time_s=time_s, auto_gain=[1, 64]).gain == pytest.approx(8, rel=1e-12)


def test_product_of_time_and_gain_answers_the_aperture() -> None:
    wide, narrow = (exposure_of(f_number=f, auto_time_s=[1e-6, 1], auto_gain=[1, 64]) for f in (2.0, 4.0))
    assert narrow.time_s * narrow.gain == pytest.approx(4 * wide.time_s * wide.gain, rel=1e-12)


def test_the_meter_alone_with_a_scene() -> None:
    made = recipe()
    environment = environment_of_scene(made.seed, 0, made.environment)
    frame = sample_frame(made, 0)
    assert automatic_exposure(made.exposure, environment, made.rig.camera, frame.world_from_left, made.sensor) == FREE


def test_a_meter_on_the_plate_minds_no_sky_behind_it() -> None:
    made = recipe(auto_meter="plate", auto_level_fraction=0.5, auto_time_s=[1e-6, 1])
    environment = environment_of_scene(made.seed, 0, made.environment)
    pose = sample_frame(made, 0).world_from_left
    longer = []
    for azimuth_deg in (0.0, 180.0):
        around = environment.model_copy(update={"sun_elevation_deg": 12.0, "sun_azimuth_deg": azimuth_deg})
        got = automatic_exposure(made.exposure, around, made.rig.camera, pose, made.sensor)
        plate = environment_radiance(around).plate_illuminance_lux(-pose.rotation[:, 2]) * np.array(WHITE_PAINT) / np.pi
        electrons = made.sensor.electrons_per_cd_m2(got) * float(luminance(plate))
        assert electrons == pytest.approx(0.5 * made.sensor.full_well_e, rel=1e-9)
        of_view = made.exposure.model_copy(update={"auto_meter": "view"})
        longer.append(got.time_s / automatic_exposure(of_view, around, made.rig.camera, pose, made.sensor).time_s)
    # With the sun ahead the sky is brighter than the shaded plate; with the sun behind the plate is brighter.
    assert longer[0] > 2
    assert longer[1] == 1


def test_a_meter_on_the_highlights_leaves_nine_tenths_of_a_view_of_clouds_below_white() -> None:
    """Over a broken deck, against the pixels of the picture itself; the usual meter clips most of the cloud."""
    deck = {"height_above_camera_m": -1500.0, "cover_fraction": 0.4, "feature_size_m": 2500.0, "optical_depth": 25.0}
    white = []
    for meter in ("view", "highlights"):
        made = recipe(auto_meter=meter, auto_level_fraction=0.95)
        frame = sample_frame(made, 0)
        around = frame.environment.model_copy(
            update={"clouds": (CloudLayer.model_validate(deck | {"texture_seed": 3}),), "sun_elevation_deg": 30.0}
        )
        pose = frame.world_from_left
        got = automatic_exposure(made.exposure, around, made.rig.camera, pose, made.sensor)
        u, v = np.meshgrid(np.arange(64.0), np.arange(48.0))
        rays = pose.rotate(made.rig.camera.rays(np.stack([u, v], axis=-1)))
        rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
        electrons = luminance(environment_radiance(around).radiance(rays)) * made.sensor.electrons_per_cd_m2(got)
        white.append(float((electrons > made.sensor.full_well_e).mean()))
    # 221 pixels decide: the standard deviation of a tenth of them is 0.02.
    assert white[1] < 0.16
    assert white[0] > 1.5 * white[1]


def test_drawn_infrared_cameras_meter_the_infrared() -> None:
    """As the rig behind a filter does."""
    table = {**BASE, "rig": {**BASE["rig"], "encoding": "gamma"}}
    made = build_recipe(
        table,
        camera={"near_infrared_scene_fraction": 1.0, "grey_scene_fraction": 0.0},
        exposure={"auto_meter": "plate", "auto_level_fraction": 0.5},
    )
    frame = sample_frame(made, 0)
    ambient = environment_radiance(frame.environment)
    plate = ambient.plate_illuminance_lux(-frame.world_from_left.rotation[:, 2]) * np.array(WHITE_PAINT) / np.pi
    electrons = float(infrared_light(plate, 850.0)) * frame.sensor.electrons_per_cd_m2(frame.exposure)
    assert electrons == pytest.approx(0.5 * frame.sensor.full_well_e, rel=1e-9)


@pytest.mark.parametrize("auto_gain", [[0.01, 1], [1, 100], [4, 2]])
def test_impossible_gains_are_refused(auto_gain: list[float]) -> None:
    with pytest.raises(ValueError, match="gain"):
        recipe(auto_gain=auto_gain)


def test_the_meter_sees_through_the_infrared_filter() -> None:
    frame = sample_frame(
        build_recipe(BASE, rig={**BASE["rig"], "preset": "mono-850"}, exposure={"auto_meter": "plate"}), 0
    )
    ambient = environment_radiance(frame.environment)
    plate = ambient.plate_illuminance_lux(-frame.world_from_left.rotation[:, 2]) * np.array(WHITE_PAINT) / np.pi
    electrons = float(infrared_light(plate, 850.0)) * frame.sensor.electrons_per_cd_m2(frame.exposure)
    assert electrons == pytest.approx(0.7 * frame.sensor.full_well_e, rel=1e-9)
