"""Closed forms of the ellipses' small matrices, and which ellipses there are."""

from __future__ import annotations

import numpy as np
import pytest

from nav.centroids.ellipses import Ellipses, moment_shapes, plane_shapes, shape_inverses, shape_radii


def shapes_of(rng: np.random.Generator, count: int) -> np.ndarray:
    arms = rng.normal(0, 3, (count, 2, 2))
    return arms @ arms.transpose(0, 2, 1) + 0.5 * np.eye(2)


def test_closed_forms_of_shapes() -> None:
    shapes = shapes_of(np.random.default_rng(1), 200)
    # Rounding, of matrices with condition numbers of up to some hundred.
    np.testing.assert_allclose(shape_inverses(shapes) @ shapes, np.broadcast_to(np.eye(2), shapes.shape), atol=1e-11)
    np.testing.assert_allclose(shape_radii(shapes), np.sqrt(np.linalg.det(shapes)), rtol=1e-12)


def test_shapes_are_roots_of_moments_and_maps() -> None:
    shapes = shapes_of(np.random.default_rng(2), 200)
    np.testing.assert_allclose(moment_shapes(shapes @ shapes / 4), shapes, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(plane_shapes(shapes), shapes, rtol=1e-9, atol=1e-12)
    # A line and a point: one and two semi-axes of zero.
    along = np.array([0.6, 0.8])
    squares = np.stack([9 * np.outer(along, along), np.zeros((2, 2))])
    np.testing.assert_allclose(moment_shapes(squares / 4), [3 * np.outer(along, along), np.zeros((2, 2))], atol=1e-7)


@pytest.mark.parametrize("axes", [(-1.0, -2.0), (1.0, -2.0), (0.0, 2.0)])
def test_an_ellipse_has_positive_semi_axes(axes: tuple[float, float]) -> None:
    shapes = np.stack([np.eye(2), np.diag(axes)])
    with pytest.raises(ValueError, match="shapes_px: must be positive"):
        Ellipses(np.zeros(2, np.int64), np.zeros((2, 2)), shapes)
