"""Both edges of bright annuli in one fit: the hub around the coupling's mouth, often partly in shadow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.centroids.annulus_model import (
    SLOPE_TURNS,
    all_parameters,
    annulus_model,
    annulus_start,
    azimuth_basis,
    in_free_parameters,
    light_above,
    radial_slopes,
    shares_of,
    tied_to_pose,
)
from nav.centroids.annulus_places import ANNULUS_AMPLITUDE, ANNULUS_BACKGROUND, ANNULUS_INNER, ANNULUS_OUTER
from nav.centroids.annulus_response import response_pictures, starting_with_pictures, with_pictures
from nav.centroids.background_glare import without_glare
from nav.centroids.centroid_quality import NoiseModel, beyond_linear, measure_noise, residual_spread
from nav.centroids.edge_model import FIRST_SMALL_STEP_PX, SECOND_SMALL_STEP_PX
from nav.centroids.edge_profile import START_WIDTH_PX, parameter_shapes
from nav.centroids.ellipses import Ellipses
from nav.centroids.marker_signal import MarkerSignal
from nav.centroids.motion_blur import Travel, moving, share_outside_along
from nav.centroids.patches import PixelSet, annulus_pixels, edge_distances
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum, Model, evaluate, minimise

# Azimuthal order of the light on the annulus; a thin one has too few pixels to tell high orders from its outline.
_ORDER, _ORDER_THIN, _THIN_PX = 4, 2, 2.5
# Light this uneven about the azimuth, as a share of its mean, changes across the annulus too; evenly lit ones, within
# 0.015 of the mean on path-traced daylight frames, are better off without.
_UNEVEN_SHARE = 0.02
# Ribs and sky around the hub are many and small, their light by the azimuth is fitted: more of it is taken than beside
# a marker.
_MOST_BEYOND = 0.8
_FIRST_STEPS, _RESPONSE_STEPS, _SECOND_STEPS = 6, 2, 3
_MOST_LEVERAGE = np.float32(0.9)
_SECTORS = 16
# Both eyes see the same shadow: what it adds does not average out between them; and the light's azimuthal terms hide
# much of it from the residuals (path-traced frames of partly shaded hubs, 1.7 to 5 m).
_SHADOW_FACTOR = 3.0
# Mean square of a sector's summed noise that one even annulus in six exceeds. In little light noise hides most of what
# a shadow leaves in the residuals, and none of what it does to the centre: a higher limit would overlook it.
_EVEN_SECTOR_CHI2 = 1.35
# Share of a pixel's light that comes from the annulus where it lies beside it.
_BESIDE = 0.03
_LEAST_CONTRAST_SIGMA = 4.0
# So much of the annulus must be lit: less does not tell where its middle is.
_LEAST_LIT_FRACTION = 0.5
_LIT_SHARE = 0.3
_MOST_CLIPPED_FRACTION = 0.05
_LARGEST_MOVE_FRACTION = 0.3
_LARGEST_SCALE = 1.25
# Fits that miss the hub state far more, right ones at dusk hardly ever so much (docs/explanation/centroids.md). [px]
_CERTAIN_SIGMA_PX = 0.1


@dataclass(frozen=True, eq=False)
class AnnulusFits:
    """Refined annuli, in the order of the predicted ones.

    Attributes:
        centers_px: (M, 2) centres of the outer edges, the predicted ones where a fit was rejected; the inner ones lie
            the predicted step beside them.
        cov_px2: (M, 2, 2) their covariances.
        contrast_dn: (M,) mean light of the annulus above that beside it. [DN]
        lit_fraction: (M,) share of the azimuth that is lit.
        inflation: (M,) factor in `cov_px2` for residuals that hang together, as shadows leave them.
        reasons: why an annulus was rejected, or None.
    """

    centers_px: Array
    cov_px2: Array
    contrast_dn: Array
    lit_fraction: Array
    inflation: Array
    reasons: tuple[str | None, ...]

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """(M,) which annuli were not rejected."""
        return np.array([reason is None for reason in self.reasons], dtype=np.bool_)

    @property
    def certain(self) -> bool:
        """Whether all annuli were found, and none so vaguely that it may be another thing."""
        return bool(self.accepted.all() and (np.einsum("nii->n", self.cov_px2) < 2 * _CERTAIN_SIGMA_PX**2).all())

    @property
    def evidence_per_px2(self) -> float:
        """How precisely the accepted ones are placed, together. [1/px^2]"""
        accepted = self.accepted
        return float((1 / np.einsum("nii->n", self.cov_px2[accepted])).sum())


def fit_annuli(
    signals: Sequence[MarkerSignal],
    outer: Ellipses,
    inner: Ellipses,
    noise: NoiseModel,
    collar_factor: float = 0.0,
    travel: Travel | None = None,
) -> AnnulusFits:
    """Fit every annulus of both eyes.

    Shapes, and the step between the centres, are those that the pose of the markers predicts, up to the size of each
    edge; of annuli too thin to show each edge by itself, up to a common size. Free shapes would follow shadows.

    Args:
        signals: left and right, around the annuli.
        outer: predicted outer edges, within a third of their radius.
        inner: predicted inner edges, of the same annuli.
        noise: of the frame's pixels, from `fit_discs`; what stands out against it is contrast.
        collar_factor: radius of the dark collar around the annulus over that of its outer edge, 0 where unknown. What
            lies beyond is left out, and its blur fitted.
        travel: how the drogue moves on the images while the shutter is open, None where it stands still.
    """
    if len(outer) == 0:
        nothing = np.zeros(0)
        return AnnulusFits(np.zeros((0, 2)), np.zeros((0, 2, 2)), nothing, nothing, nothing, ())
    width_px = float((outer.radii_px - inner.radii_px).min())
    thin = width_px < _THIN_PX
    ways = None if travel is None else travel.of(outer)
    gathered = annulus_pixels(signals, outer, inner, 0.0 if travel is None else travel.spread_px(outer))
    pixels, beyond = _within_collar(gathered, signals[0], (outer, inner), collar_factor, ways)
    turns = azimuth_basis(pixels, _ORDER_THIN if thin else _ORDER)
    start = annulus_start(pixels, outer, inner, turns.shape[1])
    first = _first_fit(pixels, (turns, beyond), start, thin, ways)
    rough = all_parameters(start, tied_to_pose(start, thin), first)
    if not thin and _unevenness(rough) > _UNEVEN_SHARE:
        turns = np.concatenate([turns, radial_slopes(pixels, turns, outer, inner)], axis=1)
        start = np.pad(rough, ((0, 0), (0, SLOPE_TURNS)))
        first = _first_fit(pixels, (turns, beyond), start, thin, ways)
    ties = tied_to_pose(start, thin)
    model = in_free_parameters(_drawn(pixels, (turns, beyond), ways), start, ties)
    final, weights, edge_factor = _weighted_fit(pixels, turns, (start, ties), model, first, ways is None)
    parameters = all_parameters(start, ties, final)
    between, light = shares_of(final, ties)[0], light_above(parameters, turns)
    contrast = parameters[:, ANNULUS_AMPLITUDE] - parameters[:, ANNULUS_BACKGROUND]
    uneven = _sector_chi2(final, weights, pixels, contrast)
    if edge_factor < 1:
        # What lies beside the annulus drowns what is on it.
        judged = weights * (between > _BESIDE) / np.float32(edge_factor)
        uneven = np.maximum(uneven, _sector_chi2(final, judged, pixels, contrast))
    inflation = 1 + _SHADOW_FACTOR * np.maximum(uneven - _EVEN_SECTOR_CHI2, 0)
    # The first two free parameters are the common shift.
    cov = beyond_linear(final.covariance()[:, :2, :2] * edge_factor * inflation[:, None, None])
    on_it = pixels.present * (between > 0.5)
    reasons, lit = _reasons(pixels, parameters, on_it, light, noise, (outer, inner))
    good = np.array([reason is None for reason in reasons])
    centers = np.where(good[:, None], pixels.origins_px + parameters[:, ANNULUS_OUTER][:, :2], outer.centers_px)
    return AnnulusFits(centers, cov, contrast, lit, inflation, reasons)


def _drawn(pixels: PixelSet, light: tuple[Array32, Array32], ways: Array | None) -> Model:
    still = annulus_model(pixels, *light)
    return still if ways is None else moving(still, ways, (ANNULUS_OUTER.start, ANNULUS_INNER.start))


def _first_fit(
    pixels: PixelSet, light: tuple[Array32, Array32], start: Array, thin: bool, ways: Array | None
) -> Minimum:
    """The fit of equal weights, for the noise by what each pixel sees; `light` is that on the annulus and beyond."""
    ties = tied_to_pose(start, thin)
    model = in_free_parameters(_drawn(pixels, light, ways), start, ties)
    begin = evaluate(model, pixels.values, pixels.present, np.zeros((len(start), ties.shape[2])))
    return minimise(model, pixels.values, pixels.present, begin, _FIRST_STEPS, FIRST_SMALL_STEP_PX)


def _weighted_fit(
    pixels: PixelSet, turns: Array32, shape: tuple[Array, Array], model: Model, first: Minimum, is_still: bool
) -> tuple[Minimum, Array32, float]:
    """The fit of inverse variances, with the pixels' response, the weights, and the factor of `NoiseModel` in them.

    The noise is the annuli's own: what lies around them is lighter than a marker's face, and so noisier.

    Args:
        pixels, turns: of the annuli.
        shape: start and ties, see `all_parameters`.
        model: in the free parameters.
        first: fit of equal weights.
        is_still: whether edges are so sharp that the pixels' response shows.
    """
    parameters, ties = all_parameters(*shape, first), shape[1]
    if is_still:
        pictures = response_pictures(pixels, parameters, shares_of(first, ties), light_above(parameters, turns))
        model = with_pictures(model, pictures)
        begin = starting_with_pictures(first, pictures)
        first = minimise(model, pixels.values, pixels.present, begin, _RESPONSE_STEPS, FIRST_SMALL_STEP_PX)
        parameters = all_parameters(*shape, first)
    between, light = shares_of(first, ties)[0], light_above(parameters, turns)
    leverages = np.minimum(first.leverages(first.covariance(), pixels.present), _MOST_LEVERAGE)
    contrast = parameters[:, ANNULUS_AMPLITUDE] - parameters[:, ANNULUS_BACKGROUND]
    noise = measure_noise(first.residuals**2 / (1 - leverages), pixels.present, between, contrast)
    weights = pixels.present / noise.variances(between, light)
    final = minimise(model, pixels.values, weights, first, _SECOND_STEPS, SECOND_SMALL_STEP_PX)
    return final, weights, noise.edge_factor


def _sector_chi2(fit: Minimum, weights: Array32, pixels: PixelSet, contrast: Array) -> Array:
    return residual_spread(fit.residuals, weights, pixels, _SECTORS, contrast, fit.parameters.shape[1]).sector_chi2


def _unevenness(parameters: Array) -> float:
    """Root mean square of the light's change with the azimuth over its mean, of the less even annulus."""
    turns = parameters[:, ANNULUS_AMPLITUDE:]
    mean = np.maximum(turns[:, 0] - parameters[:, ANNULUS_BACKGROUND], 1.0)  # at least 1 DN
    return float((np.sqrt((turns[:, 1:] ** 2).sum(axis=1) / 2) / mean).max())


