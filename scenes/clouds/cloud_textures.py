"""Periodic random textures that clouds are made of: power laws, rounded lumps, fibres and fall streaks of ice."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator

Texture = NDArray[np.float32]

TILE_PX = 512
# The largest blobs are 1/8 of one repeat, so that the repetition does not show.
BLOBS_PER_TILE = 8
LUMPS_PX = 64
# Lumps along one side of the volume.
LUMPS_PER_VOLUME = 6
_LUMP_SEED = 41
_STREAK_STEPS = 26
# A fall streak is so long, bends so far aside, and is at last so wide, in texels.
_STREAK_LENGTH_PX, _STREAK_BEND_PX, _STREAK_WIDTH_PX = 150.0, 75.0, 6.0


def power_law_tile(seed: int, stream: str, slope: float, stretch: float = 1.0) -> Texture:
    """(512, 512) periodic Gaussian texture of unit variance, rough at all scales.

    Args:
        seed, stream: keys of the random stream.
        slope: exponent of the fall of the amplitude spectrum above its peak.
        stretch: how many times longer the structures are along rows than across.
    """
    rng = frame_generator(seed, 0, stream)
    down, along = np.fft.fftfreq(TILE_PX)[:, None] * TILE_PX, np.fft.rfftfreq(TILE_PX)[None, :] * TILE_PX
    square = down**2 + (stretch * along) ** 2
    amplitude = np.where(square > 0, (square + BLOBS_PER_TILE**2) ** (-slope / 2), 0.0)
    return _normal(np.fft.rfft2(rng.standard_normal((TILE_PX, TILE_PX))) * amplitude)


def _normal(spectrum: NDArray[np.complex128]) -> Texture:
    tile = np.fft.irfft2(spectrum, s=(TILE_PX, TILE_PX))
    result: Texture = ((tile - tile.mean()) / tile.std()).astype(np.float32)
    return result


@lru_cache(maxsize=24)
def body_tile(seed: int, slope: float) -> Texture:
    """(512, 512) texture of the bodies of a layer; see `power_law_tile`."""
    return power_law_tile(seed, "texture", slope)


@lru_cache(maxsize=4)
def ice_tiles(seed: int) -> Texture:
    """(3, 512, 512) fibres, fall streaks and wide bends of cirrus; rows run along the wind.

    Crystals fall out of small cells and trail behind, for the wind is weaker below: each cell is smeared along a
    bent path along which the streak gets fainter and wider.
    """
    fibres = power_law_tile(seed, "fibres", 1.35, 6.0)
    rng = frame_generator(seed, 0, "fall streaks")
    down, along = np.fft.fftfreq(TILE_PX)[:, None], np.fft.rfftfreq(TILE_PX)[None, :]
    radius = np.hypot(down, along)
    white = np.fft.rfft2(rng.standard_normal((TILE_PX, TILE_PX)))
    cells = _normal(white * radius * np.exp(-((radius / 0.045) ** 2)))
    sources = np.fft.rfft2(np.maximum(cells - 1.1, 0.0) ** 1.5)
    trail = np.zeros_like(sources)
    # Steps grow with the width of the streak.
    edges = (np.arange(_STREAK_STEPS + 1) / _STREAK_STEPS) ** 1.6
    for first, last in pairwise(edges):
        way = 0.5 * (first + last)
        phase = along * (way * _STREAK_LENGTH_PX) + down * (way * way * _STREAK_BEND_PX)
        width_px = 0.9 + way * _STREAK_WIDTH_PX
        trail += (last - first) * (1.0 - way) * np.exp(-2j * np.pi * phase - 2.0 * (np.pi * width_px * radius) ** 2)
    streaks = np.fft.irfft2(sources * trail, s=(TILE_PX, TILE_PX))
    streaks = np.maximum(streaks, 0.0) / streaks.std()
    bends = power_law_tile(seed, "bends", 2.6)
    return np.stack([fibres, streaks.astype(np.float32), bends])


@lru_cache(maxsize=1)
def lump_volume() -> Texture:
    """(64, 64, 64) periodic rounded lumps with creases between them, of zero mean, from -1 to 1.

    The paraboloids about random points of which each place belongs to the nearest (Worley 1996,
    doi:10.1145/237170.237267). All layers use the same volume at places of their own.
    """
    cells, texels = LUMPS_PER_VOLUME, (np.arange(LUMPS_PX) + 0.5) * (LUMPS_PER_VOLUME / LUMPS_PX)
    offsets = frame_generator(_LUMP_SEED, 0, "lumps").random((3, cells, cells, cells))
    own = np.floor(texels).astype(int)
    square = np.full((LUMPS_PX,) * 3, np.inf)
    for steps in product((-1, 0, 1), repeat=3):
        at = np.ix_(*((own + step) % cells for step in steps))
        away = np.zeros_like(square)
        for axis, step in enumerate(steps):
            start = (own + step - texels).reshape([-1 if side == axis else 1 for side in range(3)])
            away += (offsets[axis][at] + start) ** 2
        np.minimum(square, away, out=square)
    lumps = square.mean() - square
    result: Texture = (lumps / np.abs(lumps).max()).astype(np.float32)
    return result
