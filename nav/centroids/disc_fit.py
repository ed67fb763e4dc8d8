"""Centres of discs by least squares: an edge model is fitted to the light of all markers of both eyes at once.

The discs share one noise model, which comes from their own residuals, one shape of the pixels' response, and the motion
of the image while the shutter is open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

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
    are_clipped,
    contrasts,
    disc_model,
    initial_disc_parameters,
    initialize_from_moments,
    rejection_reasons,
    unfitted_discs,
    with_part,
)
from nav.centroids.ellipses import Ellipses, are_positive
from nav.centroids.face_background import FaceBackground, background_shares, pixels_on_face, visible_margin_px
from nav.centroids.marker_signal import MarkerSignal
from nav.centroids.motion_blur import ImageMotion, detect_motion, fit_motion, motion_blurred
from nav.centroids.outline_pixels import OutlinePixels, disc_pixels
from nav.centroids.pixel_response import correct_pixel_response
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum, Model, evaluate, minimise
from nav.numerics.medians import median

# Shading of a smaller disc can hardly be told from a shift of it: fitting it adds 30 % of noise here, 100 % at 4 px.
_LEAST_RADIUS_FOR_SHADING_PX = 7.5
# Beside dim markers a slope of the face's light moves all centres alike by thousandths of a pixel. Fitting it adds 7 to
# 10 % of noise for larger discs, more for smaller ones, whose windows light from beyond the face reaches too.
_LEAST_RADIUS_FOR_FACE_SLOPE_PX = 27.0
_FIRST_STEPS, _SECOND_STEPS = 6, 3
# Gauss-Newton's error is about the square of its step: the first fit, for noise and weights, may end early. [px]
FIRST_SMALL_STEP_PX, SECOND_SMALL_STEP_PX = 0.03, 0.003
# Tuning constant of Cauchy's weights for 95 % efficiency on normal residuals.
_CAUCHY_SIGMA = 2.385
# Share of a pixel's light that comes from within the disc.
_ON_THE_DISC = 0.05
_LARGEST_LEVERAGE = np.float32(0.9)
# Of a disc's light: where all pixels with more of it are clipped, the disc has no edge.
_LEAST_SEEN = np.float32(1e-3)
# Squared shift of a centre over its variance, chi-square of two: even light exceeds it once in a hundred discs.
_LARGEST_SHIFT_CHI2 = 9.2
# The other colours' variance beside a marker is part of the difference's, so at most as large; where the difference's
# is above this share of the variance on the marker, it is more than noise.
_MOST_DARK_SHARE = 0.6
# A block of this size makes the C library keep freed memory.
_KEPT_BYTES = 16 * 2**20


@dataclass(frozen=True, eq=False)
class _GroupFit:
    """A fit of discs that are all modelled alike.

    Attributes:
        pixels: of the discs.
        model: their picture, with the motion of the image where there is any.
        minimum: where the iteration ended.
        motion: of the image while the shutter is open, None where it stands still.
    """

    pixels: OutlinePixels
    model: Model
    minimum: Minimum
    motion: ImageMotion | None


def fit_discs(signals: Sequence[MarkerSignal], discs: Ellipses, face: FaceBackground | None = None) -> DiscFits:
    """Fit every disc of both eyes.

    Args:
        signals: left and right, around the discs (`nav.centroids.marker_signal.marker_signals`).
        discs: initial outlines, right to about half a pixel; circles will do.
        face: the face that they lie on; None where it is wide enough that no disc's window reaches beyond it.

    Returns:
        Centres with covariances, or reasons. The noise comes from the frame itself: the residuals of all discs together
        give the variance beside, on and within the edges. A disc that fits worse is rejected, or its covariance grows.
    """
    keep_freed_memory()
    shaded = discs.radii_px >= _LEAST_RADIUS_FOR_SHADING_PX
    if len(discs) and shaded.all() == shaded.any():
        return _fit_group(signals, discs, bool(shaded[0]), face)
    fits = unfitted_discs(discs)
    for index in (np.flatnonzero(~shaded), np.flatnonzero(shaded)):
        if len(index):
            part = None if face is None else face.take(index)
            fits = with_part(fits, index, _fit_group(signals, discs.take(index), bool(shaded[index[0]]), part))
    return fits


def _fit_group(signals: Sequence[MarkerSignal], discs: Ellipses, shaded: bool, face: FaceBackground | None) -> DiscFits:
    """Fit discs that are all modelled alike."""
    is_difference = signals[0].is_difference
    first = _fit_equal_weights(signals, initialize_from_moments(signals, discs), shaded, face)
    # The derivative by the disc's level is the share of light from within.
    inside = np.ascontiguousarray(first.minimum.jacobian[:, DISC_LEVEL])
    if is_difference and first.motion is None:
        first = _correct_response(first, inside)
    # The linear steps so far change parameters and residuals, but not leverages.
    minimum, present = first.minimum, first.pixels.present
    leverages = np.minimum(minimum.leverages(minimum.covariance(), present), _LARGEST_LEVERAGE)
    # Of a clipped disc only light up to the sensor's range is seen.
    seen = np.where(
        are_clipped(discs, first.pixels), (inside * first.pixels.present).max(axis=1, initial=0), np.float32(1)
    )
    seen = np.maximum(seen, _LEAST_SEEN)
    inside /= seen[:, None]
    difference_noise = noise = _noise(minimum, leverages, first.pixels, inside, seen)
    if shaded and is_difference:
        minimum, pixels = restore_even_colors(minimum, first.pixels, noise, seen * contrasts(minimum))
        first = replace(first, minimum=minimum, pixels=pixels)
        noise = _noise(minimum, leverages, pixels, inside, seen)
    weights = first.pixels.present / noise.variances(inside, (seen * contrasts(minimum)).astype(np.float32)[:, None])
    final = _fit_weighted(first, weights, robust=not is_difference)
    return _judged(discs, final, weights, seen, (noise, difference_noise), is_difference)


def _fit_equal_weights(
    signals: Sequence[MarkerSignal], start: Ellipses, shaded: bool, face: FaceBackground | None
) -> _GroupFit:
    """Fit discs with equal weights for all pixels, and the motion of the image where the residuals show one."""
    pixels, still, minimum = _fit_given_motion(signals, start, shaded, face, None)
    motion = detect_motion(minimum, pixels, start) if signals[0].is_difference else None
    if motion is not None:
        # The fit of still discs may end pixels beside moving ones: the fit starts again.
        moved_pixels, moved_still, moved = _fit_given_motion(signals, start, shaded, face, motion)
        motion = fit_motion(moved_still, moved_pixels, moved.parameters, motion, start)
    if motion is None:
        return _GroupFit(pixels=pixels, model=still, minimum=minimum, motion=None)
    pixels, still, minimum = _fit_given_motion(signals, start, shaded, face, motion)
    model = motion_blurred(still, motion.of(start), (0,))
    return _GroupFit(pixels=pixels, model=model, minimum=minimum, motion=motion)


def _fit_given_motion(
    signals: Sequence[MarkerSignal],
    start: Ellipses,
    shaded: bool,
    face: FaceBackground | None,
    motion: ImageMotion | None,
) -> tuple[OutlinePixels, Model, Minimum]:
    """Fit discs with equal weights and a known motion.

    Returns:
        The pixels of the discs, the model of still discs, and the fit of the moving ones.
    """
    is_difference, motions = signals[0].is_difference, None if motion is None else motion.of(start)
    spread_px = 0.0 if motion is None else motion.spread_px(start)
    pixels, beyond = disc_pixels(signals, start, blur_px=spread_px), None
    if face is not None and face.margin_px <= visible_margin_px(signals[0]) + spread_px:
        beyond = background_shares(face, start, pixels, START_WIDTH_PX, motions)
        if beyond is not None:
            pixels = pixels_on_face(face, start, pixels, beyond, motions, signals[0])
    sloped = not is_difference or (shaded and bool(start.radii_px.min() >= _LEAST_RADIUS_FOR_FACE_SLOPE_PX))
    is_clipped = are_clipped(start, pixels)
    still = disc_model(pixels, sloped, shaded, beyond, is_clipped)
    model = still if motions is None else motion_blurred(still, motions, (0,))
    count = 2 * sloped + 2 * shaded + (0 if beyond is None else beyond.shape[1])
    first = initial_disc_parameters(pixels, start.shapes_px, count)
    # Clipped pixels only say that the light is at least theirs: what is left shows where the edge is.
    pixels = pixels.only(~pixels.clipped)
    begin = evaluate(model, pixels.values, pixels.present, first)
    if is_clipped.any():
        begin = _with_unclipped_level(model, pixels, begin, is_clipped)
    minimum = minimise(model, pixels.values, pixels.present, begin, _FIRST_STEPS, FIRST_SMALL_STEP_PX)
    if face is None or beyond is None or shaded:
        return pixels, still, minimum
    # The fitted places of the markers now show the face to hundredths of a pixel. Around larger discs the face is so
    # wide that tenths are enough.
    lost = ~np.isfinite(minimum.parameters).all(axis=1) | ~are_positive(parameter_shapes(minimum.parameters))
    found = _fitted_ellipses(start, pixels, minimum, tuple("the fit left the disc" if each else None for each in lost))
    width_px = median(minimum.parameters[:, DISC_WIDTH])
    shares = background_shares(face, found, pixels, width_px, motions)
    still = disc_model(pixels, sloped, shaded, shares, is_clipped)
    model = still if motions is None else motion_blurred(still, motions, (0,))
    return pixels, still, evaluate(model, pixels.values, pixels.present, minimum.parameters)


def _with_unclipped_level(model: Model, pixels: OutlinePixels, begin: Minimum, chosen: NDArray[np.bool_]) -> Minimum:
    """A start whose chosen discs have the level that fits their unclipped pixels best.

    It may be many times the sensor's range. A fit that had to find it along with the outline would end on the way.
    """
    parameters, inside = begin.parameters.copy(), begin.jacobian[:, DISC_LEVEL]
    beside = pixels.values - parameters[:, DISC_BACKGROUND, None].astype(np.float32) * (1 - inside)
    weighted = pixels.present * inside
    level = (weighted * beside).sum(axis=1) / np.maximum((weighted * inside).sum(axis=1), np.finfo(np.float32).tiny)
    parameters[chosen, DISC_LEVEL] = np.maximum(level, parameters[:, DISC_LEVEL])[chosen]
    return evaluate(model, pixels.values, pixels.present, parameters)


def _correct_response(group: _GroupFit, inside: Array32) -> _GroupFit:
    """Correct a fit, and its pixels, for the shape of edges that the pixels' response gives."""
    minimum, response = correct_pixel_response(group.minimum, group.pixels, inside, contrasts(group.minimum))
    return replace(group, minimum=minimum, pixels=replace(group.pixels, values=group.pixels.values - response))


