"""The compiled loops of least squares against numpy."""

from __future__ import annotations

import numpy as np

from nav.numerics import levenberg_marquardt


def float32(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.normal(size=shape).astype(np.float32)


def test_sums_of_least_squares_are_those_of_numpy() -> None:
    rng = np.random.default_rng(1)
    jacobian, residuals, weights = float32(rng, 5, 7, 300), float32(rng, 5, 300), rng.random((5, 300), np.float32)
    normal, gradient = np.empty((5, 7, 7)), np.empty((5, 7))
    levenberg_marquardt.normal_equations(jacobian, residuals, weights, normal, gradient)
    exact = jacobian.astype(np.float64)
    # Single precision over 300 products of numbers around one.
    close = {"rtol": 1e-5, "atol": 1e-3}
    np.testing.assert_allclose(normal, np.einsum("npk,nk,nqk->npq", exact, weights, exact), **close)
    np.testing.assert_allclose(gradient, np.einsum("npk,nk,nk->np", exact, weights, residuals), **close)
    coupled, others = np.empty((5, 7, 2)), float32(rng, 5, 2, 300)
    levenberg_marquardt.weighted_products(jacobian, others, weights, coupled)
    np.testing.assert_allclose(coupled, np.einsum("npk,nk,nqk->npq", exact, weights, others), **close)
    np.testing.assert_allclose(
        levenberg_marquardt.weighted_squares(residuals, weights),
        (weights * residuals.astype(np.float64) ** 2).sum(axis=1),
        **close,
    )
    covariance = np.linalg.inv(normal)
    filled = np.empty_like(weights)
    levenberg_marquardt.leverages(jacobian, np.linalg.cholesky(covariance).astype(np.float32), weights, filled)
    np.testing.assert_allclose(filled, weights * np.einsum("npk,npq,nqk->nk", exact, covariance, exact), rtol=1e-4)
    # A fit swallows as many pixels' worth of noise as it has parameters.
    np.testing.assert_allclose(filled.sum(axis=1), 7, rtol=1e-4)
