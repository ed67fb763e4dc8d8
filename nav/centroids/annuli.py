"""Both edges of bright annuli in one fit: the hub around the coupling's mouth, often partly in shadow.

The model is two blurred edges with light between them that varies with the azimuth. The shapes of the edges, and the
step between their centres, follow the pose that the markers give.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.centroids.blurred_edges import (
    ANNULUS_AMPLITUDE,
    ANNULUS_BACKGROUND,
    ANNULUS_CENTERS,
    ANNULUS_HOLE,
    ANNULUS_INNER,
    ANNULUS_OUTER,
    ANNULUS_WIDTH,
    START_WIDTH_PX,
    add_box_responses,
    draw_annuli,
    edge_widths,
    ellipse_parameters,
    parameter_shapes,
)
from nav.centroids.centroid_uncertainty import NoiseModel, measure_noise, residual_spread, widen_for_nonlinearity
from nav.centroids.disc_fit import FIRST_SMALL_STEP_PX, SECOND_SMALL_STEP_PX
from nav.centroids.ellipses import Ellipses
from nav.centroids.face_background import pixels_without_glare
from nav.centroids.marker_signal import MarkerSignal
from nav.centroids.motion_blur import ImageMotion, blurred_share_outside, motion_blurred
from nav.centroids.outline_pixels import OutlinePixels, annulus_pixels, edge_distances
from nav.centroids.pixel_response import RESPONSE_BOXES
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum, Model, NormalEquations, constrain_jacobian, evaluate, minimise

SLOPE_HARMONICS = 5


def annulus_model(pixels: OutlinePixels, harmonics: Array32, beyond: Array32) -> Model:
    """Intensity of an annulus, `I = b (1 - So) + A(azimuth) (So - Si) + b' Si + k(azimuth) F`.

    Args:
        pixels: at which the model is evaluated.
        harmonics: (N, T, K) functions of the azimuth whose weighted sum is A.
        beyond: (N, K) share F of light from beyond the annulus's surroundings, brighter than those by k.
    """
    x, y = pixels.x_px, pixels.y_px
    count = ANNULUS_AMPLITUDE + harmonics.shape[1]

    def model(parameters: Array) -> tuple[Array32, Array32]:
        picture, jacobian = np.empty_like(x), np.empty((len(x), count, x.shape[1]), np.float32)
        given, widths = parameters.astype(np.float32), edge_widths(parameters[:, ANNULUS_WIDTH])
        draw_annuli(given, widths, x, y, harmonics, beyond, picture, jacobian)
        return picture, jacobian

    return model


def area_shares(fit: Minimum, ties: Array) -> tuple[Array32, Array32]:
    """(N, K) share of each pixel that lies on the annulus, and share in the hole.

    They are the derivatives by the mean level of the annulus and by the level of the hole, both free parameters.
    """
    tied = ties.shape[2] - (ties.shape[1] - ANNULUS_WIDTH)
    between, in_hole = (fit.jacobian[:, tied + place - ANNULUS_WIDTH] for place in (ANNULUS_AMPLITUDE, ANNULUS_HOLE))
    return np.ascontiguousarray(between), np.ascontiguousarray(in_hole)


def light_above_background(parameters: Array, harmonics: Array32) -> Array32:
    """(N, K) level of the annulus above the background. [DN]"""
    rest = parameters[:, ANNULUS_BACKGROUND:].astype(np.float32)
    light: Array32 = np.matmul(rest[:, None, ANNULUS_AMPLITUDE - ANNULUS_BACKGROUND :], harmonics)[:, 0]
    return light - rest[:, 0, None]


def azimuth_harmonics(pixels: OutlinePixels, order: int) -> Array32:
    """(N, 2 order + 1, K) harmonics: one, then cosines and sines of multiples of the azimuth."""
    angle = np.arctan2(pixels.y_px, pixels.x_px)
    rows = [np.ones_like(angle)]
    for multiple in range(1, order + 1):
        rows += [np.cos(multiple * angle), np.sin(multiple * angle)]
    return np.stack(rows, axis=1)


def radial_slopes(pixels: OutlinePixels, harmonics: Array32, outer: Ellipses, inner: Ellipses) -> Array32:
    """(N, 5, K) the first two orders of the azimuth times the radial distance from the annulus's middle.

    Without them a slope of light across the annulus, steeper at the outer edge than at the inner one, moves both edges.
    """
    middle = ((outer.radii_px + inner.radii_px) / 2).astype(np.float32)[:, None]
    outwards = np.hypot(pixels.x_px, pixels.y_px) / middle - 1
    slopes: Array32 = outwards[:, None] * harmonics[:, :SLOPE_HARMONICS]
    return slopes


def initial_annulus_parameters(pixels: OutlinePixels, outer: Ellipses, inner: Ellipses, harmonic_count: int) -> Array:
    """(N, P) parameters of the predicted edges with the mean levels outside, on and within the annulus."""
    parameters = np.zeros((len(outer), ANNULUS_AMPLITUDE + harmonic_count))
    shift = inner.centers_px - outer.centers_px
    parameters[:, ANNULUS_OUTER] = ellipse_parameters(np.zeros((len(outer), 2)), outer.shapes_px)
    parameters[:, ANNULUS_INNER] = ellipse_parameters(shift, inner.shapes_px)
    parameters[:, ANNULUS_WIDTH] = START_WIDTH_PX
    to_outer = edge_distances(outer.shapes_px, pixels.x_px, pixels.y_px)
    x, y = (pixels.x_px - shift[:, :1], pixels.y_px - shift[:, 1:])
    to_inner = edge_distances(inner.shapes_px, x.astype(np.float32), y.astype(np.float32))
    sides = (
        (ANNULUS_BACKGROUND, to_outer < -1),
        (ANNULUS_HOLE, to_inner > 1),
        (ANNULUS_AMPLITUDE, (to_outer > 0) & (to_inner < 0)),
    )
    for column, side in sides:
        weight = pixels.present * side
        parameters[:, column] = (weight * pixels.values).sum(axis=1) / np.maximum(weight.sum(axis=1), 1)
    return parameters


def pose_constraints(start: Array, thin: bool) -> Array:
    """(N, P, Q) derivatives of the model's parameters by the free ones.

    Free are a common shift of both edges and the size of each edge, of thin annuli one common size; shapes are fixed.
    """
    count = start.shape[1]
    moved = np.zeros((len(start), count, 3 if thin else 4))
    moved[:, ANNULUS_CENTERS, [0, 1, 0, 1]] = 1
    for place, edge in enumerate((ANNULUS_OUTER, ANNULUS_INNER)):
        moved[:, edge.start + 2 : edge.stop, 2 if thin else 2 + place] = start[:, edge.start + 2 : edge.stop]
    rest = np.broadcast_to(np.eye(count)[:, ANNULUS_WIDTH:], (len(start), count, count - ANNULUS_WIDTH))
    return np.concatenate([moved, rest], axis=2)


def constrained_model(model: Model, start: Array, ties: Array) -> Model:
    """The model as a function of its free parameters, which are zero at the start."""
    # Both ellipses depend on the first few free parameters; all further parameters are free themselves.
    tied = ties.shape[2] - (ties.shape[1] - ANNULUS_WIDTH)
    across = np.ascontiguousarray(ties[:, :ANNULUS_WIDTH, :tied].transpose(0, 2, 1), np.float32)

    def in_free(free: Array) -> tuple[Array32, Array32]:
        values, jacobian = model(start + np.einsum("npq,nq->np", ties, free))
        by_free = np.empty((len(jacobian), ties.shape[2], jacobian.shape[2]), np.float32)
        constrain_jacobian(jacobian, across, by_free)
        return values, by_free

    return in_free


def expand_parameters(start: Array, ties: Array, fit: Minimum) -> Array:
    """(N, P) the model's parameters at the end of a fit of the free ones, whose vector comes first."""
    parameters: Array = start + np.einsum("npq,nq->np", ties, fit.parameters[:, : ties.shape[2]])
    return parameters