def _noise(fit: Minimum, leverages: Array32, pixels: OutlinePixels, inside: Array32, seen: Array32) -> NoiseModel:
    return measure_noise(fit.residuals**2 / (1 - leverages), pixels.present, inside, seen * contrasts(fit))


def _fit_weighted(group: _GroupFit, weights: Array32, robust: bool) -> _GroupFit:
    """Fit with inverse variances, and with Cauchy's loss for plain pictures, whose windows a bright sky may enter."""
    model, values, minimum = group.model, group.pixels.values, group.minimum
    if not robust:
        final = minimise(model, values, weights, minimum, _SECOND_STEPS, SECOND_SMALL_STEP_PX)
        return replace(group, minimum=final)
    for _ in range(2):
        cautious = weights / (1 + minimum.residuals**2 * weights / np.float32(_CAUCHY_SIGMA**2))
        minimum = minimise(model, values, cautious, minimum, _SECOND_STEPS, SECOND_SMALL_STEP_PX)
    return replace(group, minimum=minimum)


def _judged(
    discs: Ellipses,
    final: _GroupFit,
    weights: Array32,
    seen: Array32,
    noises: tuple[NoiseModel, NoiseModel],
    is_difference: bool,
) -> DiscFits:
    """The fitted discs with their covariances and the reasons for rejection.

    Args:
        discs: initial outlines.
        final: the weighted fit.
        weights: (N, K) inverse variances.
        seen: (N,) the brightest light of a disc that is not clipped, as a share of its light.
        noises: of the fitted pixels, and of the difference of colours.
        is_difference: whether the signal is a difference of colours.
    """
    pixels, minimum = final.pixels, final.minimum
    # What a plain picture shows beside a disc says nothing about the disc.
    own = minimum.jacobian[:, DISC_LEVEL] > _ON_THE_DISC * seen[:, None]
    judged = weights if is_difference else weights * own
    contrast = seen * contrasts(minimum)
    spread = residual_spread(minimum.residuals, judged, pixels, SECTORS, contrast, minimum.parameters.shape[1])
    factor = edge_noise_factor(minimum, judged, pixels.x_px, pixels.y_px)
    cov = widen_for_nonlinearity(minimum.covariance()[:, :2, :2] * factor * spread.inflation[:, None, None])
    reasons = rejection_reasons(discs, pixels, minimum, cov, noises[0], spread)
    return DiscFits(
        ellipses=_fitted_ellipses(discs, pixels, minimum, reasons),
        cov_px2=cov,
        contrast_dn=contrasts(minimum),
        background_dn=minimum.parameters[:, DISC_BACKGROUND],
        edge_width_px=minimum.parameters[:, DISC_WIDTH],
        chi2_per_dof=spread.chi2_per_dof,
        inflation=spread.inflation,
        reasons=reasons,
        noise=noises[1],
        motion=final.motion,
    )


