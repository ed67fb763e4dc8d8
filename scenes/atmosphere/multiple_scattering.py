"""Light that air and ground have scattered before, at any height and height of the sun: orders of scattering in turn.

Light of one order is followed along rays from each node of a grid. Of its distribution over directions the moments up
to the second are kept: all that Rayleigh's phase function needs, and with them an aerosol's forward side meets the
bright ring of the horizon. The grid covers all heights of the sun, so that one table serves sun and moon at any time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from geometry.compiled_loops import compiled
from scenes.atmosphere.air_layers import (
    EARTH_M,
    REPEATED_FIRST,
    REPEATED_SECOND,
    AirLayers,
    Array,
    aerosol_phase,
    height_along_m,
    horizon_dip_rad,
    ray_length_m,
    ray_steps,
    rayleigh_phase,
    spectrum_of_rgb,
)

# Grid of heights [m] and of the sun's elevation [deg], closest where light changes most.
_HEIGHTS_M = np.array([0, 250, 700, 1400, 2400, 3800, 6e3, 9e3, 13e3, 18e3, 24e3, 32e3, 43e3, 60e3, 85e3])
_SUN_DEG = np.array(
    [
        -21,
        -18,
        -16,
        -14,
        -12.5,
        -11,
        -9.5,
        -8,
        -7,
        -6,
        -5,
        -4,
        -3,
        -2,
        -1,
        0,
        1,
        2,
        3.5,
        5.5,
        8,
        12,
        18,
        27,
        40,
        60,
        90,
    ],
    dtype=np.float64,
)
_UP, _DOWN, _AROUND, _STEPS, _ORDERS, _MOMENTS = 8, 4, 6, 16, 6, 6
# Few moments of strongly one-sided light leave too little of the other side: so much of the mean stays.
_LEAST_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class ScatteredLight:
    """Moments of the light that was scattered once or more, over the sun's irradiance outside the atmosphere.

    Attributes:
        moments: (H S, 6, L) mean over the sphere of radiance, and of radiance times the components of the direction it
            comes from: upwards, level towards the sun, and their products up up, up level, level level. [1/sr]
        ground: (S, L) illuminance of level ground by scattered light.
    """

    moments: Array
    ground: Array

    def add_into_rays(
        self,
        light: Array,
        height_m: Array,
        sun_sine: Array,
        scattered: tuple[Array, Array],
        ray_up: Array,
        ray_level: Array,
    ) -> None:
        """Add to (N, L) `light` of rays what this light adds to it in a step of theirs.

        Args:
            light: is changed.
            height_m, sun_sine: (N,) of the step's middle, as in `grid_places`.
            scattered, ray_up, ray_level: as in `add_scattered`.
        """
        add_scattered(light, self.moments, grid_places(height_m, sun_sine), scattered, ray_up, ray_level)

    def ground_at(self, sun_sine: float) -> Array:
        """(L,) illuminance of level ground under a sun of that sine of elevation."""
        sun_deg = np.degrees(np.arcsin(np.clip(sun_sine, -1.0, 1.0)))
        levels = np.log(np.maximum(self.ground, 1e-30))
        result: Array = np.exp(np.stack([np.interp(sun_deg, _SUN_DEG, level) for level in levels.T]))
        return result


def grid_places(height_m: Array, sun_sine: Array) -> tuple[NDArray[np.intp], Array]:
    """Nodes of the grid around (N,) heights and sines of the sun's elevation: (N, 4) indices, and their shares."""
    sun_deg = np.degrees(np.arcsin(np.clip(sun_sine, -1.0, 1.0)))
    row, down = _place(_HEIGHTS_M, height_m)
    column, right = _place(_SUN_DEG, sun_deg)
    node = row * len(_SUN_DEG) + column
    nodes = np.stack([node, node + 1, node + len(_SUN_DEG), node + len(_SUN_DEG) + 1], axis=-1)
    shares = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right], axis=-1)
    return nodes, shares


def _place(nodes: Array, value: Array) -> tuple[NDArray[np.intp], Array]:
    """Index of the node below, and how far a value is on the way to the next."""
    inside = np.clip(value, nodes[0], nodes[-1])
    index = np.clip(np.searchsorted(nodes, inside, side="right") - 1, 0, len(nodes) - 2)
    return index, (inside - nodes[index]) / (nodes[index + 1] - nodes[index])


