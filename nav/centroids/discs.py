"""The model of a blurred disc, its initial parameters, the fitted discs, and the reasons to reject a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.centroids.blurred_edges import (
    DISC_BACKGROUND,
    DISC_FIXED_COUNT,
    DISC_LEVEL,
    DISC_WIDTH,
    ELLIPSE_PARAMETER_COUNT,
    START_WIDTH_PX,
    draw_discs,
    edge_widths,
    ellipse_parameters,
    parameter_shapes,
)
from nav.centroids.centroid_uncertainty import NoiseModel, ResidualSpread
from nav.centroids.ellipses import Ellipses, are_positive, moment_shapes, shape_radii
from nav.centroids.marker_signal import MarkerSignal
from nav.centroids.motion_blur import ImageMotion
from nav.centroids.outline_pixels import WHOLE_RADIUS_PX, OutlinePixels, coarse_pixels, edge_distances
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum, Model

# Largest error of an initial outline: pixels further than this from it show one side only. [px]
_CLEAR_PX = 1.0
# In standard deviations of a pixel: fits of fainter discs start from noise and end anywhere. Small discs have so few
# pixels that the standard deviation of the centre [px] shows when they are too faint.
_LEAST_CONTRAST_SIGMA = 2.5
_LARGEST_SIGMA_PX = 0.2
# Share of a disc's own pixels, and distance of the clipped ones' middle from its centre, as a share of its radius: a
# disc that is clipped evenly keeps its centre, one that is clipped on one side does not.
_MOST_CLIPPED_FRACTION, _MOST_CLIPPED_ASIDE = 0.05, 0.15
# Residuals of twice the frame's noise that exceed this share of the contrast come from another object.
_LARGEST_CHI2, _ROUGH_SHARE = 4.0, 0.04
# Largest move of an outline from its start, as a share of its radius; beyond, it is another object's.
_LARGEST_MOVE_FRACTION = 0.5
LARGEST_SCALE = 1.6


def disc_model(
    pixels: OutlinePixels,
    slope_outside: bool,
    slope_inside: bool,
    further: Array32 | None = None,
    held: NDArray[np.bool_] | None = None,
) -> Model:
    """Intensity of a blurred edge between two planes of light, `I = (b + g.x) (1 - S) + (A + h.x) S + k.F`.

    S is the share of light from within, see `nav.centroids.blurred_edges`.

    Args:
        pixels: at which the model is evaluated.
        slope_outside: whether the background's plane g is fitted.
        slope_inside: whether the disc's plane h is fitted.
        further: (N, E, K) shares F of other backgrounds, whose lights k above b are the last parameters.
        held: (N,) whether a disc's edge keeps the width that it has, or None where all are fitted.
    """
    x, y = pixels.x_px, pixels.y_px
    if further is None:
        further = np.zeros((len(x), 0, x.shape[1]), np.float32)
    count = DISC_FIXED_COUNT + 2 * slope_outside + 2 * slope_inside + further.shape[1]

    def model(parameters: Array) -> tuple[Array32, Array32]:
        picture, jacobian = np.empty_like(x), np.empty((len(x), count, x.shape[1]), np.float32)
        given, widths = parameters.astype(np.float32), edge_widths(parameters[:, DISC_WIDTH])
        draw_discs(given, widths, (slope_outside, slope_inside), x, y, further, picture, jacobian)
        if held is not None:
            jacobian[held, DISC_WIDTH] = 0
        return picture, jacobian

    return model


def initialize_from_moments(signals: Sequence[MarkerSignal], discs: Ellipses) -> Ellipses:
    """Initial outlines of large discs from second moments; a circle would miss a tilted disc's edge by pixels."""
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
    scale = shape_radii(shapes) / discs.radii_px
    good = (scale > 1 / LARGEST_SCALE) & (scale < LARGEST_SCALE)
    centers = np.where(good[:, None], discs.centers_px + center, discs.centers_px)
    return Ellipses(discs.eyes, centers, np.where(good[:, None, None], shapes, discs.shapes_px))


