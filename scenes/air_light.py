"""Transfer of light through cloud layers and mist, and airlight."""

from __future__ import annotations

from copy import copy
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.environment import CloudLayer, Environment
from scenes.clouds.cloud_layers import (
    BACK_SCATTER,
    CloudLight,
    diffuse_transmission,
    direct_transmission,
    opacity_towards,
)
from scenes.clouds.thin_layers import mist_depth
from scenes.ground_view import FARTHEST_M
from scenes.sky.clear_sky import ClearSky
from scenes.sky.photometry import Radiance, hemisphere, henyey_greenstein

HORIZON_ELEVATION_RAD = 0.01
_DROPLET_ASYMMETRY = 0.8
# Scale height of the haze, which sets how much of it is in front of the sky at the horizon.
_HAZE_SCALE_M = 1500.0
# Radiance of air between a bright cloud deck and dark ground, and of mist, over that of the incident light.
_AIR_UNDER_DECK, _AIR_IN_MIST = 0.6, 0.75
_LOWEST_BEAM_SINE = 0.05


class LayeredAir:
    """Light between the cloud layers and mist of one environment, under its clear sky."""

    def __init__(self, environment: Environment, sky: ClearSky) -> None:
        self._environment = _with_mist_over_ground(environment)
        self._sky = sky

    def moved_to(self, environment: Environment) -> LayeredAir:
        """The same air for a camera elsewhere: other clouds cover sun and moon; means over the layers stay.

        Args:
            environment: the same environment with another `camera_offset_m`.
        """
        moved = copy(self)
        moved._environment = _with_mist_over_ground(environment)
        for own in ("beam_share", "beam_illuminance_lux"):
            vars(moved).pop(own, None)
        return moved

    @cached_property
    def sky_level_lux(self) -> NDArray[np.float64]:
        """(3,) illuminance of a level plane by the clear sky alone. [lux]"""
        directions, weight = hemisphere(45)
        result: NDArray[np.float64] = (self._sky.radiance(directions) * weight[..., None]).sum(axis=(0, 1))
        return result

    @cached_property
    def _open_level_lux(self) -> NDArray[np.float64]:
        """(3,) illuminance of a level plane by clear sky and beam. [lux]"""
        beam = self._sky.beam
        result: NDArray[np.float64] = self.sky_level_lux + beam.beam_illuminance_lux() * max(beam.direction[2], 0.0)
        return result

    @cached_property
    def ground_illuminance_lux(self) -> NDArray[np.float64]:
        """(3,) mean illuminance of level ground under all layers. [lux]"""
        result: NDArray[np.float64] = self._open_level_lux * transmitted_share(self._environment.clouds)
        if self._environment.mist is not None:
            mist = self._environment.mist
            result /= 1.0 + BACK_SCATTER * mist.extinction_per_m * (mist.above_m + mist.below_m)
        return result

    @cached_property
    def ground_beam_lux(self) -> NDArray[np.float64]:
        """(3,) mean illuminance, over cloud and gaps, of a plane on the ground that faces the beam. [lux]"""
        beam, mist = self._sky.beam, self._environment.mist
        share = direct_share(self._environment.clouds)
        if mist is not None:
            depth = mist.extinction_per_m * (mist.above_m + mist.below_m)
            share *= float(np.exp(-depth / max(float(beam.direction[2]), _LOWEST_BEAM_SINE)))
        result: NDArray[np.float64] = share * self._beam_on_ground_lux()
        return result

    def _beam_on_ground_lux(self) -> NDArray[np.float64]:
        return self._sky.beam.beam_illuminance_lux()

    @cached_property
    def beam_illuminance_lux(self) -> NDArray[np.float64]:
        """(3,) illuminance at the camera of a plane that faces sun or moon, through cloud and mist. [lux]"""
        result: NDArray[np.float64] = self._sky.beam.beam_illuminance_lux() * self.beam_share
        return result

    @cached_property
    def beam_share(self) -> float:
        """Share of the beam that cloud and mist transmit to the camera."""
        return self.open_share(self._sky.beam.direction)

    def open_share(self, direction: NDArray[np.float64]) -> float:
        """Share of the light from a far source that cloud and mist transmit to the camera.

        Args:
            direction: (3,) unit vector in world axes towards the source.
        """
        share, mist = 1.0, self._environment.mist
        for layer in self._environment.clouds:
            share *= 1.0 - opacity_towards(layer, direction, self._environment.camera_offset_m, self.round_horizon_sine)
        if mist is None:
            return share
        sine = max(float(direction[2]), _LOWEST_BEAM_SINE)
        return share * float(np.exp(-mist.extinction_per_m * mist.above_m / sine))

    def light_on(self, layer: CloudLayer) -> CloudLight:
        """Light on a cloud layer through the layers above it and from those below."""
        environment, beam = self._environment, self._sky.beam
        height_m = layer.height_above_camera_m
        above = tuple(other for other in environment.clouds if other.height_above_camera_m > height_m)
        below = tuple(other for other in environment.clouds if other.height_above_camera_m < height_m)
        direct, through = direct_share(above), transmitted_share(above)
        spread = np.maximum(through - direct, 0.0) * self._open_level_lux
        falling = through * self._open_level_lux
        ground = np.array(environment.ground_reflectance_rgb) * self.ground_illuminance_lux
        return CloudLight(
            direction=beam.direction,
            beam_lux=direct * beam.beam_illuminance_lux(max(environment.altitude_m + height_m, 0.0)),
            sky_lux=direct * self.sky_level_lux + spread,
            ground_lux=ground + falling * (1.0 - transmitted_share(below)),
        )

    @cached_property
    def _under_deck(self) -> tuple[float, NDArray[np.float64]]:
        """Share of the sky that clouds above the camera leave open, and airlight under the rest. [cd/m2]"""
        above = tuple(layer for layer in self._environment.clouds if layer.is_above)
        return direct_share(above), _AIR_UNDER_DECK / np.pi * transmitted_share(above) * self._open_level_lux

    def sky_and_air(self, directions: NDArray[np.floating[Any]]) -> tuple[Radiance, Radiance]:
        """Clear sky behind the haze, and infinitely deep air, without mist.

        Args:
            directions: (..., 3) unit vectors in world axes.

        Returns:
            Two (..., 3) radiances; they meet at the horizon. [cd/m2]
        """
        sky = self._sky.radiance(directions)
        flat = np.array(directions, dtype=np.float64)
        horizontal = np.maximum(np.hypot(flat[..., 0], flat[..., 1]), 1e-9) / np.cos(HORIZON_ELEVATION_RAD)
        flat[..., :2] /= horizontal[..., None]
        flat[..., 2] = np.sin(HORIZON_ELEVATION_RAD)
        horizon = self._sky.radiance(flat)
        # Below this elevation the air path hardly grows: kept constant there, sky and air meet without a seam.
        sky = np.where((np.asarray(directions)[..., 2] < np.sin(HORIZON_ELEVATION_RAD))[..., None], horizon, sky)
        open_share, under_deck = self._under_deck
        if open_share == 1.0:
            return sky, horizon
        air = (open_share * horizon + (1.0 - open_share) * under_deck).astype(np.float32)
        up = np.maximum(np.asarray(directions)[..., 2], 1e-4)
        hidden = 1.0 - np.exp(-self._environment.extinction_per_m * _HAZE_SCALE_M / up)
        return sky + hidden[..., None].astype(np.float32) * (air - horizon), air

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient of the air around the camera, without mist. [1/m]"""
        return self._environment.extinction_per_m

    @property
    def round_horizon_sine(self) -> float | None:
        """Sine of the elevation of the horizon; None where the ground is level and has none."""
        return None

    def horizon_share(self, directions: NDArray[np.float32], angle_rad: float) -> NDArray[np.float32]:
        """(...) share of each pixel that lies below the horizon; pixels are `angle_rad` wide."""
        return (directions[..., 2] < 0).astype(np.float32)

    def airlight(self, directions: NDArray[np.floating[Any]]) -> Radiance:
        """(..., 3) radiance of infinitely deep air along (..., 3) unit directions. [cd/m2]"""
        return self.sky_and_air(directions)[1]

    def before_ground(
        self, ground: Radiance, directions: NDArray[np.float32], air: Radiance, level: NDArray[np.float32] | None = None
    ) -> Radiance:
        """Ground behind the air in front of it, in place.

        Args:
            ground: (H, W, 3) its radiance. [cd/m2]
            directions: (H, W, 3) unit vectors in world axes.
            air: (H, W, 3) the second result of `sky_and_air`. [cd/m2]
            level: (H, W, 3) directions in which level ground is as far away as the hills along `directions`, or None.
        """
        directions = directions if level is None else level
        altitude_m = np.float32(self._environment.altitude_m)
        distance_m = altitude_m / np.maximum(-directions[..., 2], altitude_m / np.float32(FARTHEST_M))
        clear = np.exp(-distance_m * np.float32(self._environment.extinction_per_m))[..., None]
        ground -= air
        ground *= clear
        ground += air
        return ground

    def before_cloud(
        self,
        light: Radiance,
        directions: NDArray[np.float32],
        distance_m: NDArray[np.float32],
        air: Radiance,
    ) -> Radiance:
        """(H, W, 3) light of clouds behind the air up to their distances; arguments as in `before_ground`. [cd/m2]"""
        clear = np.exp(distance_m * np.float32(-self._environment.extinction_per_m))[..., None]
        result: Radiance = air + clear * (light - air)
        return result

    @property
    def _upwelling_lux(self) -> NDArray[np.float64]:
        """(3,) illuminance, from below, of the mist's underside by ground and air; level air has none. [lux]"""
        return np.zeros(3)

    def mist_light(self, directions: NDArray[np.floating[Any]]) -> Radiance:
        """(..., 3) radiance of infinitely deep mist along (..., 3) unit directions. [cd/m2]"""
        mist = self._environment.mist
        assert mist is not None
        above = tuple(layer for layer in self._environment.clouds if layer.is_above)
        depth = BACK_SCATTER * mist.extinction_per_m * mist.above_m
        even = _AIR_IN_MIST / np.pi * transmitted_share(above) * self._open_level_lux / (1.0 + depth)
        even = even + _AIR_IN_MIST / np.pi * self._upwelling_lux / (
            1.0 + BACK_SCATTER * mist.extinction_per_m * mist.below_m
        )
        cosine = np.einsum("...i,i->...", directions, self._sky.beam.direction)
        peak = henyey_greenstein(cosine, _DROPLET_ASYMMETRY)[..., None] * self.beam_illuminance_lux
        result: Radiance = (even + peak).astype(np.float32)
        return result

    def behind_mist(self, radiance: Radiance, directions: NDArray[np.float32]) -> None:
        """Put mist in front of (H, W, 3) radiance along (H, W, 3) unit directions, in place."""
        mist, light = self._environment.mist, self.mist_light(directions)
        assert mist is not None
        if mist.patchiness > 0:
            depth, tone = mist_depth(mist, directions, self._environment.camera_offset_m)
            light *= tone[..., None]
        else:
            reach_m = np.where(directions[..., 2] > 0, np.float32(mist.above_m), np.float32(mist.below_m))
            path_m = reach_m / np.maximum(np.abs(directions[..., 2]), np.float32(1e-6))
            depth = np.float32(mist.extinction_per_m) * path_m
        radiance += (1.0 - np.exp(-depth))[..., None] * (light - radiance)


def _with_mist_over_ground(environment: Environment) -> Environment:
    """The environment with mist that ends at the ground, where its own reaches below it."""
    mist = environment.mist
    if mist is None or mist.below_m <= environment.altitude_m:
        return environment
    return environment.model_copy(update={"mist": mist.model_copy(update={"below_m": environment.altitude_m})})


def transmitted_share(layers: tuple[CloudLayer, ...]) -> float:
    """Share of light that the layers transmit, direct or scattered."""
    return float(np.prod([diffuse_transmission(layer) for layer in layers])) if layers else 1.0


def direct_share(layers: tuple[CloudLayer, ...]) -> float:
    """Mean share of light that the layers transmit directly."""
    return float(np.prod([direct_transmission(layer) for layer in layers])) if layers else 1.0