@dataclass(frozen=True, eq=False)
class _RaySteps:
    """One step along all rays; attributes as in `add_scattered`."""

    places: tuple[NDArray[np.intp], Array]
    scattered: tuple[Array, Array]
    ray_up: Array
    ray_level: Array


@compiled
def add_scattered(
    light: Array,
    moments: Array,
    places: tuple[NDArray[np.intp], Array],
    scattered: tuple[Array, Array],
    ray_up: Array,
    ray_level: Array,
) -> None:
    """Add to the light at the start of rays what a step of theirs scatters of light that was scattered before.

    Args:
        light: (N, L), is changed.
        moments: (H S, 6, L) of the light that was scattered before, as in `ScatteredLight`.
        places: of the step's middle, as of `grid_places`.
        scattered: (N, L) share of it that molecules and aerosol scatter into the ray, times 4 pi over their phase
            functions.
        ray_up, ray_level: (N,) components of the rays' directions there, along the vertical, and level towards the sun.
    """
    nodes, shares = places
    molecules, aerosol = scattered
    wavelengths = light.shape[1]
    # Loops over wavelengths are innermost, where the processor takes several at a time.
    there = np.empty((_MOMENTS, wavelengths))
    for ray in range(light.shape[0]):
        there[:] = 0.0
        for corner in range(4):
            node, share = nodes[ray, corner], shares[ray, corner]
            for moment in range(_MOMENTS):
                for k in range(wavelengths):
                    there[moment, k] += share * moments[node, moment, k]
        up, level = ray_up[ray], ray_level[ray]
        aside = 1.0 - up * up - level * level
        for k in range(wavelengths):
            mean = there[0, k]
            # By Legendre polynomials of the angle between where light comes from and where the ray looks.
            first = there[1, k] * up + there[2, k] * level
            square = there[3, k] * (up * up - aside) + there[5, k] * (level * level - aside)
            square += 2.0 * there[4, k] * (up * level)
            second = 1.5 * (square + aside * mean) - 0.5 * mean
            of_aerosol = mean + 3.0 * REPEATED_FIRST * first + 5.0 * REPEATED_SECOND * second
            aerosol_part = aerosol[ray, k] * max(of_aerosol, _LEAST_SHARE * mean)
            light[ray, k] += molecules[ray, k] * (mean + 0.5 * second) + aerosol_part


