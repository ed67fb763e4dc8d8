"""Which pixels take how many samples."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from datasets_manifest.types.appearance import DrogueCondition, SurfaceCondition
from drogue_models.parts import FIRST_MARKER_ID, Part
from render.engine import RenderEngine
from scenes.sampler import sample_frame
from tests.support.recipe_builder import paper_view_recipe

pytestmark = pytest.mark.mitsuba


def test_dirt_on_a_marker_is_an_edge_everywhere(engine: RenderEngine) -> None:
    from render.mitsuba_engine.trace_request import plan_pixels

    ids = np.full((20, 30), int(Part.FACE), dtype=np.uint8)
    ids[5:15, 5:12], ids[5:15, 18:25] = FIRST_MARKER_ID, FIRST_MARKER_ID + 1
    plan = plan_pixels([ids], [np.zeros(ids.shape, dtype=bool)], 1, {FIRST_MARKER_ID + 1})
    clean, dirty = (np.flatnonzero(ids == FIRST_MARKER_ID + index) for index in range(2))
    assert set(dirty) <= set(plan.edges)
    # Of the clean one only the outline is, and the pixels next to it.
    assert len(set(clean) & set(plan.edges)) == len(clean) - 5 * 8


def test_a_dirty_marker_has_little_noise(engine: RenderEngine) -> None:
    recipe = paper_view_recipe(scale=0.5, stations_m=(6.0,), window=0.5)
    frame = sample_frame(recipe, 0)
    dirty = [SurfaceCondition(dirt_fraction=0.4, dirt_seed=index) for index in range(frame.drogue.marker_count)]
    frame = frame.model_copy(update={"condition": DrogueCondition(markers=tuple(dirty))})
    first, second = (engine.render(frame.model_copy(update={"seed": seed}), recipe.render) for seed in (1, 2))
    inside = cv2.erode((first.left.part_id >= FIRST_MARKER_ID).astype(np.uint8), np.ones((3, 3), dtype=np.uint8)) > 0
    per_cd_m2 = frame.sensor.electrons_per_cd_m2(frame.exposure)
    red = [per_cd_m2 * seen.left.radiance_cd_m2[inside][:, 0] for seen in (first, second)]
    noise_e = np.sqrt(np.mean((red[0] - red[1]) ** 2) / 2)
    # The aim of 0.42 is behind the lens, which leaves 0.64 of it. Four rays in each of these pixels had 1.14.
    assert noise_e < 0.66 * np.sqrt(red[0].mean() + frame.sensor.read_noise_e**2)
