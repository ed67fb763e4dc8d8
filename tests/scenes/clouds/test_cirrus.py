"""How much of the sky cirrus covers, and what light it lets through."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.types.environment import CloudLayer
from scenes.clouds.cloud_layers import diffuse_transmission, direct_transmission
from scenes.clouds.thin_layers import thin_depth


def depths(layer: CloudLayer) -> np.ndarray:
    """Vertical optical depths at 40,000 places at random over 40 largest patches along and across."""
    rng = np.random.default_rng(2)
    overhead = np.zeros((200, 200, 3), dtype=np.float32)
    overhead[..., :2] = rng.uniform(0.0, 40.0 * layer.feature_size_m, (200, 200, 2))
    return thin_depth(layer, overhead, np.ones((200, 200), dtype=np.float32), 1e-3, (0.0, 0.0))


def cirrus(cover: float, optical_depth: float = 0.6) -> CloudLayer:
    return CloudLayer(kind="cirrus", height_above_camera_m=3000.0, cover_fraction=cover, feature_size_m=2000.0,
                      optical_depth=optical_depth, texture_seed=9)  # fmt: skip


@pytest.mark.parametrize("optical_depth", [0.1, 3.0])
@pytest.mark.parametrize("cover", [0.05, 0.3, 0.5, 0.8, 1.0])
def test_cover_is_the_share_with_a_tenth_of_the_depth(cover: float, optical_depth: float) -> None:
    layer = cirrus(cover, optical_depth)
    # There are some 1,500 patches: a standard deviation of 0.013.
    assert (depths(layer) > 0.1 * optical_depth).mean() == pytest.approx(cover, abs=0.03)


@pytest.mark.parametrize("cover", [0.05, 0.4, 1.0])
def test_light_below_is_what_cirrus_lets_through(cover: float) -> None:
    layer = cirrus(cover)
    depth = depths(layer)
    assert 1.0 - direct_transmission(layer) == pytest.approx(1.0 - np.exp(-depth).mean(), rel=0.1)
    assert 1.0 - diffuse_transmission(layer) == pytest.approx(1.0 - (1.0 / (1.0 + 0.11 * depth)).mean(), rel=0.1)


def test_there_is_no_ice_without_cover() -> None:
    layer = cirrus(0.0)
    assert not depths(layer).any() and direct_transmission(layer) == diffuse_transmission(layer) == 1.0
