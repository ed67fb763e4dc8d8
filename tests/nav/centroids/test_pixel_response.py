"""Edges that are no Gaussian blur, and colours that carry nothing but noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import shapely

from nav.centroids.disc_fit import fit_discs
from nav.centroids.discs import DiscFits
from nav.centroids.ellipses import Ellipses, circles
from nav.centroids.marker_signal import MarkerSignal
from render.analytic_engine.pixel_coverage import pixel_coverage
from render.camera.optics import blur

COUNT, BACKGROUND_DN, CONTRAST_DN = 8, 6.0, 100.0


def box_sampled_discs(radius_px: float, rng: np.random.Generator) -> tuple[list[np.ndarray], Ellipses]:
    """Pictures of COUNT discs in each eye, the exact share of each pixel's box after the renderer's blur, and truth."""
    cell = int(2 * radius_px + 18)
    angle = np.linspace(0, 2 * np.pi, int(64 * radius_px), endpoint=False)
    pictures, centers = [], []
    for _ in range(2):
        places = cell / 2 + rng.uniform(-0.5, 0.5, (COUNT, 2)) + np.arange(COUNT)[:, None] * [cell, 0]
        arms = radius_px * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        share = np.zeros((cell, COUNT * cell), np.float32)
        for place in places:
            covered = pixel_coverage([shapely.Polygon(place + arms)], COUNT * cell, cell)
            share[covered.rows, covered.columns] += covered.share
        pictures.append(BACKGROUND_DN + CONTRAST_DN * blur(share[..., None].repeat(3, axis=2), 0.5)[..., 0])
        centers.append(places)
    shapes = np.broadcast_to(radius_px * np.eye(2), (2 * COUNT, 2, 2))
    return pictures, Ellipses(np.repeat([0, 1], COUNT), np.concatenate(centers), shapes)


def signals_of(pictures: list[np.ndarray], own: Sequence[np.ndarray | None] = (None, None)) -> list[MarkerSignal]:
    return [
        MarkerSignal(picture, picture > 1e6, (0.0, 0.0), 1, True, colour)
        for picture, colour in zip(pictures, own, strict=True)
    ]


@pytest.mark.parametrize("radius_px", [53.0, 21.0, 5.0, 2.7])
def test_blur_of_whole_pixels_does_not_move_centers(radius_px: float) -> None:
    rng = np.random.default_rng(3)
    pictures, truth = box_sampled_discs(radius_px, rng)
    start = circles(truth.eyes, truth.centers_px + rng.normal(0, 0.1, (len(truth), 2)), 1.02 * truth.radii_px)
    error = fit_discs(signals_of(pictures), start).ellipses.centers_px - truth.centers_px
    # What is left is the curvature of the outline within nine pixels, of order one over the radius.
    assert np.sqrt(np.mean(error**2)) < 2e-4 + 4e-3 / radius_px


def noisy(pictures: list[np.ndarray], rng: np.random.Generator, deviation_dn: float = 0.6) -> list[np.ndarray]:
    return [(p + deviation_dn * rng.standard_normal(p.shape)).astype(np.float32) for p in pictures]


def rms_error(signals: list[MarkerSignal], truth: Ellipses) -> tuple[float, DiscFits]:
    fits = fit_discs(signals, circles(truth.eyes, truth.centers_px + 0.05, truth.radii_px))
    assert fits.accepted.all()
    return np.sqrt(np.mean((fits.ellipses.centers_px - truth.centers_px) ** 2)), fits


def with_shot_noise(pictures: list[np.ndarray], rng: np.random.Generator) -> list[np.ndarray]:
    return [(p + np.sqrt(0.2 + 0.03 * p) * rng.standard_normal(p.shape)).astype(np.float32) for p in pictures]


def test_noise_of_the_other_colors_is_left_out_where_they_are_even() -> None:
    rng, lead_rms, rms = np.random.default_rng(4), [], []
    for _ in range(4):
        pictures, truth = box_sampled_discs(21.0, rng)
        own = with_shot_noise(pictures, rng)
        others = noisy([np.zeros_like(p) for p in pictures], rng)
        lead = [colour - other for colour, other in zip(own, others, strict=True)]
        lead_rms.append(rms_error(signals_of(lead), truth)[0])
        rms.append(rms_error(signals_of(lead, own), truth)[0])
        best = rms_error(signals_of(own), truth)[0]
        # One disc in a hundred keeps the difference.
        assert rms[-1] == pytest.approx(best, rel=0.1)
    assert np.linalg.norm(rms) < np.linalg.norm(lead_rms)


def test_the_difference_stays_where_another_light_lies_beside_a_disc() -> None:
    rng = np.random.default_rng(5)
    pictures, truth = box_sampled_discs(21.0, rng)
    sky = [np.zeros_like(p) for p in pictures]
    for number, x in enumerate(truth.centers_px[:, 0]):
        columns = np.arange(sky[0].shape[1])
        beside = (columns > x + 15) & (columns < x + 30)
        sky[number // COUNT][:, beside] = 20.0
    own = with_shot_noise([p + s for p, s in zip(pictures, sky, strict=True)], rng)
    others = noisy(sky, rng)
    lead = [colour - other for colour, other in zip(own, others, strict=True)]
    kept, fits = rms_error(signals_of(lead, own), truth)
    alone, without = rms_error(signals_of(lead), truth)
    np.testing.assert_allclose(fits.ellipses.centers_px, without.ellipses.centers_px, atol=1e-9)
    assert kept == pytest.approx(alone) and kept < 0.01


def test_a_difference_without_its_color_is_fitted_as_it_is() -> None:
    rng = np.random.default_rng(6)
    pictures, truth = box_sampled_discs(8.0, rng)
    signals = signals_of(with_shot_noise(pictures, rng))
    half = [signals[0], replace(signals[1], own=signals[1].values)]
    assert rms_error(half, truth)[0] == rms_error(signals, truth)[0]
