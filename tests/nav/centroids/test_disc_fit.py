"""Edge-model centroids against exact pictures of discs with the sensor's noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.presets import PRESETS
from geometry.circles import project_disc_centers
from geometry.stereo import EYES, paper_rig
from nav.centroids.blurred_edges import START_WIDTH_PX, ellipse_parameters
from nav.centroids.disc_fit import fit_discs
from nav.centroids.discs import disc_model
from nav.centroids.ellipses import Ellipses, circles
from nav.centroids.face_background import FaceBackground, background_shares
from nav.centroids.marker_signal import MarkerSignal, marker_signals
from nav.centroids.outline_pixels import disc_pixels
from studies.acceptance.rendered.scored_frames import PixelLight, center_bound_px
from tests.support.drawn_discs import COUNT, DAY, DUSK, coverage, draw_discs, expose, fit_many, rough_start
from tests.support.grey_centroid import grey_centroids
from tests.support.painted_pairs import make_pose, paint_pair


@pytest.mark.parametrize("light", [DAY, DUSK], ids=["day", "dusk"])
@pytest.mark.parametrize("z_m", [2, 5, 10, 20, 40])
def test_error_reaches_the_bound_and_the_covariance_tells_it(light: PixelLight, z_m: float) -> None:
    radius, rng = 2133.333 * 0.05 / z_m, np.random.default_rng([5, z_m])
    error, cov, radial = fit_many(radius, light, rng)
    rms, bound = np.sqrt(np.mean(error**2)), center_bound_px(0.985 * radius, light)
    # 256 errors know their rms to 4.4 %; the plane of shading, fitted down to 7.5 px, costs up to a fifth.
    assert 0.88 < rms / bound < 1.35
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error).mean() / 2
    # Chi-square of 256: standard deviation of the mean square 0.088.
    assert 0.7 < nees < 1.3
    # Four standard errors of the mean of 128.
    assert np.abs(error.mean(axis=0)).max() < 4 * rms / np.sqrt(128)
    # A curved edge blurred by s moves inwards by s^2 / (2 r), all around, and so leaves the centre.
    assert np.mean(radial) == pytest.approx(-(START_WIDTH_PX**2) / (2 * radius), abs=0.02)


@pytest.mark.parametrize("radius_px", [5.0, 10.0])
def test_what_lies_beside_discs_does_not_widen_their_covariance(radius_px: float) -> None:
    rng = np.random.default_rng([6, round(radius_px)])

    def rough_beside(lit: np.ndarray, x: np.ndarray, y: np.ndarray, _: int) -> np.ndarray:
        # Three times the noise of a pixel, from where hardly any light of the disc comes.
        return lit + 150 * rng.standard_normal(lit.shape) * (np.hypot(x, y) > radius_px + 1.5)

    squares = []
    for _ in range(16):
        signals, truth = draw_discs(radius_px, DAY, rng, spoil=rough_beside)
        spoilt = truth.take(np.flatnonzero(truth.eyes == 0))
        fits = fit_discs(signals, rough_start(spoilt, rng))
        assert fits.accepted.all(), fits.reasons
        error = fits.ellipses.centers_px - spoilt.centers_px
        squares.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(fits.cov_px2), error) / 2)
    # Chi-square of 256: standard deviation of the mean square 0.088. By the noise of pixels alone it would be 0.4.
    assert 0.7 < np.mean(squares) < 1.3


@pytest.mark.parametrize("z_m", [2, 5, 10])
def test_shading_moves_grey_centroids_but_not_the_fit(z_m: int) -> None:
    radius, rng = 2133.333 * 0.05 / z_m, np.random.default_rng(6)
    signals, truth = draw_discs(radius, DAY, rng, shading=0.1, noisy=False)
    start = rough_start(truth, rng)
    fitted = fit_discs(signals, start).ellipses.centers_px - truth.centers_px
    grey = grey_centroids(signals, truth) - truth.centers_px
    # Light 1 + 0.1 x / r on a disc has its centre of mass at 0.1 r / 4, times the squared ratio of its axes.
    np.testing.assert_allclose(grey[:, 0], 0.025 * radius, rtol=0.07, atol=0.01)
    # Terms beyond the plane: curvature of the edge over its blur.
    assert np.abs(fitted).max() < 2e-3


@pytest.mark.parametrize("z_m", [1.7, 3])
def test_a_slope_of_the_face_beside_large_discs_does_not_move_the_fit(z_m: float) -> None:
    radius, rng = 2133.333 * 0.05 / z_m, np.random.default_rng(16)

    def spoil(lit: np.ndarray, x: np.ndarray, y: np.ndarray, number: int) -> np.ndarray:
        beside = 1 - (lit - DAY.background_e) / DAY.contrast_e
        return lit + 0.05 * DAY.contrast_e * beside * y / radius + 0 * x

    signals, truth = draw_discs(radius, DAY, rng, noisy=False, spoil=spoil)
    sloped = truth.eyes == 0
    error = (fit_discs(signals, rough_start(truth, rng)).ellipses.centers_px - truth.centers_px)[sloped]
    # Without the plane each edge moves by 0.05 sqrt(pi) s, s its width: 0.05 px up. What is left, a twentieth at most,
    # is the window's start half a pixel off and the curvature of the edge.
    assert np.abs(error).max() < 0.05 * np.sqrt(np.pi) * START_WIDTH_PX / 20


def test_grey_centroids_of_even_discs_are_true() -> None:
    rng = np.random.default_rng(7)
    signals, truth = draw_discs(6.0, DAY, rng, noisy=False)
    # The window cuts the tail of the blur where it ends, within 2.5 px: 1e-3 of the light of the outermost pixels.
    np.testing.assert_allclose(grey_centroids(signals, truth), truth.centers_px, atol=2e-3)


def spoil_first(kind: str, light: PixelLight) -> Callable[..., Any]:
    def spoil(lit: np.ndarray, x: np.ndarray, y: np.ndarray, number: int) -> np.ndarray:
        if number != 0:
            return lit
        if kind == "shadow":
            return np.where(x + 0 * y > 3, light.background_e + 0.4 * (lit - light.background_e), lit)
        if kind == "hidden":
            return np.where(np.abs(x - 4) + 0 * y < 2, light.background_e, lit)
        if kind == "clipped":
            return np.where(x + 0 * y > 2, 20_000.0, lit)
        return np.full_like(lit, light.background_e)

    return spoil


@pytest.mark.parametrize("difference", [True, False])
@pytest.mark.parametrize(
    ("kind", "reason"), [("shadow", "uneven"), ("hidden", "uneven"), ("clipped", "clipped"), ("gone", "no contrast")]
)
def test_spoilt_discs_are_rejected_with_a_reason(kind: str, reason: str, difference: bool) -> None:
    rng = np.random.default_rng(8)
    signals, truth = draw_discs(10.0, DAY, rng, spoil=spoil_first(kind, DAY), difference=difference)
    start = rough_start(truth, rng)
    fits = fit_discs(signals, start)
    assert reason in str(fits.reasons[0])
    assert fits.accepted[1:].all()
    np.testing.assert_array_equal(fits.ellipses.centers_px[0], start.centers_px[0])
    error = (fits.ellipses.centers_px - truth.centers_px)[1:]
    # The good ones stay good: 30 errors, 1.25 of the bound, know their rms to 13 %.
    assert np.sqrt(np.mean(error**2)) < 1.8 * center_bound_px(10.0, DAY)


@pytest.mark.parametrize("times_range", [0.9, 1.0, 3.0, 20.0])
@pytest.mark.parametrize("difference", [True, False])
def test_discs_brighter_than_the_sensors_range_are_placed_by_what_is_not_clipped(
    times_range: float, difference: bool
) -> None:
    highest_dn, rng = 255.0, np.random.default_rng([20, round(10 * times_range)])
    light = replace(DAY, contrast_e=times_range * highest_dn * DAY.step_e - DAY.background_e)
    errors, covariances = [], []
    for _ in range(2):
        signals, truth = draw_discs(6.0, light, rng, difference=difference)
        cut = [
            replace(s, values=np.minimum(s.values, np.float32(highest_dn)), clipped=s.values >= highest_dn)
            for s in signals
        ]
        fits = fit_discs(cut, rough_start(truth, rng))
        assert fits.accepted.all(), fits.reasons
        errors.append(fits.ellipses.centers_px - truth.centers_px)
        covariances.append(fits.cov_px2)
    error, cov = np.concatenate(errors), np.concatenate(covariances)
    # As good as discs that fill the range: what is lost within is won by steeper flanks.
    full = center_bound_px(6.0, replace(DAY, contrast_e=highest_dn * DAY.step_e - DAY.background_e))
    assert np.sqrt(np.mean(error**2)) < 1.5 * full
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error).mean() / 2
    # Chi-square of 64: standard deviation of the mean square 0.18.
    assert 0.4 < nees < 2.0


def test_discs_over_the_images_edge_are_rejected() -> None:
    rng = np.random.default_rng(9)
    signals, truth = draw_discs(10.0, DAY, rng)
    cut = [MarkerSignal(s.values[:, 12:], s.clipped[:, 12:], (12.0, 0.0), 1, True) for s in signals]
    fits = fit_discs(cut, rough_start(truth, rng))
    assert [i for i, reason in enumerate(fits.reasons) if reason is not None] == [0, COUNT]
    assert "edge of the image" in str(fits.reasons[0])
    assert np.isnan(grey_centroids(cut, truth)[[0, COUNT]]).all()


def test_no_discs_no_fits() -> None:
    nothing = circles(np.zeros(0), np.zeros((0, 2)), np.zeros(0))
    signals, _ = draw_discs(5.0, DAY, np.random.default_rng(1))
    assert fit_discs(signals, nothing).reasons == ()
    assert grey_centroids(signals, nothing).shape == (0, 2)


def test_derivatives_are_those_of_the_picture() -> None:
    rng = np.random.default_rng(10)
    signals, truth = draw_discs(9.0, DAY, rng)
    pixels = disc_pixels(signals, truth)
    further = rng.random((16, 1, pixels.x_px.shape[1])).astype(np.float32)
    model = disc_model(pixels, True, True, further)
    parameters = np.column_stack(
        [ellipse_parameters(rng.normal(0, 0.1, (len(truth), 2)), truth.shapes_px), np.tile([0.6, 50, 150], (16, 1))]
    )
    parameters = np.column_stack([parameters, rng.normal(0, 0.5, (16, 5))])
    _, jacobian = model(parameters)
    for place in range(parameters.shape[1]):
        step = np.zeros(parameters.shape[1])
        step[place] = 4e-4 if 2 <= place < 5 else 0.02
        slope = (model(parameters + step)[0] - model(parameters - step)[0]) / (2 * step[place])
        # Third derivatives of an edge of 0.6 px over steps of up to 0.03 px, and single precision.
        scale = np.abs(jacobian[:, place]).max()
        np.testing.assert_allclose(jacobian[:, place] / scale, slope / scale, atol=5e-3)


def draw_face(
    rng: np.random.Generator, sky_e: float, radius_px: float = 2.8, margin_px: float = 0.55, noisy: bool = True
) -> tuple[list[MarkerSignal], Ellipses, FaceBackground, np.ndarray]:
    """Eight discs on a ring of dark face in each eye, with light beyond the face's rim and within its opening."""
    ring_px, count = 5.4 * radius_px, 8
    cell = int(2 * ring_px + 6 * radius_px)
    grid = np.arange(cell, dtype=np.float64)
    angle = 2 * np.pi * np.arange(count) / count
    places = np.column_stack([np.cos(angle), np.sin(angle)])
    edges = [ring_px + sign * (radius_px + margin_px) for sign in (-1, 1)]
    signals, centers = [], []
    for _ in range(2):
        middle = cell / 2 + rng.uniform(-0.5, 0.5, 2)
        opening, rim = (coverage(edge * np.eye(2), middle, grid) for edge in edges)
        # A difference of colours is zero on the face; the noise is that of light enough to keep it positive.
        mean_e = np.full((cell, cell), 2300.0) + sky_e * (1 - rim + 0.5 * opening)
        for place in places:
            mean_e += 4700 * coverage(radius_px * np.eye(2), middle + ring_px * place, grid)
        values = expose(DAY, mean_e, rng if noisy else None)
        signals.append(MarkerSignal(values, values >= 1e4, (0.0, 0.0), 1, True))
        centers.append(middle + ring_px * places)
    truth = circles(np.repeat([0, 1], count), np.concatenate(centers), np.full(2 * count, radius_px))
    around = FaceBackground(np.tile(places, (2, 1)), (edges[0] / ring_px, edges[1] / ring_px))
    return signals, truth, around, np.tile(places, (2, 1))


