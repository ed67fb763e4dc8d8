"""Both edges of bright annuli in one fit: the hub around the coupling's mouth, often partly in shadow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.centroids.centroid_quality import NoiseModel, residual_spread, sector_index
from nav.centroids.edge_model import FIRST_SMALL_STEP_PX, SECOND_SMALL_STEP_PX
from nav.centroids.edge_profile import (
    ELLIPSE_PARAMETERS,
    START_WIDTH_PX,
    edge_profile,
    ellipse_parameters,
    parameter_shapes,
)
from nav.centroids.ellipses import Ellipses
from nav.centroids.least_squares import Minimum, Model, evaluate, minimise
from nav.centroids.marker_signal import Array32, MarkerSignal
from nav.centroids.patches import PixelSet, annulus_pixels, edge_distances

# Azimuthal order of the light on the annulus; a thin one has too few pixels to tell high orders from its outline.
_ORDER, _ORDER_THIN, _THIN_PX = 4, 2, 2.5
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

# Places in the vector of parameters.
_OUTER = slice(0, ELLIPSE_PARAMETERS)
_INNER = slice(ELLIPSE_PARAMETERS, 2 * ELLIPSE_PARAMETERS)
_WIDTH, _BACKGROUND, _HOLE, _AMPLITUDE = (2 * ELLIPSE_PARAMETERS + i for i in range(4))
_CENTERS = np.array([0, 1, ELLIPSE_PARAMETERS, ELLIPSE_PARAMETERS + 1])


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


def fit_annuli(signals: Sequence[MarkerSignal], outer: Ellipses, inner: Ellipses, noise: NoiseModel) -> AnnulusFits:
    """Fit every annulus of both eyes.

    Annuli too thin to show each edge by itself keep the predicted shapes up to a common scale and the predicted step
    between the centres.

    Args:
        signals: left and right, around the annuli.
        outer: predicted outer edges, within a third of their radius.
        inner: predicted inner edges, of the same annuli.
        noise: of the frame's pixels, from `fit_discs`.
    """
    if len(outer) == 0:
        nothing = np.zeros(0)
        return AnnulusFits(np.zeros((0, 2, 2)), np.zeros((0, 4, 4)), nothing, nothing, nothing, ())
    thin = bool((outer.radii_px - inner.radii_px).min() < _THIN_PX)
    pixels = annulus_pixels(signals, outer, inner)
    turns = _azimuth_basis(pixels, _ORDER_THIN if thin else _ORDER)
    start = _start(pixels, outer, inner, turns.shape[1])
    ties = _ties(start, thin)
    model = _tied_model(annulus_model(pixels, turns), start, ties)
    begin = evaluate(model, pixels.values, pixels.present, np.zeros((len(outer), ties.shape[2])))
    first = minimise(model, pixels.values, pixels.present, begin, _FIRST_STEPS, FIRST_SMALL_STEP_PX)
    between, light = _lit(_untied(start, ties, first), pixels, turns)
    weights = pixels.present / noise.variances(between, light)
    final = minimise(model, pixels.values, weights, first, _SECOND_STEPS, SECOND_SMALL_STEP_PX)
    parameters = _untied(start, ties, final)
    between, light = _lit(parameters, pixels, turns)
    contrast = parameters[:, _AMPLITUDE] - parameters[:, _BACKGROUND]
    sectors = sector_index(pixels.x_px, pixels.y_px, _SECTORS)
    spread = residual_spread(final.residuals, weights, sectors, contrast, ties.shape[2])
    inflation = np.maximum(spread.inflation, spread.chi2_per_dof)
    cov = _center_covariance(final, ties, thin) * inflation[:, None, None]
    on_it = pixels.present * (between > 0.5)
    reasons, lit = _reasons(pixels, parameters, on_it, light, noise, (outer, inner))
    good = np.array([reason is None for reason in reasons])
    predicted = np.stack([outer.centers_px, inner.centers_px], axis=1)
    fitted = pixels.origins_px[:, None] + parameters[:, _CENTERS].reshape(-1, 2, 2)
    return AnnulusFits(np.where(good[:, None, None], fitted, predicted), cov, contrast, lit, inflation, reasons)


def _ties(start: Array, thin: bool) -> Array:
    """(N, P, Q) how the model's parameters follow the free ones."""
    count = start.shape[1]
    ties = np.broadcast_to(np.eye(count), (len(start), count, count))
    if not thin:
        return ties
    moved = np.zeros((len(start), count, 3))
    moved[:, _CENTERS, [0, 1, 0, 1]] = 1
    for edge in (_OUTER, _INNER):
        moved[:, edge.start + 2 : edge.stop, 2] = start[:, edge.start + 2 : edge.stop]
    return np.concatenate([moved, ties[:, :, _WIDTH:]], axis=2)


def _tied_model(model: Model, start: Array, ties: Array) -> Model:
    """The model in its free parameters, counted from the start."""
    if ties.shape[1] == ties.shape[2]:
        return lambda free: model(start + free)
    across = ties.transpose(0, 2, 1).astype(np.float32)

    def in_free(free: Array) -> tuple[Array32, Array32]:
        values, jacobian = model(start + np.einsum("npq,nq->np", ties, free))
        return values, np.matmul(across, jacobian)

    return in_free


