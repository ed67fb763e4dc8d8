"""Levenberg-Marquardt for many small problems of one form at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

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
# In single precision, 1 MiB.
_CACHED_NUMBERS = 262_144


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Of N problems; each part is computed when it is first asked for, which for many it never is.

    Attributes:
        jacobian: (N, P, K).
        residuals: (N, K).
        roots: (N, K) of the weights.
    """

    jacobian: Array32
    residuals: Array32
    roots: Array32

    @cached_property
    def _products(self) -> tuple[Array, Array]:
        """(N, P, P) normal matrices `J W J^T` and (N, P) gradients."""
        count, size, length = self.jacobian.shape
        normal, gradient = np.empty((count, size, size), np.float32), np.empty((count, size, 1), np.float32)
        for part in patch_blocks(count, size * length):
            rooted = self.jacobian[part] * self.roots[part, None]
            # An array with its own transpose: half of the product is computed and mirrored.
            np.matmul(rooted, rooted.transpose(0, 2, 1), out=normal[part])
            np.matmul(rooted, (self.residuals[part] * self.roots[part])[:, :, None], out=gradient[part])
        return normal.astype(np.float64), gradient[..., 0].astype(np.float64)

    @cached_property
    def _scales(self) -> Array:
        """(N, P) scales that bring the diagonal to one."""
        diagonal = np.einsum("npp->np", self._products[0])
        scales: Array = 1 / np.sqrt(np.maximum(diagonal, _TINY_CURVATURE))
        return scales

    @cached_property
    def _scaled(self) -> Array:
        """(N, P, P) matrices with a unit diagonal, kept invertible where single precision would not."""
        scaled: Array = self._products[0] * self._scales[:, :, None] * self._scales[:, None, :]
        return scaled + _RIDGE * np.eye(scaled.shape[1])

    @cached_property
    def inverse(self) -> Array:
        """(N, P, P) inverse matrices."""
        inverse: Array = np.linalg.inv(self._scaled) * self._scales[:, :, None] * self._scales[:, None, :]
        return inverse

    def step(self, damping: Array) -> Array:
        """(N, P) steps with (N,) dampings."""
        damped = self._scaled + damping[:, None, None] * np.eye(self._scaled.shape[1])
        step: Array = np.linalg.solve(damped, (self._products[1] * self._scales)[..., None])[..., 0] * self._scales
        return step


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where the iteration ended.

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

    def given(self, residuals: Array32, weights: Array32) -> Minimum:
        """Where one undamped step ends from here if the residuals were these; (N, K) each."""
        gradient = np.matmul(self.jacobian, (weights * residuals)[:, :, None]).astype(np.float64)
        step = np.matmul(self.covariance(), gradient)[..., 0]
        left = residuals - np.matmul(step[:, None].astype(np.float32), self.jacobian)[:, 0]
        return replace(self, parameters=self.parameters + step, residuals=left)

    def leverages(self, covariance: Array, weights: Array32) -> Array32:
        """(N, K) share of each pixel's noise that its own fit swallows."""
        root = np.linalg.cholesky(covariance).astype(np.float32).transpose(0, 2, 1)
        leverages = np.empty_like(weights)
        for part in patch_blocks(len(root), self.jacobian[0].size):
            swallowed = np.matmul(root[part], self.jacobian[part])
            np.einsum("npk,npk->nk", swallowed, swallowed, out=leverages[part])
        leverages *= weights
        return leverages


def evaluate(model: Model, data: Array32, weights: Array32, parameters: Array) -> Minimum:
    """Where an iteration starts: the model at (N, P) parameters; other arguments as for `minimise`."""
    values, jacobian = model(parameters)
    residuals = data - values
    normal = NormalEquations(jacobian, residuals, np.sqrt(weights))
    return Minimum(parameters, residuals, jacobian, normal)


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
    roots = np.sqrt(weights)
    cost = _cost(residuals, roots)
    damping = np.full(len(parameters), _FIRST_DAMPING)
    normal = NormalEquations(jacobian, residuals, roots)
    for _ in range(most_steps):
        step = normal.step(damping)
        tried = parameters + step
        # A step gone astray may overflow: its cost is infinite then, and it is not taken.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            values, new_jacobian = model(tried)
            new_residuals = data - values
            new_cost = _cost(new_residuals, roots)
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
        normal = NormalEquations(jacobian, residuals, roots)
        if converged.all():
            break
    return Minimum(parameters, residuals, jacobian, normal)


def _cost(residuals: Array32, roots: Array32) -> Array:
    rooted = residuals * roots
    cost = np.einsum("nk,nk->n", rooted, rooted).astype(np.float64)
    return np.where(np.isfinite(cost), cost, np.inf)


def patch_blocks(count: int, length: int) -> list[slice]:
    """Slices of `count` patches of `length` numbers, such that those of one slice fit a core's cache."""
    step = max(1, _CACHED_NUMBERS // length)
    return [slice(low, low + step) for low in range(0, count, step)]
