"""The renderer's noise as frames state it, against the noise that is measured."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.types.frame import FrameSpec
from drogue_models.parts import MAX_MARKERS, drogue_part_ids
from geometry.stereo import EYES
from render.engine import RenderEngine, StereoRadiance
from scenes.sampler import sample_frame
from scenes.sky.photometry import REC709_LUMINANCE
from tests.support.recipe_builder import paper_view_recipe

pytestmark = pytest.mark.mitsuba

UNREACHABLE = {"noise_over_sensor": 1e-3}
"""An aim for which all samples that are allowed are taken."""
RECIPE = paper_view_recipe(scale=0.25, stations_m=(3.0,))
AIM = 0.8
PLENTY = RECIPE.render.model_copy(update={"edge_samples_per_px": 2048, "noise_over_sensor": AIM})


def test_stated_noise_is_the_difference_of_two_renders(engine: RenderEngine) -> None:
    recipe = paper_view_recipe(scale=0.25, stations_m=(2.0,))
    frame = sample_frame(recipe, 0)
    # More noise than usual, which is quicker: of any amount the statement should be right.
    settings = recipe.render.model_copy(update={"noise_over_sensor": 0.8})
    first, second = (engine.render(frame.model_copy(update={"seed": seed}), settings) for seed in (1, 2))
    error, total = [], []
    for eye in EYES:
        a, b = getattr(first, eye), getattr(second, eye)
        of_drogue = np.isin(a.part_id, drogue_part_ids(MAX_MARKERS))
        error.append(((a.radiance_cd_m2 - b.radiance_cd_m2) @ REC709_LUMINANCE)[of_drogue] / np.sqrt(2))
        total.append(((a.radiance_cd_m2 + b.radiance_cd_m2) @ REC709_LUMINANCE)[of_drogue] / 2)
    measured = np.sqrt(np.mean(np.concatenate(error) ** 2) / np.mean(np.concatenate(total) ** 2))
    stated = np.mean([first.monte_carlo_noise_fraction, second.monte_carlo_noise_fraction])
    # Each states it from a sixteenth of some 12,000 pixels; a few edge pixels make up most of the sum.
    assert stated == pytest.approx(measured, rel=0.25)


def test_more_samples_leave_less_noise(engine: RenderEngine) -> None:
    frame_recipe = paper_view_recipe(scale=0.18, stations_m=(3.5,))
    frame = sample_frame(frame_recipe, 0)
    few_samples, many_samples = (
        frame_recipe.render.model_copy(update={"samples_per_px": n, "edge_samples_per_px": 4 * n} | UNREACHABLE)
        for n in (4, 16)
    )
    few, many = (engine.render(frame, settings) for settings in (few_samples, many_samples))
    # Independent samples would halve it; stratified ones do better, and 0.6 leaves room for the estimate's own noise.
    assert many.monte_carlo_over_sensor_noise < 0.6 * few.monte_carlo_over_sensor_noise
    # Ten times the light's electrons have three times its shot noise.
    longer = frame.model_copy(
        update={"exposure": frame.exposure.model_copy(update={"time_s": 10 * frame.exposure.time_s})}
    )
    assert engine.render(longer, few_samples).monte_carlo_over_sensor_noise == pytest.approx(
        few.monte_carlo_over_sensor_noise * np.sqrt(10), rel=0.1
    )


@pytest.fixture(scope="module")
def frame() -> FrameSpec:
    return sample_frame(RECIPE, 0)


@pytest.fixture(scope="module")
def plain(engine: RenderEngine, frame: FrameSpec) -> StereoRadiance:
    """The frame, with as many rays as the aim needs."""
    return engine.render(frame, PLENTY)


def test_edges_take_no_more_rays_than_the_aim_needs(
    engine: RenderEngine, frame: FrameSpec, plain: StereoRadiance
) -> None:
    finer = engine.render(frame, PLENTY.model_copy(update={"noise_over_sensor": AIM / 2}))
    # A sixteenth of the pixels states it, and counts are powers of two.
    assert plain.monte_carlo_over_sensor_noise == pytest.approx(AIM, rel=0.25)
    assert finer.monte_carlo_over_sensor_noise == pytest.approx(AIM / 2, rel=0.25)


def test_more_light_takes_more_rays(engine: RenderEngine, frame: FrameSpec, plain: StereoRadiance) -> None:
    longer = frame.model_copy(
        update={"exposure": frame.exposure.model_copy(update={"time_s": 3 * frame.exposure.time_s})}
    )
    # The light's own noise falls against the light, and the renderer's must too. Of two such statements each is good to
    # a quarter at most.
    fraction = engine.render(longer, PLENTY).monte_carlo_noise_fraction
    assert fraction == pytest.approx(plain.monte_carlo_noise_fraction / np.sqrt(3), rel=0.3)
