"""The clear sky: by day, after Preetham et al., around sunset and through twilight, and at night with moon and stars.

Twilight is single scattering in a spherical, layered atmosphere, which gives the sky its shape and colour (the glow
over the sun, the blue zenith by ozone, the Earth's shadow). Multiple scattering is spread evenly. The sum is scaled to
the measured illuminance. Products over many directions use einsum, because BLAS rounds differently with another number
of threads.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid
from scipy.ndimage import map_coordinates, spline_filter

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.types.environment import Moon
from scenes.sky.photometry import (
    REC709_FROM_XYZ,
    REC709_LUMINANCE,
    SOLAR_ILLUMINANCE_LUX,
    Radiance,
    air_mass,
    direction_from_angles,
    hemisphere,
    henyey_greenstein,
    luminance,
    scattering_depth,
)

# Perez's function is singular at the horizon and undefined below it.
_LOWEST_COSINE = 1e-3
# The model's chromaticity turns pink towards the horizon, unlike any sky: it is kept nearly constant below 7 degrees.
_LOWEST_CHROMATIC_COSINE = 0.12
# Lowest turbidity that the model was fitted to, and scale height of the haze. [m]
_LEAST_TURBIDITY, _HAZE_SCALE_M = 1.9, 1500.0
# Above this x the sky is on the daylight locus; below it by the range, the model alone counts.
_GREEN_BEYOND_X, _GREEN_RANGE_X = 0.34, 0.08
# White is the sun outside the atmosphere, as for its beam: its chromaticity, about that of daylight of 5900 K, is
# adapted to that of D65 by the Bradford transform (Lam 1985).
_SUN_XYZ = np.array([0.3235 / 0.3395, 1.0, (1.0 - 0.3235 - 0.3395) / 0.3395])
_D65_XYZ = np.array([0.95047, 1.0, 1.08883])
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_ADAPTED_FROM_XYZ = REC709_FROM_XYZ @ (
    np.linalg.inv(_BRADFORD) @ np.diag((_BRADFORD @ _D65_XYZ) / (_BRADFORD @ _SUN_XYZ)) @ _BRADFORD
)

# Preetham, Shirley, Smits 1999 (doi:10.1145/311535.311545), appendix A.2: distribution coefficients A..E against
# turbidity (slope, offset) for luminance Y and chromaticities x, y.
_PEREZ = {
    "Y": ((0.1787, -1.4630), (-0.3554, 0.4275), (-0.0227, 5.3251), (0.1206, -2.5771), (-0.0670, 0.3703)),
    "x": ((-0.0193, -0.2592), (-0.0665, 0.0008), (-0.0004, 0.2125), (-0.0641, -0.8989), (-0.0033, 0.0452)),
    "y": ((-0.0167, -0.2608), (-0.0950, 0.0092), (-0.0079, 0.2102), (-0.0441, -1.6537), (-0.0109, 0.0529)),
}
# The same appendix: zenith chromaticity as [T^2 T 1] M [s^3 s^2 s 1], s the sun's zenith angle.
_ZENITH_X = np.array(
    [[0.00166, -0.00375, 0.00209, 0.0], [-0.02903, 0.06377, -0.03202, 0.00394], [0.11693, -0.21196, 0.06052, 0.25886]]
)
_ZENITH_Y = np.array(
    [[0.00275, -0.00610, 0.00317, 0.0], [-0.04214, 0.08970, -0.04153, 0.00516], [0.15346, -0.26756, 0.06670, 0.26688]]
)


class DaylightSky:
    """Preetham's daylight model under the full sun.

    The model is one of the sky seen from the ground. Its brightness is used unchanged at altitude. Its colour is that
    of the haze above the camera, because haze turns the sky around a low sun orange.

    Args:
        turbidity: 1.9 to 10.
        sun_elevation_deg, sun_azimuth_deg: direction to the sun, which must be above the horizon. [deg]
        altitude_m: of the camera. [m]
    """

    def __init__(
        self, turbidity: float, sun_elevation_deg: float, sun_azimuth_deg: float, altitude_m: float = 0.0
    ) -> None:
        self._turbidity = turbidity
        haze = (turbidity - _LEAST_TURBIDITY) * np.exp(-altitude_m / _HAZE_SCALE_M)
        self._chromatic_turbidity = float(_LEAST_TURBIDITY + haze)
        self.sun_direction = direction_from_angles(sun_elevation_deg, sun_azimuth_deg)
        self._sun_zenith_rad = np.radians(90.0 - sun_elevation_deg)

    @cached_property
    def _zenith_xyy(self) -> tuple[float, float, float]:
        turbidity, sun = self._turbidity, self._sun_zenith_rad
        colored = self._chromatic_turbidity
        powers, sun_powers = np.array([colored**2, colored, 1.0]), np.array([sun**3, sun**2, sun, 1.0])
        chi = (4.0 / 9.0 - turbidity / 120.0) * (np.pi - 2.0 * sun)
        luminance_kcd_m2 = (4.0453 * turbidity - 4.9710) * np.tan(chi) - 0.2155 * turbidity + 2.4192
        x, y = powers @ _ZENITH_X @ sun_powers, powers @ _ZENITH_Y @ sun_powers
        return float(x), float(y), float(max(luminance_kcd_m2, 0.05) * 1e3)

    @cached_property
    def level_illuminance_lux(self) -> float:
        """Illuminance of level ground by the sky alone. [lux]"""
        directions, weight = hemisphere(30)
        return float((luminance(self.radiance(directions)) * weight).sum())

    def radiance(self, directions: NDArray[np.floating[Any]]) -> Radiance:
        """Radiance of the sky without the sun's disc.

        Args:
            directions: (..., 3) unit vectors in world axes; those below the horizon get the horizon's radiance.

        Returns:
            (..., 3) luminance-scaled linear Rec. 709. [cd/m2]
        """
        d = np.asarray(directions, dtype=np.float64)
        cos_zenith = np.maximum(d[..., 2], _LOWEST_COSINE)
        cos_gamma = np.clip(np.einsum("...i,i->...", d, self.sun_direction), -1.0, 1.0)
        gamma = np.arccos(cos_gamma)
        zenith = self._zenith_xyy
        softened = np.hypot(cos_zenith, _LOWEST_CHROMATIC_COSINE)
        x, y, luminance = (
            self._relative(key, cosine, gamma, cos_gamma) * scale
            for key, cosine, scale in zip(("x", "y", "Y"), (softened, softened, cos_zenith), zenith, strict=True)
        )
        # Around a low sun the model is too green; measured skies keep to the daylight locus (CIE 15).
        locus = (2.870 - 3.0 * x) * x - 0.275
        y = locus + (y - locus) * np.clip((_GREEN_BEYOND_X - x) / _GREEN_RANGE_X, 0.0, 1.0)
        xyz = np.stack([x / y * luminance, luminance, (1.0 - x - y) / y * luminance], axis=-1)
        rgb = np.maximum(np.einsum("...j,ij->...i", xyz, _ADAPTED_FROM_XYZ), 0.0)
        # Adaptation changes the colour and must keep the luminance.
        rgb *= (luminance / np.einsum("...c,c->...", rgb, REC709_LUMINANCE))[..., None]
        result: Radiance = rgb.astype(np.float32)
        return result

    def _relative(
        self, key: str, cos_zenith: NDArray[np.float64], gamma: NDArray[np.float64], cos_gamma: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Perez's function, relative to its value at the zenith."""
        turbidity = self._turbidity if key == "Y" else self._chromatic_turbidity
        a, b, c, d, e = (slope * turbidity + offset for slope, offset in _PEREZ[key])
        value = (1 + a * np.exp(b / cos_zenith)) * (1 + c * np.exp(d * gamma) + e * cos_gamma**2)
        sun = self._sun_zenith_rad
        at_zenith = (1 + a * np.exp(b)) * (1 + c * np.exp(d * sun) + e * np.cos(sun) ** 2)
        result: NDArray[np.float64] = value / at_zenith
        return result


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


