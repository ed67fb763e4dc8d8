"""Radiance of the environment by direction: sky, sun, clouds, haze and ground.

The same function is the background of the images and, as a map, the light on the drogue.
"""

from __future__ import annotations

from copy import copy
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.environment import CloudLayer, Environment
from scenes.air_light import HORIZON_ELEVATION_RAD, LayeredAir
from scenes.atmosphere.scattering_sky import ScatteringAir, ScatteringSky
from scenes.clouds.cloud_layers import CloudLayerRenderer
from scenes.ground.ground_radiance import Ground, highest_land_sine
from scenes.ground.sea import GroundLight
from scenes.ground.terrain import Seen
from scenes.ground_view import EARTH_M, pixel_angle_rad
from scenes.sky.clear_sky import ClearSky
from scenes.sky.equirectangular_sky import load_map
from scenes.sky.photometry import SUN_RADIUS_RAD, SUN_SOLID_ANGLE_SR, Radiance

_LIGHT_MAP_HEIGHT_PX = 128
# Pictures of so many rays do not march all of them through clouds.
_MANY_RAYS = 60_000
# Rays across the disc of sun or moon that tell how much of it is behind land.
_DISC_RAYS = 12


class EnvironmentRadiance:
    """Radiance of one environment by direction.

    Attributes:
        environment: its description.
        sky: clear sky with sun and moon.
        air: light between the layers.
    """

    def __init__(self, environment: Environment) -> None:
        self.environment = environment
        if environment.sky_model == "scattering":
            self.sky: ClearSky = ScatteringSky(environment)
            self.air: LayeredAir = ScatteringAir(environment, self.sky)
        else:
            self.sky = ClearSky(environment)
            self.air = LayeredAir(environment, self.sky)

    def moved_to(self, environment: Environment) -> EnvironmentRadiance:
        """The same environment for a camera elsewhere.

        Ground and clouds move, and with them the transmitted share of the sun's beam; the light map stays the same.

        Args:
            environment: the same environment with another `camera_offset_m`.
        """
        # Computed here, so that the result does not depend on the order of calls.
        own = {"ground": self.ground.moved_to(environment), "light_map": self.light_map}
        moved = copy(self)
        moved.environment, moved.air = environment, self.air.moved_to(environment)
        vars(moved).pop("beam_illuminance_lux", None)
        vars(moved).update(own)
        return moved

    def clear_radiance(self, directions: NDArray[np.floating[Any]]) -> tuple[Radiance, Radiance]:
        """The slowly varying parts: clear sky, and infinitely deep air at the same azimuth.

        Args:
            directions: (..., 3) unit vectors in world axes.

        Returns:
            Two (..., 3) radiances. [cd/m2]
        """
        return self.air.sky_and_air(directions)

    def _above_ground(self, directions: NDArray[np.float32]) -> Radiance:
        """What ground mirrors: `radiance` without hills, along (H, W, 3) directions above the horizon."""
        return self._layered(directions, *self.clear_radiance(directions), has_ground=False)

    def radiance(
        self, directions: NDArray[np.float32], sky: Radiance | None = None, horizon: Radiance | None = None
    ) -> Radiance:
        """Radiance of everything except the discs of sun and moon.

        Args:
            directions: (H, W, 3) unit vectors in world axes.
            sky, horizon: (H, W, 3) results of `clear_radiance` for the same directions, or None.

        Returns:
            (H, W, 3) luminance-scaled linear Rec. 709. [cd/m2]
        """
        if sky is None or horizon is None:
            sky, horizon = self.clear_radiance(directions)
        return self._layered(directions, sky, horizon, has_ground=True)

    def _layered(self, directions: NDArray[np.float32], sky: Radiance, horizon: Radiance, has_ground: bool) -> Radiance:
        total = sky.copy()
        layers = sorted(self.environment.clouds, key=lambda layer: -abs(layer.height_above_camera_m))
        lowest = self.air.round_horizon_sine or 0.0
        parts = [
            _rows_with(directions[..., 2] * np.sign(layer.height_above_camera_m) > (lowest if layer.is_above else 0.0))
            for layer in layers
        ]
        pictures, behind = [], sky.copy()
        for layer, part in zip(layers, parts, strict=True):
            # What is behind a layer below the camera is known later.
            known = behind[part] if layer.is_above else None
            pictures.append(self._cloud(layer, directions[part], horizon[part], known))
            if layer.is_above:
                behind[part] = pictures[-1][..., :3] + (1.0 - pictures[-1][..., 3:]) * behind[part]
        rows = _rows_with(directions[..., 2] < self._ground_below(directions))
        uncovered = np.ones(directions.shape[:2], dtype=np.float32)
        for layer, part, picture in zip(layers, parts, pictures, strict=True):
            if not layer.is_above:
                uncovered[part] *= 1.0 - picture[..., 3]
        if has_ground:
            self._put_ground(total[rows], directions[rows], horizon[rows], uncovered[rows])
        for part, picture in zip(parts, pictures, strict=True):
            total[part] *= 1.0 - picture[..., 3:]
            total[part] += picture[..., :3]
        if self.environment.mist is not None:
            self.air.behind_mist(total, directions)
        return total

    def add_discs(self, radiance: Radiance, directions: NDArray[np.float32]) -> None:
        """Add sun and moon behind land, cloud and mist, in place, to (H, W, 3) radiance along directions."""
        self.sky.add_discs(radiance, directions, self._share_above_ground(directions), self.air.open_share)

    def _share_above_ground(self, directions: NDArray[np.float32]) -> float | NDArray[np.float64]:
        """(H, W) share of each pixel that ground leaves open, or 1 if no disc of sun or moon is near ground."""
        ground_below = self._ground_below(directions)
        if self.sky.lowest_disc_sine >= ground_below:
            return 1.0
        # The rows of `_layered`, so that disc and land share their outline.
        rows = _rows_with(directions[..., 2] < ground_below)
        if not self.sky.shows_disc(directions[rows]):
            return 1.0
        shares = np.ones(directions.shape[:2])
        shares[rows] -= self._ground_share(directions[rows])[1]
        return shares

    @property
    def beam_direction(self) -> NDArray[np.float64]:
        """(3,) unit vector in world axes towards the light that casts shadows: the sun, or at night the moon."""
        return self.sky.beam.direction

    @cached_property
    def beam_illuminance_lux(self) -> NDArray[np.float64]:
        """(3,) illuminance at the camera of a plane that faces the beam, past land, air, cloud and mist. [lux]"""
        result: NDArray[np.float64] = self.air.beam_illuminance_lux * self._beam_above_land()
        return result

    def _beam_above_land(self) -> float:
        """Share of the disc of sun or moon that hills, trees and houses leave open."""
        to_beam = self.beam_direction
        is_high = to_beam[2] - SUN_RADIUS_RAD > highest_land_sine(self.environment)
        if is_high or self.air.beam_illuminance_lux.max() <= 0.0:
            return 1.0
        place = (np.arange(_DISC_RAYS) + 0.5) * (2.0 / _DISC_RAYS) - 1.0
        across, up = np.meshgrid(place, -place)
        right = np.cross(to_beam, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        offset = across[..., None] * right + up[..., None] * np.cross(right, to_beam)
        rays = to_beam + SUN_RADIUS_RAD * offset
        # Refraction lifts what has set; how much of the disc has set on a level horizon, the beam knows.
        lowest = (self.air.round_horizon_sine or 0.0) + SUN_RADIUS_RAD / _DISC_RAYS
        rays[..., 2] = np.maximum(rays[..., 2], lowest)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        met = self.ground.seen(rays.astype(np.float32))
        return 1.0 if met is None else 1.0 - float(met.share[np.hypot(across, up) < 1.0].mean(dtype=np.float64))

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient of air and mist around the camera. [1/m]"""
        mist = self.environment.mist
        return self.air.extinction_per_m + (mist.extinction_per_m if mist is not None else 0.0)

    def airlight(self, directions: NDArray[np.floating[Any]]) -> Radiance:
        """Radiance of infinitely deep air and mist, into which distant objects fade.

        Args:
            directions: (..., 3) unit vectors in world axes.

        Returns:
            (..., 3) radiance. [cd/m2]
        """
        air = self.air.airlight(directions)
        if self.environment.mist is None:
            return air
        droplets = self.environment.mist.extinction_per_m / self.extinction_per_m
        result: Radiance = air + np.float32(droplets) * (self.air.mist_light(directions) - air)
        return result

    @property
    def ground_illuminance_lux(self) -> NDArray[np.float64]:
        """(3,) illuminance of level ground by everything above it, by channel. [lux]"""
        return self.air.ground_illuminance_lux

    @cached_property
    def ground(self) -> Ground:
        """Land or sea, in the light that reaches it."""
        beam_lux, to_beam = self.air.ground_beam_lux, self.beam_direction
        sky_lux = np.maximum(self.ground_illuminance_lux - beam_lux * max(float(to_beam[2]), 0.0), 0.0)
        light = GroundLight(sky_lux=sky_lux, beam_direction=to_beam, beam_lux=beam_lux, sky_radiance=self._above_ground)
        clear = self.air.ground_clear if isinstance(self.air, ScatteringAir) else None
        return Ground(self.environment, light, clear)

    def _ground_below(self, directions: NDArray[np.float32]) -> float:
        """Vertical component below which pixels show some ground."""
        horizon = self.air.round_horizon_sine
        level = 0.0 if horizon is None else min(horizon + pixel_angle_rad(directions), 0.0)
        return max(level, highest_land_sine(self.environment))

    def _put_ground(
        self, total: Radiance, directions: NDArray[np.float32], horizon: Radiance, uncovered: NDArray[np.float32]
    ) -> None:
        """Cover the lower half, in place, with ground that fades into the horizon; `uncovered` is its visible share."""
        if directions.size == 0:
            return
        met, share = self._ground_share(directions)
        level = None if met is None else self._level_rays(directions, met.distance_m)
        seen = self.air.before_ground(self.ground.radiance(directions, uncovered, met), directions, horizon, level)
        whole = (share == 1.0).all(axis=1)
        # Whole rows at once where possible: a masked copy takes as long as everything before.
        total[whole] = seen[whole]
        np.copyto(total, seen, where=((share == 1.0) & ~whole[:, None])[..., None])
        mixed = (share > 0.0) & (share < 1.0)
        if mixed.any():
            total[mixed] += share[mixed][:, None] * (seen[mixed] - total[mixed])

    def _ground_share(self, directions: NDArray[np.float32]) -> tuple[Seen | None, NDArray[np.float32]]:
        """Where (H, W, 3) directions meet hills, as `Ground.seen`, and (H, W) share of the pixels that is ground."""
        met = self.ground.seen(directions)
        share = self.air.horizon_share(directions, pixel_angle_rad(directions))
        return met, share if met is None else np.maximum(share, met.share)

    def _level_rays(self, directions: NDArray[np.float32], distance_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """(H, W, 3) rays in whose directions level ground is (H, W) as far away; they have as much air before it."""
        altitude_m = self.environment.altitude_m
        falls = np.float32(altitude_m) / np.maximum(distance_m, np.float32(altitude_m))
        if self.air.round_horizon_sine is not None:
            falls = falls + distance_m / np.float32(2.0 * EARTH_M)
        level = directions.copy()
        level[..., 2] = -np.minimum(falls, np.float32(1.0))
        return level

    def _cloud(
        self, layer: CloudLayer, directions: NDArray[np.float32], air: Radiance, behind: Radiance | None
    ) -> Radiance:
        """(H, W, 4) light of a cloud layer behind haze times its opacity, and its opacity.

        Args:
            layer: its description.
            directions: (H, W, 3) unit vectors in world axes.
            air: (H, W, 3) the second result of `sky_and_air`. [cd/m2]
            behind: as for `CloudLayerRenderer.picture`.
        """
        if directions.size == 0:
            return np.zeros((*directions.shape[:2], 4), dtype=np.float32)
        light, offset_m = self.air.light_on(layer), self.environment.camera_offset_m
        renderer = CloudLayerRenderer(layer, light, offset_m, self.air.round_horizon_sine)
        rays, behind_air = directions.reshape(-1, 3), air.reshape(-1, 3)

        def through_air(seen: Radiance, distance_m: NDArray[np.float32], indices: NDArray[np.int64]) -> Radiance:
            return self.air.before_cloud(seen, rays[indices], distance_m, behind_air[indices])

        if directions.shape[0] * directions.shape[1] >= _MANY_RAYS:
            return renderer.picture(directions, through_air, behind)
        seen = renderer.view(directions, pixel_angle_rad(directions))
        lit = self.air.before_cloud(seen.radiance, directions, seen.distance_m, air)
        layered: Radiance = np.concatenate([lit * seen.opacity[..., None], seen.opacity[..., None]], axis=-1)
        return layered

    @cached_property
    def light_map(self) -> Radiance:
        """(128, 256, 3) equirectangular map without the sun's disc; row 0 is the zenith, column 0 is east. [cd/m2]

        Columns go from east towards north; texel centres lie half a texel inside.
        """
        height, width = _LIGHT_MAP_HEIGHT_PX, 2 * _LIGHT_MAP_HEIGHT_PX
        polar = (np.arange(height) + 0.5) * np.pi / height
        azimuth = (np.arange(width) + 0.5) * 2 * np.pi / width
        p, a = np.meshgrid(polar, azimuth, indexing="ij")
        directions = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
        return self.radiance(directions.astype(np.float32))

    def plate_illuminance_lux(self, normal: NDArray[np.float64]) -> NDArray[np.float64]:
        """(3,) illuminance of a plate by sun, sky and ground, by channel.

        Args:
            normal: (3,) unit normal in world axes.
        """
        light = self.light_map
        height, width = light.shape[:2]
        polar = (np.arange(height) + 0.5) * np.pi / height
        azimuth = (np.arange(width) + 0.5) * 2 * np.pi / width
        p, a = np.meshgrid(polar, azimuth, indexing="ij")
        directions = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
        weight = (
            np.maximum(np.einsum("...i,i->...", directions, normal), 0.0)
            * np.sin(p)
            * (np.pi / height)
            * (2 * np.pi / width)
        )
        diffuse = (light * weight[..., None]).sum(axis=(0, 1))
        direct = self.beam_illuminance_lux * max(float(self.beam_direction @ normal), 0.0)
        result: NDArray[np.float64] = diffuse + direct
        return result


def _rows_with(mask: NDArray[np.bool_]) -> slice:
    """The rows from the first to the last that hold True."""
    rows = np.flatnonzero(mask.any(axis=1))
    return slice(int(rows[0]), int(rows[-1]) + 1) if len(rows) else slice(0, 0)


class MappedEnvironmentRadiance(EnvironmentRadiance):
    """Radiance by direction from a user's map; sky, ground and sun of the environment are not used."""

    def __init__(self, environment: Environment) -> None:
        assert environment.map is not None
        self.environment = environment
        self._light = load_map(environment.map)
        self._coarse = self._light.downsampled(_LIGHT_MAP_HEIGHT_PX)

    def moved_to(self, environment: Environment) -> EnvironmentRadiance:
        """The same: a map has no depth."""
        return self

    def clear_radiance(self, directions: NDArray[np.floating[Any]]) -> tuple[Radiance, Radiance]:
        """Coarse radiance, and infinitely deep air at the same azimuth; see `EnvironmentRadiance.clear_radiance`."""
        return self._coarse.radiance(directions), self.airlight(directions)

    def radiance(
        self, directions: NDArray[np.float32], sky: Radiance | None = None, horizon: Radiance | None = None
    ) -> Radiance:
        """Radiance of everything except the sun's disc; rays that are far apart see the averaged map."""
        fine = pixel_angle_rad(directions) < np.pi / _LIGHT_MAP_HEIGHT_PX / 2
        return (self._light if fine else self._coarse).radiance(directions)

    def add_discs(self, radiance: Radiance, directions: NDArray[np.float32]) -> None:
        """Add the sun's disc, in place, to (H, W, 3) radiance along directions."""
        cosine = np.einsum("...i,i->...", directions, self.beam_direction.astype(np.float32))
        radiance[cosine > np.cos(SUN_RADIUS_RAD)] += (self.beam_illuminance_lux / SUN_SOLID_ANGLE_SR).astype(np.float32)

    @property
    def beam_direction(self) -> NDArray[np.float64]:
        """(3,) unit vector in world axes towards the map's sun."""
        return self._light.sun_direction

    @property
    def beam_illuminance_lux(self) -> NDArray[np.float64]:
        """(3,) illuminance of a plane that faces the map's sun; zeros when it has none. [lux]"""
        return self._light.sun_lux

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient of the air around the camera. [1/m]"""
        return self.environment.extinction_per_m

    @property
    def ground_illuminance_lux(self) -> NDArray[np.float64]:
        """(3,) illuminance of level ground by the map, by channel. [lux]"""
        return self.plate_illuminance_lux(np.array([0.0, 0.0, 1.0]))

    def airlight(self, directions: NDArray[np.floating[Any]]) -> Radiance:
        """Radiance of infinitely deep air: the map's horizon at that azimuth; see `EnvironmentRadiance.airlight`."""
        level = np.array(directions, dtype=np.float32)
        length = np.maximum(np.hypot(level[..., 0], level[..., 1]), np.float32(1e-9))
        level[..., :2] /= length[..., None]
        level[..., 2] = np.float32(HORIZON_ELEVATION_RAD)
        return self._coarse.radiance(level.reshape(1, -1, 3)).reshape(level.shape)


def sun_elevation_deg(environment: Environment) -> float | None:
    """Elevation of the sun, or None where the environment's map shows none. [deg]

    Raises:
        ValueError: the map cannot be read, or has changed.
    """
    if environment.map is not None and load_map(environment.map).sun_lux.max() <= 0:
        return None
    return environment.sun_elevation_deg


# The frames of a scene are made in a row.
@lru_cache(maxsize=16)
def _of_scene(key: str, folder: Path | None) -> EnvironmentRadiance:
    environment = Environment.model_validate_json(key)
    if environment.map is None:
        return EnvironmentRadiance(environment)
    placed = environment.map.model_copy(update={"folder": folder})
    return MappedEnvironmentRadiance(environment.model_copy(update={"map": placed}))


# Engine, background and glare of one pair use it in turn.
@lru_cache(maxsize=2)
def _moved_to_camera(key: str, folder: Path | None) -> EnvironmentRadiance:
    environment = Environment.model_validate_json(key)
    still = environment.model_copy(update={"camera_offset_m": (0.0, 0.0)})
    return _of_scene(still.model_dump_json(), folder).moved_to(environment)


def environment_radiance(environment: Environment) -> EnvironmentRadiance:
    """The radiance of an environment; the same object for equal environments, because frames share scenes.

    Raises:
        ValueError: the environment's map cannot be read, or has changed.
    """
    build = _of_scene if environment.camera_offset_m == (0.0, 0.0) else _moved_to_camera
    return build(environment.model_dump_json(), environment.map.folder if environment.map is not None else None)
