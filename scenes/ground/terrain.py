"""Hills and mountains, and what rays see of them: the nearer hide the farther and stand out against the sky."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.environment import GroundKind
from geometry.bilinear_sampling import sample_bilinear
from scenes.ground_view import EARTH_M, Field, MipTile, power_noise

_SEED = 7
_SIZE_PX, _TEXEL_M = 512, 60.0
# Standard deviation of the slope; land of other kinds is level.
_SLOPES: dict[GroundKind, float] = {
    "forest": 0.11,
    "dry": 0.13,
    "fields": 0.035,
    "coast": 0.05,
    "town": 0.02,
    "mountains": 0.55,
    "snow": 0.16,
    "airfield": 0.035,
}
# Finer hills of the same form, by size and height.
_FINER_SIZE, _FINER_HEIGHT = 1.0 / 6.3, 0.075
_RIDGED: tuple[GroundKind, ...] = ("mountains", "dry")
# Heights stay below this share of the camera's altitude, and farther away below a cone that rises so much more.
_BELOW_CAMERA, _CONE = 0.45, 0.20
# Rays that fall more steeply meet hills too gentle to hide anything.
_STEEP_SINE = 0.45
_STEPS, _COVERED_STEPS, _MOST_COLUMNS, _FAR_M = 256, 640, 1500, 1.6e5
_COARSE_PX = 8
# The heights of a profile are averages over pieces as wide as long. So many profiles pass over each piece; between them
# heights are interpolated.
_PROFILES_PER_PIECE = 6
# No trees or houses are closer to the camera than this.
_NEAREST_COVER_M = 100.0

Heights = Callable[[Field, Field, Field], Field]


@lru_cache(maxsize=2)
def _relief(ridged: bool) -> tuple[MipTile, float]:
    """Heights of zero mean and unit variance with slopes east and north [1/m], and the slope's deviation. [1/m]"""
    if ridged:
        folds = [np.abs(power_noise(_SEED, f"ridge {cycles}", _SIZE_PX, 2.4, cycles)) for cycles in (5.0, 9.0)]
        height = -folds[0] - np.float32(0.45) * folds[1] * (np.float32(1.6) - np.minimum(folds[0], np.float32(1.6)))
        height = (height - height.mean()) / height.std()
    else:
        height = power_noise(_SEED, "terrain", _SIZE_PX, 2.5, 7.0)
    slopes = [(np.roll(height, -1, axis) - np.roll(height, 1, axis)) / np.float32(2 * _TEXEL_M) for axis in (1, 0)]
    deviation = float(np.sqrt(np.mean(slopes[0] ** 2 + slopes[1] ** 2) / 2))
    return MipTile(np.stack([height, *slopes], axis=-1).astype(np.float32), _TEXEL_M), deviation


@dataclass(frozen=True, eq=False)
class Seen:
    """Where rays meet the ground, all of shape (H, W).

    Attributes:
        distance_m: along the ray. [m]
        sine: of the angle between ray and ground.
        share: of the pixel that is below the outline of the land.
        above_m: height of the place above the level ground. [m]
    """

    distance_m: Field
    sine: Field
    share: Field
    above_m: Field

    def part(self, chosen: tuple[slice, ...]) -> Seen:
        """The same for some of the rays."""
        return Seen(self.distance_m[chosen], self.sine[chosen], self.share[chosen], self.above_m[chosen])


