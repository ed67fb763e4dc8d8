"""Skips tests that need Blender where no interpreter has it."""

from __future__ import annotations

import pytest

from render.blender_engine.interpreter import find_blender


def _missing() -> str | None:
    try:
        find_blender()
    except ValueError as error:
        return str(error)
    return None


needs_blender = pytest.mark.skipif(_missing() is not None, reason=str(_missing()))
