"""Exact pictures of discs with the sensor's noise, for tests of the edge model."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nav.centroids.disc_fit import fit_discs
from nav.centroids.ellipses import Ellipses, circles
from nav.centroids.marker_signal import MarkerSignal
from studies.acceptance.rendered.scored_frames import PixelLight, outline_coverage

DAY = PixelLight(2300, 4700, 4.8, 11_700 / 255, 0.5, 0.01)
DUSK = PixelLight(60, 240, 4.8, 11_700 / 255 / 16, 0.5, 0.01)
COUNT = 8


def tilted_shape(radius_px: float, rng: np.random.Generator, ratio: float = 0.97) -> np.ndarray:
    angle = rng.uniform(0, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn @ np.diag([radius_px, ratio * radius_px]) @ turn.T


def coverage(shape: np.ndarray, center: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """(N, N) share of each pixel of a square window that an ellipse covers, blurred by 0.5 px.

    More than two points per pixel of circumference are exact to 2e-14: the error is exp(-2 (pi 0.5 px / step)^2).
    """
    count = int(2 * 2 * np.pi * np.linalg.norm(shape)) + 64
    angle = 2 * np.pi * np.arange(count) / count
    arms = np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ shape
    tangents = np.stack([-np.sin(angle), np.cos(angle)], axis=-1) @ shape * (2 * np.pi / count)
    return outline_coverage(center + arms, tangents, grid, grid, 0.5)


def expose(light: PixelLight, mean_e: np.ndarray, rng: np.random.Generator | None) -> np.ndarray:
    if rng is None:
        return (mean_e / light.step_e).astype(np.float32)
    gains = 1 + light.prnu_fraction * rng.standard_normal(mean_e.shape)
    electrons = rng.poisson(mean_e) * gains + light.read_noise_e * rng.standard_normal(mean_e.shape)
    return np.round(electrons / light.step_e).astype(np.float32)


def draw_discs(
    radius_px: float,
    light: PixelLight,
    rng: np.random.Generator,
    shading: float = 0.0,
    noisy: bool = True,
    spoil: Callable[[np.ndarray, np.ndarray, np.ndarray, int], np.ndarray] | None = None,
    difference: bool = True,
) -> tuple[list[MarkerSignal], Ellipses]:
    """Signals of COUNT discs in each eye, and their true outlines; `spoil(light of one disc, x, y, number)`."""
    cell = int(2 * radius_px + 18)
    grid = np.arange(cell, dtype=np.float64)
    signals, centers, shapes = [], [], []
    for eye in range(2):
        mean_e = np.zeros((cell, cell * COUNT))
        for number in range(COUNT):
            center, shape = cell / 2 + rng.uniform(-0.5, 0.5, 2), tilted_shape(radius_px, rng)
            x, y = grid[None, :] - center[0], grid[:, None] - center[1]
            slope = shading * x / radius_px
            lit = light.background_e + light.contrast_e * (1 + slope) * coverage(shape, center, grid)
            if spoil is not None and eye == 0:
                lit = spoil(lit, x, y, number)
            mean_e[:, number * cell : (number + 1) * cell] = lit
            centers.append(center + np.array([number * cell, 0]))
            shapes.append(shape)
        values = expose(light, mean_e, rng if noisy else None)
        signals.append(MarkerSignal(values, values >= 255, (0.0, 0.0), 1, difference))
    return signals, Ellipses(np.repeat([0, 1], COUNT), np.array(centers), np.array(shapes))


def rough_start(truth: Ellipses, rng: np.random.Generator) -> Ellipses:
    """Circles of the right area, as far off as binary centroids are."""
    return circles(truth.eyes, truth.centers_px + rng.normal(0, 0.1, (len(truth), 2)), 1.02 * truth.radii_px)


def fit_many(
    radius_px: float, light: PixelLight, rng: np.random.Generator, draws: int = 8
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of the centres, their covariances, and errors of the radii, of all discs of some draws. [px]"""
    errors, covariances, radial = [], [], []
    for _ in range(draws):
        signals, truth = draw_discs(radius_px, light, rng)
        fits = fit_discs(signals, rough_start(truth, rng))
        assert fits.accepted.all(), fits.reasons
        errors.append(fits.ellipses.centers_px - truth.centers_px)
        covariances.append(fits.cov_px2)
        radial.append(fits.ellipses.radii_px - truth.radii_px)
    return np.concatenate(errors), np.concatenate(covariances), np.concatenate(radial)
