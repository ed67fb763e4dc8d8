"""What one camera sees of the air under one sun or moon: sky, light of the air in front of things, and transmittance.

Light that the aerosol scattered once is kept apart from the rest and without its phase function, whose forward peak no
table would resolve.

Source: the split after Bruneton and Neyret 2008 (doi:10.1111/j.1467-8659.2008.01245.x); tables by direction and
distance of one camera after Hillaire 2020 (doi:10.1111/cgf.14050).
"""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes.atmosphere.air_layers import (
    EARTH_M,
    RGB_WEIGHTS,
    AirLayers,
    Array,
    aerosol_phase,
    height_along_m,
    horizon_dip_rad,
    ray_length_m,
    ray_steps,
    rayleigh_phase,
    rgb_of_spectrum,
)
from scenes.atmosphere.multiple_scattering import scattered_light

_ROWS, _COLUMNS, _SKY_STEPS = 40, 25, 40
_DISTANCE_M = 1e3 * np.array(
    [0, 0.3, 0.8, 1.6, 3, 5, 8, 12, 18, 26, 37, 52, 72, 100, 140, 200, 280, 400, 700], dtype=np.float64
)
_STEPS_BETWEEN = 2
# Rays at the horizon itself would touch the ground or not by their last bits.
_BESIDE_HORIZON_RAD = 1e-6

Table = NDArray[np.float32]


class Directions:
    """Directions as rows and columns of the tables of one camera.

    Args:
        dip_rad: of the horizon. [rad]
        azimuth_rad: of sun or moon. [rad]
        directions: (..., 3) unit vectors in world axes.
    """

    def __init__(self, dip_rad: float, azimuth_rad: float, directions: NDArray[np.floating[Any]]) -> None:
        elevation = np.arcsin(np.clip(directions[..., 2], -1.0, 1.0)) + dip_rad
        self.sky_row = np.sqrt(np.maximum(elevation, 0.0) / (np.pi / 2 + dip_rad)) * (_ROWS - 1)
        self.ground_row = np.sqrt(np.maximum(-elevation, 0.0) / (np.pi / 2 - dip_rad)) * (_ROWS - 1)
        self.falls = elevation < 0
        apart = np.arctan2(directions[..., 1], directions[..., 0]) - azimuth_rad
        self.column = np.abs((apart + np.pi) % (2 * np.pi) - np.pi) / np.pi * (_COLUMNS - 1)


