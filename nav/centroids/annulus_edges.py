"""Both edges of bright annuli in one fit: the hub around the coupling's mouth, often partly in shadow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.centroids.annulus_model import (
    AMPLITUDE,
    BACKGROUND,
    CENTERS,
    INNER,
    OUTER,
    SLOPE_TURNS,
    all_parameters,
    annulus_model,
    annulus_start,
    azimuth_basis,
    both_edges,
    free_to_all,
    in_free_parameters,
    radial_slopes,
)
from nav.centroids.centroid_quality import NoiseModel, residual_spread, sector_index
from nav.centroids.edge_model import FIRST_SMALL_STEP_PX, SECOND_SMALL_STEP_PX
from nav.centroids.edge_profile import START_WIDTH_PX, parameter_shapes
from nav.centroids.ellipses import Ellipses
from nav.centroids.least_squares import Minimum, evaluate, minimise
from nav.centroids.marker_signal import Array32, MarkerSignal
from nav.centroids.patches import PixelSet, annulus_pixels
from nav.centroids.surroundings import share_outside

# Azimuthal order of the light on the annulus; a thin one has too few pixels to tell high orders from its outline.
_ORDER, _ORDER_THIN, _THIN_PX = 4, 2, 2.5
# Light this uneven about the azimuth, as a share of its mean, changes across the annulus too, which one this wide
# shows; evenly lit ones, within 0.015 of the mean on path-traced daylight frames, are better off without.
_UNEVEN_SHARE, _WIDE_PX = 0.02, 5.0
# Ribs and sky around the hub are many and small, their light by the azimuth is fitted: more of it is taken than beside
# a marker.
_MOST_BEYOND = 0.8
# How well the step between the centres of both edges is known where it is not fitted: it is below this itself. [px]
_OFFSET_SIGMA_PX = 0.005
_FIRST_STEPS, _SECOND_STEPS = 6, 3
_SECTORS = 16
_LEAST_CONTRAST_SIGMA = 4.0
# So much of the annulus must be lit: less does not tell where its middle is.
_LEAST_LIT_FRACTION = 0.5
_LIT_SHARE = 0.3
_MOST_CLIPPED_FRACTION = 0.05
_LARGEST_MOVE_FRACTION = 0.3
_LARGEST_SCALE = 1.25


@dataclass(frozen=True, eq=False)
class AnnulusFits:
    """Refined annuli, in the order of the predicted ones.

    Attributes:
        centers_px: (M, 2, 2) centres of the outer and the inner edge; the predicted ones where a fit was rejected.
        cov_px2: (M, 4, 4) joint covariance of outer x, y and inner x, y.
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

    def outer_given_offset(self, inner_from_outer_px: Array) -> tuple[Array, Array]:
        """Outer centres when the step between the centres, a perspective effect of known size, is taken as known.

        Args:
            inner_from_outer_px: (M, 2) predicted inner minus outer centre.

        Returns:
            (M, 2) centres and (M, 2, 2) covariances of the best joint estimate; those of rejected ones mean nothing.
        """
        design = np.concatenate([np.eye(2), np.eye(2)])
        measured = self.centers_px.copy()
        measured[:, 1] -= inner_from_outer_px
        weight = np.linalg.inv(self.cov_px2)
        cov = np.linalg.inv(design.T @ weight @ design)
        centers = np.einsum("mij,jk,mkl,ml->mi", cov, design.T, weight, measured.reshape(-1, 4))
        return centers, cov


