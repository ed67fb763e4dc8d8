"""Land and sea below the camera as a function of direction, and the coast between them."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.types.environment import CloudLayer, Environment, GroundKind
from drogue_models.frozen_model import ReflectanceRgb
from scenes.clouds.cloud_layers import THIN_KINDS, cloud_share
from scenes.clouds.ray_march import upsample
from scenes.ground.airfield import Airfield
from scenes.ground.coast import Coast
from scenes.ground.land_cover import (
    EDGE_REACH,
    LOW_M,
    LandCover,
    Regions,
    enlarged,
    gradient_tile,
    moved_tile,
    region_tile,
)
from scenes.ground.sea import GroundLight, Sea, draw_ships, fresnel, sample_ships
from scenes.ground.terrain import Seen, Terrain, highest_sine
from scenes.ground_view import Field, GroundView, ground_view, pixel_angle_rad, view_at
from scenes.sky.photometry import Radiance

MEAN_REFLECTANCE: dict[GroundKind, ReflectanceRgb] = {
    "sea": (0.006, 0.022, 0.030),  # of the water body; the surface also mirrors the sky
    "forest": (0.036, 0.051, 0.021),
    "fields": (0.096, 0.102, 0.050),
    "dry": (0.207, 0.155, 0.107),
    "coast": (0.096, 0.102, 0.050),  # of its land
    "town": (0.112, 0.106, 0.080),
    "mountains": (0.036, 0.048, 0.024),  # of its woods
    "snow": (0.080, 0.084, 0.050),  # of the fields under the snow
    "airfield": (0.090, 0.102, 0.046),
}

# Large images compute slowly varying fields at every so many pixels.
_STEP_PX, _HILLY_STEP_PX, _MANY_RAYS = 8, 4, 60_000
# Rays of a block see pieces of similar size, so that one or two mipmap levels serve it.
_BLOCK_ROWS, _BLOCK_COLUMNS = 32, 320
# Ground with less contrast than this behind the haze shows no detail.
_HIDDEN = 0.004
# Ground with less contrast than this is computed at every other pixel down and across.
_HAZY, _HAZY_STEP_PX = 0.5, 2
# Rays farther apart than this see no hills.
_COARSE_RAD = 0.012
# No trees or houses closer than this under a low camera.
_CLEARING_M, _CLEARING_RAGGED_M, _CLEARING_EDGE_M = 330.0, 70.0, 8.0
_TALLEST_M = 30.0
# Nothing stands so close to the water.
_BARE_SHORE_M = 20.0
_MEADOW = np.array([0.070, 0.090, 0.038], dtype=np.float32)
# Illuminance below which towns switch on their lamps.
_LAMPS_ON_LUX = 40.0
# Beam left by clouds below which the ground has no shadows of clouds.
_OVERCAST = 0.03


class Ground:
    """Land or sea of one environment under its light.

    Args:
        environment: gives kind, colour and seed of the ground, altitude, wind, and the clouds that shade it.
        light: on the ground, the mean under clouds and gaps.
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
        self._cover = LandCover(environment, rng, light.beam_direction)
        wind_rad = float(rng.uniform(-np.pi, np.pi))
        swell_rad, swell = frame_generator(environment.ground_texture_seed, 0, "swell").uniform(
            (-np.pi, 0.0), (np.pi, 1.0)
        )
        is_wet = self._kind in ("sea", "coast")
        self._sea = Sea(light, environment.wind_speed_m_s, wind_rad, swell_rad, swell) if is_wet else None
        self._coast = Coast(rng, environment.altitude_m) if self._kind == "coast" else None
        self._ships = sample_ships(rng, environment.altitude_m) if self._kind == "sea" else ()
        self._airfield = Airfield(rng) if self._kind == "airfield" else None
        level = self._airfield or self._coast
        kept = None if level is None else level.hill_share
        self._terrain = Terrain(self._kind, environment.altitude_m, self._shift_m, self._is_round, kept)
        self._has_cover = _has_cover(environment)

    @property
    def _is_round(self) -> bool:
        return self._environment.sky_model == "scattering"

    def seen(self, directions: NDArray[np.float32]) -> Seen | None:
        """Where rays meet hills, trees and houses; None where the ground is level, or rays are too far apart.

        Args:
            directions: (H, W, 3) unit vectors in world axes.
        """
        angle_rad = pixel_angle_rad(directions)
        if self._terrain.is_level or angle_rad > _COARSE_RAD:
            return None
        cover = self._cover_m if self._has_cover else None
        return self._terrain.seen(directions, angle_rad, self._environment.camera_offset_m, cover)

    def radiance(
        self, directions: NDArray[np.float32], uncovered: Field | None = None, seen: Seen | None = None
    ) -> Radiance:
        """Radiance of the ground without air in front of it.

        Args:
            directions: (H, W, 3) unit vectors in world axes, those above the horizon see the ground's farthest edge.
            uncovered: (H, W) share that clouds do not hide; completely hidden ground is not computed.
            seen: result of `seen` for the same directions, if known.

        Returns:
            (H, W, 3) radiance. [cd/m2]
        """
        angle_rad = pixel_angle_rad(directions)
        total = np.empty(directions.shape, dtype=np.float32)
        if seen is None:
            seen = self.seen(directions)
        many = directions.shape[0] * directions.shape[1] >= _MANY_RAYS
        every = (_STEP_PX if self._terrain.is_level else _HILLY_STEP_PX) if many else 1
        smooth = self._smooth_fields(directions, every, angle_rad, seen)
        falls = -directions[..., 2]
        if seen is not None:
            falls = np.maximum(falls, np.float32(self._environment.altitude_m) / seen.distance_m)
        clear = self._clear(np.minimum(falls.max(axis=1), np.float32(1.0)))
        for first in range(0, directions.shape[0], _BLOCK_ROWS):
            rows = slice(first, first + _BLOCK_ROWS)
            if clear[rows].max() < _HIDDEN:
                total[rows] = self._mean_radiance
                continue
            step = _HAZY_STEP_PX if many and clear[rows].max() < _HAZY else 1
            for left in range(0, directions.shape[1], _BLOCK_COLUMNS):
                block = rows, slice(left, left + _BLOCK_COLUMNS)
                if seen is not None and not seen.share[block].any():
                    total[block] = self._mean_radiance
                    continue
                if uncovered is not None and uncovered[block].max() < _HIDDEN:
                    total[block] = self._mean_radiance
                    continue
                # One more ray than the block has, for interpolation.
                chosen = tuple(slice(part.start, part.stop + step - 1, step) for part in block)
                part = None if seen is None else seen.part(chosen)
                view = self._view(directions[chosen], step * angle_rad, part)
                found = self._block(view, smooth.part(chosen), part)
                height, width = total[block].shape[:2]
                total[block] = found if step == 1 else upsample(found, step, (height, width))
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

    def _view(self, directions: NDArray[np.float32], angle_rad: float, seen: Seen | None) -> GroundView:
        environment = self._environment
        if seen is not None:
            return view_at(directions, seen.distance_m, seen.sine, angle_rad, environment.camera_offset_m)
        return ground_view(directions, environment.altitude_m, angle_rad, environment.camera_offset_m, self._is_round)

    @property
    def _mean_radiance(self) -> NDArray[np.float32]:
        reflected = np.array(self._environment.ground_reflectance_rgb) * self._light.level_lux / np.pi
        return reflected.astype(np.float32)

    def _smooth_fields(
        self, directions: NDArray[np.float32], every: int, angle_rad: float, seen: Seen | None
    ) -> Regions:
        """`Regions` of all pixels, computed at every so many of them."""
        if every == 1:
            return self._regions(self._view(directions, angle_rad, seen))
        shape = directions.shape[0], directions.shape[1]
        directions = _square_centers(directions, every)
        if seen is not None:
            near = np.stack([1.0 / seen.distance_m, seen.sine, seen.share, seen.above_m], axis=-1)
            near = _square_centers(near, every)
            seen = Seen(1.0 / near[..., 0], near[..., 1], near[..., 2], near[..., 3])
        regions = self._regions(self._view(directions, every * angle_rad, seen))
        return Regions(**{name: enlarged(field, every, shape) for name, field in vars(regions).items()})

    def _regions(self, view: GroundView) -> Regions:
        width_m = np.sqrt(view.across_m * view.along_m)
        x_m, y_m = view.x_m + self._shift_m[0], view.y_m + self._shift_m[1]
        if self._terrain.is_level:
            above_m, slopes = np.zeros_like(x_m), np.zeros((*x_m.shape, 2), dtype=np.float32)
        else:
            above_m, slopes = self._terrain.heights(view.x_m, view.y_m, width_m)
        return Regions(
            signs=region_tile().sample(x_m, y_m, width_m),
            per_m=gradient_tile().sample(x_m, y_m, width_m),
            moved=moved_tile().sample(x_m, y_m, width_m),
            above_m=above_m,
            slopes=slopes,
            sunny=self._sunny(view.x_m, view.y_m),
        )

    def _sunny(self, x_m: Field, y_m: Field) -> Field:
        """(H, W) share of the beam that clouds leave at places on the ground, over its mean."""
        sunny = np.ones_like(x_m)
        to_beam = self._light.beam_direction
        if to_beam[2] <= 0.05:
            return sunny
        for layer in self._environment.clouds:
            if layer.kind in THIN_KINDS or _open_share(layer) < _OVERCAST:
                continue
            middle_m = layer.height_above_camera_m + layer.thickness_m * (0.25 if layer.is_above else -0.75)
            way_m = (middle_m + self._environment.altitude_m) / to_beam[2]
            if way_m <= 0:
                continue
            inside = cloud_share(layer, x_m + np.float32(way_m * to_beam[0]), y_m + np.float32(way_m * to_beam[1]))
            through = 1.0 - inside * np.float32(1.0 - np.exp(-layer.optical_depth))
            sunny *= through / np.float32(_open_share(layer))
        return np.minimum(sunny, np.float32(2.5))

    def _cover_m(self, x_m: Field, y_m: Field, width_m: Field) -> Field:
        """(H, W) height of trees and houses. [m]"""
        ones = np.ones_like(x_m)
        view = GroundView(x_m, y_m, ones, np.zeros_like(x_m), ones, width_m, width_m, 1)
        # Layouts vary slowly.
        places = x_m + self._shift_m[0], y_m + self._shift_m[1], np.maximum(width_m, np.float32(60.0))
        signs, moved = region_tile().sample(*places), moved_tile().sample(*places)
        regions = Regions(signs, gradient_tile().sample(*places), moved, ones, ones[..., None], ones)
        trees_m, houses_m = np.moveaxis(self._cover.cover(view, regions, self._cover.axes(regions))[..., :2], -1, 0)
        # Crowns differ.
        trees_m = np.maximum(trees_m - np.float32(2.0), 0.0) * (1.1 + 0.16 * self._cover.crowns(view))
        cover = np.minimum(np.maximum(trees_m, houses_m), np.float32(_TALLEST_M))
        if self._airfield is not None:
            return self._airfield.height_m(cover, x_m, y_m)
        if self._coast is not None:
            cover[self._coast.offshore_m(view, signs, moved) > -_BARE_SHORE_M] = 0.0
        result: Field = cover * (1.0 - self._clearing(view))
        return result

    def _clearing(self, view: GroundView) -> Field:
        """(H, W) share of meadow around the place over which a low camera flies."""
        edge_m = np.float32(_CLEARING_M) + np.float32(_CLEARING_RAGGED_M) * self._cover.patches(view)
        away_m = np.hypot(view.x_m, view.y_m)
        share: Field = np.clip((edge_m - away_m) / np.float32(_CLEARING_EDGE_M) + 1.0, 0.0, 1.0)
        return share

    def _block(self, view: GroundView, regions: Regions, seen: Seen | None) -> Radiance:
        gusts = np.clip(
            1.0 + np.float32(0.26) * regions.signs[..., 3] + np.float32(0.08) * regions.moved[..., 0], 0.4, 1.9
        )
        if self._kind == "sea":
            assert self._sea is not None
            water = self._sea.radiance(
                view, np.array(self._environment.ground_reflectance_rgb, dtype=np.float32), gusts
            )
            draw_ships(water, view, self._ships, self._light)
            return water
        offshore_m = None
        if self._coast is not None:
            offshore_m = self._coast.offshore_m(view, regions.signs, regions.moved)
            if offshore_m.min() > self._coast.reach_m:
                return self._water(view, offshore_m, gusts)
        land = self._land(view, regions, offshore_m, seen)
        if self._coast is None or offshore_m is None or offshore_m.max() < -self._coast.reach_m:
            return land
        wet = self._coast.wet_share(view, offshore_m)[..., None]
        result: Radiance = land + wet * (self._water(view, offshore_m, gusts) - land)
        return result

    def _water(self, view: GroundView, offshore_m: Field, gusts: Field) -> Radiance:
        assert self._coast is not None and self._sea is not None
        body = self._coast.body_rgb(view, offshore_m, np.array(MEAN_REFLECTANCE["sea"], dtype=np.float32))
        water = self._sea.radiance(view, body, gusts)
        surf = self._coast.surf_share(view, offshore_m)[..., None]
        foam = np.float32(0.45) * (self._light.level_lux / np.pi).astype(np.float32)
        result: Radiance = water + surf * (foam - water)
        return result

    def _land(self, view: GroundView, regions: Regions, offshore_m: Field | None, seen: Seen | None) -> Radiance:
        light = self._light
        albedo, sunlit, lamps = self._cover.seen(view, regions, self._lamps_on)
        shine = None
        if self._airfield is not None:
            albedo, sunlit = self._airfield.drawn_on(albedo, sunlit, view, self._cover.detail(view))
        elif self._has_cover and self._kind != "snow":
            # Under a low camera there is no wood.
            share = self._clearing(view)
            dark = np.clip(2.0 - albedo.mean(axis=-1) / np.float32(0.035), 0.0, 1.0) if self._kind != "town" else share
            meadow = _MEADOW * self._cover.detail(view)[..., None]
            albedo = albedo + (share * dark)[..., None] * (meadow - albedo)
            sunlit = sunlit + share * (1.0 - sunlit)
        if self._coast is not None and offshore_m is not None:
            albedo = self._coast.with_beach(albedo, view, offshore_m)
            # Wet sand mirrors some of the sky.
            shine = np.float32(0.6) * self._coast.wetness(view, offshore_m) * fresnel(np.clip(view.sine, 0.03, 1.0))
        facing = self._beam_cosine(regions.slopes) * regions.sunny * sunlit
        sky = (light.sky_lux / np.pi).astype(np.float32)
        if self._has_cover and seen is not None:
            side = self._side_share(view, seen)
            facing = self._on_sides(facing, view, side, regions.sunny)
            sky = sky * (1.0 - np.float32(0.45) * side[..., None])
            if self._airfield is not None:  # its halls have walls of their own
                reach_m = np.float32(EDGE_REACH) * seen.distance_m
                side = np.where(self._airfield.has_hall(view.x_m, view.y_m, reach_m), np.float32(0.0), side)
            if side.any():
                albedo = albedo + side[..., None] * (self._cover.sides(view, regions, seen) - albedo)
        result: Radiance = albedo * (facing[..., None] * (light.beam_lux / np.pi).astype(np.float32) + sky)
        if shine is not None:
            result += shine[..., None].astype(np.float32) * (light.sky_lux / np.pi).astype(np.float32)
        if lamps is not None:
            result += lamps
        return result

    def _side_share(self, view: GroundView, seen: Seen) -> Field:
        """(H, W) share of what is seen that is the side of a tree or house."""
        level_sine = np.float32(self._environment.altitude_m) / np.maximum(seen.distance_m, np.float32(1.0))
        side: Field = np.clip(np.float32(1.5) - np.float32(0.5) * 5.0 * level_sine / view.sine, 0.0, 1.0)
        result: Field = side * np.clip(
            view.sine / np.clip(np.float32(8.0) * level_sine, 0.02, 0.6) - np.float32(0.5), 0.0, 1.0
        )
        return result

    def _on_sides(self, facing: Field, view: GroundView, side: Field, sunny: Field) -> Field:
        """(H, W) cosine of the beam on the sides of trees and houses, and elsewhere."""
        to_beam = self._light.beam_direction.astype(np.float32)
        towards = np.maximum(-(view.away_x * to_beam[0] + view.away_y * to_beam[1]), np.float32(0.0))
        result: Field = facing + side * (np.float32(0.15) * facing + np.float32(0.75) * towards * sunny - facing)
        return result

    def _beam_cosine(self, slopes: Field) -> Field:
        """(H, W) cosine between the beam and the normal of terrain with (H, W, 2) slopes."""
        to_sun = self._light.beam_direction.astype(np.float32)
        if to_sun[2] <= 0:
            return np.zeros(slopes.shape[:2], dtype=np.float32)
        east, north = slopes[..., 0], slopes[..., 1]
        facing = (to_sun[2] - east * to_sun[0] - north * to_sun[1]) / np.sqrt(1.0 + east * east + north * north)
        result: Field = np.maximum(facing, np.float32(0.0))
        return result

    @cached_property
    def _lamps_on(self) -> float:
        """0 by day, 1 by night."""
        daylight_lux = float(self._light.level_lux.mean())
        return float(np.clip(2.0 * (1.0 - daylight_lux / _LAMPS_ON_LUX), 0.0, 1.0))


def highest_land_sine(environment: Environment) -> float:
    """Sine of the elevation above which no land rises."""
    cover_m = _TALLEST_M if _has_cover(environment) else 0.0
    return highest_sine(environment.ground, environment.altitude_m, cover_m)


def _has_cover(environment: Environment) -> bool:
    """Whether trees and houses stand up before the camera.

    None do on dry land: the heights of its textures are those of hummocks, which are seen by their shading.
    """
    return environment.ground not in ("sea", "dry") and environment.altitude_m < LOW_M


def _open_share(layer: CloudLayer) -> float:
    """Mean share of the beam that passes a layer."""
    return 1.0 - layer.cover_fraction * (1.0 - float(np.exp(-layer.optical_depth)))


def _square_centers(directions: Field, every: int) -> Field:
    """(H / every, W / every, C) directions or values at centres of squares of rays, rounded up; `every` is even."""
    for axis in (0, 1):
        last = directions.shape[axis] - 1
        first = np.arange(every // 2 - 1, last + every // 2, every)
        before, behind = (directions.take(np.minimum(place, last), axis=axis) for place in (first, first + 1))
        directions = (before + behind) / 2
    return directions