# Shares of what molecules and aerosol scatter that they send back up, and its power of the air mass: fitted to what the
# sky of `sky_model = "scattering"` sends to ground of 0.1, for turbidities of 1.9 to 10 and suns from 10 degrees up.
# The sky is within 14 % of it, 3 % in the mean of squares, and sky and beam together within 6 % up to a turbidity of 4.
_BACK_BY_MOLECULES, _BACK_BY_AEROSOL, _BACK_POWER = 0.425, 0.224, 1.3


def daylight_illuminance_lux(sun_elevation_deg: float, turbidity: float) -> float:
    """Illuminance of level ground by the clear sky alone, under a sun well above the horizon. [lux]

    Air that absorbs nothing transmits 1 / (1 + b tau m) of the light, b the share of what it scatters that goes back up
    and tau m its optical depth; the sky sends what the beam does not. So both together are less than the sunlight
    outside the air.

    Source: the two-stream approximation of Coakley and Chylek 1975
    (doi:10.1175/1520-0469(1975)032<0409:TTSAIR>2.0.CO;2), whose b depends on the angle too.
    """
    molecules, aerosol = (float(depth[1]) for depth in scattering_depth(turbidity))
    mass = air_mass(sun_elevation_deg)
    back = (_BACK_BY_MOLECULES * molecules + _BACK_BY_AEROSOL * aerosol) * mass**_BACK_POWER
    through = 1.0 / (1.0 + back) - np.exp(-(molecules + aerosol) * mass)
    return float(SOLAR_ILLUMINANCE_LUX * np.sin(np.radians(sun_elevation_deg)) * through)


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


