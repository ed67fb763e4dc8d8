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
from scipy.sparse import csr_matrix

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

    def at(self, height_m: Array, sun_sine: Array) -> Array:
        """(N, 6, L) moments at (N,) heights and sines of the sun's elevation."""
        moved: Array = grid_weights(height_m, sun_sine) @ self.moments.reshape(self.moments.shape[0], -1)
        return moved.reshape(len(height_m), _MOMENTS, -1)

    def ground_at(self, sun_sine: float) -> Array:
        """(L,) illuminance of level ground under a sun of that sine of elevation."""
        sun_deg = np.degrees(np.arcsin(np.clip(sun_sine, -1.0, 1.0)))
        levels = np.log(np.maximum(self.ground, 1e-30))
        result: Array = np.exp(np.stack([np.interp(sun_deg, _SUN_DEG, level) for level in levels.T]))
        return result


def grid_weights(height_m: Array, sun_sine: Array) -> csr_matrix:
    """(N, H S) weights of the grid's nodes in linear interpolation at (N,) heights and sines of the sun's elevation."""
    sun_deg = np.degrees(np.arcsin(np.clip(sun_sine, -1.0, 1.0)))
    row, down = _place(_HEIGHTS_M, height_m)
    column, right = _place(_SUN_DEG, sun_deg)
    node = row * len(_SUN_DEG) + column
    nodes = np.stack([node, node + 1, node + len(_SUN_DEG), node + len(_SUN_DEG) + 1], axis=-1)
    shares = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right], axis=-1)
    ends = np.arange(len(height_m) + 1) * 4
    return csr_matrix((shares.ravel(), nodes.ravel(), ends), shape=(len(height_m), len(_HEIGHTS_M) * len(_SUN_DEG)))


def _place(nodes: Array, value: Array) -> tuple[NDArray[np.intp], Array]:
    """Index of the node below, and how far a value is on the way to the next."""
    inside = np.clip(value, nodes[0], nodes[-1])
    index = np.clip(np.searchsorted(nodes, inside, side="right") - 1, 0, len(nodes) - 2)
    return index, (inside - nodes[index]) / (nodes[index + 1] - nodes[index])


@dataclass(frozen=True, eq=False)
class _RaySteps:
    """One step along all rays.

    Attributes:
        weights: of the grid's nodes in the middle of the step.
        scattered, up, level: as in `source`.
    """

    weights: csr_matrix
    scattered: tuple[Array, Array]
    up: Array
    level: Array


def source(moments: Array, scattered: tuple[Array, Array], up: Array, level: Array) -> Array:
    """(N, L) light that reaches the start of rays from a step of theirs, of light that was scattered before.

    Args:
        moments: (N, 6, L) of that light, as in `ScatteredLight`.
        scattered: (N, L) share of it that molecules and aerosol scatter into the ray, times 4 pi over their phase
            functions.
        up, level: (N,) components of the rays' directions there, along the vertical, and level towards the sun.
    """
    mean, of_up, of_level, up_up, up_level, level_level = np.moveaxis(moments, 1, 0)
    up, level = up[:, None], level[:, None]
    # By Legendre polynomials of the angle between where light comes from and where the ray looks.
    first = of_up * up + of_level * level
    aside = 1.0 - up * up - level * level
    square = up_up * (up * up - aside) + level_level * (level * level - aside) + 2.0 * up_level * (up * level)
    second = 1.5 * (square + aside * mean) - 0.5 * mean
    molecules, aerosol = scattered
    of_aerosol = mean + 3.0 * REPEATED_FIRST * first + 5.0 * REPEATED_SECOND * second
    result: Array = molecules * (mean + 0.5 * second) + aerosol * np.maximum(of_aerosol, _LEAST_SHARE * mean)
    return result


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
                weights=grid_weights(there_m, sun_there),
                scattered=(by_each[0], by_each[1]),
                up=up,
                level=(towards_sun - sun_there * up) / np.sqrt(np.maximum(1.0 - sun_there**2, 1e-9)),
            )
        )
    reflects = falls[:, None] * np.exp(-before) * spectrum_of_rgb(np.array(layers.ground_rgb)) / np.pi
    sun_at_ground = np.clip((radius * sun_sine + length_m * towards_sun) / EARTH_M, -1.0, 1.0)
    on_ground = grid_weights(np.zeros(len(height_m)), sun_at_ground)[:, :suns]
    at_nodes = np.sin(np.radians(_SUN_DEG))
    direct = np.maximum(at_nodes, 0.0)[:, None] * layers.sunlight(np.zeros(suns), at_nodes)
    light += reflects * (on_ground @ direct)

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
        light = reflects * (on_ground @ ground)
        flat = moments.reshape(moments.shape[0], -1)
        for step in steps:
            there = (step.weights @ flat).reshape(len(height_m), _MOMENTS, -1)
            light += source(there, step.scattered, step.up, step.level)
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
