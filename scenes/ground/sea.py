"""The sea: waves, reflections of sky and sun, foam, and ships.

Some ships are red, which a search for red discs must not mistake for markers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator
from drogue_models.frozen_model import ReflectanceRgb
from geometry.bilinear_sampling import sample_bilinear
from scenes.ground_view import Axes, Field, GroundView, MipTile, kept_tile, power_noise
from scenes.sky.photometry import Radiance

_WATER_INDEX = 1.34
_SEED = 5
_TILE_PX, _TILE_TEXEL_M = 1024, 2.0
_LONGEST_WAVE_M, _SHORTEST_WAVE_M = 130.0, 4.0
# Waves of weaker winds are shorter, but a tile that is made too small repeats in view.
_LEAST_PEAK_M = 20.0
# Of the resolved variance, waves that run across the others, so that no two places of a large sea are alike.
_CROSS_SHARE, _CROSS_SCALE, _CROSS_RAD = 0.3, 0.61, 0.5
# Slope variance is even over the octaves from gravity waves to ripples; the longest 4 of about 13 are resolved.
_RESOLVED_SHARE = 0.3
# Swell of 0.5 to 2 m height between crest and trough, from winds far away.
_SWELL_TILE_PX, _SWELL_TEXEL_M, _SWELL_LENGTH_M = 512, 12.0, 170.0
_SWELL_SLOPES = 0.006, 0.022
_GUSTINESS = 0.3  # standard deviation of the slopes' variance over patches of wind, our choice
_FOAM_REFLECTANCE = 0.35  # fresh and fading foam, Koepke 1984 (doi:10.1364/AO.23.001816)
_FOAM_PATCHES = 0.01  # share of the tile under foam patches
_TABLE_ROWS, _TABLE_COLUMNS = 20, 36
# Factors on the variance of the slopes for which the mirrored sky is tabulated.
_SMOOTH, _ROUGH = 0.4, 1.9
_SKY_ROWS, _SKY_COLUMNS = 24, 72
_HULLS: tuple[ReflectanceRgb, ...] = ((0.38, 0.05, 0.04), (0.22, 0.05, 0.035), (0.05, 0.07, 0.12), (0.10, 0.10, 0.10))
_HOUSE: ReflectanceRgb = (0.55, 0.55, 0.53)
_WAKE_REFLECTANCE = 0.22
_WAKE_LENGTHS = 7.0
_MOST_SHIPS = 4


@dataclass(frozen=True, eq=False)
class GroundLight:
    """Light on the ground.

    Attributes:
        sky_lux: (3,) illuminance of level ground by everything except the beam. [lux]
        beam_direction: (3,) unit vector towards sun or moon.
        beam_lux: (3,) illuminance of a plane that faces the beam. [lux]
        sky_radiance: radiance of the sky along (H, W, 3) directions above the horizon. [cd/m2]
    """

    sky_lux: NDArray[np.float64]
    beam_direction: NDArray[np.float64]
    beam_lux: NDArray[np.float64]
    sky_radiance: Callable[[NDArray[np.float32]], Radiance]

    @property
    def level_lux(self) -> NDArray[np.float64]:
        """(3,) illuminance of level ground. [lux]"""
        result: NDArray[np.float64] = self.sky_lux + self.beam_lux * max(float(self.beam_direction[2]), 0.0)
        return result


def slope_variances(wind_speed_m_s: float) -> tuple[float, float]:
    """Mean squares of the slopes of a clean sea, along the wind and across it.

    Source: Cox and Munk 1954 (doi:10.1364/JOSA.44.000838), for the wind at 12.5 m.
    """
    return 0.00316 * wind_speed_m_s + 1e-3, 0.003 + 0.00192 * wind_speed_m_s


def foam_fraction(wind_speed_m_s: float) -> float:
    """Share of the sea under whitecaps. Source: Monahan and O'Muircheartaigh 1980, W = 3.84e-6 U^3.41."""
    return float(3.84e-6 * wind_speed_m_s**3.41)