def response_images(
    pixels: OutlinePixels, parameters: Array, shares: tuple[Array32, Array32], light: Array32
) -> Array32:
    """(N, 3, K) differences of box responses from Gaussian edges, at both edges of annuli. [DN]

    Args:
        pixels: of the annuli.
        parameters: (N, P) of the annuli.
        shares: (N, K) of the pixels that lie on the annulus, and in the hole.
        light: (N, K) of the annulus above the background.
    """
    hole = (parameters[:, ANNULUS_HOLE] - parameters[:, ANNULUS_BACKGROUND]).astype(np.float32)[:, None]
    responses = np.zeros((len(parameters), RESPONSE_BOXES, pixels.x_px.shape[1]), np.float32)
    between, in_hole = shares
    for place, inside, step in ((ANNULUS_OUTER, between + in_hole, light), (ANNULUS_INNER, in_hole, hole - light)):
        ellipses = parameters[:, place].astype(np.float32)
        add_box_responses(ellipses, pixels.x_px, pixels.y_px, pixels.present, inside, step, responses)
    return responses


def start_with_response(fit: Minimum, responses: Array32) -> Minimum:
    """The end of a fit without responses (N, S, K) as a start of the fit with them, their amounts zero."""
    jacobian = np.concatenate([fit.jacobian, responses], axis=1)
    normal = NormalEquations(jacobian, fit.residuals, fit.normal.weights)
    parameters = np.pad(fit.parameters, ((0, 0), (0, responses.shape[1])))
    return Minimum(parameters, fit.residuals, jacobian, normal)


