"""Levenberg-Marquardt for many small problems of one form at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from geometry.se3 import Array
from nav.centroids.marker_signal import Array32

# Values (N, K) and their derivatives (N, P, K) at (N, P) parameters.
Model = Callable[[Array], tuple[Array32, Array32]]

_FIRST_DAMPING = 1e-4
_SMALLEST_DAMPING = 1e-9
# Keeps a parameter that no pixel tells of where it is.
_TINY_CURVATURE = 1e-12
# Of a normal matrix with unit diagonal: what single precision leaves uncertain.
_RIDGE = 1e-6
# Relative to the cost, below which single precision tells no better from worse.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where the iteration ended.

    Attributes:
        parameters: (N, P).
        residuals: (N, K) data minus model.
        jacobian: (N, P, K).
        normal: (N, P, P) `J W J^T`.
        converged: (N,) whether the last step was small.
    """

    parameters: Array
    residuals: Array32
    jacobian: Array32
    normal: Array
    converged: np.ndarray[tuple[int], np.dtype[np.bool_]]

    def covariance(self) -> Array:
        """(N, P, P) inverse of the normal matrices."""
        scale = _scales(self.normal)
        inverse: Array = np.linalg.inv(_scaled(self.normal, scale)) * scale[:, :, None] * scale[:, None, :]
        return inverse

    def given(self, residuals: Array32, weights: Array32) -> Minimum:
        """Where one undamped step ends from here if the residuals were these; (N, K) each."""
        gradient = np.matmul(self.jacobian, (weights * residuals)[:, :, None]).astype(np.float64)
        step = np.matmul(self.covariance(), gradient)[..., 0]
        left = residuals - np.matmul(step[:, None].astype(np.float32), self.jacobian)[:, 0]
        return replace(self, parameters=self.parameters + step, residuals=left)

    def leverages(self, covariance: Array, weights: Array32) -> Array32:
        """(N, K) share of each pixel's noise that its own fit swallows."""
        root = np.linalg.cholesky(covariance).astype(np.float32)
        swallowed = np.matmul(root.transpose(0, 2, 1), self.jacobian)
        leverages: Array32 = np.einsum("npk,npk->nk", swallowed, swallowed) * weights
        return leverages


def evaluate(model: Model, data: Array32, weights: Array32, parameters: Array) -> Minimum:
    """Where an iteration starts: the model at (N, P) parameters; other arguments as for `minimise`."""
    values, jacobian = model(parameters)
    residuals = data - values
    normal = _normal_matrices(jacobian, weights)
    return Minimum(parameters, residuals, jacobian, normal, np.zeros(len(parameters), np.bool_))


def minimise(
    model: Model, data: Array32, weights: Array32, start: Minimum, most_steps: int, small_step_px: float
) -> Minimum:
    """Weighted least squares of `data - model`; the first two parameters are a place in pixels.

    Args:
        model: values and derivatives.
        data: (N, K).
        weights: (N, K), 0 for padding.
        start: an evaluated start, or the end of an iteration with other weights.
        most_steps: evaluations of the model at most.
        small_step_px: the iteration ends when no place moves more.
    """
    parameters, residuals, jacobian = start.parameters, start.residuals, start.jacobian
    cost = _cost(residuals, weights)
    damping = np.full(len(parameters), _FIRST_DAMPING)
    converged = np.zeros(len(parameters), np.bool_)
    normal = _normal_matrices(jacobian, weights)
    for _ in range(most_steps):
        step = _step(normal, np.matmul(jacobian, (weights * residuals)[:, :, None])[..., 0].astype(np.float64), damping)
        tried = parameters + step
        # A step gone astray may overflow: its cost is infinite then, and it is not taken.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            values, new_jacobian = model(tried)
            new_residuals = data - values
            new_cost = _cost(new_residuals, weights)
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
        normal = _normal_matrices(jacobian, weights)
        if converged.all():
            break
    return Minimum(parameters, residuals, jacobian, normal, converged)


def _cost(residuals: Array32, weights: Array32) -> Array:
    cost = np.einsum("nk,nk,nk->n", residuals, residuals, weights).astype(np.float64)
    return np.where(np.isfinite(cost), cost, np.inf)


def _normal_matrices(jacobian: Array32, weights: Array32) -> Array:
    normal: Array = np.matmul(jacobian * weights[:, None], jacobian.transpose(0, 2, 1)).astype(np.float64)
    return normal


def _scales(normal: Array) -> Array:
    """(N, P) scales that bring the diagonal to one."""
    diagonal = np.einsum("npp->np", normal)
    scales: Array = 1 / np.sqrt(np.maximum(diagonal, _TINY_CURVATURE))
    return scales


def _scaled(normal: Array, scale: Array) -> Array:
    """Normal matrices with a unit diagonal, kept invertible where single precision would not."""
    scaled: Array = normal * scale[:, :, None] * scale[:, None, :]
    return scaled + _RIDGE * np.eye(normal.shape[1])


def _step(normal: Array, gradient: Array, damping: Array) -> Array:
    scale = _scales(normal)
    damped = _scaled(normal, scale) + damping[:, None, None] * np.eye(normal.shape[1])
    step: Array = np.linalg.solve(damped, (gradient * scale)[..., None])[..., 0] * scale
    return step
