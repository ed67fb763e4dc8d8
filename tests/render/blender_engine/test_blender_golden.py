"""Blender's renders against the stored mean of many renders by the other path tracer."""

from __future__ import annotations

import numpy as np
import pytest

from drogue_models.parts import Part
from geometry.stereo import EYES
from scenes.sampler import sample_frame
from scenes.sky.photometry import REC709_LUMINANCE
from tests.render.golden_frame import GOLDEN, golden_recipe
from tests.support.blender_interpreter import needs_blender

pytestmark = [pytest.mark.blender, needs_blender]

RENDERS = 8
RENDER = {"engine": "blender", "samples_per_px": 16, "surround_samples_per_px": 16}


def test_renders_scatter_around_the_other_path_tracer_s_mean() -> None:
    from render.blender_engine.blender_engine import BlenderEngine

    with np.load(GOLDEN) as stored:
        mean, variance, parts = stored["mean"].astype(float), stored["variance"].astype(float), stored["parts"]
    recipe = golden_recipe(**RENDER)
    frame = sample_frame(recipe, 0)
    blender = BlenderEngine()
    images = []
    for seed in range(RENDERS):
        radiance = blender.render(frame.model_copy(update={"seed": seed}), recipe.render)
        images.append(np.stack([getattr(radiance, eye).radiance_cd_m2 @ REC709_LUMINANCE for eye in EYES]))
    blender.close()
    ours = np.mean(images, axis=0)
    for part in np.unique(parts[parts != Part.SKY]):
        of_part = parts == part
        totals = [image[of_part].sum() for image in images]
        expected = mean[of_part].sum()
        error = np.std(totals, ddof=1) / np.sqrt(RENDERS)
        # Four standard errors by Student's law with 7 degrees of freedom: one in two hundred for each of 15 parts; and
        # half a percent for parts as small as a pixel is wide, whose edges the two tracers place by float32.
        assert abs(np.mean(totals) - expected) < 4 * error + 0.005 * expected, part
    traced = variance > (1e-3 * mean) ** 2
    spread = np.var(images, axis=0, ddof=1)[traced] / RENDERS + (1e-3 * mean[traced]) ** 2
    # Squares of Student's t with 7 degrees of freedom have a median of 0.51, of 2000 pixels known to 0.03; half as much
    # again would be a systematic difference as large as the noise.
    assert np.median(np.square(ours - mean)[traced] / spread) < 0.75