@pytest.mark.parametrize("sky_e", [-2000.0, 2000.0], ids=["blue", "warm"])
def test_light_beyond_a_narrow_face_does_not_move_the_centres(sky_e: float) -> None:
    rng = np.random.default_rng(13)
    outward, plain = [], []
    for _ in range(6):
        signals, truth, around, arms = draw_face(rng, sky_e)
        start = rough_start(truth, rng)
        fits = fit_discs(signals, start, around)
        assert fits.accepted.all()
        outward.append(np.einsum("ni,ni->n", fits.ellipses.centers_px - truth.centers_px, arms))
        unaware = fit_discs(signals, start)
        plain.append(np.einsum("ni,ni->n", unaware.ellipses.centers_px - truth.centers_px, arms)[unaware.accepted])
    # 96 errors of 0.012 px, the bound with the surroundings free, know their mean to 0.0013 px.
    assert abs(np.mean(outward)) < 0.005
    # Without the surroundings the fit gives the discs up, or is drawn along the radius.
    rejected = 1 - sum(map(len, plain)) / 96
    assert rejected > 0.5 or abs(np.mean(np.concatenate(plain))) > 0.02


def test_shares_beyond_the_face_follow_the_markers() -> None:
    rng = np.random.default_rng(14)
    signals, truth, around, _ = draw_face(rng, 0.0, noisy=False)
    pixels = disc_pixels(signals, truth)
    shares = background_shares(around, truth, pixels, START_WIDTH_PX, None)
    assert shares is not None
    places = np.stack([pixels.x_px, pixels.y_px], axis=-1) + pixels.origins_px[:, None]
    for eye in range(2):
        mine = truth.eyes == eye
        middle = truth.centers_px[mine].mean(axis=0)
        out_px = np.linalg.norm(places[mine] - middle, axis=-1)
        ring_px = np.linalg.norm(truth.centers_px[mine] - middle, axis=-1).mean()
        # Half of the light comes from beyond where the edge itself lies.
        for share, edge, sign in zip(np.moveaxis(shares[mine], 1, 0), around.edges_m, (-1, 1), strict=True):
            np.testing.assert_array_equal((share > 0.5), sign * (out_px - edge * ring_px) > 0)
    few = truth.take(np.array([0, 1, 8, 9]))
    assert background_shares(around.take(np.array([0, 1, 8, 9])), few, disc_pixels(signals, few), 0.5, None) is None


