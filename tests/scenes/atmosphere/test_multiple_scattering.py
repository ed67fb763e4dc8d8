"""The compiled step of multiple scattering against the same sums by numpy and scipy."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from geometry.se3 import Array
from scenes.atmosphere.air_layers import REPEATED_FIRST, REPEATED_SECOND
from scenes.atmosphere.multiple_scattering import add_scattered, grid_places

_NODES, _MOMENTS, _WAVELENGTHS = 15 * 27, 6, 11


def expected(
    moments: Array,
    places: tuple[Array, Array],
    scattered: tuple[Array, Array],
    directions: tuple[Array, Array],
    least_share: float = 0.05,
) -> Array:
    """Phase functions in Legendre polynomials of the angle, for light of which moments over directions are known."""
    nodes, shares = places
    ends = np.arange(len(nodes) + 1) * 4
    weights = csr_matrix((shares.ravel(), nodes.ravel(), ends), shape=(len(nodes), _NODES))
    there = (weights @ moments.reshape(_NODES, -1)).reshape(len(nodes), _MOMENTS, -1)
    mean, of_up, of_level, up_up, up_level, level_level = np.moveaxis(there, 1, 0)
    up, level = (part[:, None] for part in directions)
    first = of_up * up + of_level * level
    # The mean of the component aside of both, squared, is what the other two leave of the whole.
    aside_aside = mean - up_up - level_level
    aside = 1.0 - up**2 - level**2
    square = up_up * up**2 + level_level * level**2 + aside_aside * aside + 2.0 * up_level * up * level
    second = 1.5 * square - 0.5 * mean
    of_aerosol = mean + 3.0 * REPEATED_FIRST * first + 5.0 * REPEATED_SECOND * second
    result: Array = scattered[0] * (mean + 0.5 * second) + scattered[1] * np.maximum(of_aerosol, least_share * mean)
    return result


def test_the_compiled_step_adds_what_numpy_adds() -> None:
    draws = np.random.default_rng(4)
    rays = 500
    # Light from drawn directions, some of them nearly all of it: its moments fit together.
    directions = draws.normal(size=(_NODES, 3, 3, _WAVELENGTHS))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    power = draws.exponential(size=(_NODES, 3, _WAVELENGTHS))
    up, level = directions[:, :, 0], directions[:, :, 1]
    parts = np.stack([np.ones_like(up), up, level, up * up, up * level, level * level], axis=1)
    moments = np.ascontiguousarray((power[:, None] * parts).sum(axis=2))
    places = grid_places(draws.uniform(-100.0, 90e3, rays), draws.uniform(-1.0, 1.0, rays))
    scattered = draws.random((rays, _WAVELENGTHS)), draws.random((rays, _WAVELENGTHS))
    look = draws.normal(size=(rays, 3))
    look /= np.linalg.norm(look, axis=1, keepdims=True)
    light = draws.random((rays, _WAVELENGTHS))
    before = light.copy()
    add_scattered(light, moments, places, scattered, look[:, 0].copy(), look[:, 1].copy())
    added = expected(moments, places, scattered, (look[:, 0], look[:, 1]))
    # Sums of some twenty terms of order 1 in another order: rounding of 1e-16 each.
    np.testing.assert_allclose(light - before, added, rtol=0.0, atol=2e-13 * float(moments.max()))
    # In some of the rays the light is so one-sided that the least share counts.
    unbounded = expected(moments, places, scattered, (look[:, 0], look[:, 1]), least_share=-100.0)
    assert 0.0 < np.mean(unbounded < added - 1e-9) < 0.5


def test_shares_of_the_grid_add_to_one_and_meet_the_place() -> None:
    nodes, shares = grid_places(np.array([0.0, 350.0, 84e3, 1e6]), np.sin(np.radians([-30.0, 4.0, 45.0, 90.0])))
    assert np.all(shares >= 0.0) and np.allclose(shares.sum(axis=1), 1.0)
    assert nodes.min() >= 0 and nodes.max() < _NODES
    # 350 m is between 250 and 700 m; 4 degrees between 3.5 and 5.5.
    heights, suns = np.divmod(nodes[1], 27)
    assert set(heights) == {1, 2}
    assert float(shares[1][heights == 2].sum()) == 100.0 / 450.0
    assert np.isclose(float(shares[1][suns == suns.max()].sum()), 0.25)