def with_response(model: Model, responses: Array32) -> Model:
    """The model plus responses (N, S, K), whose amounts are its last parameters."""
    count = responses.shape[1]

    def extended(parameters: Array) -> tuple[Array32, Array32]:
        values, jacobian = model(parameters[:, :-count])
        amounts = parameters[:, None, -count:].astype(np.float32)
        return values + np.matmul(amounts, responses)[:, 0], np.concatenate([jacobian, responses], axis=1)

    return extended


# Azimuthal order of the light on the annulus; thin annuli have too few pixels to separate high orders from the outline.
_ORDER, _ORDER_THIN, _THIN_PX = 4, 2, 2.5
# Light this uneven about the azimuth, as a share of its mean, also changes across the annulus, and the fit gets radial
# slopes. Evenly lit annuli, within 0.015 of the mean on path-traced daylight frames, are fitted better without.
_UNEVEN_SHARE = 0.02
# Largest share of light from beyond in a used pixel. Ribs and sky around the hub are many and small, and their light by
# the azimuth is fitted, so more is allowed than beside a marker.
_MOST_BEYOND = 0.8
_FIRST_STEPS, _RESPONSE_STEPS, _SECOND_STEPS = 6, 2, 3
_MOST_LEVERAGE = np.float32(0.9)
_SECTORS = 16
# Both eyes see the same shadow, so its errors do not average out between them, and the azimuthal harmonics hide much of
# it from the residuals (path-traced frames of partly shaded hubs, 1.7 to 5 m).
_SHADOW_FACTOR = 3.0
# Mean square of a sector's summed noise that one even annulus in six exceeds. In low light, noise hides most of a
# shadow's residuals but none of its effect on the centre, which a higher limit would overlook.
_EVEN_SECTOR_CHI2 = 1.35
# Largest share of the annulus in a pixel that counts as beside it.
_BESIDE = 0.03
_LEAST_CONTRAST_SIGMA = 4.0
# Least lit share of the annulus: less does not determine its centre.
_LEAST_LIT_FRACTION = 0.5
_LIT_SHARE = 0.3
_MOST_CLIPPED_FRACTION = 0.05
_LARGEST_MOVE_FRACTION = 0.3
_LARGEST_SCALE = 1.25
# Fits that miss the hub state far more, right ones at dusk hardly ever so much (docs/explanation/centroids.md). [px]
_CERTAIN_SIGMA_PX = 0.1