def fit_annuli(
    signals: Sequence[MarkerSignal],
    outer: Ellipses,
    inner: Ellipses,
    noise: NoiseModel,
    collar_factor: float = 0.0,
) -> AnnulusFits:
    """Fit every annulus of both eyes.

    Annuli too thin to show each edge by itself keep the predicted shapes up to a common scale and the predicted step
    between the centres.

    Args:
        signals: left and right, around the annuli.
        outer: predicted outer edges, within a third of their radius.
        inner: predicted inner edges, of the same annuli.
        noise: of the frame's pixels, from `fit_discs`.
        collar_factor: radius of the dark collar around the annulus over that of its outer edge, 0 where unknown. What
            lies beyond is left out, and its blur fitted.
    """
    if len(outer) == 0:
        nothing = np.zeros(0)
        return AnnulusFits(np.zeros((0, 2, 2)), np.zeros((0, 4, 4)), nothing, nothing, nothing, ())
    width_px = float((outer.radii_px - inner.radii_px).min())
    thin = width_px < _THIN_PX
    pixels, beyond = _within_collar(annulus_pixels(signals, outer, inner), outer, collar_factor)
    turns = azimuth_basis(pixels, _ORDER_THIN if thin else _ORDER)
    start = annulus_start(pixels, outer, inner, turns.shape[1])
    first = _first_fit(pixels, (turns, beyond), start, thin)
    if width_px > _WIDE_PX and _unevenness(start + first.parameters) > _UNEVEN_SHARE:
        turns = np.concatenate([turns, radial_slopes(pixels, turns, outer, inner)], axis=1)
        start = np.pad(start + first.parameters, ((0, 0), (0, SLOPE_TURNS)))
        first = _first_fit(pixels, (turns, beyond), start, thin)
    ties = free_to_all(start, thin)
    model = in_free_parameters(annulus_model(pixels, turns, beyond), start, ties)
    between, light = _lit(all_parameters(start, ties, first), pixels, turns)
    weights = pixels.present / noise.variances(between, light)
    final = minimise(model, pixels.values, weights, first, _SECOND_STEPS, SECOND_SMALL_STEP_PX)
    parameters = all_parameters(start, ties, final)
    between, light = _lit(parameters, pixels, turns)
    contrast = parameters[:, AMPLITUDE] - parameters[:, BACKGROUND]
    sectors = sector_index(pixels.x_px, pixels.y_px, _SECTORS)
    spread = residual_spread(final.residuals, weights, sectors, contrast, ties.shape[2])
    inflation = np.maximum(spread.inflation, spread.chi2_per_dof)
    # Both eyes see the same shadow: what it adds does not average out between them, and so counts twice.
    cov = _center_covariance(final, ties, thin) * (2 * inflation - 1)[:, None, None]
    on_it = pixels.present * (between > 0.5)
    reasons, lit = _reasons(pixels, parameters, on_it, light, noise, (outer, inner))
    good = np.array([reason is None for reason in reasons])
    predicted = np.stack([outer.centers_px, inner.centers_px], axis=1)
    fitted = pixels.origins_px[:, None] + parameters[:, CENTERS].reshape(-1, 2, 2)
    return AnnulusFits(np.where(good[:, None, None], fitted, predicted), cov, contrast, lit, inflation, reasons)


def _first_fit(pixels: PixelSet, light: tuple[Array32, Array32], start: Array, thin: bool) -> Minimum:
    """The fit of equal weights, for the noise by what each pixel sees; `light` is that on the annulus and beyond."""
    ties = free_to_all(start, thin)
    model = in_free_parameters(annulus_model(pixels, *light), start, ties)
    begin = evaluate(model, pixels.values, pixels.present, np.zeros((len(start), ties.shape[2])))
    return minimise(model, pixels.values, pixels.present, begin, _FIRST_STEPS, FIRST_SMALL_STEP_PX)


def _unevenness(parameters: Array) -> float:
    """Root mean square of the light's change with the azimuth over its mean, of the less even annulus."""
    turns = parameters[:, AMPLITUDE:]
    mean = np.maximum(turns[:, 0] - parameters[:, BACKGROUND], np.finfo(float).tiny)
    return float((np.sqrt((turns[:, 1:] ** 2).sum(axis=1) / 2) / mean).max())


def _within_collar(pixels: PixelSet, outer: Ellipses, collar_factor: float) -> tuple[PixelSet, Array32]:
    """The pixels without those beyond the collar, and the share of what lies beyond it in each."""
    if collar_factor == 0:
        return pixels, np.zeros_like(pixels.x_px)
    beyond = share_outside(collar_factor * outer.shapes_px, pixels.x_px, pixels.y_px, START_WIDTH_PX)
    return pixels.only(beyond < _MOST_BEYOND), beyond


def _center_covariance(fit: Minimum, ties: Array, thin: bool) -> Array:
    """(N, 4, 4) of outer x, y and inner x, y."""
    chosen = ties[:, CENTERS]
    cov: Array = np.einsum("nap,npq,nbq->nab", chosen, fit.covariance(), chosen)
    apart = np.array([[1.0, -1.0], [-1.0, 1.0]]) / 4
    return cov + thin * _OFFSET_SIGMA_PX**2 * np.kron(apart, np.eye(2))


def _lit(parameters: Array, pixels: PixelSet, turns: Array32) -> tuple[Array32, Array32]:
    """Share of each pixel that lies on the annulus, and the annulus's light above the background there."""
    outer, inner = both_edges(parameters, pixels.x_px, pixels.y_px)
    rest = parameters[:, BACKGROUND:].astype(np.float32)
    light = np.matmul(rest[:, None, AMPLITUDE - BACKGROUND :], turns)[:, 0]
    return outer.inside - inner.inside, light - rest[:, 0, None]


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
    for place, edge in zip((OUTER, INNER), predicted, strict=True):
        ellipse = parameters[:, place]
        moved = np.hypot(*(ellipse[:, :2] + pixels.origins_px - edge.centers_px).T)
        scale = np.sqrt(np.abs(np.linalg.det(parameter_shapes(ellipse)))) / edge.radii_px
        bad |= moved > 0.5 + _LARGEST_MOVE_FRACTION * edge.radii_px
        bad |= ~((scale > 1 / _LARGEST_SCALE) & (scale < _LARGEST_SCALE))
    contrast = parameters[:, AMPLITUDE] - parameters[:, BACKGROUND]
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
