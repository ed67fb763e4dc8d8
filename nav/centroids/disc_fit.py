"""Reference centroids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from geometry.se3 import Array
from nav.centroids.blurred_edges import DISC_BACKGROUND, DISC_LEVEL, DISC_WIDTH, START_WIDTH_PX, parameter_shapes
from nav.centroids.centroid_uncertainty import (
    SECTORS,
    NoiseModel,
    edge_noise_factor,
    measure_noise,
    residual_spread,
    widen_for_nonlinearity,
)
from nav.centroids.discs import (
    DiscFits,
    contrasts,
    disc_model,
    initial_disc_parameters,
    initialize_from_moments,
    merged,
    rejection_reasons,
    unfitted_discs,
)
from nav.centroids.ellipses import Ellipses
from nav.centroids.face_background import FaceBackground, background_shares, pixels_on_face, visible_margin_px
from nav.centroids.marker_signal import MarkerSignal
from nav.centroids.motion_blur import ImageMotion, detect_motion, fit_motion, motion_blurred
from nav.centroids.outline_pixels import OutlinePixels, disc_pixels
from nav.centroids.pixel_response import correct_pixel_response
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum, Model, evaluate, minimise

_KEPT_BYTES = 16 * 2**20


@cache
def keep_freed_memory() -> None:
    """Let the C library keep freed memory for the next array, from the first call on.

    GNU's hands the end of its heap back to the system after each larger array, and the system maps and clears the same
    pages anew for the next one, which took a fifth to a third of the time of a fit. It keeps up to twice the largest
    block that was ever freed: one that nobody writes to costs nothing. Other libraries are left as they are.
    """
    np.empty(_KEPT_BYTES, np.uint8)


# Square of a centre's move over its variance, of two coordinates: even light exceeds it once in a hundred discs.
_MOST_MOVED = 9.2
# The others' variance beside a marker is at most that of their difference from the colour, of which it is a part; and
# where that is above this share of the variance on the marker, it is more than noise.
_MOST_DARK_SHARE = 0.6


def restore_even_colors(
    fit: Minimum, pixels: OutlinePixels, noise: NoiseModel, contrast: Array
) -> tuple[Minimum, OutlinePixels]:
    """Put back what the difference of colours took off, where that was nothing but noise.

    The difference keeps sky and shadows out, at the price of the other colours' noise. Near by, a disc's window holds
    little but paint and dark face, both even in the other colours; whether they are, the others themselves tell: they
    must not move the centre by more than their own noise does. Overlooked unevenness so moves it by less than what
    leaving the noise in would.

    Args:
        fit: to the difference.
        pixels: of it.
        noise: of it.
        contrast: (N,) light of the discs above that beside them. [DN]

    Returns:
        The fit after one linear step, and the pixels, where the others are even those of the one colour.
    """
    bright_dn2 = noise.dark_dn2 + noise.per_signal_dn * np.median(contrast)
    if pixels.others is None or noise.dark_dn2 > _MOST_DARK_SHARE * bright_dn2:
        return fit, pixels
    weights = pixels.present
    shift = replace(fit, parameters=np.zeros_like(fit.parameters)).given(pixels.others, weights)
    freedom = np.maximum(weights.sum(axis=1) - fit.parameters.shape[1], 1)
    variance = (shift.residuals**2 * weights).sum(axis=1) / freedom
    unit_cov = fit.covariance()[:, :2, :2]
    moved: Array = np.einsum("ni,nij,nj->n", shift.parameters[:, :2], np.linalg.inv(unit_cov), shift.parameters[:, :2])
    even = (moved < _MOST_MOVED * variance) & (variance < noise.dark_dn2)
    back = pixels.others * even[:, None]
    return fit.given(fit.residuals + back, weights), replace(pixels, values=pixels.values + back)


# Shading of a smaller disc can hardly be told from a shift of it: fitting it adds 30 % of noise here, 100 % at 4 px.
_LEAST_RADIUS_FOR_SHADING_PX = 7.5
# Beside dim markers a slope of the face's light moves all centres alike by thousandths of a pixel. To fit it costs 7 to
# 10 % of noise for larger discs, more for smaller ones, whose windows the light from beyond the face reaches too.
_LEAST_RADIUS_FOR_SLOPE_BESIDE_PX = 27.0
_FIRST_STEPS, _SECOND_STEPS = 6, 3
# Gauss-Newton's error is the square of its step or so: the first fit, for noise and weights, may end early. [px]
FIRST_SMALL_STEP_PX, SECOND_SMALL_STEP_PX = 0.03, 0.003
# Tuning constant of Cauchy's weights for 95 % efficiency on normal residuals.
_CAUCHY_SIGMA = 2.385
# Share of a pixel's light that comes from within.
_ON_THE_DISC = 0.05


def fit_discs(signals: Sequence[MarkerSignal], discs: Ellipses, around: FaceBackground | None = None) -> DiscFits:
    """Fit every disc of both eyes.

    Args:
        signals: left and right, around the discs (`nav.centroids.marker_signal.marker_signals`).
        discs: where they are to half a pixel or so; circles will do.
        around: the face that they lie on, where it is narrow enough for their edges to see beyond.

    Returns:
        Centres with covariances, or reasons. Noise is the frame's own: the residuals of all discs together tell the
        variance beside, on and within the edges, and a disc that fits worse than that is rejected or widened.
    """
    keep_freed_memory()
    shaded = discs.radii_px >= _LEAST_RADIUS_FOR_SHADING_PX
    if len(discs) and shaded.all() == shaded.any():
        return _fit_group(signals, discs, bool(shaded[0]), around)
    fits = unfitted_discs(discs)
    for index in (np.flatnonzero(~shaded), np.flatnonzero(shaded)):
        if len(index):
            seen = None if around is None else around.take(index)
            fits = merged(fits, index, _fit_group(signals, discs.take(index), bool(shaded[index[0]]), seen))
    return fits


def _fit_group(
    signals: Sequence[MarkerSignal], discs: Ellipses, shaded: bool, around: FaceBackground | None
) -> DiscFits:
    """Fit discs that are all modelled alike."""
    plain = not signals[0].is_difference
    start = initialize_from_moments(signals, discs)
    pixels, model, first = _first_fit(signals, start, shaded, around, None)
    travel = None if plain else detect_motion(first, pixels, start)
    if travel is not None:
        # What the first fit made of moving discs may lie pixels beside them: all begins anew.
        moved, still, fit = _first_fit(signals, start, shaded, around, travel)
        travel = fit_motion(still, moved, fit.parameters, travel, start)
    if travel is not None:
        pixels, still, first = _first_fit(signals, start, shaded, around, travel)
        model = motion_blurred(still, travel.of(start), (0,))
    # The derivative by the disc's level is the share of light from within.
    inside = np.ascontiguousarray(first.jacobian[:, DISC_LEVEL])
    if not plain and travel is None:
        first, beyond_gaussian = correct_pixel_response(first, pixels, inside, contrasts(first))
        pixels = replace(pixels, values=pixels.values - beyond_gaussian)
    # What the linear steps so far change are places and residuals, not leverages.
    leverages = np.minimum(first.leverages(first.covariance(), pixels.present), np.float32(0.9))
    lead_noise = noise = _noise(first, leverages, pixels, inside)
    if shaded and not plain:
        first, pixels = restore_even_colors(first, pixels, lead_noise, contrasts(first))
        noise = _noise(first, leverages, pixels, inside)
    weights = pixels.present / noise.variances(inside, contrasts(first).astype(np.float32)[:, None])
    final = _weighted(model, pixels, first, weights, plain)
    # What a plain picture shows beside a disc says nothing about the disc.
    judged = weights * (final.jacobian[:, DISC_LEVEL] > _ON_THE_DISC) if plain else weights
    contrast = contrasts(final)
    spread = residual_spread(final.residuals, judged, pixels, SECTORS, contrast, final.parameters.shape[1])
    factor = edge_noise_factor(final, judged, pixels.x_px, pixels.y_px)
    cov = widen_for_nonlinearity(final.covariance()[:, :2, :2] * factor * spread.inflation[:, None, None])
    reasons = rejection_reasons(discs, pixels, final, inside, cov, noise, spread)
    return DiscFits(
        _fitted(discs, pixels, final, reasons),
        cov,
        contrast,
        final.parameters[:, DISC_BACKGROUND],
        final.parameters[:, DISC_WIDTH],
        spread.chi2_per_dof,
        spread.inflation,
        reasons,
        lead_noise,
        travel,
    )


def _first_fit(
    signals: Sequence[MarkerSignal],
    start: Ellipses,
    shaded: bool,
    around: FaceBackground | None,
    travel: ImageMotion | None,
) -> tuple[OutlinePixels, Model, Minimum]:
    """The pixels of discs, the model of still ones, and the fit of equal weights, of moving ones where they move."""
    plain, ways = not signals[0].is_difference, None if travel is None else travel.of(start)
    spread_px = 0.0 if travel is None else travel.spread_px(start)
    pixels, further = disc_pixels(signals, start, blur_px=spread_px), None
    if around is not None and around.margin_px <= visible_margin_px(signals[0]) + spread_px:
        further = background_shares(around, start, pixels, START_WIDTH_PX, ways)
        if further is not None:
            pixels = pixels_on_face(around, start, pixels, further, ways, signals[0])
    sloped = plain or (shaded and bool(start.radii_px.min() >= _LEAST_RADIUS_FOR_SLOPE_BESIDE_PX))
    still = disc_model(pixels, sloped, shaded, further)
    model = still if ways is None else motion_blurred(still, ways, (0,))
    count = 2 * sloped + 2 * shaded + (0 if further is None else further.shape[1])
    begin = evaluate(model, pixels.values, pixels.present, initial_disc_parameters(pixels, start.shapes_px, count))
    first = minimise(model, pixels.values, pixels.present, begin, _FIRST_STEPS, FIRST_SMALL_STEP_PX)
    if around is None or further is None or shaded:
        return pixels, still, first
    # The markers' own places now show the face to hundredths of a pixel; around larger discs it is so wide that tenths
    # do.
    found = _fitted(start, pixels, first, (None,) * len(start))
    width_px = float(np.median(first.parameters[:, DISC_WIDTH]))
    still = disc_model(pixels, sloped, shaded, background_shares(around, found, pixels, width_px, ways))
    model = still if ways is None else motion_blurred(still, ways, (0,))
    return pixels, still, evaluate(model, pixels.values, pixels.present, first.parameters)


def _noise(fit: Minimum, leverages: Array32, pixels: OutlinePixels, inside: Array32) -> NoiseModel:
    return measure_noise(fit.residuals**2 / (1 - leverages), pixels.present, inside, contrasts(fit))


def _weighted(model: Model, pixels: OutlinePixels, first: Minimum, weights: Array32, robust: bool) -> Minimum:
    """Fit with inverse variances; on a plain picture, where a bright sky may enter the window, with Cauchy's loss."""
    if not robust:
        return minimise(model, pixels.values, weights, first, _SECOND_STEPS, SECOND_SMALL_STEP_PX)
    fit = first
    for _ in range(2):
        cautious = weights / (1 + fit.residuals**2 * weights / np.float32(_CAUCHY_SIGMA**2))
        fit = minimise(model, pixels.values, cautious, fit, _SECOND_STEPS, SECOND_SMALL_STEP_PX)
    return fit


def _fitted(discs: Ellipses, pixels: OutlinePixels, fit: Minimum, reasons: tuple[str | None, ...]) -> Ellipses:
    """Fitted outlines of accepted discs, initial ones of the others."""
    good = np.array([reason is None for reason in reasons], dtype=np.bool_)
    centers, shapes = discs.centers_px.copy(), discs.shapes_px.copy()
    centers[good] = (pixels.origins_px + fit.parameters[:, :2])[good]
    shapes[good] = parameter_shapes(fit.parameters[good])
    return Ellipses(discs.eyes, centers, shapes)
