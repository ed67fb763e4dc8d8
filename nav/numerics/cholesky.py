"""Cholesky's decomposition of small matrices, for which calls of LAPACK take longer than the work, compiled."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.numerics.compiled import compiled

# Of a unit diagonal; more would help no matrix that holds numbers.
_MOST_DAMPING = 1.0


@compiled
def factorise(matrix: Array, scale: Array, damping: float, lower: Array) -> float:
    """Fill the lower factor (P, P) of a matrix (P, P) whose rows and columns are scaled by (P,).

    Args:
        matrix: symmetric; only its lower triangle is read.
        scale: mostly what brings the diagonal to one, so that pivots can be compared with rounding.
        damping: added to the scaled diagonal.
        lower: filled up to its diagonal; no numbers from the first pivot on that is not above zero.

    Returns:
        The least pivot; zero, negative or NaN for a matrix that is not positive definite.
    """
    least = np.inf
    for i in range(len(matrix)):
        for j in range(i + 1):
            rest = matrix[i, j] * scale[i] * scale[j] + (damping if i == j else 0.0)
            for m in range(j):
                rest -= lower[i, m] * lower[j, m]
            if i == j and not rest >= least:
                least = rest
            lower[i, j] = np.sqrt(rest) if i == j else rest / lower[j, j]
    return least


@compiled
def solve(lower: Array, scale: Array, right: Array, solution: Array) -> None:
    """Fill the solution (P,) of a system with the matrix of a factor, see `factorise`, and a right side (P,)."""
    size = len(right)
    for i in range(size):
        rest = right[i] * scale[i]
        for m in range(i):
            rest -= lower[i, m] * solution[m]
        solution[i] = rest / lower[i, i]
    for back in range(size):
        i = size - 1 - back
        rest = solution[i]
        for m in range(i + 1, size):
            rest -= lower[m, i] * solution[m]
        solution[i] = rest / lower[i, i]
    for i in range(size):
        solution[i] *= scale[i]


@compiled
def invert(lower: Array, scale: Array, root: Array, inverse: Array) -> None:
    """Fill the first rows and columns (Q, Q), Q <= P, of the inverse of the matrix of a factor, see `factorise`.

    `root` (P, P) is overwritten, up to its diagonal, by the factor's inverse.
    """
    size = len(lower)
    for j in range(size):
        for i in range(j, size):
            rest = 1.0 if i == j else 0.0
            for m in range(j, i):
                rest -= lower[i, m] * root[m, j]
            root[i, j] = rest / lower[i, i]
    for i in range(len(inverse)):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, size):
                total += root[k, i] * root[k, j]
            inverse[i, j] = inverse[j, i] = total * scale[i] * scale[j]


@compiled
def inverses(matrices: Array, scales: Array, damping: float) -> Array:
    """(N, P, P) inverses of matrices with scales (N, P) that bring their diagonals to one.

    A matrix that rounding has left indefinite gets ten times the damping, and as often as it needs that.
    """
    inverted, size = np.empty_like(matrices), matrices.shape[1]
    lower, root = np.empty((size, size)), np.empty((size, size))
    for n in range(len(matrices)):
        own = damping
        while not factorise(matrices[n], scales[n], own, lower) > 0 and own < _MOST_DAMPING:
            own *= 10
        invert(lower, scales[n], root, inverted[n])
    return inverted


@compiled
def damped_solutions(matrices: Array, scales: Array, rights: Array, dampings: Array) -> Array:
    """Solutions (N, P) of systems with matrices (N, P, P), scales and right sides (N, P) and dampings (N,)."""
    count, size = rights.shape
    solutions, lower = np.empty((count, size)), np.empty((size, size))
    for n in range(count):
        factorise(matrices[n], scales[n], dampings[n], lower)
        solve(lower, scales[n], rights[n], solutions[n])
    return solutions
