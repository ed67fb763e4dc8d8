"""Blender on a GPU where there is none: one line, before a picture is asked for."""

from __future__ import annotations

import pytest

from render.engine import EngineUnavailableError, engine_notice, load_engine
from tests.support.blender_interpreter import needs_blender

pytestmark = [pytest.mark.blender, needs_blender]


@pytest.fixture(autouse=True)
def no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide GPUs from Blender."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "-1")


def test_a_missing_gpu_is_named_before_pictures() -> None:
    refused = (
        r"^device cuda: Blender finds no GPU for OptiX; droguekit doctor says what is missing, or take device cpu$"
    )
    with pytest.raises(EngineUnavailableError, match=refused):
        engine_notice("blender", "cuda")
    with pytest.raises(EngineUnavailableError, match=refused):
        load_engine("blender", "cuda")


def test_records_name_the_processor() -> None:
    engine = load_engine("blender")
    assert " cycles cpu, render version " in engine.version
