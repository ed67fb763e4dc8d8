"""The sky's light on a plate in the open, against closed forms and Mitsuba's own map."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from render.engine import RenderEngine

pytestmark = pytest.mark.mitsuba


@pytest.fixture(scope="module")
def irradiance_map(engine: RenderEngine) -> Callable[..., Any]:
    """Imported only after the engine has chosen Mitsuba's variant."""
    from render.mitsuba_engine.paths.sun_sky_integrator import irradiance_map

    return irradiance_map


@pytest.fixture(scope="module")
def as_mitsuba_reads(engine: RenderEngine) -> Callable[..., Any]:
    """Imported only after the engine has chosen Mitsuba's variant."""
    from render.mitsuba_engine.scene import as_mitsuba_reads

    return as_mitsuba_reads


def test_even_sky_gives_its_own_radiance(irradiance_map: Callable[..., Any]) -> None:
    light = np.full((128, 256, 3), 7.0, dtype=np.float32)
    # Sums of 2048 float32.
    np.testing.assert_allclose(irradiance_map(light), 7.0, rtol=1e-5)


def test_bright_half_gives_the_view_factor(irradiance_map: Callable[..., Any]) -> None:
    """A plate whose normal is an angle a from the zenith sees (1 + cos a) / 2 of a bright upper half."""
    light = np.zeros((128, 256, 3), dtype=np.float32)
    light[:64] = 1.0
    polar = (np.arange(48) + 0.5) * np.pi / 48
    expected = np.broadcast_to((1 + np.cos(polar))[:, None, None] / 2, (48, 96, 3))
    # Blocks of 5.6 degrees under a cosine, and its kink at the horizon.
    np.testing.assert_allclose(irradiance_map(light), expected, atol=2e-3)


def test_map_is_stretched_as_mitsuba_reads_it(as_mitsuba_reads: Callable[..., Any]) -> None:
    height = 128
    polar = (np.arange(height) + 0.5) * np.pi / height
    light = np.broadcast_to(polar[:, None, None], (height, 2 * height, 3)).astype(np.float32)
    read = as_mitsuba_reads(light)[:, 0, 0]
    expected = np.arange(height) * np.pi / (height - 1)
    # The poles have no texels of their own: up to half a texel is carried on from the next.
    np.testing.assert_allclose(read[1:-1], expected[1:-1], atol=1e-5)
    np.testing.assert_allclose(read[[0, -1]], expected[[0, -1]], atol=1e-5 + np.pi / 256)
