"""Compiled loops of least squares over many small problems; see `nav.numerics.levenberg_marquardt`."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.numerics.compiled import Array32, compiled


@compiled
def multiply_rows(left: Array32, right: Array32, factor: np.float32, product: Array32) -> None:
    """Fill `product` with the factor times left times right."""
    for k in range(len(left)):
        product[k] = factor * left[k] * right[k]


@compiled
def add_row(values: Array32, factor: np.float32, total: Array32) -> None:
    """Add the factor times the values to a total."""
    for k in range(len(values)):
        total[k] += factor * values[k]


@compiled
def dot(left: Array32, right: Array32) -> np.float32:
    """Sum of products."""
    total = np.float32(0)
    for k in range(len(left)):
        total += left[k] * right[k]
    return total


_ZERO, _ONE = np.float32(0), np.float32(1)


@compiled
def normal_equations(jacobian: Array32, residuals: Array32, weights: Array32, normal: Array, gradient: Array) -> None:
    """Fill (N, P, P) matrices `J W J^T` and (N, P) gradients `J W r`."""
    weighted = np.empty_like(residuals[0])
    for n in range(len(jacobian)):
        rows = jacobian[n]
        for p in range(len(rows)):
            multiply_rows(rows[p], weights[n], _ONE, weighted)
            gradient[n, p] = dot(weighted, residuals[n])
            for other in range(p + 1):
                normal[n, p, other] = normal[n, other, p] = dot(weighted, rows[other])


@compiled
def weighted_products(left: Array32, right: Array32, weights: Array32, coupled: Array) -> None:
    """Fill (N, P, Q) sums of products of rows (N, P, K) and (N, Q, K) with weights (N, K)."""
    weighted = np.empty_like(weights[0])
    for n in range(len(left)):
        for q in range(right.shape[1]):
            multiply_rows(right[n, q], weights[n], _ONE, weighted)
            for p in range(left.shape[1]):
                coupled[n, p, q] = dot(left[n, p], weighted)


@compiled
def add_rows(rows: Array32, factors: Array32, total: Array32) -> None:
    """Add rows (N, P, K), times factors (N, P), to totals (N, K)."""
    for n in range(len(rows)):
        for p in range(rows.shape[1]):
            add_row(rows[n, p], factors[n, p], total[n])


@compiled
def leverages(jacobian: Array32, roots: Array32, weights: Array32, filled: Array32) -> None:
    """Fill (N, K) `w |R^T J|^2` with lower triangular roots R (N, P, P) of the covariances."""
    swallowed = np.empty_like(weights[0])
    for n in range(len(jacobian)):
        own = filled[n]
        own[:] = _ZERO
        for column in range(jacobian.shape[1]):
            swallowed[:] = _ZERO
            for p in range(column, jacobian.shape[1]):
                add_row(jacobian[n, p], roots[n, p, column], swallowed)
            for k in range(len(own)):
                own[k] += swallowed[k] * swallowed[k]
        for k in range(len(own)):
            own[k] *= weights[n, k]


@compiled
def weighted_squares(residuals: Array32, weights: Array32) -> Array:
    """(N,) sums of `w r^2`."""
    costs = np.empty(len(residuals))
    for n in range(len(residuals)):
        total = _ZERO
        for k in range(residuals.shape[1]):
            total += weights[n, k] * residuals[n, k] * residuals[n, k]
        costs[n] = total
    return costs


@compiled
def constrain_jacobian(jacobian: Array32, ties: Array32, tied: Array32) -> None:
    """Fill derivatives (N, Q, K) by free parameters, of which ties (N, T, R) move the first R of (N, P, K)."""
    count, followers = ties.shape[1], ties.shape[2]
    for n in range(len(jacobian)):
        for q in range(count):
            tied[n, q, :] = _ZERO
            for p in range(followers):
                if ties[n, q, p] != _ZERO:
                    add_row(jacobian[n, p], ties[n, q, p], tied[n, q])
        for p in range(followers, jacobian.shape[1]):
            tied[n, count + p - followers] = jacobian[n, p]


@compiled
def solve_damped(matrix: Array, scale: Array, gradient: Array, damping: float, root: Array, step: Array) -> None:
    """Fill the solution (P,) of a system with a matrix (P, P) and a right side (P,), by Cholesky decomposition.

    Rows and columns are scaled by (P,), and then the damping is added to the diagonal. A matrix that is not positive
    definite gives NaN. `root` (P, P) is overwritten.
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
