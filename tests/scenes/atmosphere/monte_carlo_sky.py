"""Radiance of the clear sky by Monte Carlo paths through the same air, without any table, moment or grid.

Every path starts at the camera, is scattered at optical depths drawn along straight rays, and adds the sun's light at
each of its ends. `python -m tests.scenes.atmosphere.monte_carlo_sky` compares the sky of the tables with it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scenes.atmosphere.air_layers import AirLayers, aerosol_phase
from scenes.atmosphere.sky_tables import scattered_into_rays
from scenes.sky.photometry import direction_from_angles

EARTH_M, TOP_M = 6.371e6, 9e4
AEROSOL_ALBEDO, AEROSOL_ASYMMETRY = 0.94, 0.76
_POINTS = 100
_AIR_M = [0, 5e3, 10e3, 15e3, 20e3, 25e3, 30e3, 40e3, 50e3, 60e3, 70e3, 80e3, 90e3]
_AIR_KG_M3 = [
    *(1.225, 0.7364, 0.4135, 0.1948, 0.08891, 0.04008, 0.01841),
    *(3.996e-3, 1.027e-3, 3.097e-4, 8.283e-5, 1.846e-5, 3.416e-6),
]


class Air:
    """Coefficients at one wavelength, from vertical optical depths. [1/m]"""

    def __init__(self, molecules: float, aerosol: float, ozone: float, aerosol_scale_m: float) -> None:
        self._heights = np.arange(0.0, TOP_M, 10.0)
        density = np.exp(np.interp(self._heights, _AIR_M, np.log(_AIR_KG_M3)))
        self._molecules = molecules * density / (10.0 * density.sum())
        self._aerosol = aerosol / aerosol_scale_m * np.exp(-self._heights / aerosol_scale_m)
        self._ozone = ozone * np.clip(1 - np.abs(self._heights - 25e3) / 15e3, 0, None) / 15e3

    def at(self, height_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Scattering by molecules, by aerosol, and extinction."""
        molecules, aerosol, ozone = (
            np.interp(height_m, self._heights, values) for values in (self._molecules, self._aerosol, self._ozone)
        )
        return molecules, AEROSOL_ALBEDO * aerosol, molecules + aerosol + ozone


