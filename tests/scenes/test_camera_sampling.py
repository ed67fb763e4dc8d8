"""Cameras by scene: streams of their own, and nothing of it in older recipes."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.images import light_from_srgb
from render.camera.image_processing import tone_tables
from scenes.camera_sampling import camera_of_scene
from scenes.sampler import sample_frame
from tests.support.recipe_builder import RecipeTable, build_recipe, stations

BASE: RecipeTable = {
    "name": "cameras",
    "rig": {"preset": "rgb-ideal", "encoding": "gamma"},
    "frames": {"count": 200, "scenes": 200},
    "distance": stations(5.0),
}


def recipe(**camera: object) -> Recipe:
    return build_recipe(BASE, camera=camera)


def test_a_recipe_without_the_section_has_frames_as_before() -> None:
    before, after = sample_frame(build_recipe(BASE), 3), sample_frame(recipe(), 3)
    assert before.camera is None and '"camera":null' not in before.model_dump_json()
    assert "camera" not in before.model_dump() and "camera" not in build_recipe(BASE).model_dump()
    changed = {name for name in FrameSpec.model_fields if repr(getattr(before, name)) != repr(getattr(after, name))}
    assert changed <= {"sensor", "camera", "exposure"}
    # Smaller pixels collect less and hold less, so that the meter gives the same, but for rounding.
    assert after.exposure.time_s == pytest.approx(before.exposure.time_s, rel=1e-12)
    assert FrameSpec.model_validate_json(after.model_dump_json()).model_dump_json() == after.model_dump_json()


def test_shares_are_those_of_the_recipe() -> None:
    drawn = [camera_of_scene(recipe(window_scene_fraction=0.3), scene)[1] for scene in range(400)]
    cameras = [camera for camera in drawn if camera is not None]
    assert len(cameras) == 400 and len({camera.model_dump_json() for camera in cameras}) == 400
    # Three standard deviations of a share of 400 are at most 0.075.
    for got, wanted in (
        (np.mean([camera.processing is not None for camera in cameras]), 0.9),
        (np.mean([camera.spectrum != "colour" for camera in cameras]), 0.12),
        (np.mean([camera.window is not None for camera in cameras]), 0.3),
        (np.mean([camera.coding.codec == "jpeg" for camera in cameras]), 0.45),
        (np.mean([camera.coding.codec == "h264-intra" for camera in cameras]), 0.35),
        (np.mean([camera.overlay is not None for camera in cameras]), 0.12),
    ):
        assert got == pytest.approx(wanted, abs=0.075)


def test_another_window_leaves_lens_and_processing() -> None:
    _, one = camera_of_scene(recipe(window_scene_fraction=0.0), 4)
    _, other = camera_of_scene(recipe(window_scene_fraction=1.0, overlay_scene_fraction=1.0), 4)
    assert one is not None and other is not None and one.window is None and other.window is not None
    assert (one.lens, one.processing, one.coding) == (other.lens, other.processing, other.coding)


@pytest.mark.parametrize("level", [0.45, 0.7])
def test_a_grey_card_is_mid_grey_in_the_picture(level: float) -> None:
    """Whatever level the meter puts white at."""
    neutral = {"exposure_ev": 0, "contrast": 0, "black_fraction": 0, "white_balance_fraction": 0}
    table = build_recipe(
        BASE, exposure={"auto_level_fraction": level}, camera={**neutral, "processed_scene_fraction": 1.0}
    )
    _, camera = camera_of_scene(table, 0)
    assert camera is not None and camera.processing is not None
    number = 64 + (4095 - 64) * level * 0.18 / 0.8
    shown = np.interp(number, np.arange(4096), tone_tables(camera.processing, 12, 64)[1]) / 255
    assert light_from_srgb(np.array(shown)) == pytest.approx(0.18, rel=0.002)


def test_a_near_infrared_camera_is_as_sensitive_as_the_shipped_one() -> None:
    """The meter gives both one time, also where the rig has a filter of its own."""
    drawn = {"grey_scene_fraction": 0, "near_infrared_scene_fraction": 1, "full_well_fraction": 1}
    rigs = ({"preset": preset, "encoding": "gamma"} for preset in ("mono-850", "mono", "rgb-ideal", "mono-850"))
    cameras: tuple[dict[str, object], ...] = ({"near_infrared_scene_fraction": 0}, drawn, drawn, drawn)
    frames = [
        sample_frame(build_recipe(BASE, rig=rig, camera=camera), 3) for rig, camera in zip(rigs, cameras, strict=True)
    ]
    for frame in frames:
        assert frame.band_nm == 850.0
        responsivity = frame.sensor.responsivity_e_per_lux_s * frames[0].sensor.full_well_e / frame.sensor.full_well_e
        assert responsivity == pytest.approx(frames[0].sensor.responsivity_e_per_lux_s, rel=1e-12)
        # Only float64 rounds.
        assert frame.exposure.time_s == pytest.approx(frames[0].exposure.time_s, rel=1e-12)


def test_families_have_cameras_of_their_own() -> None:
    text_of_family = {"name": "night", "camera": {"processed_scene_fraction": 0.0}}
    table = build_recipe(BASE, camera={"grey_scene_fraction": 0.5}, families=[text_of_family])
    (family,) = table.families
    assert family.camera is not None
    assert (family.camera.processed_scene_fraction, family.camera.grey_scene_fraction) == (0.0, 0.5)


@pytest.mark.parametrize(
    ("rig", "camera", "message"),
    [
        (
            {"preset": "rgb-ideal", "encoding": "linear"},
            {},
            'camera: gives pictures of 8 bits .* set rig.encoding to "gamma"',
        ),
        ({"preset": "rgb-ideal", "encoding": "gamma", "output_bits": 12}, {}, "rig.output_bits to 8, got gamma and 12"),
        (BASE["rig"], {"jpeg_scene_fraction": 0.8, "video_scene_fraction": 0.5}, "must add up to at most 1, got 1.3"),
        (BASE["rig"], {"jpeg_quality": [1, 50]}, "jpeg_quality: must lie in"),
        (BASE["rig"], {"quality": 50}, "camera.quality"),
    ],
)
def test_wrong_keys_are_named(rig: object, camera: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build_recipe(BASE, rig=rig, camera=camera)  # type: ignore[arg-type]


def test_cameras_without_colour_take_no_rig_with_a_mosaic() -> None:
    rig = {"preset": "paper-colour", "encoding": "gamma", "output_bits": 8}
    for name in ("grey_scene_fraction", "near_infrared_scene_fraction"):
        shares = {"grey_scene_fraction": 0.0, "near_infrared_scene_fraction": 0.0}
        assert build_recipe(BASE, rig=rig, camera=shares).camera is not None
        with pytest.raises(ValueError, match="grey and near-infrared cameras have no mosaic"):
            build_recipe(BASE, rig=rig, camera=shares | {name: 0.1})
