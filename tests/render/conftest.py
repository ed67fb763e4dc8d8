from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe, parse_recipe
from render.engine import RenderEngine, load_engine

TABLE = """
name = "render-test"
seed = 5
drogue = "red-8"
rig = { preset = "rgb-ideal", width_px = %d, height_px = %d, focal_px = %f }
[frames]
count = 50
[distance]
law = "stations"
stations_m = %s
[pose]
speed_m_s = %f
rate_deg_s = %f
[render]
samples_per_px = %d
"""


@pytest.fixture(scope="session")
def make_recipe():
    """A recipe for the paper's rig scaled down by a factor."""

    def make(scale=1.0, stations_m=(3.0,), samples=16, speed_m_s=0.0, rate_deg_s=0.0) -> Recipe:
        size = (round(1280 * scale), round(960 * scale), 2133.3333 * scale)
        return parse_recipe(TABLE % (*size, list(stations_m), speed_m_s, rate_deg_s, samples))

    return make


@pytest.fixture(scope="session")
def engine() -> RenderEngine:
    if importlib.util.find_spec("mitsuba") is None:
        pytest.skip("mitsuba is not installed")
    return load_engine("mitsuba")


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
