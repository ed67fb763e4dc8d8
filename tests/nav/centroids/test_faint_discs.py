"""Faint discs are fitted while all their pixels together determine their centre, and refused below that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datasets_manifest.types.images import StereoImages
from nav.centroids.centroid_uncertainty import SECTORS, NoiseModel, residual_spread
from nav.centroids.disc_fit import fit_discs
from nav.centroids.discs import contrasts, disc_model, initial_disc_parameters, rejection_reasons
from nav.centroids.ellipses import circles
from nav.centroids.face_background import FaceBackground
from nav.centroids.marker_signal import marker_signals
from nav.centroids.outline_pixels import disc_pixels
from nav.numerics.levenberg_marquardt import evaluate
from studies.acceptance.rendered.scored_frames import PixelLight, center_bound_px
from tests.support.drawn_discs import DAY, DUSK, draw_discs, fit_many, rough_start


def faint(contrast_sigma: float) -> PixelLight:
    """Light in which a pixel of a disc stands so many deviations of its own noise above the pixels beside it."""
    background_e = 20.0
    other_e2 = background_e + DUSK.read_noise_e**2
    contrast_e = contrast_sigma**2 / 2 + np.sqrt(contrast_sigma**4 / 4 + contrast_sigma**2 * other_e2)
    return replace(DUSK, background_e=background_e, contrast_e=contrast_e)


@pytest.mark.parametrize(("z_m", "contrast_sigma"), [(2, 3.3), (5, 3.3), (10, 3.3), (20, 4.0), (40, 4.5)])
def test_faint_discs_are_fitted_to_the_bound_and_the_covariance_tells_it(z_m: int, contrast_sigma: float) -> None:
    radius, light, rng = 2133.333 * 0.05 / z_m, faint(contrast_sigma), np.random.default_rng([15, z_m])
    error, cov, _ = fit_many(radius, light, rng)
    # As in better light: 256 errors know their rms to 4.4 %, and the plane of shading costs up to a fifth.
    assert 0.88 < np.sqrt(np.mean(error**2)) / center_bound_px(0.985 * radius, light) < 1.35
    assert 0.7 < np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error).mean() / 2 < 1.3


def test_what_is_too_faint_is_rejected_and_never_an_outline_without_inside() -> None:
    rng, reasons = np.random.default_rng(16), set()
    for contrast_sigma in (0.5, 1.0, 1.5, 2.7):
        for _ in range(6):
            signals, truth = draw_discs(3.0, faint(contrast_sigma), rng)
            fits = fit_discs(signals, rough_start(truth, rng))
            assert np.sqrt(np.einsum("nii->n", fits.cov_px2[fits.accepted]) / 2).max(initial=0) < 0.2
            if contrast_sigma < 2:
                reasons |= set(fits.reasons)
    assert {"no contrast"} <= reasons and None not in reasons


def test_an_outline_turned_inside_out_is_no_disc() -> None:
    rng = np.random.default_rng(17)
    signals, truth = draw_discs(10.0, DAY, rng)
    pixels = disc_pixels(signals, truth)
    fit = evaluate(
        disc_model(pixels, False, False),
        pixels.values,
        pixels.present,
        initial_disc_parameters(pixels, truth.shapes_px, 0),
    )
    noise = NoiseModel(50.0, 0.02, 0.0)
    cov = np.tile(1e-4 * np.eye(2), (len(truth), 1, 1))
    spread = residual_spread(fit.residuals, pixels.present / 50, pixels, SECTORS, contrasts(fit), 8)
    turned = fit.parameters.copy()
    turned[0, 2:5] *= -1
    reasons = rejection_reasons(truth, pixels, replace(fit, parameters=turned), cov, noise, spread)
    assert reasons[0] == "the fit left the disc"
    assert "the fit left the disc" not in reasons[1:]


def test_fits_that_lose_the_shape_of_a_disc_of_a_pixel_are_told() -> None:
    """Discs in noise beside the edge of a narrow face: some fits end at an ellipse that is none."""
    rng, count, scale = np.random.default_rng(39), 6, 110.0
    angle = 2 * np.pi * np.arange(count) / count
    places_m = 0.28 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    image = rng.normal(300, 30, (100, 100)).astype(np.uint16)
    images = StereoImages(image, image, 0.0, 1e-3, bits=12)
    discs = circles(np.zeros(count), places_m * scale + 50, np.full(count, 0.01 * scale))
    face = FaceBackground(places_m, (0.25, 0.305), 1.6)
    fits = fit_discs(marker_signals(images, None, discs), discs, face)
    assert not fits.accepted.any()
