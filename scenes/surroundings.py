"""Everything around the drogue as one function of direction: sky, sun, cloud, haze and ground.

The same function is the background of the images and, as a map, the light on the drogue.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from datasets_manifest.frame import CloudLayer, Environment
from scenes.sky import REC709_LUMINANCE, ClearSky, Radiance
from scenes.texture import sample_texture

_LIGHT_MAP_HEIGHT_PX = 128
_HORIZON_ELEVATION_RAD = 0.01
# Amplitude spectra: clouds follow roughly k^-5/3 in variance along a line; fields and forests are rougher.
_CLOUD_SLOPE, _GROUND_SLOPE = 1.6, 1.3
_GROUND_PATCH_M = 900.0
_GROUND_CONTRAST = 0.22
_CLOUD_ASYMMETRY = 0.85  # of the droplets' phase function
_FARTHEST_M = 4e5  # beyond this the haze has hidden everything


class Surroundings:
    """Radiance by direction for one environment."""

    def __init__(self, environment: Environment) -> None:
        self.environment = environment
        self.sky = ClearSky(environment)

    def clear_radiance(self, directions: NDArray[np.floating[Any]]) -> tuple[Radiance, Radiance]:
        """The parts that vary slowly: clear sky, and the horizon's radiance at the same azimuth.

        Args:
            directions: (..., 3) unit vectors in world axes.

        Returns:
            Two (..., 3) radiances. [cd/m2]
        """
        flat = np.array(directions, dtype=np.float64)
        horizontal = np.maximum(np.hypot(flat[..., 0], flat[..., 1]), 1e-9) / np.cos(_HORIZON_ELEVATION_RAD)
        flat[..., :2] /= horizontal[..., None]
        flat[..., 2] = np.sin(_HORIZON_ELEVATION_RAD)
        return self.sky.radiance(directions), self.sky.radiance(flat)

    def radiance(
        self, directions: NDArray[np.float32], sky: Radiance | None = None, horizon: Radiance | None = None
    ) -> Radiance:
        """Radiance of everything but the sun's disc.

        Args:
            directions: (H, W, 3) unit vectors in world axes.
            sky, horizon: (H, W, 3) results of `clear_radiance` for the same directions, if at hand.

        Returns:
            (H, W, 3) luminance-scaled linear Rec. 709. [cd/m2]
        """
        if sky is None or horizon is None:
            sky, horizon = self.clear_radiance(directions)
        total = sky.copy()
        rows = _rows_with(directions[..., 2] < 0)
        self._put_ground(total[rows], directions[rows], horizon[rows])
        cloud = self.environment.cloud
        if cloud is not None:
            rows = _rows_with(directions[..., 2] * np.sign(cloud.height_above_camera_m) > 0)
            self._put_cloud(cloud, total[rows], directions[rows])
        return total

    @property
    def horizon_radiance(self) -> NDArray[np.float64]:
        """(3,) mean radiance of the horizon: the air's own light. [cd/m2]"""
        azimuth = np.linspace(0, 2 * np.pi, 36, endpoint=False)
        around = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(36, _HORIZON_ELEVATION_RAD)], axis=-1)
        mean: NDArray[np.float64] = self.sky.radiance(around).mean(axis=0).astype(np.float64)
        return mean

    @cached_property
    def ground_illuminance_lux(self) -> NDArray[np.float64]:
        """(3,) illuminance of level ground by sun and clear sky, by channel. [lux]"""
        elevation = (np.arange(45) + 0.5) * np.pi / 90
        azimuth = np.arange(72) * np.pi / 36
        e, a = np.meshgrid(elevation, azimuth, indexing="ij")
        directions = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
        weight = np.cos(e) * np.sin(e) * (np.pi / 90) * (np.pi / 36)
        from_sky = (self.sky.radiance(directions) * weight[..., None]).sum(axis=(0, 1))
        from_sun = self.sky.sun_illuminance_lux * max(self.sky.sun_direction[2], 0.0)
        result: NDArray[np.float64] = from_sky + from_sun
        return result

    def _put_ground(self, total: Radiance, directions: NDArray[np.float32], horizon: Radiance) -> None:
        """Cover the lower half, in place, with ground that fades into the horizon."""
        environment = self.environment
        down = np.maximum(-directions[..., 2], np.float32(environment.altitude_m / _FARTHEST_M))
        distance_m = np.float32(environment.altitude_m) / down
        per_patch = distance_m / np.float32(_GROUND_PATCH_M)
        texture = sample_texture(
            environment.ground_texture_seed,
            _GROUND_SLOPE,
            directions[..., 0] * per_patch,
            directions[..., 1] * per_patch,
        )
        brightness = np.maximum(1.0 + np.float32(_GROUND_CONTRAST) * texture, 0.15)
        reflected = self.ground_illuminance_lux * np.array(environment.ground_reflectance_rgb) / np.pi
        ground = brightness[..., None] * reflected.astype(np.float32)
        clear = np.exp(-distance_m * np.float32(environment.extinction_per_m))[..., None]
        np.copyto(total, horizon + (ground - horizon) * clear, where=(directions[..., 2] < 0)[..., None])

    def _put_cloud(self, cloud: CloudLayer, total: Radiance, directions: NDArray[np.float32]) -> None:
        """Blend the cloud layer over what lies behind it, in place."""
        height_m = cloud.height_above_camera_m
        rise = directions[..., 2] * np.float32(np.sign(height_m))
        distance_m = np.float32(abs(height_m)) / np.maximum(rise, np.float32(abs(height_m) / _FARTHEST_M))
        per_blob = distance_m / np.float32(cloud.feature_size_m)
        x, y = directions[..., 0] * per_blob, directions[..., 1] * per_blob
        texture = sample_texture(cloud.texture_seed, _CLOUD_SLOPE, x, y)
        threshold = float(ndtri(np.clip(1.0 - cloud.cover_fraction, 1e-4, 1 - 1e-4)))
        thickness = np.clip((texture - np.float32(threshold)) / np.float32(0.9), 0.0, 1.5)
        depth = np.float32(cloud.optical_depth) * thickness * thickness
        alpha = 1.0 - np.exp(-depth / np.maximum(rise, np.float32(0.15)))
        alpha *= np.exp(-distance_m * np.float32(self.environment.extinction_per_m))
        alpha[rise <= 0] = 0.0
        lit = self._cloud_light(cloud, depth, x, y, texture)
        total += alpha[..., None] * (lit - total)

    def _cloud_light(
        self,
        cloud: CloudLayer,
        depth: NDArray[np.float32],
        x: NDArray[np.float32],
        y: NDArray[np.float32],
        texture: NDArray[np.float32],
    ) -> Radiance:
        """Radiance of the cloud itself: two-stream reflection above, transmission below, and its own shade."""
        back = np.float32((1 - _CLOUD_ASYMMETRY) / 2) * depth
        reflected = back / (1 + back)
        seen = reflected if cloud.height_above_camera_m < 0 else 1 - reflected
        towards_sun = self.sky.sun_direction[:2].astype(np.float32) * np.float32(0.12)
        ahead = sample_texture(cloud.texture_seed, _CLOUD_SLOPE, x + towards_sun[0], y + towards_sun[1])
        shade = np.clip(1.0 + 0.55 * (texture - ahead), 0.55, 1.35)
        light = (self.ground_illuminance_lux / np.pi).astype(np.float32)
        result: Radiance = (seen * shade)[..., None] * light
        return result

    @cached_property
    def light_map(self) -> Radiance:
        """(128, 256, 3) equirectangular map without the sun's disc; row 0 is the zenith, column 0 looks east. [cd/m2]

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
        direct = self.sky.sun_illuminance_lux * max(float(self.sky.sun_direction @ normal), 0.0)
        result: NDArray[np.float64] = diffuse + direct
        return result


def _rows_with(mask: NDArray[np.bool_]) -> slice:
    """The rows from the first to the last that hold a true value."""
    rows = np.flatnonzero(mask.any(axis=1))
    return slice(int(rows[0]), int(rows[-1]) + 1) if len(rows) else slice(0, 0)


@lru_cache(maxsize=16)
def _cached(key: str) -> Surroundings:
    return Surroundings(Environment.model_validate_json(key))


def surroundings(environment: Environment) -> Surroundings:
    """The surroundings of an environment; the same object for equal environments, as frames share scenes."""
    return _cached(environment.model_dump_json())


def luminance(radiance: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """(...) luminance of (..., 3) radiance. [cd/m2]"""
    result: NDArray[np.float64] = np.einsum("...c,c->...", np.asarray(radiance, dtype=np.float64), REC709_LUMINANCE)
    return result
