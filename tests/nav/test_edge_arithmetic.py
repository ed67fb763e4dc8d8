"""The edge model's own arithmetic against numpy's and scipy's: error function, small matrices, normal equations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from nav.centroids.blurred_edges import blurred_step
from nav.centroids.ellipses import Ellipses, shape_inverses, shape_radii
from nav.numerics.levenberg_marquardt import evaluate, minimise


def test_a_blurred_step_is_the_error_function():
    z = np.concatenate([np.linspace(-12, 12, 20_001), [-1e3, 0.0, 1e3]]).astype(np.float32)
    step, bell = blurred_step(z)
    exact = z.astype(np.float64)
    # Half of the published 1.5e-7, and three roundings of numbers up to one in single precision.
    np.testing.assert_allclose(step, (1 + erf(exact)) / 2, atol=0.75e-7 + 3 * 6e-8)
    # Exponents of up to 17 are rounded to 1e-6 where the bell is 1e-7 or more.
    np.testing.assert_allclose(bell, np.exp(-(exact**2)), rtol=3e-6, atol=1e-12)


def test_far_from_an_edge_there_are_no_denormal_numbers():
    # Nor in products of two of them, which the normal equations are made of.
    _, bell = blurred_step(np.linspace(-20, 20, 20_001, dtype=np.float32))
    squares = bell[bell != 0].astype(np.float64) ** 2
    assert squares.min() > np.finfo(np.float32).tiny
    assert (bell == 0).any()


def test_both_sides_of_a_blurred_step_are_alike():
    z = np.linspace(0, 6, 5001, dtype=np.float32)[1:]
    high, low = blurred_step(z)[0], blurred_step(-z)[0]
    # One rounding of a number below one: an edge that is steeper on one side would move centres.
    np.testing.assert_allclose(high - np.float32(0.5), np.float32(0.5) - low, atol=6e-8)


def shapes_of(rng, count):
    arms = rng.normal(0, 3, (count, 2, 2))
    return arms @ arms.transpose(0, 2, 1) + 0.5 * np.eye(2)


def test_closed_forms_of_shapes():
    shapes = shapes_of(np.random.default_rng(1), 200)
    # Rounding, of matrices with condition numbers of up to some hundred.
    np.testing.assert_allclose(shape_inverses(shapes) @ shapes, np.broadcast_to(np.eye(2), shapes.shape), atol=1e-11)
    np.testing.assert_allclose(shape_radii(shapes), np.sqrt(np.linalg.det(shapes)), rtol=1e-12)


@pytest.mark.parametrize("axes", [(-1.0, -2.0), (1.0, -2.0), (0.0, 2.0)])
def test_an_ellipse_has_positive_semi_axes(axes):
    shapes = np.stack([np.eye(2), np.diag(axes)])
    with pytest.raises(ValueError, match="shapes_px: must be positive"):
        Ellipses(np.zeros(2, np.int64), np.zeros((2, 2)), shapes)


@pytest.mark.parametrize("length", [40, 60_000])
def test_a_straight_line_is_fitted_as_by_numpy(length):
    rng = np.random.default_rng([2, length])
    x = rng.uniform(-1, 1, (9, length)).astype(np.float32)
    design = np.stack([np.ones_like(x), x], axis=1)
    data = (0.3 + 2 * x + rng.normal(0, 0.1, x.shape)).astype(np.float32)
    weights = (rng.uniform(0, 2, x.shape) * (rng.random(x.shape) > 0.2)).astype(np.float32)

    def model(parameters):
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


def test_a_linear_step_shares_the_curvature():
    rng = np.random.default_rng(3)
    x = rng.uniform(-1, 1, (3, 50)).astype(np.float32)
    design, weights = np.stack([np.ones_like(x), x], axis=1), np.ones_like(x)
    start = evaluate(lambda p: (np.einsum("np,npk->nk", p, design), design), x, weights, np.zeros((3, 2)))
    moved = start.given(start.residuals + 1, weights)
    # The data x + 1 lie on a line: single precision, and the ridge.
    np.testing.assert_allclose(moved.parameters, np.ones((3, 2)), atol=1e-5)
    np.testing.assert_allclose(moved.residuals, 0, atol=1e-5)
    np.testing.assert_array_equal(moved.covariance(), start.covariance())