def _within_collar(
    pixels: PixelSet, signal: MarkerSignal, edges: tuple[Ellipses, Ellipses], collar_factor: float, ways: Array | None
) -> tuple[PixelSet, Array32]:
    """The pixels without those beyond the collar, and the share of what lies beyond it in each."""
    if collar_factor == 0:
        return pixels, np.zeros_like(pixels.x_px)
    outer, inner = edges

    def beyond(nearer_px: float) -> Array32:
        factor = np.maximum(collar_factor - nearer_px / outer.radii_px, 0.5)[:, None, None]
        return share_outside_along(factor * outer.shapes_px, pixels.x_px, pixels.y_px, START_WIDTH_PX, ways)

    shares = beyond(0.0)
    if not signal.shows_glare:
        return pixels.only(shares < _MOST_BEYOND), shares
    to_outer = edge_distances(outer.shapes_px, pixels.x_px, pixels.y_px)
    # Into the annulus from either edge; the hole is as dark as the collar.
    inwards = np.minimum(to_outer, (outer.radii_px - inner.radii_px).astype(np.float32)[:, None] - to_outer)
    clear = without_glare(pixels, signal, inwards, beyond)
    return pixels.only(shares < _MOST_BEYOND if clear is None else clear), shares


def _reasons(
    pixels: PixelSet,
    parameters: Array,
    on_it: Array32,
    light: Array32,
    noise: NoiseModel,
    predicted: tuple[Ellipses, Ellipses],
) -> tuple[tuple[str | None, ...], Array]:
    """Why each annulus is rejected, the plainest reason first, and the share of it that is lit."""
    count = np.maximum(on_it.sum(axis=1, dtype=np.float64), 1)
    clipped = (on_it * pixels.clipped).sum(axis=1) / count
    brightest = np.where(on_it > 0, light, 0).max(axis=1, keepdims=True)
    lit: Array = (on_it * (light > _LIT_SHARE * brightest)).sum(axis=1) / count
    bad = ~np.isfinite(parameters).all(axis=1)
    for place, edge in zip((ANNULUS_OUTER, ANNULUS_INNER), predicted, strict=True):
        ellipse = parameters[:, place]
        moved = np.hypot(*(ellipse[:, :2] + pixels.origins_px - edge.centers_px).T)
        scale = np.sqrt(np.abs(np.linalg.det(parameter_shapes(ellipse)))) / edge.radii_px
        bad |= moved > 0.5 + _LARGEST_MOVE_FRACTION * edge.radii_px
        bad |= ~((scale > 1 / _LARGEST_SCALE) & (scale < _LARGEST_SCALE))
    contrast = parameters[:, ANNULUS_AMPLITUDE] - parameters[:, ANNULUS_BACKGROUND]
    sigma = np.sqrt(noise.dark_dn2 + noise.per_signal_dn * np.maximum(contrast, 0))
    tests = (
        (pixels.truncated, "cut by the edge of the image"),
        (clipped > _MOST_CLIPPED_FRACTION, "clipped: brighter than the sensor's range"),
        (~(contrast > _LEAST_CONTRAST_SIGMA * sigma), "no contrast"),
        (lit < _LEAST_LIT_FRACTION, "in shadow for the most part"),
        (bad, "the fit left the annulus"),
    )
    reasons = tuple(next((reason for failed, reason in tests if failed[i]), None) for i in range(len(lit)))
    return reasons, lit
