"""Uncertainty of fitted centres: pixel noise from the residuals, their spread about the outline, and covariances.

The sums over pixels are compiled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.centroids.outline_pixels import OutlinePixels
from nav.numerics.compiled import Array32, compiled
from nav.numerics.levenberg_marquardt import Minimum
from nav.numerics.medians import median

_F = np.float32
_ONE, _HALF, _QUARTER = _F(1), _F(0.5), _F(0.25)
# Puts the middle of an outline, which lies in no sector, into one.
_TINY_SINGLE = _F(1e-12)


# Of Abramowitz and Stegun's polynomial of the arc tangent (4.4.49), as shares of a turn.
_ATAN = (0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351)
_ATAN_1, _ATAN_2, _ATAN_3, _ATAN_4, _ATAN_5 = (_F(a / (2 * np.pi)) for a in _ATAN)


@compiled
def _sector(x: np.float32, y: np.float32, count: int) -> int:
    """Index of the sector, of `count` equal ones about the origin, that holds a position; limits to 1e-5 radians."""
    wide, high = abs(x), abs(y)
    slope = min(wide, high) / (max(wide, high) + _TINY_SINGLE)
    square = slope * slope
    turn = slope * (_ATAN_1 + square * (_ATAN_2 + square * (_ATAN_3 + square * (_ATAN_4 + square * _ATAN_5))))
    turn = _QUARTER - turn if high > wide else turn
    turn = _HALF - turn if x < _F(0) else turn
    turn = _ONE - turn if y < _F(0) else turn
    return min(int(turn * _F(count)), count - 1)


@compiled
def piece_sums(
    x: Array32,
    y: Array32,
    jacobian: Array32,
    residuals: Array32,
    weights: Array32,
    steep_share: np.float32,
    sums: Array,
) -> None:
    """Fill sums along outlines, by pieces, for `nav.centroids.centroid_uncertainty.edge_noise_factor`.

    Args:
        x, y: (N, K) places about the centres.
        jacobian: (N, P, K), first by the centre.
        residuals, weights: (N, K).
        steep_share: of the steepest pixel's slope, from which on a pixel lies on the outline.
        sums: (N, S, 2 + P) of weights and slopes times residuals, slopes, and derivatives, of zeros.
    """
    pieces, steep = sums.shape[1], np.empty_like(x[0])
    for n in range(len(x)):
        by_x, by_y = jacobian[n, 0], jacobian[n, 1]
        most = _F(0)
        for k in range(len(steep)):
            steep[k] = np.sqrt(by_x[k] * by_x[k] + by_y[k] * by_y[k])
        for k in range(len(steep)):
            most = max(most, steep[k])
        for k in range(len(steep)):
            if not steep[k] > steep_share * most or weights[n, k] == _F(0):
                continue
            own = sums[n, _sector(x[n, k], y[n, k], pieces)]
            weight = weights[n, k] * steep[k]
            own[0] += weight * residuals[n, k]
            own[1] += weight * steep[k]
            for p in range(jacobian.shape[1]):
                own[2 + p] += weight * jacobian[n, p, k]


@compiled
def sector_sums(x: Array32, y: Array32, residuals: Array32, weights: Array32, count: int) -> Array:
    """(N, S, 3) sums of w, w r and w r^2 by sectors about the origin."""
    sums = np.zeros((len(x), count, 3))
    for n in range(len(x)):
        for k in range(x.shape[1]):
            weight, residual = weights[n, k], residuals[n, k]
            if weight == _F(0):
                continue
            own = sums[n, _sector(x[n, k], y[n, k], count)]
            own[0] += weight
            own[1] += weight * residual
            own[2] += weight * residual * residual
    return sums


@compiled
def zone_sums(squares: Array32, present: Array32, inside: Array32, zones: Array32) -> Array:
    """(N, 1 + Z, 2) sums of squares, and counts, of all pixels and of those with shares inside within (Z, 2) zones."""
    sums = np.empty((len(squares), 1 + len(zones), 2))
    for n in range(len(squares)):
        # The first sums are of all pixels. Without branches the compiler processes many pixels at once.
        for zone in range(1 + len(zones)):
            everywhere = zone == 0
            low, high = zones[zone - 1, 0], zones[zone - 1, 1]
            total, count = 0.0, 0.0
            for k in range(squares.shape[1]):
                is_own = (present[n, k] > _F(0)) & (everywhere | ((low < inside[n, k]) & (inside[n, k] < high)))
                count += 1.0 if is_own else 0.0
                total += float(squares[n, k]) if is_own else 0.0
            sums[n, zone, 0], sums[n, zone, 1] = total, count
    return sums


# Rounding to integers. [DN^2]
_QUANTISATION_DN2 = 1 / 12
# Shares of light from within that count as outside, as the edge, and as inside.
_ZONES = np.array([(-np.inf, 0.03), (0.2, 0.8), (0.97, np.inf)], np.float32)
# Outlines with residuals this far above the median are not used to measure the sensor's noise.
_ODD_FACTOR = 3.0
# Least variance beside a marker, as a share of that on it: quantisation may hide the noise of a dark background.
_LEAST_DARK_SHARE = 0.05
SECTORS = 8
# Pieces of an outline, twice as many as the fit of an ellipse follows.
_PIECES = 16
# Weight of a prior factor of one, in pieces: few pieces determine the factor badly.
_PRIOR_PIECES = 8.0
_STEEP_SHARE = 0.03
_TINY = 1e-12
# Standard deviation of a centre at which a linear fit states half the variance.
_NOT_LINEAR_PX = 0.2
# A shadow or an object before the disc moves a sector's mean by more than this many standard deviations and this share
# of the contrast; smaller residuals move the centre by less than the noise of one edge pixel.
_SECTOR_SIGMA = 4.0
_SECTOR_SHARE = 0.04
# Mean square of a sector's summed noise that 5 % of even discs exceed (chi-square of 8).
_USUAL_SECTOR_CHI2 = 1.94


@dataclass(frozen=True)
class NoiseModel:
    """Variance of a pixel by its level, from the images themselves.

    Attributes:
        dark_dn2: beside the markers.
        per_signal_dn: shot noise: growth with the signal above the background.
        edge_share2: further variance on an edge, in squared steps of light (render noise, unevenness of the pixels).
        edge_factor: variance on edges over that predicted from the other zones, at most 1: objects beside an outline
            count as noise there.
    """

    dark_dn2: float
    per_signal_dn: float
    edge_share2: float
    edge_factor: float = 1.0

    def variances(self, inside: Array32, contrast: Array32) -> Array32:
        """Variances of pixels whose share `inside` of the light is `contrast` above the background. [DN^2]"""
        shot = np.float32(self.per_signal_dn) * np.maximum(contrast, 0) * inside
        edge = np.float32(4 * self.edge_share2) * contrast * contrast * inside * (1 - inside)
        variances: Array32 = np.float32(self.dark_dn2) + shot + edge
        return variances


def measure_noise(squares: Array32, present: Array32, inside: Array32, contrast: Array) -> NoiseModel:
    """Noise from the squared residuals of many outlines.

    Args:
        squares: (N, K) squared residuals, corrected for the leverages of the fit. [DN^2]
        present: (N, K) 0 for padding.
        inside: (N, K) share of the light from within.
        contrast: (N,) [DN]
    """
    sums = zone_sums(squares, present, inside, _ZONES)
    mean = sums[:, 0, 0] / np.maximum(sums[:, 0, 1], 1)
    usual = mean <= _ODD_FACTOR * median(mean)
    level = median(contrast[usual])
    totals, counts = sums[usual, 1:].sum(axis=0).T
    dark, edge, bright = (totals / np.maximum(counts, 1)).tolist()
    dark = max(dark, _LEAST_DARK_SHARE * bright, _QUANTISATION_DN2)
    bright = max(bright, dark)
    mean_shape = 0.83  # of 4 S (1 - S) over the edge's zone
    usual_edge = (dark + bright) / 2
    further = max(0.0, edge - usual_edge) / mean_shape
    # One pixel of the predicted variance is added, which gives a factor of one without any edge pixels.
    factor = min((totals[1] / usual_edge + 1) / (counts[1] + 1), 1.0)
    return NoiseModel(dark, (bright - dark) / max(level, 1e-6), further / max(level, 1e-6) ** 2, float(factor))


@dataclass(frozen=True, eq=False)
class ResidualSpread:
    """Statistics of the residuals of N fits.

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
        """(N,) whether a shadow or an object before the disc shows in the residuals."""
        found: NDArray[np.bool_] = (self.worst_sector_sigma > _SECTOR_SIGMA) & (self.worst_sector_share > _SECTOR_SHARE)
        return found

    @property
    def inflation(self) -> Array:
        """(N,) factor by which correlated residuals widen the covariance."""
        factor: Array = np.maximum(1.0, self.sector_chi2 / _USUAL_SECTOR_CHI2)
        return factor