@pytest.mark.parametrize("color", [0, 2])
@pytest.mark.parametrize("radius_px", [10.0, 39.0])
def test_mosaic_sites_keep_their_places(color: int, radius_px: float) -> None:
    rng = np.random.default_rng(11)
    signals, truth = draw_discs(radius_px, DAY, rng)
    mosaics = []
    for signal in signals:
        even = signal.values[: signal.values.shape[0] // 2 * 2]
        # Other colours see a dark picture.
        mosaic = np.full(even.shape, 20, np.uint8)
        mosaic[color // 2 :: 2, color // 2 :: 2] = even[color // 2 :: 2, color // 2 :: 2]
        mosaics.append(mosaic)
    blank = [np.zeros((*mosaic.shape, 3), np.uint8) for mosaic in mosaics]
    images = StereoImages(*blank, 0.0, 1e-3, left_mosaic=mosaics[0], right_mosaic=mosaics[1])
    fits = fit_discs(marker_signals(images, color, truth), rough_start(truth, rng))
    error = fits.ellipses.centers_px - truth.centers_px
    # A quarter of the pixels doubles the noise; 32 errors know their rms to 13 %.
    assert np.sqrt(np.mean(error**2)) < 2 * 1.6 * center_bound_px(radius_px, DAY)
    assert fits.accepted.all()


@pytest.mark.parametrize("kind", ["sky", "cloud"])
@pytest.mark.parametrize("z_m", [2.0, 10.0, 40.0])
def test_drawn_drogue_is_measured_at_its_ellipse_centres(kind: str, z_m: float) -> None:
    rig, drogue = paper_rig(), PRESETS["red-8"]
    layout, rng = marker_layout(drogue), np.random.default_rng([12, int(z_m)])
    place = make_pose(0.06, 0.002, z_m, 7, -6, 10)
    images = paint_pair(rig, drogue, place, rng, kind=kind)
    truth = np.concatenate([project_disc_centers(rig, place, layout.centers_m, layout.radius_m, eye) for eye in EYES])
    radius = rig.camera.fx_px * layout.radius_m / z_m
    start = circles(np.repeat([0, 1], 8), truth + rng.normal(0, 0.1, truth.shape), np.full(16, radius))
    around = FaceBackground(np.tile(layout.centers_m[:, :2], (2, 1)), (layout.face_inner_radius_m, drogue.rim_radius_m))
    fits = fit_discs(marker_signals(images, 0, start), start, around if z_m > 5 else None)
    assert fits.accepted.all()
    # The drawing has no lens: at 5 px across its edges within one pixel do not look like the blurred ones of the model.
    # Nearer, its eight samples a pixel and the noise leave 0.01 px.
    limit_px = 0.012 if z_m <= 10 else 0.025
    assert np.sqrt(np.mean((fits.ellipses.centers_px - truth) ** 2)) < limit_px
