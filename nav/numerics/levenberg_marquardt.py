"""Levenberg-Marquardt for many small problems of one form at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from geometry.se3 import Array
from nav.numerics.compiled import Array32
from nav.numerics.least_squares_loops import (
    add_rows,
    damped_steps,
    leverages,
    normal_equations,
    weighted_products,
    weighted_squares,
)

# Values (N, K) and their derivatives (N, P, K) at (N, P) parameters.
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
        scales = self._scales[:, :, None] * self._scales[:, None, :]
        inverse: Array = np.linalg.inv(self._products[0] * scales + _RIDGE * np.eye(scales.shape[1])) * scales
        return inverse

    def step(self, damping: Array) -> Array:
        """(N, P) steps with (N,) dampings."""
        normal, gradient = self._products
        return damped_steps(normal, self._scales, gradient, damping + _RIDGE)


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
        if better.all():
            parameters, cost, residuals, jacobian = tried, new_cost, new_residuals, new_jacobian
        else:
            parameters = np.where(better[:, None], tried, parameters)
            cost = np.where(better, new_cost, cost)
            residuals = np.where(better[:, None], new_residuals, residuals)
            jacobian = np.where(better[:, None, None], new_jacobian, jacobian)
        damping = np.where(better, np.maximum(damping / 10, _SMALLEST_DAMPING), damping * 10)
        converged = np.abs(step[:, :2]).max(axis=1) < small_step_px
        normal = NormalEquations(jacobian, residuals, weights)
        if converged.all():
            break
    return Minimum(parameters, residuals, jacobian, normal)


def _costs(residuals: Array32, weights: Array32) -> Array:
    costs = weighted_squares(residuals, weights)
    return np.where(np.isfinite(costs), costs, np.inf)