# Dark sites: 21.9 mag/arcsec2 at the zenith, 1.9e-4 cd/m2 (Leinert et al. 1998, doi:10.1051/aas:1998105), with the
# brighter stars, which the background of telescopes excludes, 2.6e-4.
_ZENITH_CD_M2 = 2.6e-4
_AIRGLOW_SHARE, _AIRGLOW_HEIGHT_M = 0.6, 9e4
EXTINCTION_MAG = 0.17
_NIGHT_RGB = np.array([1.02, 1.0, 0.95], dtype=np.float32)
# A star of magnitude m gives 10^(-0.4 (m + 14.18)) lux (Allen's Astrophysical Quantities, 4th ed., sec. 2.6).
_LUX_ZERO_MAGNITUDE = 14.18
_FULL_MOON_MAGNITUDE = -12.73
# Number of stars brighter than magnitude m in the whole sky: 10^(0.5 m + 0.70) (ibid., sec. 19.2, for m 1 to 6).
_FAINTEST_MAGNITUDE = 6.0
_STAR_SEED = 20


def night_radiance(directions: NDArray[np.floating[Any]]) -> Radiance:
    """Airglow and starlight without a moon. [cd/m2]

    Args:
        directions: (..., 3) unit vectors in world axes; those below the horizon get the horizon's radiance.
    """
    up = np.clip(np.asarray(directions[..., 2], dtype=np.float32), 0.0, 1.0)
    shell = np.float32((_EARTH_M / (_EARTH_M + _AIRGLOW_HEIGHT_M)) ** 2)
    longer = 1.0 / np.sqrt(1.0 - shell * (1.0 - up * up))
    mass = 1.0 / (up + 0.025 * np.exp(-11.0 * up))  # Rozenberg 1966
    left = np.float32(10.0) ** (-0.4 * EXTINCTION_MAG * (mass - 1.0))
    level = (_AIRGLOW_SHARE * longer + (1.0 - _AIRGLOW_SHARE)) * left + 0.35 * (1.0 - left)
    result: Radiance = (np.float32(_ZENITH_CD_M2) * level)[..., None].astype(np.float32) * _NIGHT_RGB
    return result


def moon_illuminance_lux(phase_angle_deg: float) -> float:
    """Illuminance by the moon outside the atmosphere at its mean distance. [lux]

    Source: Krisciunas and Schaefer 1991 (doi:10.1086/132921), equation 9.
    """
    magnitude = _FULL_MOON_MAGNITUDE + 0.026 * phase_angle_deg + 4e-9 * phase_angle_deg**4
    return float(10.0 ** (-0.4 * (magnitude + _LUX_ZERO_MAGNITUDE)))


def lit_side_of_moon(moon: Moon, across: NDArray[np.float32], away_from_sun: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which points of the moon's disc are lit.

    Args:
        moon: gives the phase.
        across, away_from_sun: coordinates on the disc in radii; the second axis points away from the sun.
    """
    depth = np.sqrt(np.maximum(1.0 - across**2 - away_from_sun**2, 0.0))
    phase = np.radians(moon.phase_angle_deg)
    lit: NDArray[np.bool_] = depth * np.cos(phase) - away_from_sun * np.sin(phase) > 0
    return lit


@lru_cache(maxsize=1)
def star_catalogue() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (S, 3) and illuminance (S,) [lux] of random stars to magnitude 6, in their true number.

    Fainter stars are part of `night_radiance`.
    """
    rng = frame_generator(_STAR_SEED, 0, "stars")
    count = round(10 ** (0.5 * _FAINTEST_MAGNITUDE + 0.70))
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # The inverse of the law of numbers at uniform ranks.
    magnitude = (np.log10(np.maximum(rng.random(count), 1e-4) * count) - 0.70) / 0.5
    return directions, 10.0 ** (-0.4 * (magnitude + _LUX_ZERO_MAGNITUDE))
