"""Matrices that turn pixel residuals of a feature in both eyes into independent ones of unit variance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.pinhole import PinholeCamera
from geometry.se3 import Array


def whiten(pixels_px: Array, cov_px2: Array) -> Array:
    """Pixels, and for each the whitening matrix `[[a, 0], [b, c]]` of its own covariance.

    Args:
        pixels_px: (B, E, F, 2), nan where nothing was measured.
        cov_px2: (B, E, F, 2, 2) or what broadcasts to it.

    Returns:
        (5, B, E, F) horizontal and vertical pixel, a, b, c; all zero where nothing was measured, or where the
        covariance is not positive.
    """
    cov = np.broadcast_to(cov_px2, (*pixels_px.shape, 2))
    # Not measured is nan; comparisons with nan are false, so the roots below are taken of sound numbers only.
    seen = np.isfinite(pixels_px).all(axis=-1) & (cov[..., 0, 0] > 0)
    a, b, c = _factors(cov[..., 0, 0], cov[..., 0, 1], cov[..., 1, 1], seen)
    measured: Array = np.where(c > 0, np.stack([pixels_px[..., 0], pixels_px[..., 1], a, b, c]), 0.0)
    return measured


def whiten_displaced(
    camera: PinholeCamera, measured: Array, depths_m: Array, displacement_m: Array
) -> tuple[Array, Array]:
    """The same where each feature may also stand apart from its place, by one displacement that both eyes see.

    Args:
        camera: of both eyes.
        measured: as from `whiten`, of one eye or two.
        depths_m: (B,) of the drogue.
        displacement_m: (F,) standard deviation along each axis.

    Returns:
        `measured` with other matrices, and (4, B, F) entries of the matrices `X`, by rows, that are to be added to the
        second eye's whitened residuals as `X @ (those of the first)`; zero with one eye.

    Source: block Cholesky factor of the covariance of the feature's four coordinates.
    """
    u, v = measured[:2]
    slopes = np.stack([(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px])
    scale = displacement_m / depths_m[:, None]
    out, coupling = measured.copy(), np.zeros((4, *scale.shape))
    first = _add(measured[2:, :, 0], _shared(camera, scale, slopes[:, :, 0], slopes[:, :, 0]))
    out[2:, :, 0] = first
    if u.shape[1] == 1:
        return out, coupling
    # M = K L^T with K the covariance of the second eye with the first and L the first's whitening matrix.
    (uu, uv), (vu, vv) = _shared(camera, scale, slopes[:, :, 1], slopes[:, :, 0])
    l_a, l_b, l_c = first
    m = [[uu * l_a, uu * l_b + uv * l_c], [vu * l_a, vu * l_b + vv * l_c]]
    own = _shared(camera, scale, slopes[:, :, 1], slopes[:, :, 1])
    rest = [[own[i][j] - m[i][0] * m[j][0] - m[i][1] * m[j][1] for j in range(2)] for i in range(2)]
    second = _add(measured[2:, :, 1], rest)
    out[2:, :, 1] = second
    r_a, r_b, r_c = second
    coupling[0], coupling[1] = -r_a * m[0][0], -r_a * m[0][1]
    coupling[2], coupling[3] = -(r_b * m[0][0] + r_c * m[1][0]), -(r_b * m[0][1] + r_c * m[1][1])
    return out, coupling


def _shared(camera: PinholeCamera, scale: Array, row: Array, column: Array) -> list[list[Array]]:
    """Covariance that a displacement of both brings: 2x2 entries (B, F) of `scale^2 T T^T`. [px^2]

    A displacement `d` at depth z moves an image by `f / z (d_x - d_z x / z)`, and likewise in y.
    """
    fx, fy = scale * camera.fx_px, scale * camera.fy_px
    return [
        [fx * fx * (1 + row[0] * column[0]), fx * fy * row[0] * column[1]],
        [fx * fy * row[1] * column[0], fy * fy * (1 + row[1] * column[1])],
    ]


def _add(factors: Array, more: list[list[Array]]) -> Array:
    """(3, B, F) entries a, b, c of the whitening matrix of a covariance, given by its own, plus another one."""
    a, b, c = factors
    seen = c > 0
    safe_a, safe_c = np.where(seen, a, 1.0), np.where(seen, c, 1.0)
    # [[a, 0], [b, c]]^-1 = [[1 / a, 0], [-b / (a c), 1 / c]] is the covariance's lower factor.
    p, q, r = 1 / safe_a, -np.where(seen, b, 0.0) / (safe_a * safe_c), 1 / safe_c
    return _factors(p * p + more[0][0], p * q + more[0][1], q * q + r * r + more[1][1], seen)


def _factors(first: Array, across: Array, second: Array, seen: NDArray[np.bool_]) -> Array:
    """Entries a, b, c of the whitening matrices of covariances `[[first, across], [across, second]]`, else zero."""
    first = np.where(seen, first, 1.0)
    across = np.where(seen, across, 0.0)
    rest = np.where(seen, second, 1.0) - across**2 / first
    seen = seen & (rest > 0)
    a = 1 / np.sqrt(first)
    c = 1 / np.sqrt(np.where(seen, rest, 1.0))
    factors: Array = np.where(seen, np.stack([a, -across / first * c, c]), 0.0)
    return factors
