"""Sky, sun and air light of one environment by the tables of its atmosphere; see `ClearSky` and `LayeredAir`."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.environment import Environment
from scenes.air_light import LayeredAir, transmitted_share
from scenes.atmosphere.air_layers import (
    EARTH_M,
    MOLECULE_DEPTH_550,
    MOLECULES_AT_GROUND_PER_M,
    RGB_WEIGHTS,
    AirLayers,
    Array,
    horizon_dip_rad,
    rgb_of_spectrum,
)
from scenes.atmosphere.multiple_scattering import scattered_light
from scenes.atmosphere.sky_tables import Directions, SkyTables
from scenes.clouds.cloud_layers import BACK_SCATTER
from scenes.sky.clear_sky import ClearSky, Luminary
from scenes.sky.photometry import (
    Radiance,
    direction_from_angles,
    hemisphere,
    luminance,
    scattering_depth,
)
from scenes.sky.sky_models import night_radiance

# Haze thins out by a factor of e over a height between these; cleaner air than this cannot be told from none. [m, 1/m]
_LEAST_SCALE_M, _MOST_SCALE_M = 600.0, 2500.0
_LEAST_AEROSOL_PER_M = 5e-7
# Lower than this, sun or moon light nothing that the night sky does not. [deg]
_NIGHT_BELOW_DEG = -19.0
_NEAR_M = 300.0


def air_layers_of(environment: Environment) -> AirLayers:
    """The air of an environment.

    Its visibility is that at the ground, and sets the density of the aerosol there. The turbidity sets its column
    (Preetham et al. 1999), and the two together over which height it thins out.
    """
    molecules_per_m = MOLECULE_DEPTH_550 * MOLECULES_AT_GROUND_PER_M
    aerosol_per_m = max(environment.extinction_per_m - molecules_per_m, _LEAST_AEROSOL_PER_M)
    column = float(scattering_depth(environment.turbidity)[1][1])
    scale_m = float(np.clip(column / aerosol_per_m, _LEAST_SCALE_M, _MOST_SCALE_M))
    ground = np.array(environment.ground_reflectance_rgb)
    # From above, clouds are the ground of the air.
    for layer in environment.clouds:
        if not layer.is_above:
            reflects = 1.0 - transmitted_share((layer,))
            ground = ground + (1.0 - ground) * reflects
    red, green, blue = (round(float(value), 3) for value in ground)
    return AirLayers(round(aerosol_per_m, 9), round(scale_m, 1), (red, green, blue))


class ScatteringLuminary(Luminary):
    """The sun, or the moon as a weaker sun, and the light that the air scatters of it.

    Args:
        elevation_deg, azimuth_deg: direction to it. [deg]
        illuminance_lux: of a plane that faces it, outside the atmosphere. [lux]
        layers: of the air.
        altitude_m: of the camera. [m]
    """

    def __init__(
        self, elevation_deg: float, azimuth_deg: float, illuminance_lux: float, layers: AirLayers, altitude_m: float
    ) -> None:
        self.direction = direction_from_angles(elevation_deg, azimuth_deg)
        self._azimuth_rad = float(np.radians(azimuth_deg))
        self._lux = illuminance_lux
        self._layers, self._altitude_m = layers, altitude_m
        self._sine = float(np.sin(np.radians(elevation_deg)))
        self.is_up = elevation_deg > _NIGHT_BELOW_DEG

    @cached_property
    def tables(self) -> SkyTables:
        """What the camera sees of the air under it."""
        return SkyTables(self._layers, self._altitude_m, self._sine)

    def beam_illuminance_lux(self, height_m: float | None = None) -> Array:
        """(3,) illuminance of a plane that faces it at a height, the camera's by default. [lux]"""
        height = np.array([self._altitude_m if height_m is None else height_m])
        through = rgb_of_spectrum(self._layers.sunlight(height, np.array([self._sine])))[0]
        beam: Array = self._lux * through
        return beam

    @cached_property
    def ground_sky_lux(self) -> Array:
        """(3,) illuminance of level ground by the light that air and ground scatter. [lux]"""
        if not self.is_up:
            return np.zeros(3)
        result: Array = self._lux * np.maximum(scattered_light(self._layers).ground_at(self._sine) @ RGB_WEIGHTS, 0.0)
        return result

    def sky_radiance(self, directions: NDArray[np.floating[Any]]) -> Radiance:
        """(..., 3) radiance of the sky that it lights, along (..., 3) unit directions. [cd/m2]"""
        if not self.is_up:
            return np.zeros(np.shape(directions), dtype=np.float32)
        return np.float32(self._lux) * self.tables.sky_radiance(*self._places(directions))

    def before_ground(self, directions: NDArray[np.floating[Any]]) -> Radiance:
        """(..., 3) light of the air between camera and ground; above the horizon that of the horizon. [cd/m2]"""
        if not self.is_up:
            return np.zeros(np.shape(directions), dtype=np.float32)
        return np.float32(self._lux) * self.tables.before_ground(*self._places(directions))

    def up_to(
        self, directions: NDArray[np.floating[Any]], distance_m: NDArray[np.floating[Any]]
    ) -> tuple[Radiance, NDArray[np.float32]]:
        """(..., 3) light of the air up to (...) distances [cd/m2], and (..., 3) its transmittance."""
        light, clear = self.tables.up_to(*self._places(directions), distance_m)
        return np.float32(self._lux if self.is_up else 0.0) * light, clear

    def disc(self, sines: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """(..., 3) share of the light of its disc that reaches the camera, by (...) sines of elevation."""
        heights = np.full(np.shape(sines), self._altitude_m)
        through = self._layers.transmittance(heights, np.asarray(sines, dtype=np.float64))
        return rgb_of_spectrum(through).astype(np.float32)

    def _places(self, directions: NDArray[np.floating[Any]]) -> tuple[Directions, NDArray[np.floating[Any]]]:
        towards = np.clip(np.einsum("...i,i->...", directions, self.direction), -1.0, 1.0)
        return Directions(self.tables.dip_rad, self._azimuth_rad, directions), towards


class ScatteringSky(ClearSky):
    """Sun, moon and night sky through the air around and above the camera."""

    def __init__(self, environment: Environment) -> None:
        self.layers = air_layers_of(environment)
        self._altitude_m = environment.altitude_m
        super().__init__(environment)

    def _luminary(
        self, environment: Environment, elevation_deg: float, azimuth_deg: float, illuminance_lux: float
    ) -> ScatteringLuminary:
        return ScatteringLuminary(elevation_deg, azimuth_deg, illuminance_lux, self.layers, environment.altitude_m)

    @property
    def luminaries(self) -> tuple[ScatteringLuminary, ...]:
        """Sun, and moon if there is one."""
        both = (self.sun, self.moon)
        return tuple(one for one in both if isinstance(one, ScatteringLuminary))

    def _visible(self, directions: NDArray[np.float32]) -> NDArray[np.bool_]:
        elevation = np.arcsin(np.clip(directions[..., 2], -1.0, 1.0))
        above: NDArray[np.bool_] = elevation > -horizon_dip_rad(self._altitude_m)
        return above

    def _disc_lux(self, luminary: Luminary, directions: NDArray[np.float32]) -> NDArray[np.float32]:
        assert isinstance(luminary, ScatteringLuminary)
        return np.float32(luminary._lux) * luminary.disc(directions[..., 2])


class ScatteringAir(LayeredAir):
    """The same air between cloud layers and mist, in front of ground, clouds and things."""

    def __init__(self, environment: Environment, sky: ScatteringSky) -> None:
        super().__init__(environment, sky)
        self._scattering = sky
        self._dip_rad = float(horizon_dip_rad(environment.altitude_m))

    @cached_property
    def extinction_per_m(self) -> float:
        """Extinction coefficient around the camera, for luminance. [1/m]"""
        through = rgb_of_spectrum(
            np.exp(-_NEAR_M * self._scattering.layers.extinction_per_m(self._environment.altitude_m))
        )
        return float(-np.log(luminance(through)) / _NEAR_M)

    @cached_property
    def ground_illuminance_lux(self) -> NDArray[np.float64]:
        """(3,) mean illuminance of level ground under all layers. [lux]"""
        result: NDArray[np.float64] = self._ground_open_lux * transmitted_share(self._environment.clouds)
        if self._environment.mist is not None:
            mist = self._environment.mist
            result /= 1.0 + BACK_SCATTER * mist.extinction_per_m * (mist.above_m + mist.below_m)
        return result

    @cached_property
    def _ground_open_lux(self) -> Array:
        """(3,) illuminance of level ground under a clear sky. [lux]"""
        directions, weight = hemisphere(30)
        total = np.einsum("ijc,ij->c", night_radiance(directions), weight)
        for luminary in self._scattering.luminaries:
            total = total + luminary.ground_sky_lux
            total = total + luminary.beam_illuminance_lux(0.0) * max(float(luminary.direction[2]), 0.0)
        result: Array = total
        return result

    def _beam_on_ground_lux(self) -> Array:
        return self._sky.beam.beam_illuminance_lux(0.0)

    @cached_property
    def _upwelling_lux(self) -> Array:
        """(3,) illuminance of the mist's underside by ground, clouds below and the air in front of them. [lux]"""
        directions, weight = hemisphere(15)
        falling = directions * np.array([1.0, 1.0, -1.0])
        above = tuple(layer for layer in self._environment.clouds if layer.is_above)
        below = np.array(self._scattering.layers.ground_rgb) / np.pi * transmitted_share(above) * self._ground_open_lux
        mist = self._environment.mist
        assert mist is not None
        below = below / (1.0 + BACK_SCATTER * mist.extinction_per_m * (mist.above_m + mist.below_m))
        light = self.sky_and_air(falling)[1] + self._clear_to_ground(falling) * below
        result: Array = np.einsum("ijc,ij->c", light, weight)
        return result

    def sky_and_air(self, directions: NDArray[np.floating[Any]]) -> tuple[Radiance, Radiance]:
        """Sky behind the air, and light of the air in front of the ground, without mist.

        Args:
            directions: (..., 3) unit vectors in world axes; each is continued smoothly beyond the horizon.

        Returns:
            Two (..., 3) radiances. [cd/m2]
        """
        sky = self._sky.radiance(directions)
        air = np.zeros(np.shape(directions), dtype=np.float32)
        for luminary in self._scattering.luminaries:
            air += luminary.before_ground(directions)
        clear = self._clear_to_ground(directions)
        return self._beyond_deck(sky, directions), self._under_clouds(air + self._night_light * (1.0 - clear), clear)

    def _beyond_deck(self, sky: Radiance, directions: NDArray[np.floating[Any]]) -> Radiance:
        """The (..., 3) sky with the air up to the lowest clouds above the camera in their shade, as before clouds."""
        above = [layer.height_above_camera_m for layer in self._environment.clouds if layer.is_above]
        open_share, _ = self._under_deck
        if not above or open_share == 1.0:
            return sky
        radius_m = EARTH_M + self._environment.altitude_m
        up_m = radius_m * np.maximum(np.asarray(directions, dtype=np.float64)[..., 2], self.round_horizon_sine)
        to_deck_m = np.sqrt(up_m * up_m + (2.0 * radius_m + min(above)) * min(above)) - up_m
        lit, clear = self._lit_up_to(directions, to_deck_m.astype(np.float32))
        result: Radiance = np.maximum(sky + self._under_clouds(lit, clear) - lit, np.float32(0.0))
        return result

    def horizon_share(self, directions: NDArray[np.float32], angle_rad: float) -> NDArray[np.float32]:
        """(...) share of each pixel that lies below the horizon; pixels are `angle_rad` wide."""
        below = -self._dip_rad - np.arcsin(np.clip(directions[..., 2], -1.0, 1.0))
        share: NDArray[np.float32] = np.clip(below / np.float32(angle_rad) + np.float32(0.5), 0.0, 1.0)
        return share

    @property
    def round_horizon_sine(self) -> float:
        """Sine of the elevation of the horizon."""
        return float(-np.sin(self._dip_rad))

    def before_ground(
        self, ground: Radiance, directions: NDArray[np.float32], air: Radiance, level: NDArray[np.float32] | None = None
    ) -> Radiance:
        """Ground behind the air in front of it, in place."""
        if level is None:
            ground *= self._clear_to_ground(directions)
            ground += air
            return ground
        # Hills are nearer than level ground in their direction: the air's light grows with what it hides.
        clear, behind = self._clear_to_ground(level), self._clear_to_ground(directions)
        ground *= clear
        ground += air * ((1.0 - clear) / np.maximum(1.0 - behind, np.float32(1e-4)))
        return ground

    def ground_clear(self, sine: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Transmittance to the ground by the sine of the depression of rays, for luminance."""
        directions = np.stack([np.sqrt(1.0 - sine * sine), np.zeros_like(sine), -sine], axis=-1)
        through: NDArray[np.floating[Any]] = luminance(self._clear_to_ground(directions))
        return through

    def before_cloud(
        self,
        light: Radiance,
        directions: NDArray[np.float32],
        distance_m: NDArray[np.float32],
        air: Radiance,
    ) -> Radiance:
        """(H, W, 3) light of clouds behind the air up to their distances. [cd/m2]"""
        seen, clear = self._up_to(directions, distance_m)
        result: Radiance = light * clear + seen
        return result

    def airlight(self, directions: NDArray[np.floating[Any]]) -> Radiance:
        """(..., 3) radiance of the air around the camera, as if it went on for ever. [cd/m2]"""
        seen, _ = self._up_to(directions, np.full(np.shape(directions)[:-1], _NEAR_M))
        result: Radiance = seen / np.float32(-np.expm1(-_NEAR_M * self.extinction_per_m))
        return result

    def _up_to(
        self, directions: NDArray[np.floating[Any]], distance_m: NDArray[np.floating[Any]]
    ) -> tuple[Radiance, NDArray[np.float32]]:
        lit, clear = self._lit_up_to(directions, distance_m)
        return self._under_clouds(lit, clear), clear

    def _lit_up_to(
        self, directions: NDArray[np.floating[Any]], distance_m: NDArray[np.floating[Any]]
    ) -> tuple[Radiance, NDArray[np.float32]]:
        """As `_up_to`, under a clear sky."""
        seen = np.zeros(np.shape(directions), dtype=np.float32)
        clear = np.ones(np.shape(directions), dtype=np.float32)
        for luminary in self._scattering.luminaries:
            light, clear = luminary.up_to(directions, distance_m)
            seen += light
        return seen + self._night_light * (1.0 - clear), clear

    def _clear_to_ground(self, directions: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        tables = self._scattering.luminaries[0].tables
        return tables.ground_transmittance(Directions(self._dip_rad, 0.0, directions).ground_row)

    def _under_clouds(self, air: Radiance, clear: NDArray[np.float32]) -> Radiance:
        """Light of the air where clouds above the camera stop a part of sun and sky."""
        open_share, under_deck = self._under_deck
        if open_share == 1.0:
            return air
        result: Radiance = np.float32(open_share) * air + (
            np.float32(1.0 - open_share) * under_deck.astype(np.float32) * (1.0 - clear)
        )
        return result

    @cached_property
    def _night_light(self) -> NDArray[np.float32]:
        """(3,) radiance of air that only the night sky lights. [cd/m2]"""
        directions, weight = hemisphere(15)
        mean = np.einsum("ijc,ij->c", night_radiance(directions), weight) / np.pi
        result: NDArray[np.float32] = mean.astype(np.float32)
        return result
