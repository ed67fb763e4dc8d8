"""Discs that move while the shutter is open: their displacements, and their centres at mid-exposure."""

from __future__ import annotations

import numpy as np
import pytest

from nav.centroids import disc_fit
from nav.centroids.disc_fit import fit_discs
from nav.centroids.discs import disc_model, initial_disc_parameters
from nav.centroids.ellipses import Ellipses
from nav.centroids.marker_signal import MarkerSignal
from nav.centroids.motion_blur import motion_blurred
from nav.centroids.outline_pixels import disc_pixels
from studies.acceptance.rendered.scored_frames import PixelLight
from tests.support.drawn_discs import COUNT, DAY, DUSK, coverage, draw_discs, expose, rough_start

PARTS = 32


def draw_moving(
    radius_px: float, light: PixelLight, rng: np.random.Generator, way: tuple[float, float], growth: float = 0.0
) -> tuple[list[MarkerSignal], Ellipses]:
    """Signals of a ring of COUNT discs in each eye that moves by `way`, grows about its middle, and their places."""
    reach_px = np.hypot(*way)
    ring_px = 3 * (radius_px + reach_px + 8)
    size = int(2 * (ring_px + radius_px + reach_px + 12))
    window = np.arange(int(2 * (radius_px + reach_px + 8)), dtype=np.float64)
    angles = 2 * np.pi * np.arange(COUNT) / COUNT
    shape, signals, centers = radius_px * np.diag([1.0, 0.97]), [], []
    for _ in range(2):
        middle = size / 2 + rng.uniform(-0.5, 0.5, 2)
        arms = ring_px * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        mean_e = np.full((size, size), float(light.background_e))
        for arm in arms:
            left, top = np.rint(middle + arm - len(window) / 2).astype(int)
            lit = mean_e[top : top + len(window), left : left + len(window)]
            for part in (np.arange(PARTS) + 0.5) / PARTS - 0.5:
                at = middle + part * np.array(way) + (1 + growth * part) * arm - (left, top)
                lit += light.contrast_e / PARTS * coverage((1 + growth * part) * shape, at, window)
        values = expose(light, mean_e, rng)
        signals.append(MarkerSignal(values, values >= 1e4, (0.0, 0.0), 1, True))
        centers.append(middle + arms)
    return signals, Ellipses(np.repeat([0, 1], COUNT), np.concatenate(centers), np.tile(shape, (2 * COUNT, 1, 1)))


@pytest.mark.parametrize(
    ("radius_px", "way", "growth"),
    [
        pytest.param(30.0, (9.0, -4.0), 0.006, marks=pytest.mark.slow),
        (12.0, (0.0, 6.0), -0.004),
        (8.0, (2.5, 1.0), 0.0),
        (4.0, (1.5, -1.5), 0.0),
    ],
)
def test_moving_discs_are_found_where_they_were_at_mid_exposure(
    monkeypatch: pytest.MonkeyPatch, radius_px: float, way: tuple[float, float], growth: float
) -> None:
    rng, normalized, errors, unaware = np.random.default_rng([3, int(radius_px)]), [], [], []
    for _ in range(2):
        signals, truth = draw_moving(radius_px, DAY, rng, way, growth)
        start = rough_start(truth, rng)
        fits = fit_discs(signals, start)
        assert fits.accepted.all(), fits.reasons
        assert fits.motion is not None
        sense = np.sign(fits.motion.means_px[0] @ np.array(way))
        # The shortest ways, which widen edges least, are told worst: to 0.1 px or so.
        np.testing.assert_allclose(sense * fits.motion.means_px, [way, way], atol=0.25)
        error = fits.ellipses.centers_px - truth.centers_px
        errors.append(error)
        normalized.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(fits.cov_px2), error) / 2)
        with monkeypatch.context() as context:
            context.setattr(disc_fit, "detect_motion", lambda *_: None)
            unaware.append(fit_discs(signals, start).ellipses.centers_px - truth.centers_px)
    # 64 squared errors: standard deviation 0.18.
    assert 0.5 < np.mean(normalized) < 1.6
    # Shorter ways move the fit of still discs by less than the noise.
    assert np.hypot(*way) < 3 or np.mean(np.square(errors)) < np.mean(np.square(unaware)) / 2
    # Four standard errors: neither end of the way has more weight than the other.
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 4 * np.std(errors) / np.sqrt(32)


@pytest.mark.parametrize("light", [DAY, DUSK])
@pytest.mark.parametrize("radius_px", [30.0, 8.0, 3.0])
def test_still_discs_are_not_said_to_move(radius_px: float, light: PixelLight) -> None:
    rng = np.random.default_rng([5, int(radius_px)])
    for _ in range(6):
        signals, truth = draw_discs(radius_px, light, rng)
        assert fit_discs(signals, rough_start(truth, rng)).motion is None


def test_what_has_no_edges_does_not_move() -> None:
    rng = np.random.default_rng(7)
    _, truth = draw_moving(12.0, DAY, rng, (3.0, 0.0))
    noise = rng.normal(50, 20, (2, 200, 200)).astype(np.float32)
    signals = [MarkerSignal(values, values >= 1e4, (0.0, 0.0), 1, True) for values in noise]
    fits = fit_discs(signals, truth)
    assert not fits.accepted.all() and fits.motion is None


def test_derivatives_are_those_of_the_moving_picture() -> None:
    rng = np.random.default_rng(9)
    signals, truth = draw_moving(12.0, DAY, rng, (4.0, 2.0))
    pixels = disc_pixels(signals, truth, blur_px=2.5)
    model = motion_blurred(disc_model(pixels, False, True), np.tile([4.0, 2.0, 0.01], (len(truth), 1)), (0,))
    parameters = initial_disc_parameters(pixels, truth.shapes_px, 2)
    parameters[:, -2:] = rng.normal(0, 1, (len(truth), 2))
    _, jacobian = model(parameters)
    for place in range(parameters.shape[1]):
        step = np.zeros(parameters.shape[1])
        step[place] = 3e-4 if place in (2, 3, 4) else 0.02
        slope = (model(parameters + step)[0] - model(parameters - step)[0]) / (2 * step[place])
        scale = np.abs(jacobian[:, place]).max()
        # The shape's growth of half a hundredth is left out of its derivatives, and single precision.
        np.testing.assert_allclose(jacobian[:, place] / scale, slope / scale, atol=1.2e-2)
