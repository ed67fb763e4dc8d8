"""Reference centroids of discs: an edge model fitted to the light of all markers of both eyes at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.centroids.centroid_quality import (
    SECTORS,
    NoiseModel,
    ResidualSpread,
    edge_noise_factor,
    measure_noise,
    residual_spread,
    sector_index,
)
from nav.centroids.disc_model import BACKGROUND, LEVEL, WIDTH, disc_model, disc_start
from nav.centroids.edge_profile import START_WIDTH_PX, parameter_shapes
from nav.centroids.ellipses import Ellipses, moment_shapes
from nav.centroids.least_squares import Minimum, Model, evaluate, minimise
from nav.centroids.marker_signal import Array32, MarkerSignal
from nav.centroids.patches import WHOLE_RADIUS_PX, PixelSet, coarse_pixels, disc_pixels, edge_distances
from nav.centroids.pixel_response import without_pixel_response
from nav.centroids.single_color import with_even_others
from nav.centroids.surroundings import MOST_BEYOND, Surroundings, shares_beyond

# Shading of a smaller disc can hardly be told from a shift of it: fitting it adds 30 % of noise here, 100 % at 4 px.
_LEAST_RADIUS_FOR_SHADING_PX = 7.5
_FIRST_STEPS, _SECOND_STEPS = 6, 3
# Gauss-Newton's error is the square of its step or so: the first fit, for noise and weights, may end early. [px]
FIRST_SMALL_STEP_PX, SECOND_SMALL_STEP_PX = 0.03, 0.003
# Tuning constant of Cauchy's weights for 95 % efficiency on normal residuals.
_CAUCHY_SIGMA = 2.385
_LEAST_CONTRAST_SIGMA = 4.0
# Share of a pixel's light that comes from within.
_ON_THE_DISC = 0.05
# Of a disc's own pixels; a wholly clipped disc keeps its middle, one clipped in part does not.
_MOST_CLIPPED_FRACTION = 0.05
# Residuals of twice the frame's noise and of more than this share of the contrast are those of another thing.
_LARGEST_CHI2, _ROUGH_SHARE = 4.0, 0.04
# An outline that ends this far from its start, as a share of its radius, is another thing's.
_LARGEST_MOVE_FRACTION = 0.5
_LARGEST_SCALE = 1.6


@dataclass(frozen=True, eq=False)
class DiscFits:
    """Refined discs, in the order of the initial ones.

    Attributes:
        ellipses: fitted outlines; the initial ones where a fit was rejected.
        cov_px2: (M, 2, 2) covariances of the centres.
        contrast_dn, background_dn: (M,) light of the disc above that beside it, and the latter. [DN]
        edge_width_px: (M,) Gaussian width of the edge, pixel's box included.
        chi2_per_dof: (M,) of the residuals against the frame's own noise.
        inflation: (M,) factor in `cov_px2` for residuals that hang together.
        reasons: why a disc was rejected, or None.
        noise: of the frame's pixels, None without any disc.
    """

    ellipses: Ellipses
    cov_px2: Array
    contrast_dn: Array
    background_dn: Array
    edge_width_px: Array
    chi2_per_dof: Array
    inflation: Array
    reasons: tuple[str | None, ...]
    noise: NoiseModel | None

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """(M,) which discs were not rejected."""
        return np.array([reason is None for reason in self.reasons], dtype=np.bool_)


def fit_discs(signals: Sequence[MarkerSignal], discs: Ellipses, around: Surroundings | None = None) -> DiscFits:
    """Fit every disc of both eyes.

    Args:
        signals: left and right, around the discs (`nav.centroids.marker_signal.marker_signals`).
        discs: where they are to half a pixel or so; circles will do.
        around: the face that they lie on, where it is narrow enough for their edges to see beyond.

    Returns:
        Centres with covariances, or reasons. Noise is the frame's own: the residuals of all discs together tell the
        variance beside, on and within the edges, and a disc that fits worse than that is rejected or widened.
    """
    fits = _unfitted(discs)
    shaded = discs.radii_px >= _LEAST_RADIUS_FOR_SHADING_PX
    for index in (np.flatnonzero(~shaded), np.flatnonzero(shaded)):
        if len(index):
            seen = None if around is None else around.take(index)
            fits = _merged(fits, index, _fit_group(signals, discs.take(index), bool(shaded[index[0]]), seen))
    return fits


def _unfitted(discs: Ellipses) -> DiscFits:
    count = len(discs)
    nothing = np.zeros(count)
    return DiscFits(discs, np.zeros((count, 2, 2)), nothing, nothing, nothing, nothing, nothing, (None,) * count, None)


def _merged(fits: DiscFits, index: NDArray[np.int64], part: DiscFits) -> DiscFits:
    """`fits` with those of `index` replaced."""

    def put(old: Array, new: Array) -> Array:
        merged = old.copy()
        merged[index] = new
        return merged

    reasons = list(fits.reasons)
    for place, reason in zip(index, part.reasons, strict=True):
        reasons[place] = reason
    centers = put(fits.ellipses.centers_px, part.ellipses.centers_px)
    shapes = put(fits.ellipses.shapes_px, part.ellipses.shapes_px)
    return DiscFits(
        Ellipses(fits.ellipses.eyes, centers, shapes),
        put(fits.cov_px2, part.cov_px2),
        put(fits.contrast_dn, part.contrast_dn),
        put(fits.background_dn, part.background_dn),
        put(fits.edge_width_px, part.edge_width_px),
        put(fits.chi2_per_dof, part.chi2_per_dof),
        put(fits.inflation, part.inflation),
        tuple(reasons),
        part.noise,
    )


def _fit_group(signals: Sequence[MarkerSignal], discs: Ellipses, shaded: bool, around: Surroundings | None) -> DiscFits:
    """Fit discs that are all modelled alike."""
    plain = not signals[0].is_difference
    start = located(signals, discs)
    pixels = disc_pixels(signals, start)
    further = None if around is None else shares_beyond(around, start, pixels, START_WIDTH_PX)
    if further is not None:
        pixels = pixels.only((further < MOST_BEYOND).all(axis=1))
    model = disc_model(pixels, plain, shaded, further)
    count = 2 * plain + 2 * shaded + (0 if further is None else further.shape[1])
    begin = evaluate(model, pixels.values, pixels.present, disc_start(pixels, start.shapes_px, count))
    first = minimise(model, pixels.values, pixels.present, begin, _FIRST_STEPS, FIRST_SMALL_STEP_PX)
    if around is not None and further is not None and not shaded:
        # The markers' own places now show the face to hundredths of a pixel; around larger discs it is so wide that
        # tenths do.
        found = _fitted(start, pixels, first, (None,) * len(start))
        width_px = float(np.median(first.parameters[:, WIDTH]))
        model = disc_model(pixels, plain, shaded, shares_beyond(around, found, pixels, width_px))
        first = evaluate(model, pixels.values, pixels.present, first.parameters)
    # The derivative by the disc's level is the share of light from within.
    inside = first.jacobian[:, LEVEL]
    if not plain:
        first, beyond_gaussian = without_pixel_response(first, pixels, inside, _contrast(first))
        pixels = replace(pixels, values=pixels.values - beyond_gaussian)
    lead_noise = noise = _noise(first, pixels, inside)
    if shaded and not plain:
        first, pixels = with_even_others(first, pixels, lead_noise, _contrast(first))
        noise = _noise(first, pixels, inside)
    weights = pixels.present / noise.variances(inside, _contrast(first).astype(np.float32)[:, None])
    final = _weighted(model, pixels, first, weights, plain)
    # What a plain picture shows beside a disc says nothing about the disc.
    judged = weights * (final.jacobian[:, LEVEL] > _ON_THE_DISC) if plain else weights
    contrast = _contrast(final)
    sectors = sector_index(pixels.x_px, pixels.y_px, SECTORS)
    spread = residual_spread(final.residuals, judged, sectors, contrast, final.parameters.shape[1])
    factor = edge_noise_factor(final, judged, pixels.x_px, pixels.y_px)
    cov = final.covariance()[:, :2, :2] * factor * spread.inflation[:, None, None]
    reasons = _reasons(discs, pixels, final, inside, cov, noise, spread)
    return DiscFits(
        _fitted(discs, pixels, final, reasons),
        cov,
        contrast,
        final.parameters[:, BACKGROUND],
        final.parameters[:, WIDTH],
        spread.chi2_per_dof,
        spread.inflation,
        reasons,
        lead_noise,
    )


def located(signals: Sequence[MarkerSignal], discs: Ellipses) -> Ellipses:
    """Initial outlines of large discs from second moments, since a circle misses a tilted disc's edge by pixels."""
    if discs.radii_px.max() <= WHOLE_RADIUS_PX:
        return discs
    pixels = coarse_pixels(signals, discs)
    distance = edge_distances(discs.shapes_px, pixels.x_px, pixels.y_px)
    levels = []
    for side in (distance < 0, distance > 0):
        weight = pixels.present * side
        levels.append((weight * pixels.values).sum(axis=1) / np.maximum(weight.sum(axis=1), 1))
    bright = pixels.present * (pixels.values > ((levels[0] + levels[1]) / 2)[:, None])
    places = np.stack([pixels.x_px, pixels.y_px], axis=-1).astype(np.float64)
    total = np.maximum(bright.sum(axis=1), 1)
    center = np.einsum("nk,nki->ni", bright, places) / total[:, None]
    arms = places - center[:, None]
    shapes = moment_shapes(np.einsum("nk,nki,nkj->nij", bright, arms, arms) / total[:, None, None])
    scale = np.sqrt(np.maximum(np.linalg.det(shapes), 0)) / discs.radii_px
    good = (scale > 1 / _LARGEST_SCALE) & (scale < _LARGEST_SCALE)
    centers = np.where(good[:, None], discs.centers_px + center, discs.centers_px)
    return Ellipses(discs.eyes, centers, np.where(good[:, None, None], shapes, discs.shapes_px))


