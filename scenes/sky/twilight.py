"""The clear sky around sunset and through twilight.

Single scattering in a spherical, layered atmosphere gives the sky its shape and colour (the glow over the sun, the blue
zenith by ozone, the Earth's shadow). Multiple scattering is spread evenly. The sum is scaled to the measured
illuminance.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid
from scipy.ndimage import map_coordinates, spline_filter

from scenes.sky.photometry import REC709_LUMINANCE, Radiance, direction_from_angles, henyey_greenstein, scattering_depth

_EARTH_M = 6.371e6
_TOP_M = 9e4
_MOLECULE_SCALE_M, _AEROSOL_SCALE_M = 8000.0, 1500.0
# Ozone between 10 and 40 km, densest at 25 km; 300 Dobson units in the Chappuis band (Serdyuchenko et al. 2014,
# doi:10.5194/amt-7-625-2014, averaged over the channels by eye).
_OZONE_DEPTH = np.array([0.036, 0.028, 0.004])
_OZONE_CENTER_M, _OZONE_HALF_WIDTH_M = 25_000.0, 15_000.0
_AEROSOL_ASYMMETRY = 0.72
_ELEVATIONS, _AZIMUTHS, _VIEW_STEPS, _SUN_STEPS = 26, 22, 28, 20
# Share of multiple scattering in the illuminance, by elevation of the sun, and its colour: our compromise between
# measurements of the zenith's colour and brightness (tests state how close it is).
_MULTIPLE_SHARE = ((-18.0, 1.0), (-15.0, 0.65), (-9.0, 0.55), (-4.0, 0.35), (0.0, 0.25), (10.0, 0.2))
_DARKEST = 1e-30
_MULTIPLE_RGB = np.array([0.62, 0.98, 1.75])


def twilight_illuminance_lux(sun_elevation_deg: float) -> float:
    """Illuminance of level ground by the clear sky alone, without sun, moon and night sky. [lux]

    Source: Janiczek and DeYoung 1987, Computer programs for sun and moon illuminance, US Naval Observatory Circular
    171: the term of the sky.
    """
    sine, cosine = np.sin(np.radians(sun_elevation_deg)), np.cos(np.radians(sun_elevation_deg))
    shell = 753.66156
    inner = np.sqrt(1.0 - (shell * cosine / (shell + 1.0)) ** 2)
    mass = shell * (inner - sine) + inner
    sky = 0.0289 * np.exp(-0.042 * mass) * (1.0 + (sun_elevation_deg + 90.0) * sine / 57.29577951)
    return float(133_775.0 * sky)


class TwilightSky:
    """The sky under a sun near or below the horizon.

    Args:
        turbidity: as in `Environment`.
        sun_elevation_deg, sun_azimuth_deg: direction to the sun. [deg]
    """

    def __init__(self, turbidity: float, sun_elevation_deg: float, sun_azimuth_deg: float) -> None:
        self._azimuth_rad = np.radians(sun_azimuth_deg)
        elevation, azimuth = _grid()
        single = _single_scattering(turbidity, direction_from_angles(sun_elevation_deg, 0.0), elevation, azimuth)
        single_lux = max(_level_illuminance(single, elevation, azimuth), _DARKEST)
        elevations, shares = zip(*_MULTIPLE_SHARE, strict=True)
        multiple = float(np.interp(sun_elevation_deg, elevations, shares))
        # Evenly lit air is brighter where it is deeper, until it is opaque.
        even = (1.0 + 0.8 * np.exp(-np.degrees(elevation) / 12.0))[..., None] * (
            _MULTIPLE_RGB / (_MULTIPLE_RGB @ REC709_LUMINANCE)
        )
        wanted_lux = twilight_illuminance_lux(sun_elevation_deg)
        table = wanted_lux * (
            (1.0 - multiple) * single / single_lux + multiple * even / _level_illuminance(even, elevation, azimuth)
        )
        self._spline = [spline_filter(np.log(np.maximum(table[..., c], 1e-12)), mode="mirror") for c in range(3)]

    def radiance(self, directions: NDArray[np.floating[Any]]) -> Radiance:
        """Radiance of the sky.

        Args:
            directions: (..., 3) unit vectors in world axes; those below the horizon get the horizon's radiance.

        Returns:
            (..., 3) luminance-scaled linear Rec. 709. [cd/m2]
        """
        d = np.asarray(directions, dtype=np.float64).reshape(-1, 3)
        elevation = np.arcsin(np.clip(d[..., 2], 0.0, 1.0))
        apart = np.arctan2(d[..., 1], d[..., 0]) - self._azimuth_rad
        apart = np.abs((apart + np.pi) % (2 * np.pi) - np.pi)
        row = np.sqrt(elevation / (np.pi / 2)) * (_ELEVATIONS - 1)
        column = apart / np.pi * (_AZIMUTHS - 1)
        out = np.empty(d.shape, dtype=np.float32)
        for channel, spline in enumerate(self._spline):
            out[..., channel] = np.exp(map_coordinates(spline, [row, column], order=3, mode="mirror", prefilter=False))
        return out.reshape(np.shape(directions))


def _grid() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(26, 22) elevations, closer together near the horizon, and azimuths from the sun. [rad]"""
    rows = (np.arange(_ELEVATIONS) / (_ELEVATIONS - 1)) ** 2 * np.pi / 2
    columns = np.arange(_AZIMUTHS) / (_AZIMUTHS - 1) * np.pi
    elevation, azimuth = np.meshgrid(rows, columns, indexing="ij")
    return elevation, azimuth