def longest_wave_m(wind_speed_m_s: float) -> float:
    """Length of the waves with most energy in a sea that the wind has long blown over. [m]

    Source: Pierson and Moskowitz 1964 (doi:10.1029/JZ069i024p05181), whose peak is at 0.877 g / U.
    """
    return 2 * np.pi * wind_speed_m_s**2 / (0.877**2 * 9.81)


def fresnel(cosine: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Share of unpolarised light that water reflects, from the cosine of the angle of incidence."""
    inside = np.sqrt(1.0 - (1.0 - cosine * cosine) / _WATER_INDEX**2)
    across = ((cosine - _WATER_INDEX * inside) / (cosine + _WATER_INDEX * inside)) ** 2
    along = ((inside - _WATER_INDEX * cosine) / (inside + _WATER_INDEX * cosine)) ** 2
    result: NDArray[np.floating[Any]] = 0.5 * (across + along)
    return result


def hidden_share(sine: NDArray[np.floating[Any]], variance: float) -> NDArray[np.floating[Any]]:
    """Smith's Lambda: hidden over visible area of waves.

    Source: Smith 1967 (doi:10.1109/TAP.1967.1138991), with Walter et al. 2007's rational approximation
    (doi:10.2312/EGWR/EGSR07/195-206).
    """
    cotangent = sine / np.sqrt(np.maximum(1.0 - sine * sine, 1e-6))
    a = cotangent / np.sqrt(2.0 * variance)
    result: NDArray[np.floating[Any]] = np.where(
        a < 1.6, (1 - 1.259 * a + 0.396 * a * a) / (3.535 * a + 2.181 * a * a), 0
    )
    return result


@lru_cache(maxsize=1)
def _wave_tile() -> MipTile:
    """Slopes along and across the wind (together of unit variance), and patches of foam (mean `_FOAM_PATCHES`)."""
    return kept_tile("waves", __file__, _waves)


def _waves() -> MipTile:
    rng = frame_generator(_SEED, 0, "waves")
    k1, k2 = np.meshgrid(
        np.fft.fftfreq(_TILE_PX, _TILE_TEXEL_M), np.fft.rfftfreq(_TILE_PX, _TILE_TEXEL_M), indexing="ij"
    )
    k = np.hypot(k1, k2)
    safe = np.maximum(k, 1e-9)
    # Slope variance falls a little from octave to octave: the height's amplitude goes as k^-2.3 in two dimensions.
    band = np.exp(-((1.0 / (safe * _LONGEST_WAVE_M)) ** 4)) * (k < 1.0 / _SHORTEST_WAVE_M)
    spread = np.sqrt(0.25 + (k2 / safe) ** 4)
    height = np.fft.rfft2(rng.standard_normal((_TILE_PX, _TILE_PX))) * np.where(k > 0, band * spread / safe**2.3, 0.0)
    size = (_TILE_PX, _TILE_PX)
    along, across = np.fft.irfft2(1j * k2 * height, s=size), np.fft.irfft2(1j * k1 * height, s=size)
    scale = 1.0 / np.sqrt(along.var() + across.var())
    noise = power_noise(_SEED, "foam", _TILE_PX, 0.9, 60.0)
    foam = noise > np.quantile(noise, 1.0 - _FOAM_PATCHES)
    return MipTile(np.stack([along * scale, across * scale, foam], axis=-1).astype(np.float32), _TILE_TEXEL_M)


@lru_cache(maxsize=1)
def _swell_tile() -> MipTile:
    """Slopes of unit variance along the way of a swell: waves of nearly one length and direction, in groups."""
    rng = frame_generator(_SEED, 0, "swell")
    size = (_SWELL_TILE_PX, _SWELL_TILE_PX)
    down, across = np.meshgrid(
        np.fft.fftfreq(_SWELL_TILE_PX, _SWELL_TEXEL_M), np.fft.rfftfreq(_SWELL_TILE_PX, _SWELL_TEXEL_M), indexing="ij"
    )
    length, turn = np.hypot(down, across) * _SWELL_LENGTH_M, np.arctan2(down, np.maximum(across, 1e-12))
    amplitude = np.exp(-(((length - 1.0) / 0.16) ** 2) - (turn / 0.2) ** 2)
    slopes = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(size)) * amplitude, s=size)
    return MipTile((slopes / slopes.std())[..., None].astype(np.float32), _SWELL_TEXEL_M)


@lru_cache(maxsize=1)
def _gust_tile() -> MipTile:
    """Cat's paws and slicks between 20 m and 2 km, of unit variance."""
    return MipTile(power_noise(_SEED, "gusts", 512, 1.5, 5.0)[..., None], 8.0)


class Sea:
    """Water under one sky and wind.

    Args:
        light: on the sea.
        wind_speed_m_s: at 12.5 m above the sea. [m/s]
        wind_rad: direction to which the wind blows, from east towards north. [rad]
        swell_rad: direction to which the swell runs, likewise. [rad]
        swell: slope of the swell, from 0 for the least to 1 for the most.
    """

    def __init__(
        self, light: GroundLight, wind_speed_m_s: float, wind_rad: float, swell_rad: float = 0.0, swell: float = 0.0
    ) -> None:
        self._light = light
        self._along, self._across = slope_variances(wind_speed_m_s)
        self._foam = foam_fraction(wind_speed_m_s)
        self._wind_rad, self._swell_rad = wind_rad, swell_rad
        self._wind = np.float32(np.cos(wind_rad)), np.float32(np.sin(wind_rad))
        self._scale = _LONGEST_WAVE_M / max(longest_wave_m(wind_speed_m_s), _LEAST_PEAK_M)
        self._swell_slope = _SWELL_SLOPES[0] + swell * (_SWELL_SLOPES[1] - _SWELL_SLOPES[0])
        self._smooth, self._rough = self._sky_table(_SMOOTH), self._sky_table(_ROUGH)

    def radiance(self, view: GroundView, body_rgb: Field, gusts: Field) -> Radiance:
        """(H, W, 3) radiance of the water. [cd/m2]

        Args:
            view: pieces of the sea.
            body_rgb: (H, W, 3) or (3,) diffuse reflectance of the water body.
            gusts: (H, W) factor on the variance of the slopes.
        """
        cosine, sine = self._wind
        # Patches of wind are drawn out along it.
        u, v = cosine * view.x_m + sine * view.y_m, cosine * view.y_m - sine * view.x_m
        width_m = np.sqrt(view.across_m * view.along_m)
        paws = _gust_tile().sample(np.float32(0.4) * u, v, width_m)[..., 0]
        gusts = gusts * np.clip(1.0 + np.float32(_GUSTINESS) * paws, 0.25, 2.2)
        slope_x, slope_y, patches = self._waves(view)
        size = np.float32(np.sqrt(_RESOLVED_SHARE * (self._along + self._across))) * np.sqrt(gusts)
        slope_x, slope_y = self._with_swell(view, size * slope_x, size * slope_y)
        towards = slope_x * view.away_x + slope_y * view.away_y
        mirrored = self._mirrored_sky(view, towards, gusts)
        mirrored += self._glint(view, slope_x, slope_y, gusts)
        level = (self._light.level_lux / np.pi).astype(np.float32)
        foam = np.minimum(patches * gusts * np.float32(self._foam / _FOAM_PATCHES), 1.0)[..., None]
        water = mirrored + np.asarray(body_rgb, dtype=np.float32) * level
        result: Radiance = water + foam * (np.float32(_FOAM_REFLECTANCE) * level - water)
        return result

    def _waves(self, view: GroundView) -> tuple[Field, Field, Field]:
        """(H, W) slopes east and north, together of unit variance where nothing is averaged out, and foam patches."""
        ones, zeros = np.ones_like(view.x_m), np.zeros_like(view.x_m)
        parts = []
        for turn_rad, scale in ((0.0, self._scale), (_CROSS_RAD, _CROSS_SCALE * self._scale)):
            angle_rad = self._wind_rad + turn_rad
            cosine, sine = np.float32(np.cos(angle_rad)), np.float32(np.sin(angle_rad))
            waves = view.scaled(scale).average(_wave_tile(), axes=Axes(cosine, sine, ones, zeros, zeros))[0]
            along, across = waves[..., 0], waves[..., 1]
            parts.append((cosine * along - sine * across, sine * along + cosine * across, waves[..., 2]))
        first, second = np.float32(np.sqrt(1.0 - _CROSS_SHARE)), np.float32(np.sqrt(_CROSS_SHARE))
        (x, y, foam), (cross_x, cross_y, _) = parts
        return first * x + second * cross_x, first * y + second * cross_y, foam

    def _with_swell(self, view: GroundView, slope_x: Field, slope_y: Field) -> tuple[Field, Field]:
        """(H, W) slopes east and north with those of the swell."""
        ones, zeros = np.ones_like(view.x_m), np.zeros_like(view.x_m)
        cosine, sine = np.float32(np.cos(self._swell_rad)), np.float32(np.sin(self._swell_rad))
        swell = view.average(_swell_tile(), axes=Axes(cosine, sine, ones, zeros, zeros))[0][..., 0]
        swell *= np.float32(self._swell_slope)
        return slope_x + cosine * swell, slope_y + sine * swell

    def _mirrored_sky(self, view: GroundView, towards: Field, gusts: Field) -> Radiance:
        """Sky mirrored in waves that a resolved slope tilts towards the camera; the tables hold the finer waves."""
        elevation = np.arcsin(np.clip(view.sine, 0.0, 1.0)) + towards
        row = _row_of_elevation(np.clip(elevation, 0.0, np.pi / 2)).astype(np.float32)
        azimuth = np.arctan2(view.away_y, view.away_x)
        column = np.mod(azimuth * np.float32(_TABLE_COLUMNS / (2 * np.pi)), np.float32(_TABLE_COLUMNS))
        shape = view.x_m.shape
        # One column is repeated at the end, because remap would wrap rows as well as columns.
        smooth, rough = (
            np.asarray(sample_bilinear(table, column, row, cv2.BORDER_REPLICATE), np.float32).reshape(*shape, 3)
            for table in (self._smooth, self._rough)
        )
        # Between the tables what is mirrored goes about as the logarithm of the variance.
        share = np.log(np.maximum(gusts, np.float32(1e-2)) / np.float32(_SMOOTH)) / np.float32(np.log(_ROUGH / _SMOOTH))
        share = np.clip(share, -0.5, 1.5)[..., None]
        result: Radiance = smooth + share * (rough - smooth)
        return result

    def _glint(self, view: GroundView, slope_x: Field, slope_y: Field, gusts: Field) -> Radiance:
        """Glint of sun or moon: the share of the surface with the slope that mirrors it into the camera.

        Source: Cox and Munk 1954, as above; L = R E p / (4 sin(elevation of the camera) cos^4(tilt)).
        """
        to_sun = self._light.beam_direction.astype(np.float32)
        if to_sun[2] <= 0 or self._light.beam_lux.max() <= 0:
            return np.zeros((*view.x_m.shape, 3), dtype=np.float32)
        level = np.sqrt(np.maximum(1.0 - view.sine * view.sine, 0.0))
        half_x, half_y = to_sun[0] - level * view.away_x, to_sun[1] - level * view.away_y
        half_z = to_sun[2] + view.sine
        length = np.sqrt(half_x**2 + half_y**2 + half_z**2)
        tilt_x, tilt_y = -half_x / half_z - slope_x, -half_y / half_z - slope_y
        cosine, sine = self._wind
        along, across = cosine * tilt_x + sine * tilt_y, cosine * tilt_y - sine * tilt_x
        left = np.float32(1.0 - _RESOLVED_SHARE) * gusts
        vu, vc = np.float32(self._along) * left, np.float32(self._across) * left
        density = np.exp(-0.5 * (along**2 / vu + across**2 / vc)) / (np.float32(2 * np.pi) * np.sqrt(vu * vc))
        incidence = np.clip(0.5 * length, 0.0, 1.0)
        variance = 0.5 * (self._along + self._across)
        seen = 1.0 / (1.0 + hidden_share(view.sine, variance) + hidden_share(to_sun[2:], variance))
        fourth = (half_z / length) ** 4
        share = fresnel(incidence) * density * seen / (4.0 * np.maximum(view.sine, 0.01) * fourth)
        result: Radiance = share.astype(np.float32)[..., None] * self._light.beam_lux.astype(np.float32)
        return result

    def _sky_table(self, roughness: float) -> Radiance:
        """(rows, columns + 1, 3) mirrored sky by elevation of the camera over the water and azimuth of the ray.

        Args:
            roughness: factor on the variance of the slopes.
        """
        elevation = _elevation_of_row(np.arange(_TABLE_ROWS))
        azimuth = np.arange(_TABLE_COLUMNS + 1) * 2 * np.pi / _TABLE_COLUMNS
        e, a = np.meshgrid(elevation, azimuth, indexing="ij")
        back = np.stack([-np.cos(e) * np.cos(a), -np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
        total, weights = np.zeros((*e.shape, 3)), np.zeros(e.shape)
        sky = self._sky_map()
        cosine, sine = self._wind
        steps = np.linspace(-2.5, 2.5, 9)
        for s, t in np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2):
            along, across = s * np.sqrt(roughness * self._along), t * np.sqrt(roughness * self._across)
            normal = np.array([-(cosine * along - sine * across), -(sine * along + cosine * across), 1.0])
            normal /= np.linalg.norm(normal)
            facing = np.maximum(back @ normal, 0.0)
            weight = np.exp(-0.5 * (s * s + t * t)) * facing / normal[2]
            up = 2 * facing[..., None] * normal - back
            total += (weight * fresnel(facing))[..., None] * _nearest_sky(sky, up)
            weights += weight
        result: Radiance = (total / np.maximum(weights, 1e-12)[..., None]).astype(np.float32)
        return result

    def _sky_map(self) -> Radiance:
        elevation = (np.arange(_SKY_ROWS) + 0.5) * (np.pi / 2) / _SKY_ROWS
        azimuth = np.arange(_SKY_COLUMNS) * 2 * np.pi / _SKY_COLUMNS
        e, a = np.meshgrid(elevation, azimuth, indexing="ij")
        directions = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
        return self._light.sky_radiance(directions.astype(np.float32))


def _nearest_sky(sky: Radiance, directions: NDArray[np.float64]) -> Radiance:
    """The nearest texels of a sky map; directions below the horizon hit another wave, which mirrors low sky."""
    elevation = np.arcsin(np.clip(np.abs(directions[..., 2]), 0.0, 1.0))
    row = np.clip((elevation / (np.pi / 2) * _SKY_ROWS).astype(int), 0, _SKY_ROWS - 1)
    turns = np.arctan2(directions[..., 1], directions[..., 0]) / (2 * np.pi)
    column = np.rint(turns * _SKY_COLUMNS).astype(int) % _SKY_COLUMNS
    result: Radiance = sky[row, column]
    return result


def _elevation_of_row(row: NDArray[np.integer[Any]]) -> NDArray[np.float64]:
    result: NDArray[np.float64] = np.maximum((row / (_TABLE_ROWS - 1)) ** 1.5 * (np.pi / 2), 2e-3)
    return result


def _row_of_elevation(elevation_rad: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Row of an elevation; rows are closer together where the camera looks along the water."""
    result: NDArray[np.floating[Any]] = (_TABLE_ROWS - 1) * (elevation_rad / (np.pi / 2)) ** (2 / 3)
    return result


@dataclass(frozen=True)
class Ship:
    """A ship from above: a hull with its bridge aft, and a wake.

    Attributes:
        x_m, y_m: of its middle, east and north of the ground's origin. [m]
        heading_rad: from east towards north.
        length_m, width_m: [m]
        hull_rgb: diffuse reflectance of hull and deck.
    """

    x_m: float
    y_m: float
    heading_rad: float
    length_m: float
    width_m: float
    hull_rgb: ReflectanceRgb


def sample_ships(rng: np.random.Generator, altitude_m: float) -> tuple[Ship, ...]:
    """Up to four ships ahead of the camera."""
    ships = []
    for _ in range(int(rng.integers(0, _MOST_SHIPS + 1))):
        away_m = altitude_m * rng.uniform(3.5, 12.0)
        length_m = rng.uniform(60, 330)
        ships.append(
            Ship(
                x_m=float(away_m),
                y_m=float(away_m * rng.uniform(-0.35, 0.35)),
                heading_rad=float(rng.uniform(-np.pi, np.pi)),
                length_m=float(length_m),
                width_m=float(length_m / rng.uniform(5.5, 7.5)),
                hull_rgb=_HULLS[int(rng.integers(len(_HULLS)))],
            )
        )
    return tuple(ships)


def draw_ships(water: Radiance, view: GroundView, ships: tuple[Ship, ...], light: GroundLight) -> None:
    """Draw ships and their wakes into the radiance of the sea, in place."""
    level = (light.level_lux / np.pi).astype(np.float32)
    for ship in ships:
        reach_m = ship.length_m * (_WAKE_LENGTHS + 1)
        far_m, near_m = float(view.along_m.max()), float(view.x_m.min())
        if not near_m - reach_m - far_m < ship.x_m < float(view.x_m.max()) + reach_m + far_m:
            continue
        cosine, sine = np.float32(np.cos(ship.heading_rad)), np.float32(np.sin(ship.heading_rad))
        dx, dy = view.x_m - np.float32(ship.x_m), view.y_m - np.float32(ship.y_m)
        ahead, beside = cosine * dx + sine * dy, cosine * dy - sine * dx
        blur = _widths(view, cosine, sine)
        tail = np.clip(-ahead / np.float32(ship.length_m * _WAKE_LENGTHS), 0.0, 1.0)
        half_m = ship.width_m * (0.35 + 1.6 * tail)
        wake = inside_share(beside, half_m, blur[1]) * (1.0 - tail) * (ahead < 0)
        water += (0.8 * wake)[..., None] * (np.float32(_WAKE_REFLECTANCE) * level - water)
        hull = inside_share(ahead, ship.length_m / 2, blur[0]) * inside_share(beside, ship.width_m / 2, blur[1])
        water += hull[..., None] * (np.array(ship.hull_rgb, dtype=np.float32) * level - water)
        aft = inside_share(ahead + np.float32(0.38 * ship.length_m), 0.06 * ship.length_m, blur[0])
        house = aft * inside_share(beside, 0.45 * ship.width_m, blur[1])
        water += house[..., None] * (np.array(_HOUSE, dtype=np.float32) * level - water)


def _widths(view: GroundView, cosine: np.float32, sine: np.float32) -> tuple[Field, Field]:
    """(H, W) widths of the pieces of sea along the ship and across it. [m]"""
    along = np.abs(cosine * view.away_x + sine * view.away_y)
    across = np.abs(cosine * view.away_y - sine * view.away_x)
    return along * view.along_m + across * view.across_m, across * view.along_m + along * view.across_m


def inside_share(place_m: Field, half_m: Field | np.floating[Any] | float, blur_m: Field) -> Field:
    """(H, W) share of each piece of sea within a distance of a line."""
    low = np.maximum(place_m - blur_m / 2, -half_m)
    high = np.minimum(place_m + blur_m / 2, half_m)
    result: Field = (np.clip(high - low, 0.0, None) / blur_m).astype(np.float32)
    return result