class Terrain:
    """Heights of one environment's land.

    Args:
        kind: of ground.
        altitude_m: of the camera; hills stay below it, farther ones may rise above. [m]
        shift_m: (2,) place in the pattern. [m]
        is_round: whether the level ground curves as the Earth does.
        kept: share of their height that hills keep by (H, W) x and y, or None.
    """

    def __init__(
        self,
        kind: GroundKind,
        altitude_m: float,
        shift_m: NDArray[np.float32],
        is_round: bool,
        kept: Callable[[Field, Field], Field] | None = None,
    ) -> None:
        self._kept = kept
        self.is_level = kind not in _SLOPES
        self._altitude_m, self._shift_m, self._is_round = altitude_m, shift_m, is_round
        if not self.is_level:
            self._tile, deviation = _relief(kind in _RIDGED)
            self._amplitude_m = np.float32(_SLOPES[kind] / deviation)

    def heights(self, x_m: Field, y_m: Field, footprint_m: Field) -> tuple[Field, Field]:
        """(H, W) heights [m] and (H, W, 2) slopes east and north of the land, averaged over the footprint."""
        seen = self._tile.sample(x_m + self._shift_m[0], y_m + self._shift_m[1], footprint_m)
        scale = np.float32(1.0 / _FINER_SIZE)
        finer = self._tile.sample(x_m * scale, y_m * scale, footprint_m * scale)
        seen = seen + np.float32(_FINER_HEIGHT) * finer * np.array([1.0, scale, scale], dtype=np.float32)
        height = self._amplitude_m * seen[..., 0]
        gain: Field | np.float32 = self._amplitude_m
        if self._kept is not None:
            gain = gain * self._kept(x_m, y_m)
            height = gain * seen[..., 0]
        limit = np.float32(_BELOW_CAMERA * self._altitude_m) + np.float32(_CONE) * np.hypot(x_m, y_m)
        bent = 1.0 / np.sqrt(1.0 + (height / limit) ** 2)
        return height * bent, (gain * bent * bent * bent)[..., None] * seen[..., 1:]

    def seen(
        self,
        directions: NDArray[np.float32],
        angle_rad: float,
        offset_m: tuple[float, float],
        cover: Heights | None = None,
    ) -> Seen:
        """Where (H, W, 3) unit directions meet the land.

        Args:
            directions: in world axes; neighbours in the array are `angle_rad` apart.
            angle_rad: [rad]
            offset_m: of the camera, east and north of the ground's origin. [m]
            cover: height of trees and houses by (H, W) x, y and width of a piece, or None where too small to see. [m]
        """
        steep = self._steep(directions, offset_m)
        flat = -directions[..., 2] < np.float32(_STEEP_SINE)
        if not flat.any():
            return steep
        rows = np.flatnonzero(flat.any(axis=1))
        part = slice(int(rows[0]), int(rows[-1]) + 1)
        low = self._profile(directions[part], angle_rad, offset_m, cover)
        chosen = flat[part]
        for name in ("distance_m", "sine", "share", "above_m"):
            getattr(steep, name)[part][chosen] = getattr(low, name)[chosen]
        return steep

    def _steep(self, directions: NDArray[np.float32], offset_m: tuple[float, float]) -> Seen:
        """Rays that meet gentle slopes from above, by iteration."""
        height, width = directions.shape[:2]
        every = _COARSE_PX if min(height, width) > 8 * _COARSE_PX else 1
        # The last rays are repeated, so that the coarse grid covers the image.
        rows = np.minimum(np.arange(0, height + every, every), height - 1)
        columns = np.minimum(np.arange(0, width + every, every), width - 1)
        coarse = directions if every == 1 else directions[np.ix_(rows, columns)]
        down = np.maximum(-coarse[..., 2], np.float32(0.1))
        above_m = np.zeros_like(down)
        for _ in range(3):
            distance_m = (np.float32(self._altitude_m) - above_m) / down
            x_m, y_m = self._places(coarse, distance_m, offset_m)
            above_m, _ = self.heights(x_m, y_m, np.full_like(x_m, _TEXEL_M))
        if every > 1:
            above_m = _enlarged(above_m, every, (height, width))
        down = np.maximum(-directions[..., 2], np.float32(1e-3))
        distance_m = (np.float32(self._altitude_m) - above_m) / down
        return Seen(distance_m, down, np.ones_like(down), above_m)

    def _places(
        self, directions: NDArray[np.float32], distance_m: Field, offset_m: tuple[float, float]
    ) -> tuple[Field, Field]:
        x_m = directions[..., 0] * distance_m + np.float32(offset_m[0])
        y_m = directions[..., 1] * distance_m + np.float32(offset_m[1])
        return x_m, y_m

    def _profile(
        self, directions: NDArray[np.float32], angle_rad: float, offset_m: tuple[float, float], cover: Heights | None
    ) -> Seen:
        """Rays near the horizon: profiles of the land in every direction, nearer land before farther."""
        level = np.hypot(directions[..., 0], directions[..., 1])
        slope = directions[..., 2] / np.maximum(level, np.float32(0.1))
        ahead = directions.reshape(-1, 3)[:, :2].mean(axis=0, dtype=np.float64)
        heading = np.arctan2(ahead[1], ahead[0])
        cosine, sine = np.float32(np.cos(heading)), np.float32(np.sin(heading))
        along = cosine * directions[..., 0] + sine * directions[..., 1]
        azimuth = np.arctan2(cosine * directions[..., 1] - sine * directions[..., 0], along)
        first = float(azimuth.min())
        step_rad = max(angle_rad, (float(azimuth.max()) - first) / (_MOST_COLUMNS - 2))
        columns = int((float(azimuth.max()) - first) / step_rad) + 2
        # The table's rows are even in the slope; close to the horizon that is even in elevation.
        rises = self._rises(heading + first + step_rad * np.arange(columns), angle_rad, offset_m, cover)
        distances, highest = rises
        low, high = float(max(slope.min(), -0.6)), float(min(slope.max(), highest.max()))
        rows = max(int((high - low) / angle_rad), 1) + 2
        wanted = low + angle_rad * np.arange(rows)
        table = np.empty((columns, rows, 2), dtype=np.float32)
        nearness = 1.0 / distances
        for index in range(columns):
            table[index, :, 0] = np.interp(wanted, highest[index], nearness)
        falls = np.abs(np.diff(table[..., 0], axis=1))
        # Across an outline only the nearer side counts.
        table[:, 1:-1, 1] = np.minimum(falls[:, :-1], falls[:, 1:])
        table[:, 0, 1], table[:, -1, 1] = falls[:, 0], falls[:, -1]
        place = np.clip((slope - np.float32(low)) / np.float32(angle_rad), 0, rows - 1).astype(np.float32)
        column = ((azimuth - np.float32(first)) / np.float32(step_rad)).astype(np.float32)
        found = sample_bilinear(table, place, column, cv2.BORDER_REPLICATE)
        level_m = 1.0 / np.maximum(found[..., 0], np.float32(1.0 / _FAR_M))
        length_m = np.maximum(level_m * level_m * found[..., 1], level_m * np.float32(angle_rad))
        top = np.ascontiguousarray(highest[:, -1:], dtype=np.float32)
        outline = sample_bilinear(top, np.zeros_like(column), column, cv2.BORDER_REPLICATE)
        share = np.clip((outline - slope) / np.float32(angle_rad) + np.float32(0.5), 0.0, 1.0)
        above_m = np.float32(self._altitude_m) + slope * level_m
        if self._is_round:
            above_m += level_m * level_m / np.float32(2 * EARTH_M)
        return Seen(
            distance_m=level_m / np.maximum(level, np.float32(0.1)),
            sine=np.clip(level_m * np.float32(angle_rad) / length_m, 2e-3, 1.0).astype(np.float32),
            share=share.astype(np.float32),
            above_m=above_m,
        )

    def _rises(
        self, azimuths_rad: NDArray[np.float64], angle_rad: float, offset_m: tuple[float, float], cover: Heights | None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(D,) level distances [m], and (A, D) the steepest slope up to each of them."""
        nearest_m = self._altitude_m * (1.0 - _BELOW_CAMERA) * 1.2
        steps = _STEPS if cover is None else _COVERED_STEPS
        distances = np.geomspace(nearest_m, max(_FAR_M, 3 * nearest_m), steps)
        height_m = self._heights_along(azimuths_rad, distances, angle_rad, offset_m, cover)
        rise = (height_m.astype(np.float64) - self._altitude_m) / distances
        if self._is_round:
            rise -= distances / (2 * EARTH_M)
        return distances, np.maximum.accumulate(rise, axis=1)

    def _heights_along(
        self,
        azimuths_rad: NDArray[np.float64],
        distances: NDArray[np.float64],
        angle_rad: float,
        offset_m: tuple[float, float],
        cover: Heights | None,
    ) -> Field:
        """(A, D) heights of the land with its cover at level distances in each direction. [m]"""

        def places(turned_rad: NDArray[np.float64]) -> tuple[Field, Field, Field]:
            level_m = np.broadcast_to(distances.astype(np.float32), (len(turned_rad), len(distances)))
            cosine, sine = (turn(turned_rad).astype(np.float32)[:, None] for turn in (np.cos, np.sin))
            return cosine * level_m + np.float32(offset_m[0]), sine * level_m + np.float32(offset_m[1]), level_m

        piece_rad = max(angle_rad, distances[1] / distances[0] - 1.0)
        first, last = float(azimuths_rad[0]), float(azimuths_rad[-1])
        profiles = min(int((last - first) / piece_rad * _PROFILES_PER_PIECE) + 2, len(azimuths_rad))
        x_m, y_m, level_m = places(np.linspace(first, last, profiles))
        bare_m, _ = self.heights(x_m, y_m, level_m * np.float32(piece_rad))
        height_m = _with_rows(bare_m, len(azimuths_rad))
        if cover is not None:
            x_m, y_m, level_m = places(azimuths_rad)
            height_m = height_m + cover(x_m, y_m, level_m * np.float32(angle_rad))
        return height_m


def highest_sine(kind: GroundKind, altitude_m: float, cover_m: float) -> float:
    """Sine of the elevation above which no land rises, nor what is up to `cover_m` high on it. [m]"""
    if kind not in _SLOPES:
        return -1.0
    tile, deviation = _relief(kind in _RIDGED)
    top_m = _SLOPES[kind] / deviation * (tile.most + _FINER_HEIGHT * tile.most) + cover_m
    nearest_m = max(top_m - _BELOW_CAMERA * altitude_m, 1.0) / _CONE
    hills = min(max(top_m - altitude_m, 0.0) / nearest_m, _CONE)
    return hills + max(cover_m - (1.0 - _BELOW_CAMERA) * altitude_m, 0.0) / _NEAREST_COVER_M


def _enlarged(coarse: Field, every: int, shape: tuple[int, int]) -> Field:
    """A grid whose points are `every` pixels apart, from the first pixel on, enlarged to (H, W)."""
    v = np.arange(shape[0], dtype=np.float32)[:, None] / np.float32(every)
    u = np.arange(shape[1], dtype=np.float32)[None, :] / np.float32(every)
    columns, rows = np.broadcast_to(u, shape), np.broadcast_to(v, shape)
    return np.asarray(sample_bilinear(coarse, columns, rows, cv2.BORDER_REPLICATE), dtype=np.float32)


def _with_rows(image: Field, rows: int) -> Field:
    """An image enlarged to so many rows; the first and the last stay."""
    place = np.linspace(0.0, image.shape[0] - 1, rows)
    above = np.minimum(place.astype(int), image.shape[0] - 2)
    share = (place - above).astype(np.float32)[:, None]
    larger: Field = image[above] * (1 - share) + image[above + 1] * share
    return larger
