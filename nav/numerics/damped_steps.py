"""Damped normal equations of few unknowns, solved by compiled loops."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.numerics.compiled import compiled


@compiled
def solve_damped(matrix: Array, scale: Array, gradient: Array, damping: float, root: Array, step: Array) -> None:
    """Fill the solution (P,) of a system with a matrix (P, P) and a right side (P,), by Cholesky.

    Rows and columns are scaled (P,), and then the damping added to the diagonal. What a matrix that is not positive
    would give is no number. (P, P) numbers of `root` are overwritten.
    """
    size = len(gradient)
    for i in range(size):
        for j in range(i + 1):
            rest = matrix[i, j] * scale[i] * scale[j] + (damping if i == j else 0.0)
            for m in range(j):
                rest -= root[i, m] * root[j, m]
            root[i, j] = np.sqrt(rest) if i == j else rest / root[j, j]
    for i in range(size):
        rest = gradient[i] * scale[i]
        for m in range(i):
            rest -= root[i, m] * step[m]
        step[i] = rest / root[i, i]
    for back in range(size):
        i = size - 1 - back
        rest = step[i]
        for m in range(i + 1, size):
            rest -= root[m, i] * step[m]
        step[i] = rest / root[i, i]
    for i in range(size):
        step[i] *= scale[i]


@compiled
def damped_steps(matrices: Array, scales: Array, gradients: Array, dampings: Array) -> Array:
    """Solutions (N, P) of systems with matrices (N, P, P), scales and right sides (N, P) and dampings (N,)."""
    count, size = gradients.shape
    steps, root = np.empty((count, size)), np.empty((size, size))
    for n in range(count):
        solve_damped(matrices[n], scales[n], gradients[n], dampings[n], root, steps[n])
    return steps