class SkyTables:
    """The air under one sun or moon, over its irradiance outside the atmosphere.

    Args:
        layers: of the air.
        height_m: of the camera above the ground. [m]
        sun_sine: sine of the elevation of sun or moon.
    """

    def __init__(self, layers: AirLayers, height_m: float, sun_sine: float) -> None:
        self._layers, self._height_m, self._sun_sine = layers, height_m, sun_sine
        self.dip_rad = float(horizon_dip_rad(height_m))
        square = (np.arange(_ROWS) / (_ROWS - 1)) ** 2
        above = -self.dip_rad + _BESIDE_HORIZON_RAD + (np.pi / 2 + self.dip_rad) * square
        below = -self.dip_rad - _BESIDE_HORIZON_RAD - (np.pi / 2 - self.dip_rad) * square
        self._sines = np.sin(np.concatenate([np.minimum(above, np.pi / 2), np.maximum(below, -np.pi / 2)]))

    @cached_property
    def sky(self) -> Table:
        """(R, A, 6) light of the sky along rays that miss the ground, from the horizon to the zenith. [1/sr]

        The first three channels are to be added to the last three times the phase function of the aerosol.
        """
        sine, towards = self._rays(self._sines[:_ROWS])
        both = scattered_into_rays(self._layers, self._height_m, self._sun_sine, sine, towards)
        return _rgb_of(*both).reshape(_ROWS, _COLUMNS, 6)

    @cached_property
    def _aerial(self) -> tuple[Table, Table]:
        """(2 R, A, D, 6) light of the air up to distances, and (2 R, D, 3) its transmittance; rows as of `_sines`."""
        sine, towards = self._rays(self._sines)
        length_m, _ = ray_length_m(np.full(sine.shape, self._height_m), sine)
        march = _March(self._layers, self._height_m, self._sun_sine, sine, towards)
        light, through = [march.light_rgb()], [march.transmittance_rgb()]
        for first, last in pairwise(_DISTANCE_M):
            for part in range(_STEPS_BETWEEN):
                near_m, far_m = (
                    np.minimum(first + (last - first) * (part + end) / _STEPS_BETWEEN, length_m) for end in (0, 1)
                )
                march.step(0.5 * (near_m + far_m), far_m - near_m)
            light.append(march.light_rgb())
            through.append(march.transmittance_rgb())
        of_rays = np.stack(light, axis=1).reshape(2 * _ROWS, _COLUMNS, len(_DISTANCE_M), 6)
        by_row = np.stack(through, axis=1).reshape(2 * _ROWS, _COLUMNS, len(_DISTANCE_M), 3)[:, 0]
        return of_rays, by_row

    def _rays(self, sines: Array) -> tuple[Array, Array]:
        """(N A,) sines of elevation of all rays, and cosines of their angles to the sun."""
        azimuth = np.arange(_COLUMNS) / (_COLUMNS - 1) * np.pi
        sine = np.repeat(sines, _COLUMNS)
        level = np.sqrt(np.maximum(1.0 - sine * sine, 0.0)) * np.sqrt(max(1.0 - self._sun_sine**2, 0.0))
        return sine, sine * self._sun_sine + level * np.tile(np.cos(azimuth), len(sines))

    def sky_radiance(self, at: Directions, towards_sun: NDArray[np.floating[Any]]) -> Table:
        """(..., 3) light of the sky; below the horizon that of the horizon. [1/sr]"""
        return _with_phase(_bilinear(self.sky, at.sky_row, at.column), towards_sun)

    @cached_property
    def _before_ground(self) -> tuple[Table, Table]:
        """(R, A, 6) light of the air in front of the ground, and (R, 3) its transmittance."""
        light, through = self._aerial
        length_m, _ = ray_length_m(np.full(_ROWS, self._height_m), self._sines[_ROWS:])
        place = np.interp(length_m, _DISTANCE_M, np.arange(len(_DISTANCE_M)))
        nearest = np.minimum(np.ceil(place).astype(np.intp), len(_DISTANCE_M) - 1)
        rows = np.arange(_ROWS)
        # Rays end at the ground, so that farther columns of the tables hold what is in front of it.
        return light[_ROWS + rows, :, nearest], through[_ROWS + rows, nearest]

    def before_ground(self, at: Directions, towards_sun: NDArray[np.floating[Any]]) -> Table:
        """(..., 3) light of the air in front of the ground; above the horizon that of the horizon. [1/sr]"""
        return _with_phase(_bilinear(self._before_ground[0], at.ground_row, at.column), towards_sun)

    def ground_transmittance(self, ground_row: NDArray[np.floating[Any]]) -> Table:
        """(..., 3) share of the ground's light that reaches the camera."""
        rows = np.arange(_ROWS)
        of_rows = self._before_ground[1]
        clear = np.stack([np.interp(ground_row, rows, of_rows[:, c]) for c in range(3)], axis=-1)
        result: Table = clear.astype(np.float32)
        return result

    def up_to(
        self, at: Directions, towards_sun: NDArray[np.floating[Any]], distance_m: NDArray[np.floating[Any]]
    ) -> tuple[Table, Table]:
        """(..., 3) light of the air up to (...) distances [1/sr], and (..., 3) its transmittance."""
        light, through = self._aerial
        place = np.interp(distance_m, _DISTANCE_M, np.arange(len(_DISTANCE_M)))
        nearer = np.minimum(place.astype(np.intp), len(_DISTANCE_M) - 2)
        share = (place - nearer)[..., None].astype(np.float32)
        row = np.where(at.falls, _ROWS + at.ground_row, at.sky_row)
        top = np.where(
            at.falls, np.clip(row.astype(np.intp), _ROWS, 2 * _ROWS - 2), np.minimum(row.astype(np.intp), _ROWS - 2)
        )
        down = (row - top)[..., None].astype(np.float32)
        left = np.minimum(at.column.astype(np.intp), _COLUMNS - 2)
        right = (at.column - left)[..., None].astype(np.float32)
        seen = np.zeros((*top.shape, 6), dtype=np.float32)
        clear = np.zeros((*top.shape, 3), dtype=np.float32)
        for k, of_distance in ((nearer, 1 - share), (nearer + 1, share)):
            for i, of_row in ((top, 1 - down), (top + 1, down)):
                clear += of_distance * of_row * through[i, k]
                for j, of_column in ((left, 1 - right), (left + 1, right)):
                    seen += of_distance * of_row * of_column * light[i, j, k]
        return _with_phase(seen, towards_sun), clear


