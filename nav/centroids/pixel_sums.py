"""Sums over the pixels of outlines by where they lie, compiled; see `nav.centroids.centroid_quality`."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.numerics.compiled import Array32, compiled

_F = np.float32
_ONE, _HALF, _QUARTER = _F(1), _F(0.5), _F(0.25)
# Keeps the middle of an outline, which lies in no sector, in one.
_TINY_SINGLE = _F(1e-12)


# Of Abramowitz and Stegun's polynomial of the arc tangent (4.4.49), as shares of a turn.
_ATAN = (0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351)
_ATAN_1, _ATAN_2, _ATAN_3, _ATAN_4, _ATAN_5 = (_F(a / (2 * np.pi)) for a in _ATAN)


@compiled
def _sector(x: np.float32, y: np.float32, count: int) -> int:
    """Which of so many equal sectors about the origin a place lies in, their limits to 1e-5 radians."""
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
    """Fill sums along outlines, by pieces, for `nav.centroids.centroid_quality.edge_noise_factor`.

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
    sums = np.zeros((len(squares), 1 + len(zones), 2))
    for n in range(len(squares)):
        for k in range(squares.shape[1]):
            if present[n, k] == _F(0):
                continue
            sums[n, 0, 0] += squares[n, k]
            sums[n, 0, 1] += 1.0
            for zone in range(len(zones)):
                if zones[zone, 0] < inside[n, k] < zones[zone, 1]:
                    sums[n, 1 + zone, 0] += squares[n, k]
                    sums[n, 1 + zone, 1] += 1.0
    return sums
