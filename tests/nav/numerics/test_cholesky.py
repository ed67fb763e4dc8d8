"""The compiled loops of Cholesky's decomposition against numpy. Tolerances are rounding."""

from __future__ import annotations

import numpy as np
import pytest

from nav.numerics.cholesky import damped_solutions, factorise, inverses, invert


def _systems(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(6, 9, 9) positive definite matrices and (6, 9) scales."""
    arms = rng.normal(size=(6, 9, 9))
    return arms @ arms.transpose(0, 2, 1) + np.eye(9), rng.uniform(0.1, 3, (6, 9))


def test_damped_solutions_solve_their_systems() -> None:
    rng = np.random.default_rng(2)
    matrices, scales = _systems(rng)
    rights, dampings = rng.normal(size=(6, 9)), rng.random(6)
    solutions = damped_solutions(matrices, scales, rights, dampings)
    # What is added to a scaled diagonal is the more in the matrix's own units, the smaller the scale is.
    damped = matrices + (dampings[:, None] / scales**2)[:, None] * np.eye(9)
    np.testing.assert_allclose(solutions, np.linalg.solve(damped, rights[..., None])[..., 0], rtol=1e-9)
    matrices[0] *= -1
    solutions = damped_solutions(matrices, scales, rights, 0 * dampings)
    assert np.isnan(solutions).any(axis=1).tolist() == [True] + 5 * [False]


def test_inverses_are_those_of_the_damped_matrices() -> None:
    rng = np.random.default_rng(3)
    matrices, scales = _systems(rng)
    damped = matrices + 0.2 / scales[:, :, None] ** 2 * np.eye(9)
    np.testing.assert_allclose(inverses(matrices, scales, 0.2), np.linalg.inv(damped), rtol=1e-9, atol=1e-12)
    part, lower = np.empty((4, 4)), np.empty((9, 9))
    factorise(matrices[0], scales[0], 0.0, lower)
    invert(lower, scales[0], np.empty((9, 9)), part)
    np.testing.assert_allclose(part, np.linalg.inv(matrices[0])[:4, :4], rtol=1e-9, atol=1e-12)


def test_what_rounding_has_left_indefinite_has_a_finite_inverse_too() -> None:
    matrices = np.broadcast_to(np.eye(3), (3, 3, 3)).copy()
    # Least eigenvalues of -2e-6 and 1e-3: the first needs more than a millionth on its diagonal, the second does not.
    matrices[0, 0, 1] = matrices[0, 1, 0] = 1 + 2e-6
    matrices[1, 0, 1] = matrices[1, 1, 0] = 1 - 1e-3
    matrices[2, 1, 1] = np.nan
    found = inverses(matrices, np.ones((3, 3)), 1e-6)
    np.testing.assert_allclose(found[0], np.linalg.inv(matrices[0] + 1e-5 * np.eye(3)), rtol=1e-6)
    np.testing.assert_allclose(found[1], np.linalg.inv(matrices[1] + 1e-6 * np.eye(3)), rtol=1e-9)
    assert not np.isfinite(found[2]).all()


@pytest.mark.parametrize("least", [0.5, 1e-3, -1e-3])
def test_the_least_pivot_tells_whether_a_matrix_is_positive(least: float) -> None:
    # Unit diagonal and one pair of rows at an angle: the second one's pivot is the square of its sine.
    matrix, lower = np.eye(3), np.empty((3, 3))
    matrix[2, 0] = matrix[0, 2] = np.sqrt(1 - least)
    assert factorise(matrix, np.ones(3), 0.0, lower) == pytest.approx(least, rel=1e-9)
    matrix[1, 1] = np.nan
    assert np.isnan(factorise(matrix, np.ones(3), 0.0, lower))