def _fitted_ellipses(discs: Ellipses, pixels: OutlinePixels, fit: Minimum, reasons: tuple[str | None, ...]) -> Ellipses:
    """Fitted outlines of accepted discs, initial outlines of rejected ones."""
    good = np.array([reason is None for reason in reasons], dtype=np.bool_)
    centers, shapes = discs.centers_px.copy(), discs.shapes_px.copy()
    centers[good] = (pixels.origins_px + fit.parameters[:, :2])[good]
    shapes[good] = parameter_shapes(fit.parameters[good])
    return Ellipses(discs.eyes, centers, shapes)


def restore_even_colors(
    fit: Minimum, pixels: OutlinePixels, noise: NoiseModel, contrast: Array
) -> tuple[Minimum, OutlinePixels]:
    """Add the other colours back to a difference of colours where they held nothing but noise.

    The difference removes sky and shadows but adds the other colours' noise. At close range a disc's window shows
    little but paint and dark face, and both are even in the other colours. The other colours are tested for that: they
    must not move the centre by more than their own noise does. Unevenness that passes the test moves the centre by
    less than the noise would.

    Args:
        fit: to the difference.
        pixels: of the difference.
        noise: of the difference.
        contrast: (N,) light of the discs above that beside them. [DN]

    Returns:
        The fit after one linear step, and the pixels; of discs whose other colours are even, both are those of the
        markers' colour alone.
    """
    bright_dn2 = noise.dark_dn2 + noise.per_signal_dn * median(contrast)
    if pixels.others is None or noise.dark_dn2 > _MOST_DARK_SHARE * bright_dn2:
        return fit, pixels
    weights = pixels.present
    shift = replace(fit, parameters=np.zeros_like(fit.parameters)).after_linear_step(pixels.others, weights)
    freedom = np.maximum(weights.sum(axis=1) - fit.parameters.shape[1], 1)
    variance = (shift.residuals**2 * weights).sum(axis=1) / freedom
    unit_cov = fit.covariance()[:, :2, :2]
    moved: Array = np.einsum("ni,nij,nj->n", shift.parameters[:, :2], np.linalg.inv(unit_cov), shift.parameters[:, :2])
    even = (moved < _LARGEST_SHIFT_CHI2 * variance) & (variance < noise.dark_dn2)
    back = pixels.others * even[:, None]
    return fit.after_linear_step(fit.residuals + back, weights), replace(pixels, values=pixels.values + back)


@cache
def keep_freed_memory() -> None:
    """Make the C library keep freed memory for the next array, from the first call on.

    The GNU C library returns the end of its heap to the system after each larger array, and the system maps and clears
    the same pages again for the next one, which took a fifth to a third of the time of a fit. It keeps up to twice the
    largest block that was ever freed, and a block that is never written to costs nothing. Other C libraries are not
    affected.
    """
    np.empty(_KEPT_BYTES, np.uint8)
