from __future__ import annotations

import gc
import importlib.util

import pytest

from render.engine import RenderEngine, load_engine


@pytest.fixture(scope="session")
def loaded_engine() -> RenderEngine:
    if importlib.util.find_spec("mitsuba") is None:
        pytest.skip("mitsuba is not installed")
    return load_engine("mitsuba")


@pytest.fixture(scope="module")
def engine(loaded_engine: RenderEngine) -> RenderEngine:
    """Mitsuba without the scenes of other modules.

    Kernels are compiled for all kinds of paint that any kept scene has. So they are the same whichever modules ran
    before in this process, and the next run reads them from disk.
    """
    tracer = loaded_engine._tracer  # type: ignore[attr-defined]
    if hasattr(tracer, "_scenes"):
        tracer._scenes._scenes.clear()
        gc.collect()
    return loaded_engine
