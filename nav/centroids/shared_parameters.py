"""What many outlines have in common, fitted beside what each has of its own."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum
from nav.numerics.matrix_loops import couplings, normal_equations

# Of a normal matrix with unit diagonal: what light too dim cannot tell apart is shared out.
_RIDGE = 1e-3


def reduced_equations(fit: Minimum, pictures: Array32, weights: Array32) -> tuple[Array, Array]:
    """Normal equations of shared amounts of pictures, outline by outline, its own parameters left free.

    Args:
        fit: of N outlines.
        pictures: (N, S, K) by what the shared amounts change the data.
        weights: (N, K).

    Returns:
        (N, S, S) matrices and (N, S) gradients, whose sums are those of the amounts.
    """
    count, shared = fit.parameters.shape[1], pictures.shape[1]
    pictures = np.ascontiguousarray(pictures)
    coupled, slopes = np.empty((len(weights), count, shared)), np.empty((len(weights), count, 1))
    couplings(fit.jacobian, pictures, weights, coupled)
    couplings(fit.jacobian, fit.residuals[:, None], weights, slopes)
    normal, gradient = np.empty((len(weights), shared, shared)), np.empty((len(weights), shared))
    normal_equations(pictures, fit.residuals, weights, normal, gradient)
    taken = np.matmul(fit.covariance(), coupled)
    gradient -= np.einsum("nps,np->ns", taken, slopes[..., 0])
    normal -= np.matmul(coupled.transpose(0, 2, 1), taken)
    return normal, gradient


def least_of_all(normal: Array, gradient: Array) -> Array:
    """(S,) amounts that solve summed equations."""
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), np.finfo(np.float32).tiny))
    unit = normal * scale[:, None] * scale + _RIDGE * np.eye(len(scale))
    amounts: Array = scale * np.linalg.solve(unit, gradient * scale)
    return amounts