def initial_disc_parameters(pixels: OutlinePixels, shapes_px: Array, further_count: int) -> Array:
    """(N, P) parameters of initial outlines with the mean level on each side, and zero for all further parameters."""
    parameters = np.zeros((len(shapes_px), DISC_FIXED_COUNT + further_count))
    parameters[:, :ELLIPSE_PARAMETER_COUNT] = ellipse_parameters(np.zeros((len(shapes_px), 2)), shapes_px)
    parameters[:, DISC_WIDTH] = START_WIDTH_PX
    distance = edge_distances(shapes_px, pixels.x_px, pixels.y_px)
    for column, side in ((DISC_BACKGROUND, distance < -_CLEAR_PX), (DISC_LEVEL, distance > _CLEAR_PX)):
        weight = pixels.present * side
        parameters[:, column] = (weight * pixels.values).sum(axis=1) / np.maximum(weight.sum(axis=1), 1)
    return parameters


def contrasts(fit: Minimum) -> Array:
    """(N,) level of fitted discs above the background. [DN]"""
    contrast: Array = fit.parameters[:, DISC_LEVEL] - fit.parameters[:, DISC_BACKGROUND]
    return contrast


@dataclass(frozen=True, eq=False)
class DiscFits:
    """Refined discs, in the order of the initial ones.

    Attributes:
        ellipses: fitted outlines; initial ones where the fit was rejected.
        cov_px2: (M, 2, 2) covariances of the centres.
        contrast_dn, background_dn: (M,) level of the disc above the background, and of the background. [DN]
        edge_width_px: (M,) standard deviation of the Gaussian edge blur, the pixel's box included. [px]
        chi2_per_dof: (M,) of the residuals, by the frame's own noise.
        inflation: (M,) factor in `cov_px2` for correlated residuals.
        reasons: why a disc was rejected, or None.
        noise: of the frame's pixels, None without any disc.
        motion: of the discs while the shutter was open, None where they stood still.
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
    motion: ImageMotion | None = None

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """(M,) which discs were not rejected."""
        return np.array([reason is None for reason in self.reasons], dtype=np.bool_)

    def take(self, index: NDArray[np.int64]) -> DiscFits:
        """Those of some discs."""
        return replace(
            self,
            ellipses=self.ellipses.take(index),
            cov_px2=self.cov_px2[index],
            contrast_dn=self.contrast_dn[index],
            background_dn=self.background_dn[index],
            edge_width_px=self.edge_width_px[index],
            chi2_per_dof=self.chi2_per_dof[index],
            inflation=self.inflation[index],
            reasons=tuple(self.reasons[k] for k in index),
        )


def unfitted_discs(discs: Ellipses) -> DiscFits:
    """Initial outlines without fits, to be replaced part by part, see `with_part`."""
    nothing = np.zeros(len(discs))
    return DiscFits(
        ellipses=discs,
        cov_px2=np.zeros((len(discs), 2, 2)),
        contrast_dn=nothing,
        background_dn=nothing,
        edge_width_px=nothing,
        chi2_per_dof=nothing,
        inflation=nothing,
        reasons=(None,) * len(discs),
        noise=None,
    )


def with_part(fits: DiscFits, index: NDArray[np.int64], part: DiscFits) -> DiscFits:
    """`fits` with the discs of `index` replaced by `part`."""

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
        ellipses=Ellipses(fits.ellipses.eyes, centers, shapes),
        cov_px2=put(fits.cov_px2, part.cov_px2),
        contrast_dn=put(fits.contrast_dn, part.contrast_dn),
        background_dn=put(fits.background_dn, part.background_dn),
        edge_width_px=put(fits.edge_width_px, part.edge_width_px),
        chi2_per_dof=put(fits.chi2_per_dof, part.chi2_per_dof),
        inflation=put(fits.inflation, part.inflation),
        reasons=tuple(reasons),
        noise=part.noise,
        motion=fits.motion if part.motion is None else part.motion,
    )


def rejection_reasons(
    discs: Ellipses,
    pixels: OutlinePixels,
    fit: Minimum,
    cov_px2: Array,
    noise: NoiseModel,
    spread: ResidualSpread,
) -> tuple[str | None, ...]:
    """Reason to reject each disc, None for accepted ones; where several apply, the first of this order."""
    contrast, clipped = contrasts(fit), _clipped_aside(discs, pixels)
    bright = noise.dark_dn2 + noise.per_signal_dn * np.maximum(contrast, 0)
    moved = np.hypot(*(fit.parameters[:, :2] + pixels.origins_px - discs.centers_px).T)
    shapes = parameter_shapes(fit.parameters)
    scale = shape_radii(shapes) / discs.radii_px
    rough = (spread.chi2_per_dof > _LARGEST_CHI2) & (spread.chi2_per_dof * bright > (_ROUGH_SHARE * contrast) ** 2)
    lost = ~np.isfinite(fit.parameters).all(axis=1) | ~np.isfinite(cov_px2).all(axis=(1, 2)) | ~are_positive(shapes)
    placed = np.einsum("nii->n", cov_px2) < 2 * _LARGEST_SIGMA_PX**2
    astray = (moved > 1 + _LARGEST_MOVE_FRACTION * discs.radii_px) | ~(
        (scale > 1 / LARGEST_SCALE) & (scale < LARGEST_SCALE)
    )
    tests = (
        (pixels.truncated, "cut by the edge of the image"),
        (clipped, "clipped in part: brighter than the sensor's range"),
        (~(contrast > _LEAST_CONTRAST_SIGMA * np.sqrt(bright)), "no contrast"),
        (lost | astray, "the fit left the disc"),
        (spread.uneven | rough, "uneven: cut by a shadow or hidden in part"),
        (~placed, "too faint to be placed"),
    )
    return tuple(next((reason for failed, reason in tests if failed[i]), None) for i in range(len(discs)))


def are_clipped(discs: Ellipses, pixels: OutlinePixels) -> NDArray[np.bool_]:
    """(N,) whether more than a few of the pixels within (N,) discs are clipped.

    What is left of such a disc does not tell its light, its size and the width of its edge from each other.
    """
    if not pixels.clipped.any():
        return np.zeros(len(discs), np.bool_)
    own, clipped = _own_and_clipped(discs, pixels)
    many: NDArray[np.bool_] = clipped.sum(axis=1) > _MOST_CLIPPED_FRACTION * own.sum(axis=1)
    return many


def _own_and_clipped(discs: Ellipses, pixels: OutlinePixels) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(N, K) whether pixels lie within the discs, and whether such pixels are clipped."""
    own = ((pixels.present > 0) | pixels.clipped) & (edge_distances(discs.shapes_px, pixels.x_px, pixels.y_px) > 0)
    return own, own & pixels.clipped


def _clipped_aside(discs: Ellipses, pixels: OutlinePixels) -> NDArray[np.bool_]:
    """(N,) whether discs are clipped, and that more on one side than by chance."""
    if not pixels.clipped.any():
        return np.zeros(len(discs), np.bool_)
    clipped = _own_and_clipped(discs, pixels)[1]
    count = np.maximum(clipped.sum(axis=1), 1)
    x, y = ((clipped * each).sum(axis=1) / count for each in (pixels.x_px, pixels.y_px))
    # Places spread evenly over a disc have a standard deviation of half its radius along each axis.
    by_chance = 0.5 / np.sqrt(count)
    far = np.hypot(x, y) / discs.radii_px > _MOST_CLIPPED_ASIDE + by_chance
    aside: NDArray[np.bool_] = far & are_clipped(discs, pixels)
    return aside
