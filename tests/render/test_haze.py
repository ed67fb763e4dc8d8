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


def test_a_pixel_is_as_hazy_alone_as_among_others() -> None:
    rng = np.random.default_rng(8)
    depth_m = np.where(rng.random((12, 9)) < 0.6, np.inf, rng.uniform(5, 40, (12, 9))).astype(np.float32)
    seen = TracedEye.untraced(part_id=depth_m > 0, depth_m=depth_m, normal=np.zeros((12, 9, 3)), amodal_px={})
    per_m = rng.uniform(0.01, 0.05, depth_m.size).astype(np.float32)
    all_of_them = seen.air_transmittance(np.arange(depth_m.size), per_m)
    # By the definition: the nearest depth of the 25 pixels around, and clear air where none has one.
    padded = np.pad(depth_m, 2, constant_values=np.inf)
    nearest_m = np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).min(axis=(2, 3)).ravel()
    expected = np.exp(-per_m * np.where(np.isfinite(nearest_m), nearest_m, 0.0))
    np.testing.assert_allclose(all_of_them[:, 0], expected, rtol=1e-6)
    for pixel in range(depth_m.size):
        assert seen.air_transmittance(np.array([pixel]), per_m[[pixel]])[0, 0] == pytest.approx(
            expected[pixel], rel=1e-6
        )
    assert seen.air_transmittance(np.zeros(0, dtype=np.int64), per_m[:0]).shape == (0, 1)