def _level_illuminance(
    table: NDArray[np.float64], elevation: NDArray[np.float64], azimuth: NDArray[np.float64]
) -> float:
    """Illuminance of level ground by a table of radiance over half the sky. [lux]"""
    light = np.broadcast_to(table @ REC709_LUMINANCE, elevation.shape) * np.sin(elevation) * np.cos(elevation)
    return float(2.0 * trapezoid(trapezoid(light, azimuth[0], axis=1), elevation[:, 0]))


def _densities(height_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Densities of molecules, aerosol and ozone over their vertical columns. [1/m]"""
    molecules = np.exp(-height_m / _MOLECULE_SCALE_M) / _MOLECULE_SCALE_M
    aerosol = np.exp(-height_m / _AEROSOL_SCALE_M) / _AEROSOL_SCALE_M
    ozone = np.maximum(1.0 - np.abs(height_m - _OZONE_CENTER_M) / _OZONE_HALF_WIDTH_M, 0.0) / _OZONE_HALF_WIDTH_M
    return molecules, aerosol, ozone


def _depth_to_sun(
    depths: NDArray[np.float64], height_m: NDArray[np.float64], sine: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(..., 3) optical depth from points at a height towards the sun, infinite through the Earth.

    Args:
        depths: (3, 3) vertical depth by constituent and channel.
        height_m: (...) of the points.
        sine: (...) of the sun's elevation at each point.
    """
    radius = _EARTH_M + height_m
    out_m = -radius * sine + np.sqrt(np.maximum((radius * sine) ** 2 + (_EARTH_M + _TOP_M) ** 2 - radius**2, 0.0))
    lowest = np.where(sine < 0, radius * np.sqrt(np.maximum(1 - sine**2, 0.0)), radius) - _EARTH_M
    nearest_m = np.where(sine < 0, -radius * sine, 0.0)
    column = np.zeros((3, *height_m.shape))
    # Steps are shorter around the lowest point of the ray, where nearly all of the air is.
    for low, high in ((np.zeros_like(nearest_m), nearest_m), (nearest_m, out_m)):
        edges = (np.arange(_SUN_STEPS // 2 + 1) / (_SUN_STEPS // 2)) ** 2
        edges = edges if high is out_m else 1.0 - edges[::-1]
        for first, last in pairwise(edges):
            middle_m = low + (high - low) * 0.5 * (first + last)
            height = np.sqrt(np.maximum(radius**2 + middle_m**2 + 2 * radius * middle_m * sine, 1.0)) - _EARTH_M
            length_m = (high - low) * (last - first)
            column += np.stack(_densities(np.maximum(height, 0.0))) * length_m
    depth: NDArray[np.float64] = np.einsum("k...,kc->...c", column, depths)
    # The edge of the Earth's shadow is as soft as the lowest air is deep.
    depth += (200.0 * np.maximum(-lowest / 3000.0, 0.0))[..., None]
    return depth


def _single_scattering(
    turbidity: float, sun: NDArray[np.float64], elevation: NDArray[np.float64], azimuth: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(E, A, 3) light scattered once to the ground, per illuminance outside the atmosphere. [1/sr]"""
    molecules, aerosol = scattering_depth(turbidity)
    depths = np.stack([molecules, aerosol, _OZONE_DEPTH])
    sine, cosine = np.sin(elevation), np.cos(elevation)
    towards_sun = cosine * np.cos(azimuth) * sun[0] + sine * sun[2]
    rayleigh = 3.0 / (16.0 * np.pi) * (1.0 + towards_sun**2)
    mie = henyey_greenstein(towards_sun, _AEROSOL_ASYMMETRY)
    length_m = -_EARTH_M * sine + np.sqrt((_EARTH_M * sine) ** 2 + 2 * _EARTH_M * _TOP_M + _TOP_M**2)
    edges = (np.arange(_VIEW_STEPS + 1) / _VIEW_STEPS) ** 2
    seen = np.zeros((*elevation.shape, 3))
    before = np.zeros((*elevation.shape, 3))
    for first, last in pairwise(edges):
        at_m = length_m * 0.5 * (first + last)
        step_m = length_m * (last - first)
        radius = np.sqrt(_EARTH_M**2 + at_m**2 + 2 * _EARTH_M * at_m * sine)
        height_m = np.maximum(radius - _EARTH_M, 0.0)
        up_sun = ((_EARTH_M + at_m * sine) * sun[2] + at_m * cosine * np.cos(azimuth) * sun[0]) / radius
        density = np.stack(_densities(height_m))
        scattering = (
            density[0, ..., None] * molecules * rayleigh[..., None] + density[1, ..., None] * aerosol * mie[..., None]
        )
        here = np.einsum("k...,kc->...c", density, depths) * step_m[..., None]
        lit = np.exp(-_depth_to_sun(depths, height_m, up_sun) - before - 0.5 * here)
        seen += lit * scattering * step_m[..., None]
        before += here
    return seen
