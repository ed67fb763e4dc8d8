"""Annuli fitted by both edges, evenly lit and cut by a shadow."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from nav.centroids.annuli import AnnulusFits, annulus_model, azimuth_harmonics, fit_annuli, initial_annulus_parameters
from nav.centroids.centroid_uncertainty import NoiseModel
from nav.centroids.ellipses import Ellipses, circles
from nav.centroids.marker_signal import MarkerSignal
from nav.centroids.motion_blur import ImageMotion
from nav.centroids.outline_pixels import annulus_pixels
from render.analytic_engine.pixel_coverage import pixel_coverage
from render.camera.optics import blur
from tests.support.drawn_discs import DAY, coverage

STEP_PX = np.array([0.03, -0.02])
# Shot noise of the background, and its growth; what discs of the same light would have told.
NOISE = NoiseModel(2300 / DAY.step_e**2 + 1 / 12, 1 / DAY.step_e * 2, 0.0)


def draw_annuli(
    outer_px: float,
    rng: np.random.Generator,
    shadow: float = 0.0,
    contrast_e: float = DAY.contrast_e,
    mouth_e: float = 0.0,
    way: tuple[float, float] = (0.0, 0.0),
) -> tuple[list[MarkerSignal], Ellipses, Ellipses]:
    """Signals of an annulus in each eye with their true edges.

    `shadow` takes a share of the light beyond a line, `mouth_e` is the deviation of the light in the middle; all
    moves by `way` meanwhile. [px]
    """
    cell = int(2 * outer_px + 16)
    grid = np.arange(cell, dtype=np.float64)
    signals, centers = [], []
    shape = np.diag([1.0, 0.97])
    for _ in range(2):
        center = cell / 2 + rng.uniform(-0.5, 0.5, 2)
        steps = np.outer((np.arange(20) + 0.5) / 20 - 0.5, way) if any(way) else np.zeros((1, 2))
        hole = np.mean([coverage(shape * outer_px / 1.5, center + STEP_PX + step, grid) for step in steps], axis=0)
        share = np.mean([coverage(shape * outer_px, center + step, grid) for step in steps], axis=0) - hole
        toward = rng.uniform(0, 2 * np.pi)
        along = (grid[None, :] - center[0]) * np.cos(toward) + (grid[:, None] - center[1]) * np.sin(toward)
        mean_e = DAY.background_e + contrast_e * share * (1 - shadow * (along > 0.3 * outer_px))
        out_px = np.hypot(grid[None, :] - center[0], grid[:, None] - center[1])
        mean_e = np.maximum(mean_e + mouth_e * rng.standard_normal(mean_e.shape) * (out_px < outer_px / 1.5 - 2), 0)
        electrons = rng.poisson(mean_e) * (1 + DAY.prnu_fraction * rng.standard_normal(mean_e.shape))
        values = np.round(electrons / DAY.step_e).astype(np.float32)
        signals.append(MarkerSignal(values, values >= 255, (0.0, 0.0), 1, True))
        centers.append(center)
    eyes, middle = np.arange(2), np.array(centers)
    outer = Ellipses(eyes, middle, np.tile(shape * outer_px, (2, 1, 1)))
    return signals, outer, Ellipses(eyes, middle + STEP_PX, np.tile(shape * outer_px / 1.5, (2, 1, 1)))


def off(edges: Ellipses, shift: float | np.ndarray) -> Ellipses:
    """The edges as a markers-only pose predicts them."""
    return Ellipses(edges.eyes, edges.centers_px + shift, 1.004 * edges.shapes_px)


def fit_many(outer_px: float, shadow: float, draws: int = 30) -> tuple[float, ...]:
    """Means of normalized squared errors, of squared errors [px^2] and of stated variances [px^2]."""
    rng = np.random.default_rng([3, int(outer_px)])
    normalized, errors, told = [], [], []
    for _ in range(draws):
        signals, outer, inner = draw_annuli(outer_px, rng, shadow)
        shift = rng.normal(0, 0.3, (2, 2))
        fits = fit_annuli(signals, off(outer, shift), off(inner, shift), NOISE)
        assert fits.accepted.all(), fits.reasons
        error = fits.centers_px - outer.centers_px
        normalized.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(fits.cov_px2), error) / 2)
        errors.append(error)
        told.append(fits.cov_px2[:, [0, 1], [0, 1]])
    return np.mean(normalized), np.mean(np.square(errors)), np.mean(told)


@pytest.mark.parametrize("outer_px", [30.0, 15.0, 8.0])
def test_even_annuli_are_as_good_as_their_covariance(outer_px: float) -> None:
    normalized, variance, _ = fit_many(outer_px, 0.0)
    # 120 squared errors: standard deviation 0.13.
    assert 0.6 < normalized < 1.4
    # More edge than a marker of two thirds of the radius, whose bound is 0.0036 sqrt(10.7 / r).
    assert np.sqrt(variance) < 0.0045 * np.sqrt(16 / outer_px)


def test_thin_annuli_keep_the_predicted_step() -> None:
    normalized, variance, _ = fit_many(4.0, 0.0)
    assert 0.6 < normalized < 1.4
    # The bound of a disc of 4 px is 0.007 px.
    assert np.sqrt(variance) < 0.0085


def test_covariances_are_right_beside_lighter_surroundings_than_a_marker_has() -> None:
    rng = np.random.default_rng(9)
    # What discs on a dark face would have told: a ninth of the variance beside the annuli.
    told = NoiseModel(NOISE.dark_dn2 / 9, NOISE.per_signal_dn, 0.0)
    normalized = []
    for _ in range(40):
        signals, outer, inner = draw_annuli(15.0, rng)
        fits = fit_annuli(signals, off(outer, 0.1), off(inner, 0.1), told)
        error = fits.centers_px - outer.centers_px
        normalized.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(fits.cov_px2), error) / 2)
    # 160 squared errors: standard deviation 0.11.
    assert 0.65 < np.mean(normalized) < 1.35


@pytest.mark.parametrize("outer_px", [30.0, 15.0])
def test_what_lies_in_the_mouth_does_not_widen_covariances(outer_px: float) -> None:
    rng, normalized = np.random.default_rng([11, int(outer_px)]), []
    for _ in range(40):
        # Twelve times the noise of a pixel.
        signals, outer, inner = draw_annuli(outer_px, rng, mouth_e=600.0)
        fits = fit_annuli(signals, off(outer, 0.1), off(inner, 0.1), NOISE)
        error = fits.centers_px - outer.centers_px
        normalized.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(fits.cov_px2), error) / 2)
    # 160 squared errors: standard deviation 0.11. By the noise of all pixels it would be 0.12 and 0.16.
    assert 0.6 < np.mean(normalized) < 1.4


@pytest.mark.parametrize("outer_px", [53.0, 16.0, 5.3])
def test_blur_of_whole_pixels_does_not_move_the_centre(outer_px: float) -> None:
    rng = np.random.default_rng(5)
    cell, errors = int(2 * outer_px + 18), []
    angle = np.linspace(0, 2 * np.pi, int(64 * outer_px), endpoint=False)
    for _ in range(6):
        centers, signals = cell / 2 + rng.uniform(-0.5, 0.5, (2, 2)), []
        for center in centers:
            share = np.zeros((cell, cell), np.float32)
            for radius, sign in ((outer_px, 1), (outer_px / 1.5, -1)):
                outline = center + radius * np.stack([np.cos(angle), 0.97 * np.sin(angle)], axis=-1)
                covered = pixel_coverage([shapely.Polygon(outline)], cell, cell)
                share[covered.rows, covered.columns] += sign * covered.share
            picture = 6 + 100 * blur(share[..., None].repeat(3, axis=2), 0.5)[..., 0]
            signals.append(MarkerSignal(picture, picture > 1e6, (0.0, 0.0), 1, True))
        shapes = np.tile(np.diag([1.0, 0.97]), (2, 1, 1))
        edges = [Ellipses(np.arange(2), centers, radius * shapes) for radius in (outer_px, outer_px / 1.5)]
        fits = fit_annuli(signals, off(edges[0], 0.1), off(edges[1], 0.1), NOISE)
        errors.append(fits.centers_px - centers)
    # As for markers: what is left is the curvature of the outline within nine pixels. Gaussian edges alone miss by two
    # to twenty times as much.
    assert np.sqrt(np.mean(np.square(errors))) < 1e-4 + 4e-3 / outer_px


@pytest.mark.parametrize("outer_px", [30.0, 15.0])
def test_shadow_edges_widen_the_covariance_more_than_they_move_the_centre(outer_px: float) -> None:
    normalized, variance, told = fit_many(outer_px, 0.5)
    _, _, even = fit_many(outer_px, 0.0, 5)
    assert told > 3 * even
    # What the azimuthal terms cannot follow is no noise, and what both eyes share is counted twice: nothing too narrow.
    assert normalized < 1.2
    assert np.sqrt(variance) < 0.02


@pytest.mark.parametrize("outer_px", [12.0, 5.0])
def test_light_beyond_the_collar_does_not_move_the_centre(outer_px: float) -> None:
    rng = np.random.default_rng([7, int(outer_px)])
    factor, errors, unaware = 1 + 0.8 / outer_px, [], []
    for _ in range(20):
        # Brighter by half a contrast beyond the collar, except behind a hose on the right.
        beyond_e = 2300.0
        signals, outer, inner = draw_annuli(outer_px, rng)
        lit = []
        for signal, center in zip(signals, outer.centers_px, strict=True):
            grid = np.arange(signal.values.shape[0], dtype=np.float64)
            x = grid[None, :] - center[0]
            share = (1 - coverage(np.diag([1.0, 0.97]) * factor * outer_px, center, grid)) * (x < outer_px / 2)
            values = signal.values + np.round(share * beyond_e / DAY.step_e).astype(np.float32)
            lit.append(MarkerSignal(values, values >= 1e4, (0.0, 0.0), 1, True))
        shift = rng.normal(0, 0.1, (2, 2))
        edges = off(outer, shift), off(inner, shift)
        for found, collar in ((errors, factor), (unaware, 0.0)):
            fits = fit_annuli(lit, *edges, NOISE, collar)
            found.append((fits.centers_px - outer.centers_px)[fits.accepted])
    assert sum(map(len, errors)) == 40
    # Four standard errors of 40 errors of 0.02 px; the edge of the hose is sharper than two orders of the azimuth.
    assert np.abs(np.concatenate(errors).mean(axis=0)).max() < 0.02
    lost = sum(map(len, unaware)) < 30
    assert lost or np.abs(np.concatenate(unaware).mean(axis=0)).max() > 0.02


@pytest.mark.parametrize(
    ("outer_px", "way"),
    [pytest.param(30.0, (5.0, 3.0), marks=pytest.mark.slow), (15.0, (-4.0, 1.0)), (8.0, (1.0, 2.0))],
)
def test_annuli_that_move_are_as_good_as_their_covariance(outer_px: float, way: tuple[float, float]) -> None:
    rng, normalized = np.random.default_rng([17, int(outer_px)]), []
    for _ in range(30):
        signals, outer, inner = draw_annuli(outer_px, rng, way=way)
        # The two senses of a way look alike.
        travel = ImageMotion(outer.centers_px, -np.tile(way, (2, 1)), np.zeros((2, 2)))
        fits = fit_annuli(signals, off(outer, 0.1), off(inner, 0.1), NOISE, motion=travel)
        error = fits.centers_px - outer.centers_px
        normalized.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(fits.cov_px2), error) / 2)
    # 120 squared errors: standard deviation 0.13.
    assert 0.6 < np.mean(normalized) < 1.4


def test_annuli_that_are_not_there_or_dark_give_reasons() -> None:
    rng = np.random.default_rng(4)
    signals, outer, inner = draw_annuli(15.0, rng, contrast_e=0.0)
    fits = fit_annuli(signals, outer, inner, NOISE)
    assert fits.reasons == ("no contrast", "no contrast")
    np.testing.assert_array_equal(fits.centers_px, outer.centers_px)
    signals, outer, inner = draw_annuli(15.0, rng)
    fits = fit_annuli(signals, off(outer, 12.0), off(inner, 12.0), NOISE)
    assert not fits.accepted.any()


def test_derivatives_are_those_of_the_picture() -> None:
    rng = np.random.default_rng(5)
    signals, outer, inner = draw_annuli(12.0, rng)
    pixels = annulus_pixels(signals, outer, inner)
    turns = azimuth_harmonics(pixels, 4)
    model = annulus_model(pixels, turns, rng.random(pixels.x_px.shape).astype(np.float32))
    parameters = initial_annulus_parameters(pixels, outer, inner, turns.shape[1])
    parameters[:, -8:] = rng.normal(0, 5, (2, 8))
    _, jacobian = model(parameters)
    for place in range(parameters.shape[1]):
        step = np.zeros(parameters.shape[1])
        step[place] = 3e-4 if place in (2, 3, 4, 7, 8, 9) else 0.02
        slope = (model(parameters + step)[0] - model(parameters - step)[0]) / (2 * step[place])
        scale = np.abs(jacobian[:, place]).max()
        # Third derivatives of an edge of 0.6 px over steps of up to 0.04 px, and single precision.
        np.testing.assert_allclose(jacobian[:, place] / scale, slope / scale, atol=5e-3)


def test_no_annuli_no_fits() -> None:
    nothing = circles(np.zeros(0), np.zeros((0, 2)), np.zeros(0))
    signals, _, _ = draw_annuli(5.0, np.random.default_rng(6))
    assert isinstance(fit_annuli(signals, nothing, nothing, NOISE), AnnulusFits)
