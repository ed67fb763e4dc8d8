"""Fits of discs of 0.3 to 3 px radius against drawn truth over many draws of noise, and against their own bound.

The pictures are drawn by counted points and by filters of other libraries, not by the fit's own model.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from datasets_manifest.types.images import StereoImages
from nav.centroids.discs import DiscFits
from nav.centroids.ellipses import circles
from nav.centroids.small_discs import fit_small_discs
from render.camera.optics import blur

SIGMA_PX, BLACK_DN, DN_PER_E, READ_E = 0.5, 64, 0.35, 4.8
PER_PX, SIDE_PX, APART_PX, COUNT = 16, 84, 26, 9


def light_of(centers: np.ndarray, radius: float, lens_first: bool) -> np.ndarray:
    """(H, W) share of each pixel that discs cover, after the spread of the light."""
    at = (np.arange(SIDE_PX * PER_PX) + 0.5) / PER_PX - 0.5
    fine = np.zeros((at.size, at.size), np.float32)
    for x, y in centers:
        fine[(at - x) ** 2 + (at[:, None] - y) ** 2 < radius**2] = 1
    if lens_first:
        fine = gaussian_filter(fine, SIGMA_PX * PER_PX, mode="nearest")
    covered = cv2.resize(fine, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA)
    return covered if lens_first else blur(covered[..., None], SIGMA_PX).reshape(covered.shape)


def centers_of(rng: np.random.Generator) -> np.ndarray:
    grid = np.array([(16 + APART_PX * (k % 3), 16 + APART_PX * (k // 3)) for k in range(COUNT)], dtype=float)
    return grid + rng.uniform(-0.5, 0.5, grid.shape)


def numbers(mean_e: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    electrons = rng.poisson(mean_e) + rng.normal(0, READ_E, mean_e.shape)
    return np.clip(np.rint(DN_PER_E * electrons) + BLACK_DN, 0, 4095).astype(np.uint16)


def fit(left: np.ndarray, right: np.ndarray, centers: np.ndarray, radius: float, rng: np.random.Generator) -> DiscFits:
    """Fit drawn discs from starts that are off by up to 0.4 px."""
    images = StereoImages(left, right, 0.0, 1e-3, bits=12, black_level_dn=float(BLACK_DN))
    starts = np.concatenate([centers, centers]) + rng.uniform(-0.4, 0.4, (2 * COUNT, 2))
    return fit_small_discs(images, circles(np.repeat([0, 1], COUNT), starts, np.full(2 * COUNT, radius)))


def errors_and_bounds(
    radius: float, lens_first: bool, contrast_e: float, draws: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """(M, 2) errors, (M, 2, 2) covariances, and the number of rejected discs."""
    errors, covariances, rejected = [], [], 0
    for seed in range(draws):
        rng = np.random.default_rng([int(100 * radius), lens_first, seed])
        centers = centers_of(rng)
        mean_e = 500 + contrast_e * light_of(centers, radius, lens_first)
        fits = fit(numbers(mean_e, rng), numbers(mean_e, rng), centers, radius, rng)
        good = fits.accepted
        rejected += int((~good).sum())
        errors.append((fits.ellipses.centers_px - np.concatenate([centers, centers]))[good])
        covariances.append(fits.cov_px2[good])
    return np.concatenate(errors), np.concatenate(covariances), rejected


def check(radius: float, lens_first: bool, contrast_e: float, draws: int) -> None:
    errors, covariances, rejected = errors_and_bounds(radius, lens_first, contrast_e, draws)
    count, rms = len(errors), np.sqrt((errors**2).mean())
    bound = np.sqrt(np.einsum("nii->n", covariances).mean() / 2)
    assert rejected == 0
    # Four standard errors of a mean, and 0.005 px for the points that the discs are drawn with.
    assert np.abs(errors.mean(axis=0)).max() < min(0.02, 4 * rms / np.sqrt(count) + 0.005)
    # A standard deviation of M numbers is right to 1 / sqrt(2 M) of itself; four of that, and 10 % for the model.
    assert rms < bound * (1.1 + 4 / np.sqrt(4 * count))
    assert bound < max(rms, 0.02) * 1.5


@pytest.mark.parametrize("lens_first", [True, False])
def test_a_disc_of_a_pixel_is_placed_to_its_bound_without_bias(lens_first: bool) -> None:
    check(1.0, lens_first, 2000.0, draws=5)


def test_touching_discs_do_not_draw_each_other_inwards() -> None:
    """A ring of lamps with less than a pixel between them: the light of both neighbours pulls towards the middle."""
    radius, count, errors = 1.3, 16, []
    angle = 2 * np.pi * np.arange(count) / count
    out = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    for seed in range(2):
        rng = np.random.default_rng([31, seed])
        centers = SIDE_PX / 2 + rng.uniform(-0.5, 0.5, 2) + 3.4 / (2 * np.sin(np.pi / count)) * out
        images = [numbers(500 + 3000 * light_of(centers, radius, False), rng) for _ in range(2)]
        pair = StereoImages(*images, 0.0, 1e-3, bits=12, black_level_dn=float(BLACK_DN))
        starts = np.concatenate([centers, centers]) + rng.uniform(-0.2, 0.2, (2 * count, 2))
        fits = fit_small_discs(pair, circles(np.repeat([0, 1], count), starts, np.full(2 * count, radius)))
        assert fits.accepted.all(), fits.reasons
        off = fits.ellipses.centers_px - np.concatenate([centers, centers])
        errors.append((off * np.concatenate([out, out])).sum(axis=1))
    # Was 0.03 px when each disc was fitted beside the last fits of the others.
    assert abs(np.mean(errors)) < 0.01


@pytest.mark.slow  # ten times as many draws as above, over all sizes: 3 minutes
@pytest.mark.parametrize("lens_first", [True, False])
@pytest.mark.parametrize("contrast_e", [600.0, 4000.0])
@pytest.mark.parametrize("radius", [0.5, 0.7, 1.0, 1.5, 2.0, 3.0])
def test_discs_of_all_small_sizes_are_placed_to_their_bound(radius: float, contrast_e: float, lens_first: bool) -> None:
    check(radius, lens_first, contrast_e / min(1.0, np.pi * radius**2), draws=20)


@pytest.mark.slow  # a grid of places for each disc: 40 s
def test_a_disc_within_one_pixel_is_placed_in_that_pixel() -> None:
    """Charge that spreads between pixels does not tell where in the pixel the light fell."""
    errors, covariances, rejected = errors_and_bounds(0.3, False, 7000.0, draws=10)
    assert rejected == 0
    # Uniform within 0.2 px of the pixel's middle is 0.115 px.
    assert np.sqrt((errors**2).mean()) < 0.15
    # Measured 1.3; without the spread over places 4 and more, for discs that reach a little into the next pixel.
    assert np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors).mean() / 2 < 2.0


def test_a_lamp_of_all_colours_in_a_mosaic_and_in_a_colour_image() -> None:
    """The channels that navigation looks for markers in take the least of the colours; the fit takes them all."""
    rng, radius = np.random.default_rng(3), 1.0
    centers = centers_of(rng)
    light = light_of(centers, radius, lens_first=True)[..., None]
    planes = np.array([200.0, 500.0, 900.0]) + np.array([2500.0, 2000.0, 1500.0]) * light
    colors = [numbers(planes, rng) for _ in range(2)]
    errors = []
    for mosaics in (None, [mosaic_of(image) for image in colors]):
        left, right = mosaics or (None, None)
        images = StereoImages(*colors, 0.0, 1e-3, 12, "linear", float(BLACK_DN), left, right)
        starts = np.concatenate([centers, centers]) + rng.uniform(-0.4, 0.4, (2 * COUNT, 2))
        fits = fit_small_discs(images, circles(np.repeat([0, 1], COUNT), starts, np.full(2 * COUNT, radius)))
        assert fits.accepted.all()
        off = fits.ellipses.centers_px - np.concatenate([centers, centers])
        errors.append(np.sqrt((off**2).mean()))
        sigma = np.sqrt(np.einsum("nii->n", fits.cov_px2).mean() / 2)
        assert 0.7 < errors[-1] / sigma < 1.3  # of 36 numbers: four times 12 %, less what the two have in common
    # A mosaic has a third of the samples.
    assert errors[0] < errors[1] < 3 * errors[0]


def mosaic_of(image: np.ndarray) -> np.ndarray:
    mosaic = image[..., 1].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = image[::2, ::2, 0], image[1::2, 1::2, 2]
    return mosaic


def test_what_is_no_disc_or_cannot_be_placed_is_told() -> None:
    rng = np.random.default_rng(5)
    centers = centers_of(rng)
    light = light_of(centers[1:], 1.0, lens_first=True)
    mean_e = 500 + 2000 * light
    # The second lamp is far above the sensor's range with all of its light, and the third one an edge.
    x, y = np.rint(centers[1]).astype(int)
    mean_e[y - 6 : y + 7, x - 6 : x + 7] = 1e6
    x, y = np.rint(centers[2]).astype(int)
    mean_e[y - 8 : y + 9, x : x + 9] = 6000
    fits = fit(numbers(mean_e, rng), numbers(mean_e, rng), centers, 1.0, rng)
    assert fits.reasons[0] == "no contrast"
    assert "clipped" in fits.reasons[1]
    assert fits.reasons[2] is not None
    assert fits.reasons[3:COUNT] == (None,) * (COUNT - 3)
