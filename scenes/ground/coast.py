"""The shore between land and sea: beach, shallows over bars, and surf."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from scenes.ground_view import Field, GroundView, MipTile, power_noise

_SEED = 6
_SAND = np.array([0.29, 0.248, 0.185], dtype=np.float32)
_DUNE = np.array([0.135, 0.130, 0.075], dtype=np.float32)
_LARGE_BAYS_M, _SMALL_BAYS_M, _ROUGHNESS_M = 900.0, 260.0, 22.0
_BEACH_M = 45.0
_LEVEL_M = 1800.0
_BED_SLOPE, _BAR_SPACING_M = 0.009, 140.0
# Diffuse attenuation, down and up again, of clear coastal water. [1/m]
_ATTENUATION_PER_M = np.array([0.75, 0.17, 0.14], dtype=np.float32)
_SURF_M = 110.0
_BREAKER_SPACING_M = 38.0


@lru_cache(maxsize=1)
def _ragged() -> MipTile:
    """Roughness of the shoreline and of breakers; each of unit variance."""
    made = [power_noise(_SEED, name, 512, 1.5, 12.0) for name in ("shore", "breakers")]
    return MipTile(np.stack(made, axis=-1), 6.0)


class Coast:
    """A shoreline across the view ahead.

    Args:
        rng: draws direction and position.
        altitude_m: of the camera, which sets the distance ahead. [m]
    """

    def __init__(self, rng: np.random.Generator, altitude_m: float) -> None:
        angle = float(rng.uniform(-1.25, 1.25))
        side = 1.0 if rng.random() < 0.5 else -1.0
        self._normal = side * np.cos(angle), side * np.sin(angle)
        self._start_m = side * np.cos(angle) * altitude_m * float(rng.uniform(4.0, 10.0))
        self._shift_m = rng.uniform(0, 1e5, 2).astype(np.float32)
        self._breadth = float(rng.uniform(0.4, 1.6))
        self.reach_m = _SURF_M + 4 * _BEACH_M

    def offshore_m(self, view: GroundView, regions: Field, shapes: Field) -> Field:
        """(H, W) approximate distance from the shoreline; negative on land. [m]"""
        straight = view.x_m * np.float32(self._normal[0]) + view.y_m * np.float32(self._normal[1])
        rough = self._rough(view)
        bays = np.float32(_LARGE_BAYS_M) * regions[..., 1] + np.float32(_SMALL_BAYS_M) * shapes[..., 0]
        result: Field = straight - np.float32(self._start_m) + bays + np.float32(_ROUGHNESS_M) * rough[..., 0]
        return result

    def hill_share(self, x_m: Field, y_m: Field) -> Field:
        """(H, W) how much of their height hills keep: none near the shore, so that it is level."""
        straight = x_m * np.float32(self._normal[0]) + y_m * np.float32(self._normal[1]) - np.float32(self._start_m)
        return np.clip((-straight - np.float32(_LEVEL_M)) / np.float32(_LEVEL_M), 0.0, 1.0)

    def wet_share(self, view: GroundView, offshore_m: Field) -> Field:
        """(H, W) share of each piece that is under water."""
        return _rise(offshore_m, np.float32(0.0), self._blur_m(view))

    def with_beach(self, albedo: Field, view: GroundView, offshore_m: Field) -> Field:
        """(H, W, 3) reflectance of the land with sand along the water."""
        rough = self._rough(view)
        # Broad in bays, narrow or none before bluffs.
        breadth_m = np.float32(_BEACH_M * self._breadth) * np.clip(1.0 + np.float32(0.7) * rough[..., 1], 0.15, 3.0)
        blur_m = self._blur_m(view)
        sandy = _rise(offshore_m + breadth_m, np.float32(0.0), np.maximum(blur_m, np.float32(9.0)))
        # Dunes and grass behind the beach.
        dunes = _rise(offshore_m + 2.2 * breadth_m, np.float32(0.0), np.maximum(blur_m, 1.6 * breadth_m))
        back = _DUNE * (1.0 + np.float32(0.12) * rough[..., :1])
        albedo = albedo + np.float32(0.6) * (dunes * (1.0 - sandy))[..., None] * (back - albedo)
        sand = _SAND * (1.0 + np.float32(0.05) * rough[..., :1])
        result: Field = albedo + sandy[..., None] * (
            sand * (1.0 - np.float32(0.5) * self.wetness(view, offshore_m))[..., None] - albedo
        )
        return result

    def wetness(self, view: GroundView, offshore_m: Field) -> Field:
        """(H, W) share of the land that waves keep wet, darker and shining."""
        return _rise(offshore_m, np.float32(-9.0), np.maximum(self._blur_m(view), np.float32(16.0)))

    def _rough(self, view: GroundView) -> Field:
        return _ragged().sample(
            view.x_m + self._shift_m[0], view.y_m + self._shift_m[1], np.sqrt(view.across_m * view.along_m)
        )

    def body_rgb(self, view: GroundView, offshore_m: Field, deep_rgb: Field) -> Field:
        """(H, W, 3) diffuse reflectance of the water: the bed shows through where it is shallow."""
        # Bars along the shore, broken by channels.
        bars = np.sin(np.maximum(offshore_m, 0.0) * np.float32(2 * np.pi / _BAR_SPACING_M)) * self._rough(view)[..., 0]
        away_m = np.maximum(offshore_m, 0.0)
        depth_m = np.float32(_BED_SLOPE) * away_m * (1.0 + np.float32(0.3) * bars) + away_m * away_m / np.float32(4e4)
        through = np.exp(-depth_m[..., None] * (2 * _ATTENUATION_PER_M))
        result: Field = deep_rgb + through * (np.float32(0.55) * _SAND - deep_rgb)
        return result

    def surf_share(self, view: GroundView, offshore_m: Field) -> Field:
        """(H, W) share of each piece that breakers cover with foam."""
        rough = _ragged().sample(
            view.x_m + self._shift_m[1], view.y_m + self._shift_m[0], np.sqrt(view.across_m * view.along_m)
        )[..., 1]
        blur_m = self._blur_m(view)
        swept = np.clip(1.0 - offshore_m / np.float32(_SURF_M), 0.0, 1.0) * (offshore_m > -2 * blur_m)
        phase = (offshore_m + 14.0 * rough) * np.float32(2 * np.pi / _BREAKER_SPACING_M)
        # Lines of breakers that cannot be resolved merge into their mean.
        sharp = np.exp(-((blur_m / np.float32(0.3 * _BREAKER_SPACING_M)) ** 2))
        lines = np.clip(np.cos(phase) * 1.6 - 0.5, 0.0, 1.0) * sharp + np.float32(0.3) * (1.0 - sharp)
        torn = np.clip(0.75 + 0.5 * rough, 0.0, 1.0)
        result: Field = (swept * np.maximum(lines, np.exp(-np.maximum(offshore_m, 0.0) / 6.0)) * torn).astype(
            np.float32
        )
        return result

    def _blur_m(self, view: GroundView) -> Field:
        """(H, W) width of the pieces of ground across the shoreline. [m]"""
        facing = np.abs(view.away_x * np.float32(self._normal[0]) + view.away_y * np.float32(self._normal[1]))
        result: Field = view.across_m + facing * view.along_m
        return result


def _rise(value: Field, edge: np.float32, width: Field) -> Field:
    """Linear rise from 0 to 1 over a width around an edge."""
    result: Field = np.clip((value - edge) / width + np.float32(0.5), 0.0, 1.0)
    return result
