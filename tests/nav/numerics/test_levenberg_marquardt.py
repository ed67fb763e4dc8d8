"""The Levenberg-Marquardt solver against numpy's and scipy's least squares."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from nav.numerics.levenberg_marquardt import evaluate, minimise


@pytest.mark.parametrize("length", [40, 60_000])
def test_a_straight_line_is_fitted_as_by_numpy(length: int) -> None:
    rng = np.random.default_rng([2, length])
    x = rng.uniform(-1, 1, (9, length)).astype(np.float32)
    design = np.stack([np.ones_like(x), x], axis=1)
    data = (0.3 + 2 * x + rng.normal(0, 0.1, x.shape)).astype(np.float32)
    weights = (rng.uniform(0, 2, x.shape) * (rng.random(x.shape) > 0.2)).astype(np.float32)

    def model(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.einsum("np,npk->nk", parameters, design).astype(np.float32), design

    fit = minimise(model, data, weights, evaluate(model, data, weights, np.zeros((9, 2))), 6, 1e-6)
    for index in range(9):
        rows, weight = design[index].astype(np.float64), weights[index].astype(np.float64)
        normal = (rows * weight) @ rows.T
        # Single precision, summed over the pixels: 6e-8 sqrt(K) at most, and the ridge of 1e-6 on the diagonal.
        np.testing.assert_allclose(
            fit.parameters[index], np.linalg.solve(normal, (rows * weight) @ data[index]), atol=2e-5
        )
        np.testing.assert_allclose(fit.covariance()[index], np.linalg.inv(normal), rtol=1e-4, atol=1e-4 / normal[0, 0])


def test_a_linear_step_shares_the_curvature() -> None:
    rng = np.random.default_rng(3)
    x = rng.uniform(-1, 1, (3, 50)).astype(np.float32)
    design, weights = np.stack([np.ones_like(x), x], axis=1), np.ones_like(x)
    start = evaluate(lambda p: (np.einsum("np,npk->nk", p, design), design), x, weights, np.zeros((3, 2)))
    moved = start.after_linear_step(start.residuals + 1, weights)
    # The data x + 1 lie on a line: single precision, and the ridge.
    np.testing.assert_allclose(moved.parameters, np.ones((3, 2)), atol=1e-5)
    np.testing.assert_allclose(moved.residuals, 0, atol=1e-5)
    np.testing.assert_array_equal(moved.covariance(), start.covariance())


def gaussian_spots(
    parameters: np.ndarray, x: np.ndarray, y: np.ndarray, dtype: type[Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Values (N, K) of spots of light, and their derivatives by centre, width, height and background (N, 5, K)."""
    center_x, center_y, width, height, background = parameters.astype(dtype).T[:, :, None]
    across, along = x - center_x, y - center_y
    bell = np.exp(-(across**2 + along**2) / (2 * width**2))
    slope = height * bell / width**2
    by_width = slope * (across**2 + along**2) / width
    return height * bell + background, np.stack(
        [slope * across, slope * along, by_width, bell, np.ones_like(bell)], axis=1
    )


def test_the_minimum_of_a_curved_model_is_that_of_scipy() -> None:
    rng = np.random.default_rng(4)
    y, x = (axis.ravel().astype(np.float32) for axis in np.mgrid[-8:9, -8:9])
    truth = rng.uniform([-1, -1, 1.5, 50, 5], [1, 1, 3, 200, 20], (12, 5))
    data = (gaussian_spots(truth, x, y, np.float64)[0] + rng.normal(0, 1, (12, x.size))).astype(np.float32)
    weights = (rng.uniform(0.5, 2, data.shape) * (rng.random(data.shape) > 0.2)).astype(np.float32)
    start = truth + rng.uniform(-1, 1, truth.shape) * [0.7, 0.7, 0.4, 20, 3]

    def model(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return gaussian_spots(parameters, x, y, np.float32)

    fit = minimise(model, data, weights, evaluate(model, data, weights, start), 30, 1e-6)
    for index in range(len(truth)):
        root = np.sqrt(weights[index].astype(np.float64))

        def residuals(parameters: np.ndarray, root: np.ndarray = root, index: int = index) -> np.ndarray:
            return root * (data[index] - gaussian_spots(parameters[None], x, y, np.float64)[0][0])

        def jacobian(parameters: np.ndarray, root: np.ndarray = root) -> np.ndarray:
            return -(root * gaussian_spots(parameters[None], x, y, np.float64)[1][0]).T

        found = least_squares(residuals, start[index], jacobian, method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
        deviations = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
        # Single precision rounds a value of up to 220 by 8e-6 at most, 1e-5 of its noise; were all 289 pixels off in
        # the direction of one parameter, that would be the root of their number times as much of its deviation.
        assert (np.abs(fit.parameters[index] - found.x) < 1e-5 * np.sqrt(x.size) * deviations).all()
        # The same rounding of the residuals, squared and summed.
        cost = (weights[index].astype(np.float64) * fit.residuals[index].astype(np.float64) ** 2).sum()
        assert cost == pytest.approx(2 * found.cost, rel=1e-5)
        np.testing.assert_allclose(np.sqrt(np.diag(fit.covariance()[index])), deviations, rtol=1e-4)