def scattered_into_rays(
    layers: AirLayers, height_m: float, sun_sine: float, sine: Array, towards_sun: Array
) -> tuple[Array, Array]:
    """Light that the air scatters into rays from one place, up to their ends.

    Args:
        layers: of the air.
        height_m: where all rays start. [m]
        sun_sine: sine of the elevation of sun or moon there.
        sine: (N,) of the rays' elevation.
        towards_sun: (N,) cosine of their angle to the sun.

    Returns:
        Two (N, L) radiances over the sun's irradiance: without what aerosol scattered once, and that over the
        aerosol's phase function. [1/sr]
    """
    start_m = np.full(sine.shape, height_m)
    length_m, falls = ray_length_m(start_m, sine)
    march = _March(layers, height_m, sun_sine, sine, towards_sun)
    for at_m, step_m in ray_steps(start_m, sine, length_m, falls, _SKY_STEPS):
        march.step(at_m, step_m)
    return march.smooth, march.peaked


class _March:
    """Light collected along rays, step by step; arguments and `smooth` and `peaked` as in `scattered_into_rays`."""

    def __init__(self, layers: AirLayers, height_m: float, sun_sine: float, sine: Array, towards_sun: Array) -> None:
        self._layers, self._sun_sine = layers, sun_sine
        self._height_m, self._sine, self._towards = np.full(sine.shape, height_m), sine, towards_sun
        self._scattered = scattered_light(layers)
        self._molecules = rayleigh_phase(towards_sun)[:, None]
        wavelengths = layers.depths.shape[1]
        self._before = np.zeros((len(sine), wavelengths))
        self.smooth = np.zeros((len(sine), wavelengths))
        self.peaked = np.zeros((len(sine), wavelengths))

    def step(self, at_m: Array, step_m: Array) -> None:
        """Add steps with these middles and lengths. [m]"""
        there_m = np.maximum(height_along_m(self._height_m, self._sine, at_m), 0.0)
        radius = EARTH_M + self._height_m
        sun_there = np.clip((radius * self._sun_sine + at_m * self._towards) / (EARTH_M + there_m), -1.0, 1.0)
        up = np.clip((radius * self._sine + at_m) / (EARTH_M + there_m), -1.0, 1.0)
        level = (self._towards - sun_there * up) / np.sqrt(np.maximum(1.0 - sun_there**2, 1e-9))
        density = self._layers.densities(there_m) * step_m
        here = np.einsum("kn,kl->nl", density, self._layers.depths)
        # Exact within a step of even air.
        passed = np.exp(-self._before) * -np.expm1(-here) / np.maximum(here, 1e-12)
        self._before += here
        molecules, aerosol = (np.outer(density[k], self._layers.scattered[k]) * passed for k in range(2))
        sunlight = self._layers.sunlight(there_m, sun_there)
        self.smooth += molecules * sunlight * self._molecules
        self._scattered.add_into_rays(self.smooth, there_m, sun_there, (molecules, aerosol), up, level)
        self.peaked += aerosol * sunlight

    def light_rgb(self) -> Table:
        """(N, 6) light so far, as in `SkyTables.sky`."""
        return _rgb_of(self.smooth, self.peaked)

    def transmittance_rgb(self) -> Table:
        """(N, 3) transmittance so far."""
        clear: Table = rgb_of_spectrum(np.exp(-self._before)).astype(np.float32)
        return clear


def _rgb_of(smooth: Array, peaked: Array) -> Table:
    both = [np.einsum("nl,lc->nc", part, RGB_WEIGHTS) for part in (smooth, peaked)]
    light: Table = np.concatenate(both, axis=1).astype(np.float32)
    return light


def _with_phase(light: Table, towards_sun: NDArray[np.floating[Any]]) -> Table:
    phase = aerosol_phase(towards_sun)[..., None].astype(np.float32)
    # Deep blue and deep red light lies outside of Rec. 709.
    result: Table = np.maximum(light[..., :3] + phase * light[..., 3:], np.float32(0.0))
    return result


def _bilinear(table: Table, row: NDArray[np.floating[Any]], column: NDArray[np.floating[Any]]) -> Table:
    top, left = (
        np.minimum(row.astype(np.intp), table.shape[0] - 2),
        np.minimum(column.astype(np.intp), table.shape[1] - 2),
    )
    down, right = ((value)[..., None].astype(np.float32) for value in (row - top, column - left))
    above = table[top, left] + right * (table[top, left + 1] - table[top, left])
    below = table[top + 1, left] + right * (table[top + 1, left + 1] - table[top + 1, left])
    result: Table = above + down * (below - above)
    return result
