"""Land and sea below the camera as a function of direction, and the coast between them."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.types.environment import Environment, GroundKind
from drogue_models.frozen_model import ReflectanceRgb
from scenes.clouds.ray_march import upsample
from scenes.ground.land_tiles import LandKind, land_tile
from scenes.ground.sea import GroundLight, Sea, draw_ships, sample_ships
from scenes.ground_view import Field, GroundView, MipTile, ground_view, pixel_angle_rad, power_noise, smooth_noise
from scenes.sky.photometry import Radiance

MEAN_REFLECTANCE: dict[GroundKind, ReflectanceRgb] = {
    "sea": (0.006, 0.022, 0.030),  # of the water body; the surface also mirrors the sky
    "forest": (0.036, 0.051, 0.021),
    "fields": (0.106, 0.110, 0.050),
    "dry": (0.207, 0.155, 0.107),
    "coast": (0.106, 0.110, 0.050),  # of its land
    "town": (0.130, 0.112, 0.090),
}

_LAND_OF: dict[GroundKind, LandKind] = {
    "sea": "fields",
    "coast": "fields",
    "forest": "forest",
    "fields": "fields",
    "dry": "dry",
    "town": "town",
}
_SEED = 3
# Large images compute slowly varying fields at every so many pixels.
_STEP_PX, _MANY_RAYS = 8, 60_000
# Rays of a block see pieces of similar size, so that one or two mipmap levels serve it.
_BLOCK_ROWS, _BLOCK_COLUMNS = 32, 320
_SMOOTH_PX, _SMOOTH_TEXEL_M = 512, 60.0
_WARP_M = 110.0
# Ground with less contrast than this behind the haze shows no detail.
_HIDDEN = 0.004
# Ground with less contrast than this is computed at every other pixel down and across.
_HAZY, _HAZY_STEP_PX = 0.5, 2
# Standard deviation of the terrain's slope.
_RELIEF: dict[GroundKind, float] = {"forest": 0.10, "dry": 0.13, "fields": 0.025, "coast": 0.05}
# Height and spacing of hedges and rows of trees, which hide the ground behind them from low rays, and their colour.
_HEDGE_M, _HEDGE_SPACING_M = 6.0, 220.0
_HEDGE_SIDE = np.array([0.048, 0.062, 0.026], dtype=np.float32)
_BRIGHTNESS, _TOWN_ABOVE, _GRAIN_BELOW_M, _GRAIN = 0.13, -0.45, 8.0, 0.22
# Illuminance below which towns switch on their lamps, and the radiance of a lit street with its lamps.
_LAMPS_ON_LUX = 40.0
_LAMP_CD_M2 = np.array([36.0, 25.0, 14.0], dtype=np.float32)


@lru_cache(maxsize=1)
def _regions() -> MipTile:
    """Three fields whose signs separate regions, and one of brightness."""
    made = [smooth_noise(_SEED, f"region {index}", _SMOOTH_PX, 9.0) for index in range(3)]
    made.append(power_noise(_SEED, "brightness", _SMOOTH_PX, 1.6, 6.0))
    return MipTile(np.stack(made, axis=-1), _SMOOTH_TEXEL_M)


@lru_cache(maxsize=1)
def _shapes() -> MipTile:
    """Displacements east and north, and slopes of the terrain; each of unit variance."""
    moved = [smooth_noise(_SEED, f"moved {axis}", _SMOOTH_PX, 17.0) for axis in "xy"]
    height = power_noise(_SEED, "terrain", _SMOOTH_PX, 2.1, 7.0)
    slopes = [np.roll(height, -1, axis) - np.roll(height, 1, axis) for axis in (1, 0)]
    return MipTile(np.stack([*moved, *(slope / slope.std() for slope in slopes)], axis=-1), _SMOOTH_TEXEL_M)


@lru_cache(maxsize=1)
def _grain() -> MipTile:
    """Detail finer than the land textures, visible from low altitude."""
    return MipTile(power_noise(_SEED, "grain", 512, 1.0, 24.0)[..., None], 0.4)


class Ground:
    """Land or sea of one environment under its light.

    Args:
        environment: gives kind, colour and seed of the ground, altitude and wind.
        light: on the ground.
        clear: transmittance of the air in front of the ground, by the sine of the depression of rays; None for air that
            is as dense everywhere as the visibility says.
    """

    def __init__(
        self,
        environment: Environment,
        light: GroundLight,
        clear: Callable[[NDArray[np.floating[Any]]], NDArray[np.floating[Any]]] | None = None,
    ) -> None:
        self._environment = environment
        self._clear = clear or self._even_air
        self._light = light
        self._kind = environment.ground
        rng = frame_generator(environment.ground_texture_seed, 0, "ground")
        self._shift_m = rng.uniform(0, 1e5, 2).astype(np.float32)
        angles = rng.uniform(0, 2 * np.pi, 8)
        self._turns = np.stack([np.cos(angles), np.sin(angles), *rng.uniform(0, 1e5, (2, 8))]).astype(np.float32)
        wind_rad = float(rng.uniform(-np.pi, np.pi))
        self._sea = Sea(light, environment.wind_speed_m_s, wind_rad) if self._kind in ("sea", "coast") else None
        self._coast = Coast(rng, environment.altitude_m) if self._kind == "coast" else None
        self._ships = sample_ships(rng, environment.altitude_m) if self._kind == "sea" else ()

    def radiance(self, directions: NDArray[np.float32], uncovered: Field | None = None) -> Radiance:
        """Radiance of the ground without air in front of it.

        Args:
            directions: (H, W, 3) unit vectors in world axes, those above the horizon see the ground's farthest edge.
            uncovered: (H, W) share that clouds do not hide; completely hidden ground is not computed.

        Returns:
            (H, W, 3) radiance. [cd/m2]
        """
        angle_rad = pixel_angle_rad(directions)
        total = np.empty(directions.shape, dtype=np.float32)
        every = _STEP_PX if directions.shape[0] * directions.shape[1] >= _MANY_RAYS else 1
        regions, shapes = self._smooth_fields(directions, every, angle_rad)
        clear = self._clear(-directions[..., 2].min(axis=1))
        for first in range(0, directions.shape[0], _BLOCK_ROWS):
            rows = slice(first, first + _BLOCK_ROWS)
            if clear[rows].max() < _HIDDEN:
                total[rows] = self._mean_radiance
                continue
            step = _HAZY_STEP_PX if every > 1 and clear[rows].max() < _HAZY else 1
            for left in range(0, directions.shape[1], _BLOCK_COLUMNS):
                block = rows, slice(left, left + _BLOCK_COLUMNS)
                if uncovered is not None and uncovered[block].max() < _HIDDEN:
                    total[block] = self._mean_radiance
                    continue
                # One more ray than the block has, for interpolation.
                chosen = tuple(slice(part.start, part.stop + step - 1, step) for part in block)
                view = self._view(directions[chosen], step * angle_rad)
                seen = self._block(view, regions[chosen], shapes[chosen])
                height, width = total[block].shape[:2]
                total[block] = seen if step == 1 else upsample(seen, step, (height, width))
        return total

    def _even_air(self, sine: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        distance_m = self._environment.altitude_m / np.maximum(sine, 1e-6)
        clear: NDArray[np.floating[Any]] = np.exp(-self._environment.extinction_per_m * distance_m)
        return clear

    def moved_to(self, environment: Environment) -> Ground:
        """The same ground for a camera elsewhere at the same altitude.

        Args:
            environment: this ground's environment with another `camera_offset_m`.
        """
        moved = copy(self)
        moved._environment = environment
        return moved

    def _view(self, directions: NDArray[np.float32], angle_rad: float) -> GroundView:
        environment = self._environment
        is_round = environment.sky_model == "scattering"
        return ground_view(directions, environment.altitude_m, angle_rad, environment.camera_offset_m, is_round)

    @property
    def _mean_radiance(self) -> NDArray[np.float32]:
        reflected = np.array(self._environment.ground_reflectance_rgb) * self._light.level_lux / np.pi
        return reflected.astype(np.float32)

    def _smooth_fields(self, directions: NDArray[np.float32], every: int, angle_rad: float) -> tuple[Field, Field]:
        """(H, W, 4) regions; (H, W, 3) displacements, and the share of the beam that the terrain receives."""
        view = self._view(directions if every == 1 else _square_centers(directions, every), every * angle_rad)
        x_m, y_m = view.x_m + self._shift_m[0], view.y_m + self._shift_m[1]
        fields = [tile.sample(x_m, y_m, np.sqrt(view.across_m * view.along_m)) for tile in (_regions(), _shapes())]
        fields[1] = np.concatenate([fields[1][..., :2], self._beam_cosine(fields[1][..., 2:])[..., None]], axis=-1)
        if every == 1:
            return fields[0], fields[1]
        height, width = directions.shape[:2]
        full = [cv2.resize(field, None, fx=every, fy=every, interpolation=cv2.INTER_LINEAR) for field in fields]
        return full[0][:height, :width], full[1][:height, :width]

    def _block(self, view: GroundView, regions: Field, shapes: Field) -> Radiance:
        gusts = np.clip(1.0 + np.float32(0.26) * regions[..., 3] + np.float32(0.08) * shapes[..., 0], 0.4, 1.9)
        if self._kind == "sea":
            assert self._sea is not None
            water = self._sea.radiance(
                view, np.array(self._environment.ground_reflectance_rgb, dtype=np.float32), gusts
            )
            draw_ships(water, view, self._ships, self._light)
            return water
        offshore_m = None
        if self._coast is not None:
            offshore_m = self._coast.offshore_m(view, regions, shapes)
            if offshore_m.min() > self._coast.reach_m:
                return self._water(view, offshore_m, gusts)
        land = self._land(view, regions, shapes, offshore_m)
        if self._coast is None or offshore_m is None or offshore_m.max() < -self._coast.reach_m:
            return land
        wet = self._coast.wet_share(view, offshore_m)[..., None]
        result: Radiance = land + wet * (self._water(view, offshore_m, gusts) - land)
        return result

    def _water(self, view: GroundView, offshore_m: Field, gusts: Field) -> Radiance:
        assert self._coast is not None and self._sea is not None
        body = self._coast.body_rgb(offshore_m, np.array(MEAN_REFLECTANCE["sea"], dtype=np.float32))
        water = self._sea.radiance(view, body, gusts)
        surf = self._coast.surf_share(view, offshore_m)[..., None]
        foam = np.float32(0.45) * (self._light.level_lux / np.pi).astype(np.float32)
        result: Radiance = water + surf * (foam - water)
        return result

    def _land(self, view: GroundView, regions: Field, shapes: Field, offshore_m: Field | None) -> Radiance:
        kind = _LAND_OF[self._kind]
        region = (regions[..., 0] > 0).astype(np.intp) + 2 * (regions[..., 1] > 0) + 4 * (regions[..., 2] > 0)
        cosine, sine, shift_u, shift_v = self._turns[:, region]
        moved = np.float32(_WARP_M) * shapes[..., :2]
        turn = cosine, sine
        shift = (
            shift_u + cosine * moved[..., 0] + sine * moved[..., 1],
            shift_v + cosine * moved[..., 1] - sine * moved[..., 0],
        )
        seen = view.average(land_tile(kind), turn, shift)
        if kind == "town":
            edge = regions[..., 0] + np.float32(0.25) * regions[..., 3] + np.float32(0.2) * shapes[..., 0]
            outskirts = edge < np.float32(_TOWN_ABOVE)
            if outskirts.any():
                seen = np.where(outskirts[..., None], view.average(land_tile("fields"), turn, shift), seen)
        tint = np.array(self._environment.ground_reflectance_rgb) / land_tile(kind).mean[:3]
        brightness = np.clip(1.0 + np.float32(_BRIGHTNESS) * regions[..., 3], 0.5, 1.6)
        if float(view.across_m.min()) < _GRAIN_BELOW_M:
            near = np.clip(2.0 - 2.0 * view.across_m / np.float32(_GRAIN_BELOW_M), 0.0, 1.0)
            grain = near * view.average(_grain())[..., 0]
            brightness = brightness * np.maximum(1.0 + np.float32(_GRAIN) * grain, 0.2)
        albedo = seen[..., :3] * tint.astype(np.float32) * brightness[..., None]
        if kind == "fields":
            # A hedge hides ground over a length of its height over the sine of the ray's elevation.
            behind = np.exp(np.float32(-_HEDGE_M / _HEDGE_SPACING_M) / view.sine)[..., None]
            albedo = _HEDGE_SIDE + behind * (albedo - _HEDGE_SIDE)
        if self._coast is not None and offshore_m is not None:
            albedo = self._coast.with_beach(albedo, view, offshore_m)
        result: Radiance = albedo * self._lit(shapes[..., 2])
        if self._lamps_on > 0:
            result += (self._lamps_on * seen[..., 3])[..., None] * _LAMP_CD_M2
        return result

    def _beam_cosine(self, slopes: Field) -> Field:
        """(H, W) cosine between the beam and the normal of terrain with (H, W, 2) slopes of unit variance."""
        relief = np.float32(_RELIEF.get(self._kind, 0.0))
        to_sun = self._light.beam_direction.astype(np.float32)
        east, north = relief * slopes[..., 0], relief * slopes[..., 1]
        facing = (to_sun[2] - east * to_sun[0] - north * to_sun[1]) / np.sqrt(1.0 + east * east + north * north)
        result: Field = np.maximum(facing, np.float32(0.0))
        return result

    def _lit(self, facing: Field) -> Radiance:
        """(H, W, 3) or (3,) reflected radiance of a white surface that follows the terrain."""
        light = self._light
        if self._kind not in _RELIEF or light.beam_direction[2] <= 0:
            return (light.level_lux / np.pi).astype(np.float32)
        sky = (light.sky_lux / np.pi).astype(np.float32)
        result: Radiance = facing[..., None] * (light.beam_lux / np.pi).astype(np.float32) + sky
        return result

    @cached_property
    def _lamps_on(self) -> np.float32:
        """0 by day, 1 by night."""
        daylight_lux = float(self._light.level_lux.mean())
        return np.float32(np.clip(2.0 * (1.0 - daylight_lux / _LAMPS_ON_LUX), 0.0, 1.0))


def _square_centers(directions: NDArray[np.float32], every: int) -> NDArray[np.float32]:
    """(H / every, W / every, 3) directions at the centres of squares of rays, rounded up; `every` is even."""
    for axis in (0, 1):
        last = directions.shape[axis] - 1
        first = np.arange(every // 2 - 1, last + every // 2, every)
        before, behind = (directions.take(np.minimum(place, last), axis=axis) for place in (first, first + 1))
        directions = (before + behind) / 2
    return directions


_COAST_SEED = 6
_SAND = np.array([0.30, 0.255, 0.185], dtype=np.float32)
_LARGE_BAYS_M, _SMALL_BAYS_M, _ROUGHNESS_M = 900.0, 260.0, 22.0
_BEACH_M = 45.0
_BED_SLOPE = 0.012
# Diffuse attenuation, down and up again, of clear coastal water. [1/m]
_ATTENUATION_PER_M = np.array([0.75, 0.17, 0.14], dtype=np.float32)
_SURF_M = 110.0
_BREAKER_SPACING_M = 38.0


@lru_cache(maxsize=1)
def _ragged() -> MipTile:
    """Roughness of the shoreline and of breakers; each of unit variance."""
    made = [power_noise(_COAST_SEED, name, 512, 1.5, 12.0) for name in ("shore", "breakers")]
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
        rough = _ragged().sample(
            view.x_m + self._shift_m[0], view.y_m + self._shift_m[1], np.sqrt(view.across_m * view.along_m)
        )
        bays = np.float32(_LARGE_BAYS_M) * regions[..., 1] + np.float32(_SMALL_BAYS_M) * shapes[..., 0]
        result: Field = straight - np.float32(self._start_m) + bays + np.float32(_ROUGHNESS_M) * rough[..., 0]
        return result

    def wet_share(self, view: GroundView, offshore_m: Field) -> Field:
        """(H, W) share of each piece that is under water."""
        return _rise(offshore_m, np.float32(0.0), self._blur_m(view))

    def with_beach(self, albedo: Field, view: GroundView, offshore_m: Field) -> Field:
        """(H, W, 3) reflectance of the land with sand along the water."""
        breadth_m = np.float32(_BEACH_M * self._breadth)
        sandy = _rise(offshore_m, -breadth_m, np.maximum(self._blur_m(view), np.float32(8.0)))[..., None]
        # Wet sand is darker.
        wet = _rise(offshore_m, np.float32(-7.0), np.maximum(self._blur_m(view), np.float32(5.0)))[..., None]
        result: Field = albedo + sandy * (_SAND * (1.0 - np.float32(0.45) * wet) - albedo)
        return result

    def body_rgb(self, offshore_m: Field, deep_rgb: Field) -> Field:
        """(H, W, 3) diffuse reflectance of the water: the bed shows through where it is shallow."""
        depth_m = np.float32(_BED_SLOPE) * np.maximum(offshore_m, 0.0)
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