def _contrast(fit: Minimum) -> Array:
    contrast: Array = fit.parameters[:, LEVEL] - fit.parameters[:, BACKGROUND]
    return contrast


def _noise(fit: Minimum, pixels: PixelSet, inside: Array32) -> NoiseModel:
    leverages = np.minimum(fit.leverages(fit.covariance(), pixels.present), np.float32(0.9))
    return measure_noise(fit.residuals**2 / (1 - leverages), pixels.present, inside, _contrast(fit))


def _weighted(model: Model, pixels: PixelSet, first: Minimum, weights: Array32, robust: bool) -> Minimum:
    """Fit with inverse variances; on a plain picture, where a bright sky may enter the window, with Cauchy's loss."""
    if not robust:
        return minimise(model, pixels.values, weights, first, _SECOND_STEPS, SECOND_SMALL_STEP_PX)
    fit = first
    for _ in range(2):
        cautious = weights / (1 + fit.residuals**2 * weights / np.float32(_CAUCHY_SIGMA**2))
        fit = minimise(model, pixels.values, cautious, fit, _SECOND_STEPS, SECOND_SMALL_STEP_PX)
    return fit


def _reasons(
    discs: Ellipses,
    pixels: PixelSet,
    fit: Minimum,
    inside: Array32,
    cov_px2: Array,
    noise: NoiseModel,
    spread: ResidualSpread,
) -> tuple[str | None, ...]:
    """Why each disc is rejected, the plainest reason first."""
    contrast, own = _contrast(fit), pixels.present * (inside > 0.5)
    clipped = (own * pixels.clipped).sum(axis=1) / np.maximum(own.sum(axis=1), 1)
    bright = noise.dark_dn2 + noise.per_signal_dn * np.maximum(contrast, 0)
    moved = np.hypot(*(fit.parameters[:, :2] + pixels.origins_px - discs.centers_px).T)
    scale = np.sqrt(np.abs(np.linalg.det(parameter_shapes(fit.parameters)))) / discs.radii_px
    rough = (spread.chi2_per_dof > _LARGEST_CHI2) & (spread.chi2_per_dof * bright > (_ROUGH_SHARE * contrast) ** 2)
    lost = ~np.isfinite(fit.parameters).all(axis=1) | ~np.isfinite(cov_px2).all(axis=(1, 2))
    astray = (moved > 1 + _LARGEST_MOVE_FRACTION * discs.radii_px) | ~(
        (scale > 1 / _LARGEST_SCALE) & (scale < _LARGEST_SCALE)
    )
    tests = (
        (pixels.truncated, "cut by the edge of the image"),
        (clipped > _MOST_CLIPPED_FRACTION, "clipped: brighter than the sensor's range"),
        (~(contrast > _LEAST_CONTRAST_SIGMA * np.sqrt(bright)), "no contrast"),
        (lost | astray, "the fit left the disc"),
        (spread.uneven | rough, "uneven: cut by a shadow or hidden in part"),
    )
    return tuple(next((reason for failed, reason in tests if failed[i]), None) for i in range(len(discs)))


def _fitted(discs: Ellipses, pixels: PixelSet, fit: Minimum, reasons: tuple[str | None, ...]) -> Ellipses:
    """Fitted outlines of accepted discs, initial ones of the others."""
    good = np.array([reason is None for reason in reasons], dtype=np.bool_)
    centers, shapes = discs.centers_px.copy(), discs.shapes_px.copy()
    centers[good] = (pixels.origins_px + fit.parameters[:, :2])[good]
    shapes[good] = parameter_shapes(fit.parameters[good])
    return Ellipses(discs.eyes, centers, shapes)
