"""What the air is made of by height, how far light gets through it, and rays through its round layers.

The wavelengths that the atmosphere is computed at come first, and linear Rec. 709 from them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes.sky.photometry import REC709_FROM_XYZ, SUN_RADIUS_RAD, henyey_greenstein

WAVELENGTH_UM = np.array([0.40, 0.44, 0.48, 0.52, 0.56, 0.60, 0.64, 0.68])

# Sunlight outside the atmosphere from 380 to 720 nm in steps of 10 nm (ASTM G173-03). [W/m2/nm]
_SUN_NM = np.arange(380.0, 721.0, 10.0)
_SUN = np.array(
    [
        *(1.0125, 1.1472, 1.7277, 1.7305, 1.6887, 1.6125, 1.9120, 2.0347, 2.0204, 2.0221, 1.9338, 1.9581, 1.9169),
        *(1.8298, 1.8685, 1.8931, 1.8515, 1.8504, 1.8341, 1.8345, 1.8147, 1.7816, 1.7533, 1.6965, 1.6819, 1.6465),
        *(1.6048, 1.5214, 1.5562, 1.5113, 1.4740, 1.4482, 1.4102, 1.3678, 1.3419),
    ]
)
# Cross sections of ozone at 223 K, averaged over 40 nm around each wavelength (Serdyuchenko et al. 2014,
# doi:10.5194/amt-7-625-2014). [m2]
_OZONE_M2 = np.array([2.0e-27, 1.73e-26, 7.8e-26, 2.20e-25, 4.04e-25, 4.53e-25, 2.73e-25, 1.32e-25])
_DOBSON_PER_M2 = 2.687e20
_OZONE_DOBSON = 300.0

MOLECULE_DEPTH = 0.008569 * WAVELENGTH_UM**-4 * (1.0 + 0.0113 * WAVELENGTH_UM**-2 + 0.00013 * WAVELENGTH_UM**-4)
"""(L,) vertical optical depth of the molecules (Hansen and Travis 1974, doi:10.1007/BF00168069, eq. 2.30)."""
OZONE_DEPTH = _OZONE_M2 * _DOBSON_PER_M2 * _OZONE_DOBSON
"""(L,) vertical optical depth of ozone."""
AEROSOL_RELATIVE = (WAVELENGTH_UM / 0.55) ** -1.3
"""(L,) extinction of aerosol over that at 550 nm (Angstrom's exponent of continental haze)."""
MOLECULE_DEPTH_550 = 0.0973
"""Vertical optical depth of the molecules at 550 nm, by the same formula."""


def _lobe(nm: NDArray[np.float64], center: float, below: float, above: float) -> NDArray[np.float64]:
    slope = np.where(nm < center, below, above)
    lobe: NDArray[np.float64] = np.exp(-0.5 * ((nm - center) * slope) ** 2)
    return lobe


def color_matching(nm: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3) CIE 1931 colour-matching functions of (...) wavelengths. [nm]

    Source: Wyman, Sloan, Shirley 2013, JCGT 2(2).
    """
    x = (
        0.362 * _lobe(nm, 442.0, 0.0624, 0.0374)
        + 1.056 * _lobe(nm, 599.8, 0.0264, 0.0323)
        - 0.065 * _lobe(nm, 501.1, 0.0490, 0.0382)
    )
    y = 0.821 * _lobe(nm, 568.8, 0.0213, 0.0247) + 0.286 * _lobe(nm, 530.9, 0.0613, 0.0322)
    z = 1.217 * _lobe(nm, 437.0, 0.0845, 0.0278) + 0.681 * _lobe(nm, 459.0, 0.0385, 0.0725)
    matching: NDArray[np.float64] = np.stack([x, y, z], axis=-1)
    return matching


def _rgb_weights() -> NDArray[np.float64]:
    """(L, 3) linear Rec. 709, scaled so that sunlight outside the atmosphere is (1, 1, 1), of light over sunlight."""
    nm = np.arange(380.0, 721.0)
    shapes = np.stack([np.interp(nm, 1e3 * WAVELENGTH_UM, hat) for hat in np.eye(len(WAVELENGTH_UM))])
    xyz = np.einsum("ln,nk->lk", shapes * np.interp(nm, _SUN_NM, _SUN), color_matching(nm))
    # White is the sun, in the axes of cones as for the other skies (Lam 1985).
    cones = np.einsum("lk,ck->lc", xyz, BRADFORD)
    cones *= np.einsum("ck,k->c", BRADFORD, D65_XYZ) / cones.sum(axis=0)
    rgb = np.einsum("lc,kc->lk", cones, REC709_FROM_XYZ @ np.linalg.inv(BRADFORD))
    result: NDArray[np.float64] = rgb / rgb.sum(axis=0)
    return result


D65_XYZ = np.array([0.95047, 1.0, 1.08883])
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
RGB_WEIGHTS = _rgb_weights()


def rgb_of_spectrum(relative: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """(..., 3) linear Rec. 709 of (..., L) light over sunlight outside the atmosphere; no channel is negative."""
    rgb: NDArray[np.float64] = np.maximum(np.einsum("...l,lc->...c", relative, RGB_WEIGHTS), 0.0)
    return rgb


def spectrum_of_rgb(rgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., L) smooth reflectance of (..., 3) reflectances by channel."""
    blue, green, red = 0.465, 0.55, 0.61
    share = np.stack([np.interp(WAVELENGTH_UM, (blue, green, red), hat) for hat in np.eye(3)[::-1]], axis=-1)
    result: NDArray[np.float64] = np.einsum("...c,lc->...l", rgb, share)
    return result


Array = NDArray[np.float64]

EARTH_M, TOP_M = 6.371e6, 9e4
# Density of air by height (US Standard Atmosphere 1976). [m, kg/m3]
_AIR_M = np.array([0, 5e3, 10e3, 15e3, 20e3, 25e3, 30e3, 40e3, 50e3, 60e3, 70e3, 80e3, 90e3])
_AIR_KG_M3 = np.array(
    [
        1.225,
        0.7364,
        0.4135,
        0.1948,
        0.08891,
        0.04008,
        0.01841,
        3.996e-3,
        1.027e-3,
        3.097e-4,
        8.283e-5,
        1.846e-5,
        3.416e-6,
    ]
)
_AIR_LOG = np.log(_AIR_KG_M3)
# Column of air whose density is interpolated exponentially. [kg/m2]
_AIR_COLUMN_KG_M2 = float(np.sum(np.diff(_AIR_M) * np.diff(_AIR_KG_M3) / np.diff(_AIR_LOG)))
MOLECULES_AT_GROUND_PER_M = float(_AIR_KG_M3[0]) / _AIR_COLUMN_KG_M2
"""Density of molecules at the ground over their vertical column. [1/m]"""
_OZONE_CENTER_M, _OZONE_HALF_WIDTH_M = 25_000.0, 15_000.0
AEROSOL_ASYMMETRY, AEROSOL_ALBEDO = 0.76, 0.94
"""Asymmetry of the scattering and single-scattering albedo of continental aerosol (Hess et al. 1998, OPAC, 550 nm)."""
REPEATED_FIRST, REPEATED_SECOND = 0.66, 0.33
"""Legendre coefficients for light that was scattered before, of which only moments up to the second are known: those of
the phase function, 0.76 and 0.76^2, damped so that the sky differs least from that of Monte Carlo paths."""
_COLUMN_HEIGHTS, _COLUMN_ANGLES, _COLUMN_STEPS = 48, 160, 48


def rayleigh_phase(cosine: Any) -> Any:
    """Phase function of molecules, normalised over the sphere. [1/sr]"""
    return 3.0 / (16.0 * np.pi) * (1.0 + cosine * cosine)


def aerosol_phase(cosine: Any) -> Any:
    """Phase function of aerosol, normalised over the sphere. [1/sr]"""
    return henyey_greenstein(cosine, AEROSOL_ASYMMETRY)


@dataclass(frozen=True)
class AirLayers:
    """Molecules, aerosol and ozone over a round Earth; hashable, so that tables can be cached by it.

    Attributes:
        aerosol_per_m: extinction of the aerosol at the ground, at 550 nm. [1/m]
        aerosol_scale_m: height over which the aerosol thins out by a factor of e. [m]
        ground_rgb: diffuse reflectance of what lies below.
    """

    aerosol_per_m: float
    aerosol_scale_m: float
    ground_rgb: tuple[float, float, float] = (0.1, 0.1, 0.1)

    @cached_property
    def depths(self) -> Array:
        """(3, L) vertical optical depth of molecules, aerosol and ozone."""
        aerosol = self.aerosol_per_m * self.aerosol_scale_m * AEROSOL_RELATIVE
        return np.stack([MOLECULE_DEPTH, aerosol, OZONE_DEPTH])

    @cached_property
    def scattered(self) -> Array:
        """(2, L) vertical optical depth of what molecules and aerosol scatter."""
        aerosol = self.aerosol_per_m * self.aerosol_scale_m * AEROSOL_RELATIVE
        return np.stack([MOLECULE_DEPTH, AEROSOL_ALBEDO * aerosol])

    def densities(self, height_m: Array) -> Array:
        """(3, ...) density of molecules, aerosol and ozone at heights, over that of their vertical columns. [1/m]"""
        molecules = np.exp(np.interp(height_m, _AIR_M, _AIR_LOG)) / _AIR_COLUMN_KG_M2
        aerosol = np.exp(-height_m / self.aerosol_scale_m) / self.aerosol_scale_m
        ozone = np.maximum(1.0 - np.abs(height_m - _OZONE_CENTER_M) / _OZONE_HALF_WIDTH_M, 0.0) / _OZONE_HALF_WIDTH_M
        return np.stack([molecules, aerosol, ozone])

    def extinction_per_m(self, height_m: float) -> Array:
        """(L,) extinction coefficient at a height. [1/m]"""
        result: Array = np.einsum("k,kl->l", self.densities(np.array(height_m)), self.depths)
        return result

    def transmittance(self, height_m: Array, sine: Array) -> Array:
        """(..., L) share of light that reaches (...) heights from outside, from (...) sines of elevation.

        Directions into the ground get the transmittance of the horizon.
        """
        column = np.stack([_lookup(table, height_m, sine) for table in _columns(self.aerosol_scale_m)])
        result: Array = np.exp(-np.einsum("k...,kl->...l", column, self.depths))
        return result

    def sunlight(self, height_m: Array, sine: Array) -> Array:
        """(..., L) the same for light of sun or moon, of whose disc the Earth may hide a part."""
        above = np.arcsin(np.clip(sine, -1.0, 1.0)) + horizon_dip_rad(height_m)
        risen = np.clip((above + SUN_RADIUS_RAD) / (2 * SUN_RADIUS_RAD), 0.0, 1.0)
        result: Array = (risen * risen * (3.0 - 2.0 * risen))[..., None] * self.transmittance(height_m, sine)
        return result


def horizon_dip_rad(height_m: Any) -> Any:
    """Angle of the horizon below level from a height, without refraction. [rad]"""
    return np.arccos(EARTH_M / (EARTH_M + np.maximum(height_m, 0.0)))


def ray_length_m(height_m: Array, sine: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Length of rays from heights at sines of elevation to where the air ends [m], and whether that is the ground."""
    radius = EARTH_M + height_m
    along = -radius * sine
    to_ground = along * along - (2.0 * EARTH_M + height_m) * height_m
    falls = (sine < 0) & (to_ground >= 0)
    out = along + np.sqrt(along * along + (TOP_M - height_m) * (2.0 * EARTH_M + TOP_M + height_m))
    near = (2.0 * EARTH_M + height_m) * height_m / (along + np.sqrt(np.maximum(to_ground, 0.0)) + 1e-9)
    return np.where(falls, near, out), falls


def height_along_m(height_m: Array, sine: Array, distance_m: Array) -> Array:
    """Height at a distance along rays. [m]"""
    radius = EARTH_M + height_m
    rise = distance_m * distance_m + 2.0 * radius * distance_m * sine
    height: Array = height_m + rise / (radius + np.sqrt(np.maximum(radius * radius + rise, 1.0)))
    return height


def _mapped(height_m: Array, sine: Array) -> tuple[Array, Array]:
    """Row and column in a table by height and elevation, finest near the ground and the horizon.

    Source: Bruneton and Neyret 2008 (doi:10.1111/j.1467-8659.2008.01245.x), section 4.
    """
    radius = EARTH_M + np.clip(height_m, 0.0, TOP_M)
    tangent = np.sqrt(np.maximum(radius * radius - EARTH_M**2, 0.0))
    widest = np.sqrt((EARTH_M + TOP_M) ** 2 - EARTH_M**2)
    out = -radius * sine + np.sqrt(np.maximum((radius * sine) ** 2 + (EARTH_M + TOP_M) ** 2 - radius**2, 0.0))
    least, most = EARTH_M + TOP_M - radius, tangent + widest
    row = tangent / widest * (_COLUMN_HEIGHTS - 1)
    column = np.clip((out - least) / (most - least), 0.0, 1.0) * (_COLUMN_ANGLES - 1)
    return row, column


def _lookup(table: Array, height_m: Array, sine: Array) -> Array:
    row, column = _mapped(height_m, sine)
    top, left = (
        np.minimum(row.astype(np.intp), table.shape[0] - 2),
        np.minimum(column.astype(np.intp), table.shape[1] - 2),
    )
    down, right = row - top, column - left
    flat, first = table.reshape(-1), top * table.shape[1] + left
    above = flat[first] + right * (flat[first + 1] - flat[first])
    first = first + table.shape[1]
    below = flat[first] + right * (flat[first + 1] - flat[first])
    result: Array = above + down * (below - above)
    return result


@lru_cache(maxsize=16)
def _columns(aerosol_scale_m: float) -> tuple[Array, Array, Array]:
    """Three tables of columns from a height out of the atmosphere, over the vertical columns of all air."""
    widest = np.sqrt((EARTH_M + TOP_M) ** 2 - EARTH_M**2)
    tangent = np.arange(_COLUMN_HEIGHTS)[:, None] / (_COLUMN_HEIGHTS - 1) * widest
    radius = np.hypot(tangent, EARTH_M)
    least, most = EARTH_M + TOP_M - radius, tangent + widest
    out = least + np.arange(_COLUMN_ANGLES)[None, :] / (_COLUMN_ANGLES - 1) * (most - least)
    # At the top, a ray of no length goes straight up.
    sine = ((EARTH_M + TOP_M) ** 2 - radius**2 - out**2) / np.maximum(2 * radius * out, 1e-6)
    sine = np.clip(np.where(out > 1e-3, sine, 1.0), -1.0, 1.0)
    height_m = np.broadcast_to(radius - EARTH_M, sine.shape)
    layers = AirLayers(0.0, aerosol_scale_m)
    total = np.zeros((3, *sine.shape))
    for at_m, length_m in ray_steps(height_m, sine, out, np.zeros(sine.shape, dtype=np.bool_), _COLUMN_STEPS):
        total += layers.densities(np.maximum(height_along_m(height_m, sine, at_m), 0.0)) * length_m
    return total[0], total[1], total[2]


def ray_steps(
    height_m: Array, sine: Array, length_m: Array, falls: NDArray[np.bool_], steps: int
) -> list[tuple[Array, Array]]:
    """Middle and length of `steps` steps along rays, shortest where rays are lowest, in order from the start. [m]

    Args:
        height_m, sine: (...) of the rays.
        length_m, falls: as from `ray_length_m`.
        steps: an even number.
    """
    # The lowest point: the start of rising rays, the end of those that meet the ground.
    lowest_m = np.where(falls, length_m, np.clip(-(EARTH_M + height_m) * sine, 0.0, length_m))
    half = steps // 2
    edges = (np.arange(half + 1) / half) ** 2
    ends: list[Array] = [lowest_m * (1.0 - edge) for edge in edges[::-1]]
    # Rays that only rise, and those that only fall, spend all of their steps on their one side.
    one_sided = (lowest_m <= 0.0) | falls
    all_edges = (np.arange(steps + 1) / steps) ** 2
    both = [*ends, *[lowest_m + (length_m - lowest_m) * edge for edge in edges[1:]]]
    one = [
        np.where(falls, length_m * (1.0 - back), length_m * edge)
        for edge, back in zip(all_edges, all_edges[::-1], strict=True)
    ]
    at = [np.where(one_sided, single, double) for single, double in zip(one, both, strict=True)]
    return [(0.5 * (first + last), last - first) for first, last in pairwise(at)]
