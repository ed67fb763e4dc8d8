"""Levenberg-Marquardt for many small problems of one form at once, and the compiled loops of least squares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from geometry.se3 import Array
from nav.numerics.cholesky import damped_solutions, inverses
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


# Values (N, K) and their derivatives (N, P, K) at (N, P) parameters, in new arrays, which the caller may change.
Model = Callable[[Array], tuple[Array32, Array32]]

_FIRST_DAMPING = 1e-4
_SMALLEST_DAMPING = 1e-9
# Keeps a parameter that no pixel depends on at its value.
_TINY_CURVATURE = 1e-12
# Added to a normal matrix with unit diagonal: the uncertainty of single precision.
_RIDGE = 1e-6
# Relative change of the cost that is below the rounding of single precision.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of N problems; each part is computed at its first use, which many problems never reach.

    Attributes:
        jacobian: (N, P, K).
        residuals: (N, K).
        weights: (N, K).
    """

    jacobian: Array32
    residuals: Array32
    weights: Array32

    @cached_property
    def _products(self) -> tuple[Array, Array]:
        """(N, P, P) normal matrices `J W J^T` and (N, P) gradients."""
        count, size, _ = self.jacobian.shape
        normal, gradient = np.empty((count, size, size)), np.empty((count, size))
        normal_equations(self.jacobian, self.residuals, self.weights, normal, gradient)
        return normal, gradient

    @cached_property
    def _scales(self) -> Array:
        """(N, P) scales that bring the diagonal to one."""
        diagonal = np.einsum("npp->np", self._products[0])
        scales: Array = 1 / np.sqrt(np.maximum(diagonal, _TINY_CURVATURE))
        return scales

    @cached_property
    def inverse(self) -> Array:
        """(N, P, P) inverse matrices, kept invertible by a ridge on the matrices scaled to a unit diagonal."""
        return inverses(self._products[0], self._scales, _RIDGE)

    def step(self, damping: Array) -> Array:
        """(N, P) steps with (N,) dampings."""
        normal, gradient = self._products
        return damped_solutions(normal, self._scales, gradient, damping + _RIDGE)


@dataclass(frozen=True, eq=False)
class Minimum:
    """The point at which the iteration ended.

    Attributes:
        parameters: (N, P).
        residuals: (N, K) data minus model.
        jacobian: (N, P, K).
        normal: the normal equations there.
    """

    parameters: Array
    residuals: Array32
    jacobian: Array32
    normal: NormalEquations

    def covariance(self) -> Array:
        """(N, P, P) inverse of the normal matrices."""
        return self.normal.inverse

    def after_linear_step(self, residuals: Array32, weights: Array32) -> Minimum:
        """The minimum after one undamped linear step from here with other residuals and weights, (N, K) each."""
        gradient = np.empty((*self.parameters.shape, 1))
        weighted_products(self.jacobian, residuals[:, None], weights, gradient)
        step = np.matmul(self.covariance(), gradient)[..., 0]
        left = residuals.copy()
        add_rows(self.jacobian, -step.astype(np.float32), left)
        return replace(self, parameters=self.parameters + step, residuals=left)

    def leverages(self, covariance: Array, weights: Array32) -> Array32:
        """(N, K) leverages: the share of each pixel's noise that the fit follows."""
        filled = np.empty_like(weights)
        leverages(self.jacobian, np.linalg.cholesky(covariance).astype(np.float32), weights, filled)
        return filled


def evaluate(model: Model, data: Array32, weights: Array32, parameters: Array) -> Minimum:
    """Evaluate the model at (N, P) parameters as the start of an iteration; other arguments as for `minimise`."""
    values, jacobian = model(parameters)
    residuals = data - values
    normal = NormalEquations(jacobian, residuals, weights)
    return Minimum(parameters, residuals, jacobian, normal)


def minimise(
    model: Model, data: Array32, weights: Array32, start: Minimum, most_steps: int, small_step_px: float
) -> Minimum:
    """Weighted least squares of `data - model`; the first two parameters are a position in pixels.

    Args:
        model: values and derivatives.
        data: (N, K).
        weights: (N, K), 0 for padding.
        start: an evaluated start, or the end of an iteration with other weights.
        most_steps: largest number of evaluations of the model.
        small_step_px: the iteration ends when no position moves by more. [px]
    """
    parameters, residuals, jacobian = start.parameters, start.residuals, start.jacobian
    cost = _costs(residuals, weights)
    damping = np.full(len(parameters), _FIRST_DAMPING)
    normal = NormalEquations(jacobian, residuals, weights)
    for _ in range(most_steps):
        step = normal.step(damping)
        tried = parameters + step
        # A diverging step may overflow: its cost is infinite then, and the step is rejected.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            values, new_jacobian = model(tried)
            new_residuals = data - values
            new_cost = _costs(new_residuals, weights)
        better = new_cost <= cost * (1 + _ROUNDING)
        worse = np.flatnonzero(~better)
        if len(worse):
            for new, old in (tried, parameters), (new_cost, cost), (new_residuals, residuals), (new_jacobian, jacobian):
                new[worse] = old[worse]
        parameters, cost, residuals, jacobian = tried, new_cost, new_residuals, new_jacobian
        damping = np.where(better, np.maximum(damping / 10, _SMALLEST_DAMPING), damping * 10)
        converged = np.abs(step[:, :2]).max(axis=1) < small_step_px
        normal = NormalEquations(jacobian, residuals, weights)
        if converged.all():
            break
    return Minimum(parameters, residuals, jacobian, normal)


def _costs(residuals: Array32, weights: Array32) -> Array:
    costs = weighted_squares(residuals, weights)
    return np.where(np.isfinite(costs), costs, np.inf)