def to_end_m(place: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Length of rays to the ground or out of the air, and whether it is the ground; Earth's centre is the origin."""
    along = (place * direction).sum(axis=-1)
    square = (place * place).sum(axis=-1)
    ground = along**2 - square + EARTH_M**2
    falls = (along < 0) & (ground > 0)
    out = -along + np.sqrt(along**2 - square + (EARTH_M + TOP_M) ** 2)
    return np.where(falls, -along - np.sqrt(np.maximum(ground, 0)), out), falls


def depth_along(
    air: Air, place: np.ndarray, direction: np.ndarray, length_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (N, P) along rays, closer together near the start, and optical depth up to them."""
    distance_m = length_m[:, None] * np.linspace(0, 1, _POINTS) ** 2
    points = place[:, None] + distance_m[..., None] * direction[:, None]
    extinction = air.at(np.linalg.norm(points, axis=-1) - EARTH_M)[2]
    steps = 0.5 * (extinction[:, 1:] + extinction[:, :-1]) * np.diff(distance_m, axis=1)
    return distance_m, np.concatenate([np.zeros((len(place), 1)), np.cumsum(steps, axis=1)], axis=1)


def sunlight(air: Air, place: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Transmittance towards the sun, 0 through the Earth."""
    towards = np.broadcast_to(sun, place.shape)
    length_m, falls = to_end_m(place, towards)
    lowest_m = np.clip(-(place @ sun), 0, length_m)
    lowest = place + lowest_m[:, None] * towards
    depth = depth_along(air, lowest, -towards, lowest_m)[1][:, -1]
    depth = depth + depth_along(air, lowest, towards, length_m - lowest_m)[1][:, -1]
    return np.where(falls, 0.0, np.exp(-depth))


def turned(direction: np.ndarray, cosine: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Directions at angles of these cosines to others, turned about them by another angle."""
    helper = np.where(np.abs(direction[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    side = np.cross(direction, helper)
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    aside = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(direction, side)
    return cosine[:, None] * direction + np.sqrt(np.maximum(1 - cosine**2, 0))[:, None] * aside


def rayleigh(cosine: np.ndarray) -> np.ndarray:
    return 3 / (16 * np.pi) * (1 + cosine**2)


def henyey_greenstein(cosine: np.ndarray) -> np.ndarray:
    g = AEROSOL_ASYMMETRY
    return (1 - g * g) / (4 * np.pi) / (1 + g * g - 2 * g * cosine) ** 1.5


def sky_radiance(
    air: Air, ground_reflectance: float, height_m: float, sun: np.ndarray, view: np.ndarray, paths: int = 3000
) -> tuple[float, float]:
    """Radiance over the sun's irradiance along a view that misses the ground, and its standard error. [1/sr]"""
    rng = np.random.default_rng(1)
    place = np.tile([0.0, 0.0, EARTH_M + height_m], (paths, 1))
    direction = np.tile(view, (paths, 1))
    weight, total = np.ones(paths), np.zeros(paths)
    for _ in range(8):
        length_m, falls = to_end_m(place, direction)
        distance_m, depth = depth_along(air, place, direction, length_m)
        whole = depth[:, -1]
        # What would leave the air is left out of the paths and of their weight; what would reach the ground does.
        on_ground = falls & (rng.random(paths) < np.exp(-whole))
        weight = weight * np.where(falls, 1.0, -np.expm1(-whole))
        drawn = -np.log1p(rng.random(paths) * np.expm1(-whole))
        at_m = np.array([np.interp(d, row, places) for d, row, places in zip(drawn, depth, distance_m, strict=True)])
        place = place + np.where(on_ground, length_m, at_m)[:, None] * direction
        radius = np.linalg.norm(place, axis=-1)
        up = place / radius[:, None]
        molecules, aerosol, extinction = air.at(radius - EARTH_M)
        weight = weight * np.where(on_ground, ground_reflectance, (molecules + aerosol) / extinction)
        towards = direction @ sun
        phase = (molecules * rayleigh(towards) + aerosol * henyey_greenstein(towards)) / (molecules + aerosol)
        phase = np.where(on_ground, np.maximum(up @ sun, 0) / np.pi, phase)
        place = np.where(on_ground[:, None], up * (EARTH_M + 0.5), place)
        total += weight * phase * sunlight(air, place, sun)
        g, u = AEROSOL_ASYMMETRY, rng.random(paths)
        peaked = (1 + g * g - ((1 - g * g) / (1 - g + 2 * g * u)) ** 2) / (2 * g)
        root = np.cbrt(4 * u - 2 + np.sqrt((4 * u - 2) ** 2 + 1))
        by_aerosol = rng.random(paths) < aerosol / (molecules + aerosol)
        cosine = np.where(by_aerosol, peaked, root - 1 / root)
        angle = 2 * np.pi * rng.random(paths)
        scattered, reflected = turned(direction, np.clip(cosine, -1, 1), angle), turned(up, np.sqrt(u), angle)
        direction = np.where(on_ground[:, None], reflected, scattered)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return float(total.mean()), float(total.std() / np.sqrt(paths))


# Extinction of the aerosol at the ground [1/m] and the height over which it thins out [m].
AIRS = {"thin": (2.1e-5, 2500.0), "clear": (6.67e-5, 2263.0), "haze": (2.5e-4, 700.0)}
# Height [m], elevation of the sun, elevation of the view and its azimuth from the sun [deg].
VIEWS = (
    (10.0, 50.0, 0.5, 90.0),
    (10.0, 50.0, 5.0, 150.0),
    (10.0, 50.0, 30.0, 90.0),
    (10.0, 50.0, 20.0, 20.0),
    (10.0, 20.0, 0.5, 180.0),
    (10.0, 20.0, 10.0, 40.0),
    (10.0, 20.0, 60.0, 180.0),
    (3000.0, 40.0, 3.0, 120.0),
    (3000.0, 40.0, 0.5, 180.0),
    (3000.0, 5.0, 2.0, 40.0),
    (3000.0, 5.0, 8.0, 160.0),
    (3000.0, -4.0, 10.0, 10.0),
    (10.0, 40.0, 20.0, 120.0),
)
GREEN = 4


def table_over_paths(air: str) -> Iterator[tuple[float, float]]:
    """Radiance of the tables at 560 nm over that of 2000 paths, and its standard error, for each view in an air."""
    layers = AirLayers(*AIRS[air], (0.1, 0.1, 0.1))
    for height_m, sun_deg, view_deg, apart_deg in VIEWS:
        sun, view = direction_from_angles(sun_deg, 0.0), direction_from_angles(view_deg, apart_deg)
        by_paths = Air(*layers.depths[:, GREEN], layers.aerosol_scale_m)
        expected, error = sky_radiance(by_paths, 0.1, height_m, sun, view, 2000)
        smooth, peaked = scattered_into_rays(
            layers, height_m, float(sun[2]), np.array([view[2]]), np.array([view @ sun])
        )
        found = float(smooth[0, GREEN] + peaked[0, GREEN] * aerosol_phase(view @ sun))
        yield found / expected, error / expected


def main() -> None:
    """Print a table in Markdown."""
    print("| height, sun, view up, view from the sun | " + " | ".join(AIRS) + " |\n|---|" + "---|" * len(AIRS))
    columns = [list(table_over_paths(air)) for air in AIRS]
    for view, row in zip(VIEWS, zip(*columns, strict=True), strict=True):
        cells = [f"{ratio:.2f} +- {error:.2f}" for ratio, error in row]
        print(f"| {view[0]:g} m, {view[1]:g}, {view[2]:g}, {view[3]:g} deg | {' | '.join(cells)} |")
    ratios = np.array([[ratio for ratio, _ in column] for column in columns])
    print(f"root mean square of the logarithm: {np.sqrt((np.log(ratios) ** 2).mean()):.3f}")


if __name__ == "__main__":
    main()
