"""How far a fitted outline can be trusted: noise from residuals, spread of residuals about the outline, reasons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.centroids.patches import PixelSet
from nav.centroids.pixel_sums import piece_sums, sector_sums, zone_sums
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum

# Rounding to integers. [DN^2]
_QUANTISATION_DN2 = 1 / 12
# Shares of light from within that count as outside, as the edge, and as inside.
_ZONES = np.array([(-np.inf, 0.03), (0.2, 0.8), (0.97, np.inf)], np.float32)
# Of an outline whose residuals are so much above the usual, none tells of the sensor.
_ODD_FACTOR = 3.0
# Of the noise on a marker, what is left beside it at least: coarse numbers may hide the noise of a dark background.
_LEAST_DARK_SHARE = 0.05
SECTORS = 8
# Of an outline; twice as many as the fit of an ellipse follows leave enough to tell.
_PIECES = 16
# Outlines that are as restless as their pixels tell, beside those of the frame: few pieces know the factor badly.
_PRIOR_PIECES = 8.0
_STEEP_SHARE = 0.03
_TINY = 1e-12
# Deviation of a centre of which a linear fit tells half the variance.
_NOT_LINEAR_PX = 0.2
# A shadow or a thing before the disc leaves residuals beyond so many deviations of a sector's mean, and beyond this
# share of the contrast; what is smaller moves the centre by less than the noise of one edge pixel.
_SECTOR_SIGMA = 4.0
_SECTOR_SHARE = 0.04
# Mean square of a sector's summed noise that 5 % of even discs exceed (chi-square of 8).
_USUAL_SECTOR_CHI2 = 1.94


@dataclass(frozen=True)
class NoiseModel:
    """Variance of a pixel by what it sees, from the images themselves.

    Attributes:
        dark_dn2: beside the markers.
        per_signal_dn: shot noise: growth with the signal above the background.
        edge_share2: further variance on an edge, in squared steps of light (render noise, unevenness of the pixels).
        edge_factor: what edges vary over what the others say of them, at most 1: things that lie beside an outline pass
            for noise there.
    """

    dark_dn2: float
    per_signal_dn: float
    edge_share2: float
    edge_factor: float = 1.0

    def variances(self, inside: Array32, contrast: Array32) -> Array32:
        """Variances where the share `inside` of the light comes from `contrast` above the background. [DN^2]"""
        shot = np.float32(self.per_signal_dn) * np.maximum(contrast, 0) * inside
        edge = np.float32(4 * self.edge_share2) * contrast * contrast * inside * (1 - inside)
        variances: Array32 = np.float32(self.dark_dn2) + shot + edge
        return variances


def measure_noise(squares: Array32, present: Array32, inside: Array32, contrast: Array) -> NoiseModel:
    """Noise from the squared residuals of many outlines.

    Args:
        squares: (N, K) squared residuals, corrected for what the fit swallowed. [DN^2]
        present: (N, K) 0 for padding.
        inside: (N, K) share of the light from within.
        contrast: (N,) [DN]
    """
    sums = zone_sums(squares, present, inside, _ZONES)
    mean = sums[:, 0, 0] / np.maximum(sums[:, 0, 1], 1)
    usual = mean <= _ODD_FACTOR * np.median(mean)
    level = float(np.median(contrast[usual]))
    totals, counts = sums[usual, 1:].sum(axis=0).T
    dark, edge, bright = (totals / np.maximum(counts, 1)).tolist()
    dark = max(dark, _LEAST_DARK_SHARE * bright, _QUANTISATION_DN2)
    bright = max(bright, dark)
    mean_shape = 0.83  # of 4 S (1 - S) over the edge's zone
    usual_edge = (dark + bright) / 2
    further = max(0.0, edge - usual_edge) / mean_shape
    # One pixel more, as noisy as the others tell: without an edge's pixels they are all there is.
    factor = min((totals[1] / usual_edge + 1) / (counts[1] + 1), 1.0)
    return NoiseModel(dark, (bright - dark) / max(level, 1e-6), further / max(level, 1e-6) ** 2, float(factor))


@dataclass(frozen=True, eq=False)
class ResidualSpread:
    """What is left of N patches after the fit.

    Attributes:
        chi2_per_dof: (N,) mean square of the residuals over their variances.
        worst_sector_sigma: (N,) largest mean of a sector over its deviation.
        worst_sector_share: (N,) largest mean of a sector over the contrast.
        sector_chi2: (N,) mean square of the sectors' summed residuals over their variances; 1 for white noise.
    """

    chi2_per_dof: Array
    worst_sector_sigma: Array
    worst_sector_share: Array
    sector_chi2: Array

    @property
    def uneven(self) -> NDArray[np.bool_]:
        """(N,) whether a shadow or something before the disc shows."""
        found: NDArray[np.bool_] = (self.worst_sector_sigma > _SECTOR_SIGMA) & (self.worst_sector_share > _SECTOR_SHARE)
        return found

    @property
    def inflation(self) -> Array:
        """(N,) factor by which residuals that hang together widen the covariance."""
        factor: Array = np.maximum(1.0, self.sector_chi2 / _USUAL_SECTOR_CHI2)
        return factor


def residual_spread(
    residuals: Array32, weights: Array32, pixels: PixelSet, sectors: int, contrast: Array, fitted: int
) -> ResidualSpread:
    """Residuals summed over the patch and over sectors.

    Args:
        residuals: (N, K). [DN]
        weights: (N, K) inverse variances, 0 for padding. [1/DN^2]
        pixels: whose they are.
        sectors: how many about the centre.
        contrast: (N,) [DN]
        fitted: number of parameters.
    """
    sums = sector_sums(pixels.x_px, pixels.y_px, residuals, weights, sectors)
    weight, summed = np.maximum(sums[..., 0], 1e-12), sums[..., 1]
    squares = sums[..., 2].sum(axis=1)
    dof = np.maximum((weights > 0).sum(axis=1) - fitted, 1)
    sigma = np.abs(summed) / np.sqrt(weight)
    mean = np.abs(summed) / weight
    share = mean / np.maximum(contrast, 1e-6)[:, None]
    worst = np.argmax(np.minimum(sigma / _SECTOR_SIGMA, share / _SECTOR_SHARE), axis=1)[:, None]
    return ResidualSpread(
        squares / dof,
        np.take_along_axis(sigma, worst, 1)[:, 0],
        np.take_along_axis(share, worst, 1)[:, 0],
        (summed**2 / weight).mean(axis=1),
    )


def edge_noise_factor(fit: Minimum, weights: Array32, x_px: Array32, y_px: Array32) -> float:
    """Variance with which the outlines of a frame move about, piece by piece, over what their pixels' noise tells.

    Noise that a lens has spread over neighbouring pixels, as that of a renderer, is stronger along an outline than
    pixel by pixel; what lies beside narrow faces passes for noise of the pixels and does not move an outline. Every
    piece's own shift, against what its pixels' variances and the fit's freedom lead one to expect, tells.

    Args:
        fit: of N outlines; its first two parameters are the centre.
        weights: (N, K) inverse variances, 0 for padding. [1/DN^2]
        x_px, y_px: (N, K) places about the centres.

    Returns:
        Factor in the variance of the frame's outlines.
    """
    # Along the outline the derivative by the centre is as steep as the edge; elsewhere no pixel tells of its place.
    sums = np.zeros((len(weights), _PIECES, 2 + fit.jacobian.shape[1]))
    piece_sums(x_px, y_px, fit.jacobian, fit.residuals, weights, np.float32(_STEEP_SHARE), sums)
    shift, alone, coupled = sums[..., 0], np.maximum(sums[..., 1], _TINY), sums[..., 2:]
    swallowed = np.einsum("nsp,nsp->ns", np.matmul(coupled, fit.covariance()), coupled)
    found = (shift**2 / alone).sum(axis=1)
    expected = np.maximum((1 - swallowed / alone).sum(axis=1), 1.0)
    usual = found / expected <= _ODD_FACTOR * np.median(found / expected)
    return float((found[usual].sum() + _PRIOR_PIECES) / (expected[usual].sum() + _PRIOR_PIECES))


def beyond_linear(cov_px2: Array) -> Array:
    """Covariances of centres, widened by what the derivatives at the solution do not tell of faint discs.

    Where the noise moves a centre by a fifth of a pixel, a third of an edge's width, its square is twice what they say;
    half as much adds a quarter (measured on discs of 3 to 20 px and contrasts of 1.5 to 6 deviations of a pixel).

    Args:
        cov_px2: (N, 2, 2). [px^2]
    """
    variance = np.einsum("nii->n", cov_px2) / 2
    widened: Array = cov_px2 * (1 + variance / _NOT_LINEAR_PX**2)[:, None, None]
    return widened
