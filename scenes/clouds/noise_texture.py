"""Periodic random textures with a power-law spectrum, for clouds and ground."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator

_SIZE_PX = 1024
# Periods of the texture held by one repeat: the largest blobs are 1/8 of it, so repeats are not seen at once.
_LARGEST_PER_REPEAT = 8
# Finer copies of the same texture stand in for its missing small scales: (scale, weight), scales without common factor.
_OCTAVE_GROUPS = ((1.0, 1.0), (6.13, 0.30), (37.7, 0.10))


# A slope above this leaves nothing for the finest texels: half as many will do, and stay in the processor's cache.
_SMOOTH_SLOPE = 2.5


@lru_cache(maxsize=24)
def _tile(seed: int, slope: float) -> NDArray[np.float32]:
    """(1024, 1024) periodic Gaussian texture of unit variance whose spectrum falls with `slope` above its peak."""
    rng = frame_generator(seed, 0, "texture")
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(_SIZE_PX), np.fft.rfftfreq(_SIZE_PX), indexing="ij")) * _SIZE_PX
    amplitude = np.where(frequency > 0, (frequency**2 + _LARGEST_PER_REPEAT**2) ** (-slope / 2), 0.0)
    noise = np.fft.rfft2(rng.standard_normal((_SIZE_PX, _SIZE_PX)))
    tile = np.fft.irfft2(noise * amplitude, s=(_SIZE_PX, _SIZE_PX))
    result: NDArray[np.float32] = (tile / tile.std()).astype(np.float32)
    return result


@lru_cache(maxsize=24)
def _half_tile(seed: int, slope: float) -> NDArray[np.float32]:
    """(512, 512) every second texel of a smooth tile."""
    return np.ascontiguousarray(_tile(seed, slope)[::2, ::2])


def sample_tile(seed: int, slope: float, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
    """As `sample_texture` without the finer copies: smooth below a hundredth of the largest blobs, and faster."""
    tile = _half_tile(seed, slope) if slope > _SMOOTH_SLOPE else _tile(seed, slope)
    texels, size = np.float32(len(tile) / _LARGEST_PER_REPEAT), np.float32(len(tile))
    u, v = x * texels, y * texels
    u -= np.floor(u / size) * size
    v -= np.floor(v / size) * size
    result: NDArray[np.float32] = cv2.remap(tile, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return result


def sample_texture(seed: int, slope: float, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
    """Texture values of zero mean and unit variance.

    Args:
        seed: of the pattern.
        slope: of its amplitude spectrum; larger is smoother.
        x, y: (H, W) coordinates in units of the largest blobs.

    Returns:
        (H, W) values.
    """
    if x.size == 0:
        return np.zeros(x.shape, dtype=np.float32)
    tile = _tile(seed, slope)
    total = np.zeros(x.shape, dtype=np.float32)
    norm = 0.0
    for scale, weight in _OCTAVE_GROUPS:
        texels = np.float32(scale * _SIZE_PX / _LARGEST_PER_REPEAT)
        # remap wraps only by its border mode and holds 16-bit coordinates: reduce to one repeat first.
        u, v = x * texels, y * texels
        u -= np.floor(u / np.float32(_SIZE_PX)) * np.float32(_SIZE_PX)
        v -= np.floor(v / np.float32(_SIZE_PX)) * np.float32(_SIZE_PX)
        total += np.float32(weight) * cv2.remap(tile, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        norm += weight**2
    return total / np.float32(np.sqrt(norm))
