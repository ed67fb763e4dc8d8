"""Blotches of dirt on a painted disc."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from datasets_manifest.random_streams import frame_generator

DIRT_MAP_PX = 64
# Soot, hydraulic fluid and road dust: dark and nearly grey (our choice).
DIRT_RGB = (0.055, 0.050, 0.045)
_BLOTCH_PX = 5.0
_EDGE_PX = 1.2


def dirt_map(seed: int, dirt_fraction: float) -> NDArray[np.float32]:
    """Where dirt covers a square around a disc.

    Args:
        seed: of the pattern.
        dirt_fraction: share of the square that is covered.

    Returns:
        (64, 64) share of each texel under dirt, 0 to 1; row 0 is the low y end of the square.
    """
    noise = frame_generator(seed, 0, "dirt").standard_normal((DIRT_MAP_PX, DIRT_MAP_PX))
    smooth = gaussian_filter(noise, _BLOTCH_PX, mode="wrap")
    covered = (smooth >= np.quantile(smooth, 1.0 - dirt_fraction)).astype(np.float64)
    if dirt_fraction <= 0:
        covered[:] = 0.0
    softened: NDArray[np.float32] = gaussian_filter(covered, _EDGE_PX, mode="wrap").astype(np.float32)
    return softened
