"""The clear sky at any hour: radiance of sun, moon and night sky by direction, in absolute units."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.environment import Environment
from scenes.sky.photometry import (
    SOLAR_ILLUMINANCE_LUX,
    SUN_RADIUS_RAD,
    SUN_SOLID_ANGLE_SR,
    Radiance,
    beam_transmission,
    direction_from_angles,
)
from scenes.sky.sky_models import (
    DaylightSky,
    TwilightSky,
    daylight_illuminance_lux,
    lit_side_of_moon,
    moon_illuminance_lux,
    night_radiance,
    twilight_illuminance_lux,
)

# Below the first elevation the sky is the twilight model's, above the second the daylight model's. [deg]
_TWILIGHT_BELOW_DEG, _DAYLIGHT_ABOVE_DEG = 2.0, 9.0
# Preetham's sky sends too much light, up to four times under low suns, so its level is another's: between these
# elevations that of a daylight sky blends into that measured under low suns. [deg]
_MEASURED_BELOW_DEG, _MODEL_ABOVE_DEG = 4.0, 15.0
# Below this elevation the sun's light is negligible beside the night sky. [deg]
_NIGHT_BELOW_DEG = -18.5


def _smooth_step(value: float, low: float, high: float) -> float:
    """0 up to `low`, 1 from `high` on, without a kink."""
    rise = min(max((value - low) / (high - low), 0.0), 1.0)
    return rise * rise * (3.0 - 2.0 * rise)


class Luminary:
    """The sun, or the moon as a weaker sun, and the sky that it lights.

    Args:
        elevation_deg, azimuth_deg: direction to it. [deg]
        turbidity: as in `Environment`.
        illuminance_lux: of a plane that faces it, outside the atmosphere. [lux]
        altitude_m: of the camera. [m]
    """

    def __init__(
        self, elevation_deg: float, azimuth_deg: float, turbidity: float, illuminance_lux: float, altitude_m: float
    ) -> None:
        self.direction = direction_from_angles(elevation_deg, azimuth_deg)
        self._share = illuminance_lux / SOLAR_ILLUMINANCE_LUX
        self._elevation_deg = elevation_deg
        self._turbidity = turbidity
        day = _smooth_step(elevation_deg, _TWILIGHT_BELOW_DEG, _DAYLIGHT_ABOVE_DEG)
        self._skies: list[tuple[float, DaylightSky | TwilightSky]] = []
        brighter = 1.0
        if day > 0:
            sky = DaylightSky(turbidity, elevation_deg, azimuth_deg, altitude_m)
            measured_lux = twilight_illuminance_lux(elevation_deg)
            modelled = _smooth_step(elevation_deg, _MEASURED_BELOW_DEG, _MODEL_ABOVE_DEG)
            if modelled > 0:
                brighter = (daylight_illuminance_lux(elevation_deg, turbidity) / measured_lux) ** modelled
            self._skies.append((day * brighter * measured_lux / sky.level_illuminance_lux, sky))
        if day < 1 and elevation_deg > _NIGHT_BELOW_DEG:
            self._skies.append(((1.0 - day) * brighter, TwilightSky(turbidity, elevation_deg, azimuth_deg)))

    def beam_illuminance_lux(self, height_m: float | None = None) -> NDArray[np.float64]:
        """(3,) illuminance of a plane that faces it, by channel; at greater heights it sets later. [lux]"""
        dip_deg = float(np.degrees(np.sqrt(2.0 * max(height_m or 0.0, 0.0) / 6.371e6)))
        through = beam_transmission(self._elevation_deg + dip_deg, self._turbidity)
        result: NDArray[np.float64] = SOLAR_ILLUMINANCE_LUX * self._share * through
        return result

    def sky_radiance(self, directions: NDArray[np.floating[Any]]) -> Radiance:
        """(..., 3) radiance of the sky that it lights, along (..., 3) unit directions. [cd/m2]"""
        total = np.zeros(np.shape(directions), dtype=np.float32)
        for weight, sky in self._skies:
            total += np.float32(weight * self._share) * sky.radiance(directions)
        return total


class ClearSky:
    """Sun, moon and night sky through clear air, as seen from the ground, and used unchanged at altitude.

    Attributes:
        sun: always there.
        moon: None without a moon.
        beam: the brighter of the two, which casts the shadows.
    """

    def __init__(self, environment: Environment) -> None:
        self._moon = environment.moon
        self._sun_azimuth_deg = environment.sun_azimuth_deg
        self.sun = self._luminary(
            environment, environment.sun_elevation_deg, environment.sun_azimuth_deg, SOLAR_ILLUMINANCE_LUX
        )
        self.moon: Luminary | None = None
        if environment.moon is not None:
            moon = environment.moon
            self.moon = self._luminary(
                environment, moon.elevation_deg, moon.azimuth_deg, moon_illuminance_lux(moon.phase_angle_deg)
            )
        self.beam = self.sun
        if self.moon is not None and self.moon.beam_illuminance_lux().sum() > self.sun.beam_illuminance_lux().sum():
            self.beam = self.moon

    def _luminary(
        self, environment: Environment, elevation_deg: float, azimuth_deg: float, illuminance_lux: float
    ) -> Luminary:
        return Luminary(elevation_deg, azimuth_deg, environment.turbidity, illuminance_lux, environment.altitude_m)

    @property
    def sun_direction(self) -> NDArray[np.float64]:
        """(3,) unit vector towards the sun in world axes."""
        return self.sun.direction

    @cached_property
    def sun_illuminance_lux(self) -> NDArray[np.float64]:
        """(3,) illuminance of a plane that faces the sun, by channel. [lux]"""
        return self.sun.beam_illuminance_lux()

    def radiance(self, directions: NDArray[np.floating[Any]]) -> Radiance:
        """Radiance of the sky without the discs of sun and moon.

        Args:
            directions: (..., 3) unit vectors in world axes; those below the horizon get the horizon's radiance.

        Returns:
            (..., 3) luminance-scaled linear Rec. 709. [cd/m2]
        """
        total = self.sun.sky_radiance(directions)
        if self.moon is not None:
            total += self.moon.sky_radiance(directions)
        total += night_radiance(directions)
        return total

    @property
    def luminaries(self) -> tuple[Luminary, ...]:
        """Sun, and moon if there is one."""
        return (self.sun,) if self.moon is None else (self.sun, self.moon)

    @property
    def lowest_disc_sine(self) -> float:
        """Sine of the elevation that no disc of sun or moon is wholly below."""
        return min(float(luminary.direction[2]) for luminary in self.luminaries) - float(SUN_RADIUS_RAD)

    def shows_disc(self, directions: NDArray[np.float32]) -> bool:
        """Whether any of (..., 3) unit directions meets the disc of sun or moon."""
        return any(_meets_disc(luminary, directions).any() for luminary in self.luminaries)

    def add_discs(
        self,
        radiance: Radiance,
        directions: NDArray[np.float32],
        through: float | NDArray[np.floating[Any]],
        share_towards: Callable[[NDArray[np.float64]], float] | None = None,
    ) -> None:
        """Add the discs of sun and moon, in place.

        Args:
            radiance: (..., 3) along `directions`. [cd/m2]
            directions: (..., 3) unit vectors in world axes.
            through: share of both beams that is not stopped on its way; a number, or (...).
            share_towards: a further share, of the beam from the (3,) direction of each; None for all of it.
        """
        through = np.broadcast_to(through, directions.shape[:-1])
        for luminary in self.luminaries:
            disc = _meets_disc(luminary, directions) & self._visible(directions)
            if not disc.any():
                continue
            lit, area_sr = np.ones(int(disc.sum()), dtype=bool), SUN_SOLID_ANGLE_SR
            if luminary is self.moon and self._moon is not None:
                lit = self._lit_moon(directions[disc])
                area_sr *= 0.5 * (1.0 + np.cos(np.radians(self._moon.phase_angle_deg)))
            share = 1.0 if share_towards is None else share_towards(luminary.direction)
            lux = self._disc_lux(luminary, directions[disc]) * (share * through[disc])[:, None]
            light = lux / max(area_sr, 0.01 * SUN_SOLID_ANGLE_SR)
            radiance[disc] += lit[:, None] * light.astype(np.float32)

    def _visible(self, directions: NDArray[np.float32]) -> NDArray[np.bool_]:
        """(...) which directions are above the level horizon."""
        above: NDArray[np.bool_] = directions[..., 2] > 0
        return above

    def _disc_lux(self, luminary: Luminary, directions: NDArray[np.float32]) -> NDArray[np.floating[Any]]:
        """(3,) or (..., 3) illuminance by the light that comes through the disc at directions. [lux]"""
        return luminary.beam_illuminance_lux()

    def _lit_moon(self, directions: NDArray[np.float32]) -> NDArray[np.bool_]:
        """(N,) which (N, 3) directions within the moon's disc hit its lit side."""
        assert self.moon is not None and self._moon is not None
        to_moon = self.moon.direction
        away = to_moon * (to_moon @ self.sun.direction) - self.sun.direction
        length = float(np.linalg.norm(away))
        away = away / length if length > 1e-6 else np.cross(to_moon, [0.0, 0.0, 1.0])
        offset = (directions.astype(np.float64) - to_moon) / SUN_RADIUS_RAD
        along = np.einsum("ni,i->n", offset, away)
        across = np.einsum("ni,i->n", offset, np.cross(to_moon, away))
        return lit_side_of_moon(self._moon, across.astype(np.float32), along.astype(np.float32))


def _meets_disc(luminary: Luminary, directions: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(...) which (..., 3) unit directions meet the disc."""
    cosine = np.einsum("...i,i->...", directions, luminary.direction.astype(np.float32))
    meets: NDArray[np.bool_] = cosine > np.cos(SUN_RADIUS_RAD)
    return meets