@lru_cache(maxsize=32)
def scattered_light(layers: AirLayers) -> ScatteredLight:
    """All orders of scattering from the first on, under one sun, by height and by the sun's elevation."""
    heights, suns = len(_HEIGHTS_M), len(_SUN_DEG)
    sine, around, share = _directions()
    shape = (heights, suns, sine.shape[1], len(around))
    height_m = np.broadcast_to(_HEIGHTS_M[:, None, None, None], shape).ravel()
    sun_sine = np.broadcast_to(np.sin(np.radians(_SUN_DEG))[None, :, None, None], shape).ravel()
    ray_sine = np.broadcast_to(sine[:, None, :, None], shape).ravel()
    level = np.sqrt(1.0 - ray_sine**2) * np.broadcast_to(np.cos(around), shape).ravel()
    towards_sun = ray_sine * sun_sine + level * np.sqrt(1.0 - sun_sine**2)
    share = np.broadcast_to(share[:, None, :, None], shape)

    # The forward side needs more directions: the sum over these ones is kept exact instead.
    forward = aerosol_phase(towards_sun).reshape(shape)
    peak = 1.0 / (share * forward).sum(axis=(2, 3), keepdims=True)
    phases = rayleigh_phase(towards_sun), (peak * forward).ravel()

    length_m, falls = ray_length_m(height_m, ray_sine)
    light = np.zeros((len(height_m), layers.depths.shape[1]))
    before = np.zeros_like(light)
    steps: list[_RaySteps] = []
    for at_m, step_m in ray_steps(height_m, ray_sine, length_m, falls, _STEPS):
        there_m = np.maximum(height_along_m(height_m, ray_sine, at_m), 0.0)
        radius = EARTH_M + height_m
        sun_there = np.clip((radius * sun_sine + at_m * towards_sun) / (EARTH_M + there_m), -1.0, 1.0)
        up = np.clip((radius * ray_sine + at_m) / (EARTH_M + there_m), -1.0, 1.0)
        density = layers.densities(there_m) * step_m
        here = np.einsum("kn,kl->nl", density, layers.depths)
        # Exact within a step of even air.
        passed = np.exp(-before) * -np.expm1(-here) / np.maximum(here, 1e-12)
        by_each = [np.outer(density[k], layers.scattered[k]) * passed for k in range(2)]
        sunlight = layers.sunlight(there_m, sun_there)
        light += sunlight * (by_each[0] * phases[0][:, None] + by_each[1] * phases[1][:, None])
        before += here
        steps.append(
            _RaySteps(
                places=grid_places(there_m, sun_there),
                scattered=(by_each[0], by_each[1]),
                ray_up=up,
                ray_level=(towards_sun - sun_there * up) / np.sqrt(np.maximum(1.0 - sun_there**2, 1e-9)),
            )
        )
    reflects = falls[:, None] * np.exp(-before) * spectrum_of_rgb(np.array(layers.ground_rgb)) / np.pi
    sun_at_ground = np.clip((radius * sun_sine + length_m * towards_sun) / EARTH_M, -1.0, 1.0)
    # At the lowest height only the first two nodes have a share.
    ground_nodes, ground_shares = grid_places(np.zeros(len(height_m)), sun_at_ground)

    def on_ground(of_suns: Array) -> Array:
        left, right = (ground_shares[:, k, None] * of_suns[ground_nodes[:, k]] for k in range(2))
        both: Array = left + right
        return both

    at_nodes = np.sin(np.radians(_SUN_DEG))
    direct = np.maximum(at_nodes, 0.0)[:, None] * layers.sunlight(np.zeros(suns), at_nodes)
    light += reflects * on_ground(direct)

    up, level = ray_sine.reshape(shape), level.reshape(shape)
    components = np.stack([np.ones(shape), up, level, up * up, up * level, level * level])

    def moments_of(light: Array) -> tuple[Array, Array]:
        shaped = light.reshape(*shape, -1)
        weighted = shaped * (share / (4.0 * np.pi))[..., None]
        moments = np.einsum("hsdal,mhsda->hsml", weighted, components)
        rises = np.maximum(components[1, 0][..., None], 0.0)
        ground = (4.0 * np.pi * weighted[0] * rises).sum(axis=(1, 2))
        return moments.reshape(heights * suns, _MOMENTS, -1), ground

    moments, ground = moments_of(light)
    total, total_ground, last = moments.copy(), ground.copy(), moments
    for _ in range(2, _ORDERS + 1):
        light = reflects * on_ground(ground)
        for step in steps:
            add_scattered(light, moments, step.places, step.scattered, step.ray_up, step.ray_level)
        last = moments
        moments, ground = moments_of(light)
        total += moments
        total_ground += ground
    # Higher orders fall off evenly.
    ratio = np.clip(moments[:, :1].sum(axis=0) / last[:, :1].sum(axis=0), 0.0, 0.95)
    total += moments * (ratio / (1.0 - ratio))
    total_ground += ground * (ratio / (1.0 - ratio))[0]
    return ScatteredLight(moments=total, ground=total_ground)


def _directions() -> tuple[Array, Array, Array]:
    """(H, D) sines of elevation by height, (A,) azimuths on one side of the sun, and (H, D) solid angles on both."""
    dip = horizon_dip_rad(_HEIGHTS_M)
    nodes_up, weights_up = np.polynomial.legendre.leggauss(_UP)  # type: ignore[no-untyped-call]
    nodes_down, weights_down = np.polynomial.legendre.leggauss(_DOWN)  # type: ignore[no-untyped-call]
    sines, shares = [], []
    for angle in dip:
        horizon = -np.sin(angle)
        # Closer together towards the horizon: the sine is a square of the node.
        up, down = 0.5 * (nodes_up + 1.0), 0.5 * (nodes_down + 1.0)
        sines.append(np.concatenate([horizon + (1.0 - horizon) * up**2, horizon - (1.0 + horizon) * down**2]))
        shares.append(np.concatenate([(1.0 - horizon) * up * weights_up, (1.0 + horizon) * down * weights_down]))
    around = (np.arange(_AROUND) + 0.5) / _AROUND * np.pi
    return np.array(sines), around, np.array(shares) * (2.0 * np.pi / _AROUND)
