"""What the air is made of by height, how far light gets through it, and rays through its round layers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes.atmosphere.spectrum import AEROSOL_RELATIVE, MOLECULE_DEPTH, OZONE_DEPTH
from scenes.sky.photometry import SUN_RADIUS_RAD, henyey_greenstein

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
REPEATED_ASYMMETRY = 0.55
"""Asymmetry for light that was scattered before and of which two moments are known: with it, the sky differs least from
that of Monte Carlo paths."""
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