def _untied(start: Array, ties: Array, fit: Minimum) -> Array:
    parameters: Array = start + np.einsum("npq,nq->np", ties, fit.parameters)
    return parameters


def _center_covariance(fit: Minimum, ties: Array, thin: bool) -> Array:
    """(N, 4, 4) of outer x, y and inner x, y."""
    chosen = ties[:, _CENTERS]
    cov: Array = np.einsum("nap,npq,nbq->nab", chosen, fit.covariance(), chosen)
    apart = np.array([[1.0, -1.0], [-1.0, 1.0]]) / 4
    return cov + thin * _OFFSET_SIGMA_PX**2 * np.kron(apart, np.eye(2))


def annulus_model(pixels: PixelSet, turns: Array32) -> Model:
    """`I = b (1 - So) + A(azimuth) (So - Si) + b' Si`.

    Args:
        pixels: where.
        turns: (N, T, K) functions of the azimuth whose sum is A.
    """
    x, y = pixels.x_px, pixels.y_px

    def model(parameters: Array) -> tuple[Array32, Array32]:
        width = parameters[:, _WIDTH]
        outer = edge_profile(parameters[:, _OUTER], width, x, y)
        inner = edge_profile(parameters[:, _INNER], width, x, y)
        rest = parameters[:, _BACKGROUND:].astype(np.float32)
        background, hole = rest[:, 0, None], rest[:, 1, None]
        light = np.matmul(rest[:, None, 2:], turns)[:, 0]
        jacobian = np.empty((len(x), parameters.shape[1], x.shape[1]), np.float32)
        up, down = (light - background) * outer.density, (hole - light) * inner.density
        np.multiply(outer.slopes, up[:, None], out=jacobian[:, _OUTER])
        np.multiply(inner.slopes, down[:, None], out=jacobian[:, _INNER])
        spread = up * outer.distance_px + down * inner.distance_px
        jacobian[:, _WIDTH] = -spread / width[:, None].astype(np.float32)
        jacobian[:, _BACKGROUND], jacobian[:, _HOLE] = 1 - outer.inside, inner.inside
        between = outer.inside - inner.inside
        np.multiply(turns, between[:, None], out=jacobian[:, _AMPLITUDE:])
        return background * (1 - outer.inside) + light * between + hole * inner.inside, jacobian

    return model


def _azimuth_basis(pixels: PixelSet, order: int) -> Array32:
    """(N, 2 order + 1, K): one, then cosines and sines of multiples of the azimuth."""
    angle = np.arctan2(pixels.y_px, pixels.x_px)
    rows = [np.ones_like(angle)]
    for multiple in range(1, order + 1):
        rows += [np.cos(multiple * angle), np.sin(multiple * angle)]
    return np.stack(rows, axis=1)


def _start(pixels: PixelSet, outer: Ellipses, inner: Ellipses, turn_count: int) -> Array:
    parameters = np.zeros((len(outer), _AMPLITUDE + turn_count))
    shift = inner.centers_px - outer.centers_px
    parameters[:, _OUTER] = ellipse_parameters(np.zeros((len(outer), 2)), outer.shapes_px)
    parameters[:, _INNER] = ellipse_parameters(shift, inner.shapes_px)
    parameters[:, _WIDTH] = START_WIDTH_PX
    to_outer = edge_distances(outer.shapes_px, pixels.x_px, pixels.y_px)
    x, y = (pixels.x_px - shift[:, :1], pixels.y_px - shift[:, 1:])
    to_inner = edge_distances(inner.shapes_px, x.astype(np.float32), y.astype(np.float32))
    sides = ((_BACKGROUND, to_outer < -1), (_HOLE, to_inner > 1), (_AMPLITUDE, (to_outer > 0) & (to_inner < 0)))
    for column, side in sides:
        weight = pixels.present * side
        parameters[:, column] = (weight * pixels.values).sum(axis=1) / np.maximum(weight.sum(axis=1), 1)
    return parameters


def _lit(parameters: Array, pixels: PixelSet, turns: Array32) -> tuple[Array32, Array32]:
    """Share of each pixel that lies on the annulus, and the annulus's light above the background there."""
    width = parameters[:, _WIDTH]
    outer = edge_profile(parameters[:, _OUTER], width, pixels.x_px, pixels.y_px)
    inner = edge_profile(parameters[:, _INNER], width, pixels.x_px, pixels.y_px)
    rest = parameters[:, _BACKGROUND:].astype(np.float32)
    return outer.inside - inner.inside, np.matmul(rest[:, None, 2:], turns)[:, 0] - rest[:, 0, None]


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
    for place, edge in zip((_OUTER, _INNER), predicted, strict=True):
        ellipse = parameters[:, place]
        moved = np.hypot(*(ellipse[:, :2] + pixels.origins_px - edge.centers_px).T)
        scale = np.sqrt(np.abs(np.linalg.det(parameter_shapes(ellipse)))) / edge.radii_px
        bad |= moved > 0.5 + _LARGEST_MOVE_FRACTION * edge.radii_px
        bad |= ~((scale > 1 / _LARGEST_SCALE) & (scale < _LARGEST_SCALE))
    contrast = parameters[:, _AMPLITUDE] - parameters[:, _BACKGROUND]
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