@dataclass(frozen=True, eq=False)
class AnnulusFits:
    """Fitted annuli, in the order of the predicted ones.

    Attributes:
        centers_px: (M, 2) centres of the outer edges, the predicted ones where a fit was rejected; the inner ones lie
            the predicted step beside them.
        cov_px2: (M, 2, 2) their covariances.
        contrast_dn: (M,) mean light of the annulus above that beside it. [DN]
        lit_fraction: (M,) share of the azimuth that is lit.
        inflation: (M,) factor in `cov_px2` for correlated residuals, as shadows leave them.
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
        """Whether all annuli were found with centres precise enough to rule out another object."""
        return bool(self.accepted.all() and (np.einsum("nii->n", self.cov_px2) < 2 * _CERTAIN_SIGMA_PX**2).all())

    @property
    def evidence_per_px2(self) -> float:
        """Summed inverse variances of the accepted centres. [1/px^2]"""
        accepted = self.accepted
        return float((1 / np.einsum("nii->n", self.cov_px2[accepted])).sum())


_NO_ANNULI = AnnulusFits(
    centers_px=np.zeros((0, 2)),
    cov_px2=np.zeros((0, 2, 2)),
    contrast_dn=np.zeros(0),
    lit_fraction=np.zeros(0),
    inflation=np.zeros(0),
    reasons=(),
)


def fit_annuli(
    signals: Sequence[MarkerSignal],
    outer: Ellipses,
    inner: Ellipses,
    noise: NoiseModel,
    collar_factor: float = 0.0,
    motion: ImageMotion | None = None,
) -> AnnulusFits:
    """Fit every annulus of both eyes.

    Shapes and the step between the centres are those of the predicted edges; the size of each edge is free. Annuli too
    thin to show each edge by itself have one common size. Free shapes would follow shadows.

    Args:
        signals: left and right, around the annuli.
        outer: predicted outer edges, within a third of their radius.
        inner: predicted inner edges, of the same annuli.
        noise: of the frame's pixels, from `fit_discs`; it limits the contrast of accepted annuli.
        collar_factor: radius of the dark collar around the annulus over that of its outer edge, 0 where unknown. What
            lies beyond is left out, and its blur is fitted.
        motion: of the drogue's image while the shutter is open, None where it stands still.
    """
    if len(outer) == 0:
        return _NO_ANNULI
    width_px = float((outer.radii_px - inner.radii_px).min())
    thin = width_px < _THIN_PX
    motions = None if motion is None else motion.of(outer)
    gathered = annulus_pixels(signals, outer, inner, 0.0 if motion is None else motion.spread_px(outer))
    pixels, beyond = _within_collar(gathered, signals[0], (outer, inner), collar_factor, motions)
    harmonics = azimuth_harmonics(pixels, _ORDER_THIN if thin else _ORDER)
    start = initial_annulus_parameters(pixels, outer, inner, harmonics.shape[1])
    first = _first_fit(pixels, (harmonics, beyond), start, thin, motions)
    rough = expand_parameters(start, pose_constraints(start, thin), first)
    if not thin and _unevenness(rough) > _UNEVEN_SHARE:
        harmonics = np.concatenate([harmonics, radial_slopes(pixels, harmonics, outer, inner)], axis=1)
        start = np.pad(rough, ((0, 0), (0, SLOPE_HARMONICS)))
        first = _first_fit(pixels, (harmonics, beyond), start, thin, motions)
    ties = pose_constraints(start, thin)
    model = constrained_model(_annulus_model_of(pixels, (harmonics, beyond), motions), start, ties)
    final, weights, edge_factor = _weighted_fit(pixels, harmonics, (start, ties), model, first, motions is None)
    parameters = expand_parameters(start, ties, final)
    between, light = area_shares(final, ties)[0], light_above_background(parameters, harmonics)
    contrast = parameters[:, ANNULUS_AMPLITUDE] - parameters[:, ANNULUS_BACKGROUND]
    inflation = _shadow_inflation(final, weights, pixels, contrast, between, edge_factor)
    # The first two free parameters are the common shift.
    cov = widen_for_nonlinearity(final.covariance()[:, :2, :2] * edge_factor * inflation[:, None, None])
    on_it = pixels.present * (between > 0.5)
    reasons, lit = _reasons(pixels, parameters, on_it, light, noise, (outer, inner))
    good = np.array([reason is None for reason in reasons])
    centers = np.where(good[:, None], pixels.origins_px + parameters[:, ANNULUS_OUTER][:, :2], outer.centers_px)
    return AnnulusFits(
        centers_px=centers,
        cov_px2=cov,
        contrast_dn=contrast,
        lit_fraction=lit,
        inflation=inflation,
        reasons=reasons,
    )


def _annulus_model_of(pixels: OutlinePixels, light: tuple[Array32, Array32], motions: Array | None) -> Model:
    still = annulus_model(pixels, *light)
    return still if motions is None else motion_blurred(still, motions, (ANNULUS_OUTER.start, ANNULUS_INNER.start))


def _first_fit(
    pixels: OutlinePixels, light: tuple[Array32, Array32], start: Array, thin: bool, motions: Array | None
) -> Minimum:
    """Fit with equal weights, to measure the noise; `light` is the basis of that on the annulus and beyond."""
    ties = pose_constraints(start, thin)
    model = constrained_model(_annulus_model_of(pixels, light, motions), start, ties)
    begin = evaluate(model, pixels.values, pixels.present, np.zeros((len(start), ties.shape[2])))
    return minimise(model, pixels.values, pixels.present, begin, _FIRST_STEPS, FIRST_SMALL_STEP_PX)


def _weighted_fit(
    pixels: OutlinePixels, harmonics: Array32, shape: tuple[Array, Array], model: Model, first: Minimum, is_still: bool
) -> tuple[Minimum, Array32, float]:
    """Fit with inverse variances and the pixels' response.

    The noise comes from the annuli: their surroundings are brighter than a marker's face, and so noisier.

    Args:
        pixels, harmonics: of the annuli.
        shape: start and ties, see `expand_parameters`.
        model: in the free parameters.
        first: fit of equal weights.
        is_still: whether edges are so sharp that the pixels' response shows.

    Returns:
        The fit, the weights (N, K), and the edge factor of their noise model.
    """
    parameters, ties = expand_parameters(*shape, first), shape[1]
    if is_still:
        responses = response_images(
            pixels, parameters, area_shares(first, ties), light_above_background(parameters, harmonics)
        )
        model = with_response(model, responses)
        begin = start_with_response(first, responses)
        first = minimise(model, pixels.values, pixels.present, begin, _RESPONSE_STEPS, FIRST_SMALL_STEP_PX)
        parameters = expand_parameters(*shape, first)
    between, light = area_shares(first, ties)[0], light_above_background(parameters, harmonics)
    leverages = np.minimum(first.leverages(first.covariance(), pixels.present), _MOST_LEVERAGE)
    contrast = parameters[:, ANNULUS_AMPLITUDE] - parameters[:, ANNULUS_BACKGROUND]
    noise = measure_noise(first.residuals**2 / (1 - leverages), pixels.present, between, contrast)
    weights = pixels.present / noise.variances(between, light)
    final = minimise(model, pixels.values, weights, first, _SECOND_STEPS, SECOND_SMALL_STEP_PX)
    return final, weights, noise.edge_factor


def _shadow_inflation(
    fit: Minimum, weights: Array32, pixels: OutlinePixels, contrast: Array, between: Array32, edge_factor: float
) -> Array:
    """(N,) factor in the covariances for the correlated residuals that a shadow leaves."""
    uneven = _sector_chi2(fit, weights, pixels, contrast)
    if edge_factor < 1:
        # The noise beside the annulus hides the residuals on it.
        judged = weights * (between > _BESIDE) / np.float32(edge_factor)
        uneven = np.maximum(uneven, _sector_chi2(fit, judged, pixels, contrast))
    inflation: Array = 1 + _SHADOW_FACTOR * np.maximum(uneven - _EVEN_SECTOR_CHI2, 0)
    return inflation


def _sector_chi2(fit: Minimum, weights: Array32, pixels: OutlinePixels, contrast: Array) -> Array:
    return residual_spread(fit.residuals, weights, pixels, _SECTORS, contrast, fit.parameters.shape[1]).sector_chi2


def _unevenness(parameters: Array) -> float:
    """Root mean square of the light's azimuthal change over its mean, of the least even annulus."""
    harmonics = parameters[:, ANNULUS_AMPLITUDE:]
    mean = np.maximum(harmonics[:, 0] - parameters[:, ANNULUS_BACKGROUND], 1.0)  # at least 1 DN
    return float((np.sqrt((harmonics[:, 1:] ** 2).sum(axis=1) / 2) / mean).max())


