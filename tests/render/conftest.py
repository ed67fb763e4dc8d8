from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from render.engine import RenderEngine, load_engine
from tests.support.recipe_builder import build_recipe, stations


@pytest.fixture(scope="session")
def make_recipe():
    """A recipe for the paper's rig scaled down by a factor."""

    def make(scale=1.0, stations_m=(3.0,), samples=16, speed_m_s=0.0, rate_deg_s=0.0) -> Recipe:
        width_px, height_px, focal_px = round(1280 * scale), round(960 * scale), round(2133.3333 * scale, 6)
        return build_recipe(
            name="render-test",
            seed=5,
            rig={"preset": "rgb-ideal", "width_px": width_px, "height_px": height_px, "focal_px": focal_px},
            frames={"count": 50},
            distance=stations(*stations_m),
            pose={"speed_m_s": speed_m_s, "rate_deg_s": rate_deg_s},
            render={"samples_per_px": samples},
        )

    return make


@pytest.fixture(scope="session")
def engine() -> RenderEngine:
    if importlib.util.find_spec("mitsuba") is None:
        pytest.skip("mitsuba is not installed")
    return load_engine("mitsuba")


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
