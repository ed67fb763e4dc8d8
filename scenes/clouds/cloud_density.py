"""Density of a cloud layer, from periodic random textures with power-law spectra."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.types.environment import CloudLayer
from geometry.bilinear_sampling import sample_bilinear

_SIZE_PX = 1024
# The largest blobs are 1/8 of one repeat, so that the repetition does not show.
_LARGEST_PER_REPEAT = 8
# Finer copies of the same texture add its missing small scales: (scale, weight); the scales have no common factor.
_OCTAVE_GROUPS = ((1.0, 1.0), (6.13, 0.30), (37.7, 0.10))
# A texture with a larger slope has no detail in the finest texels: half as many suffice, and fit the processor's cache.
_SMOOTH_SLOPE = 2.5
_Field = NDArray[np.float32]
# Slopes of the amplitude spectra: bodies of cloud, the heaps on them, streaks of ice.
_BODY_SLOPE, _HEAP_SLOPE, _KNOB_SLOPE, _STREAK_SLOPE = 3.0, 2.8, 2.0, 1.5
# Heaps per body, along and across; two patterns are sheared against each other with height.
_HEAPS_PER_BODY = 3.1
_KNOBS_PER_BODY = 6.3
_EARTH_M = 6.371e6
_FADING_RISE, _FADING_RISE_AT_GROUND = 0.005, 1e-4
# The patterns repeat along axes at this angle to the flight; otherwise repeats would line up in the view ahead.
_TURN_COSINE, _TURN_SINE = np.float32(np.cos(0.37)), np.float32(np.sin(0.37))


class CloudDensity:
    """Density of one layer: positive where there is cloud, negative outside.

    Args:
        layer: its description.
        offset_m: of the camera, east and north of the layer's origin. [m]
        horizon_sine: of the elevation of the ground's horizon, where the Earth is round under the camera too; None
            for layers that rise towards level rays, above and below.

    Attributes:
        layer: its description.
        least_rise: sine of the elevation towards the layer beyond which rays miss it.
        fading_rise: how far above `least_rise` it reaches its full opacity.
        extinction_per_m: inside the cloud. [1/m]
        steepness: slope of density over excess, up to full density.
    """

    def __init__(
        self, layer: CloudLayer, offset_m: tuple[float, float] = (0.0, 0.0), horizon_sine: float | None = None
    ) -> None:
        self.layer = layer
        self._east_m, self._north_m = np.float32(offset_m[0]), np.float32(offset_m[1])
        self._threshold = np.float32(ndtri(np.clip(1.0 - layer.cover_fraction, 1e-4, 1.0 - 1e-4)))
        self._sign = np.float32(np.sign(layer.height_above_camera_m))
        base_m = layer.height_above_camera_m - (0.0 if layer.is_above else layer.thickness_m)
        self._base_m = np.float32(base_m)
        self.extinction_per_m = 2.6 * layer.optical_depth / layer.thickness_m
        self.steepness = 2.0
        self._sinks = horizon_sine is not None and not layer.is_above
        self.least_rise, self.fading_rise = 0.0, _FADING_RISE
        if horizon_sine is not None:
            below = float(np.sqrt(2.0 * abs(layer.height_above_camera_m) / _EARTH_M))
            self.least_rise = horizon_sine if layer.is_above else below
            # The ground's horizon cuts off what lies above it.
            self.fading_rise = _FADING_RISE_AT_GROUND if layer.is_above else _FADING_RISE

    def height_fraction(self, z_m: _Field) -> _Field:
        """0 at the layer's base, 1 at its highest tops."""
        fraction: _Field = (z_m - self._base_m) / np.float32(self.layer.thickness_m)
        return fraction

    def excess(self, directions: NDArray[np.float32], distance_m: _Field) -> _Field:
        """(H, W) excess at a distance along each direction."""
        return self._excess(
            directions[..., 0] * distance_m + self._east_m,
            directions[..., 1] * distance_m + self._north_m,
            self._height_m(directions, distance_m),
        )

    def crossing(self, rise: _Field) -> tuple[_Field, _Field]:
        """Distances at which rays that rise towards the layer enter and leave it, over the round Earth. [m]"""
        near_m = abs(self.layer.height_above_camera_m)
        steep = np.maximum(rise, np.float32(self.least_rise))
        curve = -2.0 if self._sinks else 2.0
        root = [
            np.sqrt(np.maximum(steep * steep + np.float32(curve * h / _EARTH_M), np.float32(0.0)))
            for h in (near_m, near_m + self.layer.thickness_m)
        ]
        # The roots of h = s rise +- s^2 / 2 R, in a form without cancellation for steep rays.
        entry, leave = (
            np.float32(2.0 * h) / (steep + r)
            for h, r in zip((near_m, near_m + self.layer.thickness_m), root, strict=True)
        )
        return entry, leave

    def _height_m(self, directions: NDArray[np.float32], distance_m: _Field) -> _Field:
        """Height above the level surface through the camera. [m]"""
        bend = (np.float32(1.0) if self._sinks else self._sign) / np.float32(2.0 * _EARTH_M)
        height: _Field = directions[..., 2] * distance_m + bend * distance_m * distance_m
        return height

    def place(self, directions: NDArray[np.float32], distance_m: _Field) -> NDArray[np.float32]:
        """(H, W, 3) position at a distance along each direction; the third coordinate is above the level surface."""
        place = directions * distance_m[..., None]
        place[..., 0] += self._east_m
        place[..., 1] += self._north_m
        place[..., 2] = self._height_m(directions, distance_m)
        return place

    def excess_at(self, place_m: NDArray[np.float32]) -> _Field:
        """(H, W) excess at (H, W, 3) places."""
        return self._excess(place_m[..., 0], place_m[..., 1], place_m[..., 2])

    def _excess(self, x_m: _Field, y_m: _Field, z_m: _Field) -> _Field:
        layer = self.layer
        per_m = np.float32(1.0 / layer.feature_size_m)
        x = x_m * (_TURN_COSINE * per_m) + y_m * (_TURN_SINE * per_m)
        y = y_m * (_TURN_COSINE * per_m) - x_m * (_TURN_SINE * per_m)
        height = self.height_fraction(z_m)
        # Height in the patterns' own units: heaps are as tall as they are wide.
        lift = height * np.float32(layer.thickness_m / layer.feature_size_m)
        body = sample_tile(layer.texture_seed, _BODY_SLOPE, x, y) - self._threshold
        heaps = self._heaps(x, y, lift)
        if layer.kind == "stratus":
            relief = np.float32(0.5) + np.float32(0.2) * heaps
            sheet = np.minimum((1.15 - relief * 0.6) - height, height - relief * np.float32(0.35)) * np.float32(2.5)
            return np.minimum(sheet, body * np.float32(1.5))
        # A dome over every body, with heaps on it, cut off at the condensation level; no dome is higher than the layer.
        square = height * height
        fall = np.float32(2.2) * square + np.float32(1.6) * square * square * square
        dome = body + np.float32(0.5) * heaps * (np.float32(0.3) + height) - fall
        base = (height - np.float32(0.04) - np.float32(0.03) * heaps) * np.float32(3.0)
        return np.minimum(dome, base)

    def _heaps(self, x: _Field, y: _Field, lift: _Field) -> _Field:
        """Rounded heaps with creases between them, of about zero mean, in three dimensions."""
        seed, k = self.layer.texture_seed + 1, np.float32(_HEAPS_PER_BODY)
        one = sample_tile(seed, _HEAP_SLOPE, (x + np.float32(0.83) * lift) * k, (y + np.float32(0.55) * lift) * k)
        k = np.float32(_HEAPS_PER_BODY * 1.37)
        two = sample_tile(seed, _HEAP_SLOPE, (y - np.float32(0.77) * lift) * k, (x + np.float32(0.62) * lift) * k)
        heaps: _Field = np.float32(0.9) * np.minimum(np.abs(one + two), np.float32(2.6)) - np.float32(1.0)
        return heaps

    def knob_strength(self, place_m: NDArray[np.float32], width_m: _Field) -> _Field:
        """(H, W) visible amplitude of the knobs at (H, W, 3) positions, for rays of a width. [m]

        Knobs fade where they are too small to resolve; the condensation level is smooth.
        """
        small = width_m * np.float32(3.0 * _KNOBS_PER_BODY / self.layer.feature_size_m)
        above_base = np.clip(np.float32(4.0) * self.height_fraction(place_m[..., 2]), 0.1, 1.0)
        strength: _Field = above_base / (1.0 + small * small)
        return strength

    def knobs(self, place_m: NDArray[np.float32]) -> _Field:
        """(H, W) knobs at (H, W, 3) positions: structure on the heaps too fine for ray marching."""
        per_m = np.float32(_KNOBS_PER_BODY / self.layer.feature_size_m)
        x, y, z = (place_m[..., axis] * per_m for axis in range(3))
        seed = self.layer.texture_seed + 1
        # Each pattern is constant along one slanted axis; the sum of three has creases along none.
        total = sample_tile(seed, _KNOB_SLOPE, x + np.float32(0.5) * z, y - np.float32(0.6) * z)
        total += sample_tile(seed, _KNOB_SLOPE, y + np.float32(0.5) * x + np.float32(2.7), z - np.float32(0.4) * x)
        total += sample_tile(seed, _KNOB_SLOPE, z + np.float32(0.6) * y + np.float32(5.1), x - np.float32(0.5) * y)
        knobs: _Field = np.float32(0.82) * np.sqrt(total * total + np.float32(0.15)) - np.float32(1.2)
        return knobs

    def mottling(self, place_m: NDArray[np.float32]) -> _Field:
        """(H, W) variation in thickness of a sheet, as the logarithm of its light."""
        per_m = np.float32(1.0 / self.layer.feature_size_m)
        x, y = place_m[..., 0] * per_m, place_m[..., 1] * per_m
        wide = sample_tile(self.layer.texture_seed, _BODY_SLOPE, x, y)
        fine = sample_tile(self.layer.texture_seed + 1, _KNOB_SLOPE, x * np.float32(2.3), y * np.float32(2.3))
        mottling: _Field = np.float32(0.16) * wide + np.float32(0.08) * fine
        return mottling

    def cirrus_depth(self, directions: NDArray[np.float32], distance_m: _Field) -> _Field:
        """(H, W) vertical optical depth of streaks."""
        layer = self.layer
        size_m = np.float32(layer.feature_size_m)
        per_m = distance_m * np.float32(1.0 / layer.feature_size_m)
        cosine, sine = (np.float32(turn(np.radians(layer.heading_deg))) for turn in (np.cos, np.sin))
        along = (directions[..., 0] * cosine + directions[..., 1] * sine) * per_m
        along += (self._east_m * cosine + self._north_m * sine) / size_m
        across = (directions[..., 1] * cosine - directions[..., 0] * sine) * per_m
        across += (self._north_m * cosine - self._east_m * sine) / size_m
        seed = layer.texture_seed
        bend = sample_tile(seed + 2, 2.4, along * np.float32(0.35), across * np.float32(0.35))
        streaks = sample_tile(
            seed + 3,
            _STREAK_SLOPE,
            along * np.float32(0.3) + np.float32(0.06) * bend,
            across * np.float32(1.6) + np.float32(0.3) * bend,
        )
        patches = sample_tile(seed, _BODY_SLOPE, along * np.float32(0.5), across * np.float32(0.6)) - self._threshold
        amount = np.clip(patches * np.float32(0.6) + np.float32(0.3), 0.0, 1.0)
        depth: _Field = np.float32(layer.optical_depth) * amount * np.clip(0.45 + 0.55 * streaks, 0.0, 1.6)
        return depth


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
    """Like `sample_texture`, without the finer copies: smooth below a hundredth of the largest blobs, and faster."""
    tile = _half_tile(seed, slope) if slope > _SMOOTH_SLOPE else _tile(seed, slope)
    texels, size = np.float32(len(tile) / _LARGEST_PER_REPEAT), np.float32(len(tile))
    u, v = x * texels, y * texels
    u -= np.floor(u / size) * size
    v -= np.floor(v / size) * size
    result: NDArray[np.float32] = sample_bilinear(tile, u, v, cv2.BORDER_WRAP)
    return result


def sample_texture(seed: int, slope: float, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
    """Texture values of zero mean and unit variance.

    Args:
        seed: of the texture.
        slope: of its amplitude spectrum; a larger slope is smoother.
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
        total += np.float32(weight) * sample_bilinear(tile, u, v, cv2.BORDER_WRAP)
        norm += weight**2
    return total / np.float32(np.sqrt(norm))
