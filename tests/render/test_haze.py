"""Koschmieder's law: the contrast of a black thing against the horizon falls with exp(-extinction x distance)."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.environment import Environment, Mist
from datasets_manifest.types.frame import FrameSpec
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import Part
from geometry.se3 import RigidTransform
from render.compositing import TracedEye
from render.engine import RenderEngine, load_engine
from scenes.sampler import sample_frame
from scenes.sky.photometry import luminance
from tests.support.recipe_builder import paper_view_recipe

BLACK = (0.0, 0.0, 0.0)
VISIBILITY_M = 60.0
DISTANCES_M = (5.0, 15.0, 30.0)


def black_frame(distance_m: float) -> tuple[Recipe, FrameSpec]:
    """A black drogue in dense mist, in one corner of the view."""
    recipe = paper_view_recipe(scale=0.25, stations_m=(distance_m,), samples=4)
    frame = sample_frame(recipe, 0)
    drogue = DrogueParameters.model_validate(
        frame.drogue.model_dump() | {"face_reflectance_rgb": BLACK, "marker_reflectance_rgb": BLACK}
    )
    environment = Environment.model_validate(
        frame.environment.model_dump()
        | {"visibility_m": 400_000.0, "mist": Mist(visibility_m=VISIBILITY_M, above_m=2000, below_m=2000)}
    )
    pose = RigidTransform(np.eye(3), [0.13 * distance_m, -0.09 * distance_m, distance_m])
    return recipe, frame.model_copy(
        update={"drogue": drogue, "environment": environment, "left_from_drogue": pose, "condition": None}
    )


def check(engine: RenderEngine) -> None:
    for distance_m in DISTANCES_M:
        recipe, frame = black_frame(distance_m)
        seen = engine.render(frame, recipe.render).left
        light = luminance(seen.radiance_cd_m2)
        marker = (seen.part_id == int(Part.FACE)) & (seen.coverage > 0.9999)
        sky = seen.coverage == 0
        contrast = 1.0 - light[marker].mean() / light[sky].mean()
        v, u = np.nonzero(marker)
        rays = frame.rig.camera.rays(np.stack([u, v], axis=-1).astype(float))
        length_m = (seen.depth_m[marker] * np.linalg.norm(rays / rays[:, 2:], axis=-1)).mean()
        expected = np.exp(-frame.environment.extinction_per_m * length_m) * np.exp(-3.912 / VISIBILITY_M * length_m)
        # The bar of the law itself; what is left is the spread of depth over the face and float32.
        assert contrast == pytest.approx(expected, rel=0.02)


def test_contrast_falls_as_koschmieder_says_in_the_analytic_engine() -> None:
    check(load_engine("analytic"))


@pytest.mark.mitsuba
def test_contrast_falls_as_koschmieder_says_in_mitsuba(engine: RenderEngine) -> None:
    check(engine)


def test_airlight_is_the_background_where_nothing_can_be_seen() -> None:
    """Endless air in front of things and the background behind them are one, in clear air and in mist."""
    from scenes.environment_radiance import EnvironmentRadiance

    _, frame = black_frame(10.0)
    azimuth = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(90, -1e-4)], axis=-1)[None].astype(np.float32)
    for environment in (frame.environment, frame.environment.model_copy(update={"mist": None, "visibility_m": 3e4})):
        around = EnvironmentRadiance(environment)
        # 1e-4 rad down is endlessly far.
        np.testing.assert_allclose(around.radiance(rays), around.airlight(rays), rtol=0.02)


def untraced(depth_m: np.ndarray) -> TracedEye:
    depth_m = depth_m.astype(np.float32)
    return TracedEye.untraced(
        part_id=np.isfinite(depth_m).astype(np.uint8),
        depth_m=depth_m,
        normal=np.zeros((*depth_m.shape, 3), dtype=np.float32),
        amodal_px={},
    )


MIST_LIGHT_CD_M2, MIST_PER_M = 2000.0, 3.912 / 80.0
NEAR_CD_M2, FAR_CD_M2 = (600.0, 600.0, 650.0), (900.0, 20.0, 20.0)


def in_mist(depth_m: np.ndarray, light: np.ndarray) -> np.ndarray:
    """(H, W, 3) radiance behind mist of (H, W, 3) light at (H, W) depths; everything is covered."""
    pixel = np.arange(depth_m.size)
    covered = np.concatenate([light.reshape(-1, 3), np.ones((len(pixel), 1))], axis=1).astype(np.float32)
    seen = untraced(depth_m).with_light(pixel, covered)
    air = np.full((len(pixel), 3), MIST_LIGHT_CD_M2, dtype=np.float32)
    per_m = np.full(len(pixel), MIST_PER_M, dtype=np.float32)
    seen.apply_air(air, per_m)
    seen.limit_edges(per_m)
    return seen.radiance_cd_m2.reshape(light.shape)


def test_air_in_front_of_a_far_thing_is_that_of_its_own_depth_beside_a_near_one() -> None:
    """A probe 3 m away covers half of a drogue at 20 m in mist: up to the edge the drogue is as hazy as elsewhere."""
    depth_m = np.full((9, 12), 20.0)
    depth_m[:, :5] = 3.0
    clear = np.exp(-MIST_PER_M * depth_m)[..., None]
    light = np.where(depth_m[..., None] < 10, NEAR_CD_M2, FAR_CD_M2)
    expected = light * clear + (1 - clear) * MIST_LIGHT_CD_M2
    found = in_mist(depth_m, light)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize("near_share", [0.0, 0.2, 0.49, 0.51, 0.8, 1.0])
def test_a_pixel_on_an_edge_in_mist_is_not_darker_than_what_it_borders_on(near_share: float) -> None:
    depth_m = np.full((9, 12), 20.0)
    depth_m[:, : 5 if near_share < 0.5 else 6] = 3.0
    light = np.where(np.arange(12)[None, :, None] < 5, NEAR_CD_M2, FAR_CD_M2) * np.ones((9, 1, 1))
    light[:, 5] = near_share * np.array(NEAR_CD_M2) + (1 - near_share) * np.array(FAR_CD_M2)
    found = in_mist(depth_m, light)
    darker = found[4, [2, 9]].min(axis=0)
    assert np.all(found[:, 5] > darker - 1) and np.all(found[:, 5] < MIST_LIGHT_CD_M2)


def test_a_spoke_that_no_centre_hits_is_as_hazy_as_its_neighbours_beside_a_near_thing() -> None:
    depth_m = np.full((9, 12), np.inf)
    depth_m[:, :4] = 3.0
    depth_m[:, 6] = 20.0
    found = untraced(depth_m).air_transmittance(np.array([4 * 12 + 5]), np.full(1, MIST_PER_M, dtype=np.float32))
    assert found[0, 0] == pytest.approx(np.exp(-MIST_PER_M * 20.0), rel=1e-6)


def test_a_pixel_whose_centre_misses_has_the_air_of_what_is_nearest_to_it() -> None:
    """However far a moving thing is smeared beyond its place at mid-exposure."""
    depth_m = np.full((21, 60), np.inf)
    depth_m[8:12, 4:9] = 15.0
    depth_m[8:12, 40:] = 4.0
    per_m = np.full(4, 0.05, dtype=np.float32)
    pixel = np.ravel_multi_index((np.full(4, 10), np.array([9, 15, 20, 39])), depth_m.shape)
    found = untraced(depth_m).air_transmittance(pixel, per_m)
    np.testing.assert_allclose(found[:, 0], np.exp(-0.05 * np.array([15.0, 15.0, 15.0, 4.0])), rtol=1e-6)
    nothing = untraced(np.full((21, 60), np.inf)).air_transmittance(pixel, per_m)
    np.testing.assert_array_equal(nothing, 1.0)


def test_a_pixel_is_as_hazy_alone_as_among_others() -> None:
    rng = np.random.default_rng(8)
    depth_m = np.where(rng.random((12, 9)) < 0.9, np.inf, rng.uniform(5, 40, (12, 9))).astype(np.float32)
    seen = untraced(depth_m)
    per_m = rng.uniform(0.01, 0.05, depth_m.size).astype(np.float32)
    all_of_them = seen.air_transmittance(np.arange(depth_m.size), per_m)
    for pixel in range(depth_m.size):
        assert seen.air_transmittance(np.array([pixel]), per_m[[pixel]])[0, 0] == all_of_them[pixel, 0]
    assert seen.air_transmittance(np.zeros(0, dtype=np.int64), per_m[:0]).shape == (0, 1)