def residual_spread(
    residuals: Array32, weights: Array32, pixels: OutlinePixels, sectors: int, contrast: Array, fitted: int
) -> ResidualSpread:
    """Residuals summed over the patch and over sectors.

    Args:
        residuals: (N, K). [DN]
        weights: (N, K) inverse variances, 0 for padding. [1/DN^2]
        pixels: of the residuals.
        sectors: their number about the centre.
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
    """Variance of the shifts of an outline's pieces over the variance that the pixels' noise predicts.

    Noise that a lens spreads over neighbouring pixels, such as a renderer's, is stronger along an outline than pixel by
    pixel. Light from beside narrow faces counts as noise of the pixels and does not move an outline. The factor
    compares the shift of every piece with its expectation from the pixels' variances and the fit's leverage.

    Args:
        fit: of N outlines; its first two parameters are the centre.
        weights: (N, K) inverse variances, 0 for padding. [1/DN^2]
        x_px, y_px: (N, K) places about the centres.

    Returns:
        The factor, common to all outlines of the frame.
    """
    # The derivative by the centre is the edge's slope along the outline, and about zero elsewhere.
    sums = np.zeros((len(weights), _PIECES, 2 + fit.jacobian.shape[1]))
    piece_sums(x_px, y_px, fit.jacobian, fit.residuals, weights, np.float32(_STEEP_SHARE), sums)
    shift, alone, coupled = sums[..., 0], np.maximum(sums[..., 1], _TINY), sums[..., 2:]
    swallowed = np.einsum("nsp,nsp->ns", np.matmul(coupled, fit.covariance()), coupled)
    found = (shift**2 / alone).sum(axis=1)
    expected = np.maximum((1 - swallowed / alone).sum(axis=1), 1.0)
    usual = found / expected <= _ODD_FACTOR * median(found / expected)
    return float((found[usual].sum() + _PRIOR_PIECES) / (expected[usual].sum() + _PRIOR_PIECES))


def widen_for_nonlinearity(cov_px2: Array) -> Array:
    """Covariances of centres, widened for the nonlinearity of the fits of faint discs.

    Where noise moves a centre by a fifth of a pixel, a third of an edge's width, the variance is twice the linear one;
    half that shift adds a quarter (measured on discs of 3 to 20 px and contrasts of 1.5 to 6 deviations of a pixel).

    Args:
        cov_px2: (N, 2, 2). [px^2]
    """
    variance = np.einsum("nii->n", cov_px2) / 2
    widened: Array = cov_px2 * (1 + variance / _NOT_LINEAR_PX**2)[:, None, None]
    return widened