def _within_collar(
    pixels: OutlinePixels,
    signal: MarkerSignal,
    edges: tuple[Ellipses, Ellipses],
    collar_factor: float,
    motions: Array | None,
) -> tuple[OutlinePixels, Array32]:
    """The pixels without those beyond the collar, and the share of light from beyond it in each, (N, K)."""
    if collar_factor == 0:
        return pixels, np.zeros_like(pixels.x_px)
    outer, inner = edges

    def beyond(nearer_px: float) -> Array32:
        factor = np.maximum(collar_factor - nearer_px / outer.radii_px, 0.5)[:, None, None]
        return blurred_share_outside(factor * outer.shapes_px, pixels.x_px, pixels.y_px, START_WIDTH_PX, motions)

    shares = beyond(0.0)
    if not signal.shows_glare:
        return pixels.only(shares < _MOST_BEYOND), shares
    to_outer = edge_distances(outer.shapes_px, pixels.x_px, pixels.y_px)
    # Distance into the annulus from the nearer edge; the hole is as dark as the collar.
    inwards = np.minimum(to_outer, (outer.radii_px - inner.radii_px).astype(np.float32)[:, None] - to_outer)
    clear = pixels_without_glare(pixels, signal, inwards, beyond)
    return pixels.only(shares < _MOST_BEYOND if clear is None else clear), shares


def _reasons(
    pixels: OutlinePixels,
    parameters: Array,
    on_it: Array32,
    light: Array32,
    noise: NoiseModel,
    predicted: tuple[Ellipses, Ellipses],
) -> tuple[tuple[str | None, ...], Array]:
    """Reason to reject each annulus, None for accepted ones, and (N,) the lit share of each."""
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
