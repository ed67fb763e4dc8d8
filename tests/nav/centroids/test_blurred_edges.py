"""The error function of the blurred edges against scipy's, and pixels far from any edge."""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from nav.centroids import blurred_edges
from nav.centroids.blurred_edges import blurred_step


def test_a_blurred_step_is_the_error_function() -> None:
    z = np.concatenate([np.linspace(-12, 12, 20_001), [-1e3, 0.0, 1e3]]).astype(np.float32)
    step, bell = blurred_step(z)
    exact = z.astype(np.float64)
    # Half of the published 1.5e-7, and three roundings of numbers up to one in single precision.
    np.testing.assert_allclose(step, (1 + erf(exact)) / 2, atol=0.75e-7 + 3 * 6e-8)
    # Exponents of up to 17 are rounded to 1e-6 where the bell is 1e-7 or more.
    np.testing.assert_allclose(bell, np.exp(-(exact**2)), rtol=3e-6, atol=1e-12)


def test_far_from_an_edge_there_are_no_denormal_numbers() -> None:
    # Nor in products of two of them, which the normal equations are made of.
    _, bell = blurred_step(np.linspace(-20, 20, 20_001, dtype=np.float32))
    squares = bell[bell != 0].astype(np.float64) ** 2
    assert squares.min() > np.finfo(np.float32).tiny
    assert (bell == 0).any()


def test_both_sides_of_a_blurred_step_are_alike() -> None:
    z = np.linspace(0, 6, 5001, dtype=np.float32)[1:]
    high, low = blurred_step(z)[0], blurred_step(-z)[0]
    # One rounding of a number below one: an edge that is steeper on one side would move centres.
    np.testing.assert_allclose(high - np.float32(0.5), np.float32(0.5) - low, atol=6e-8)


def float32(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.normal(size=shape).astype(np.float32)


def test_pixels_that_see_no_edge_get_no_picture_whatever_the_outline_is() -> None:
    x, y, ones = float32(np.random.default_rng(6), 3, 2, 50)
    pictures, inside = np.zeros((2, 3, 50), np.float32), np.full((2, 50), np.nan, np.float32)
    inside[1] = 1.0
    ellipses = np.array([5 * [np.nan], [0.0, 0.0, np.nan, 0.1, 0.0]], np.float32)
    blurred_edges.add_box_responses(ellipses, x, y, np.ones_like(x), inside, ones, pictures)
    assert not pictures.any()
