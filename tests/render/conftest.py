from __future__ import annotations

import importlib.util

import pytest

from render.engine import RenderEngine, load_engine


@pytest.fixture(scope="session")
def engine() -> RenderEngine:
    if importlib.util.find_spec("mitsuba") is None:
        pytest.skip("mitsuba is not installed")
    return load_engine("mitsuba")
