"""The picture of a disc of a few pixels or less: the area that it covers of each pixel, and the light's spread.

An image of so small a disc shows no edge to fit. It shows the point spread, and how the disc's light is shared between
the pixels. Cells of a fraction of a pixel stand for a lens that spreads the light before the pixels collect it; cells
of whole pixels for light that is collected first and then spreads between neighbours, as charge does, and as our
simulated sensor draws it. The two differ for discs that lie within one pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.numerics.compiled import compiled

# Beyond four standard deviations a Gaussian holds less than 1e-4 of the light.
_REACH_SIGMA = 4.0
_LEAST_SIGMA_PX = 0.05
# Lines that are less slanted count as this slanted.
_LEAST_SLANT = 1e-3
# For the derivative by the spread.
_STEP_PX = 1e-3


@compiled
def _below(limit: float, radius: float) -> float:
    """Area between the axis and the circle, right of the axis and up to a limit within the radius."""
    inside = np.sqrt(max(radius * radius - limit * limit, 0.0))
    area: float = (limit * inside + radius * radius * np.arcsin(max(-1.0, min(1.0, limit / radius)))) / 2
    return area


@compiled
def disc_areas_below(x: Array, y: Array, radius: Array, areas: Array, by_x: Array, by_y: Array) -> None:
    """Fill the areas of discs about the origin left of x and above y, and their derivatives by x and by y.

    Args:
        x, y: (N, L)
        radius: (N,) above zero.
        areas, by_x, by_y: (N, L, L), y first.

    Source: the integral of the chord's part below y, `max(0, min(y, h) + h)` with `h = sqrt(r^2 - X^2)`, over X.
    """
    for n in range(len(x)):
        r = radius[n]
        for i in range(y.shape[1]):
            v = max(-r, min(r, y[n, i]))
            half_at_v = np.sqrt(max(r * r - v * v, 0.0))
            at_low, at_high, whole = _below(-half_at_v, r), _below(half_at_v, r), _below(-r, r)
            for j in range(x.shape[1]):
                u = max(-r, min(r, x[n, j]))
                half_at_u = np.sqrt(max(r * r - u * u, 0.0))
                # Between the two points at which the line at y meets the circle, the chord is cut by it.
                end = max(-half_at_v, min(half_at_v, u))
                at_end = at_low if end == -half_at_v else at_high if end == half_at_v else _below(end, r)
                area = v * (end + half_at_v) + at_end - at_low
                if v > 0:
                    left = at_low if u >= -half_at_v else _below(u, r)
                    right = at_high if u <= half_at_v else _below(u, r)
                    area += 2 * (left - whole + right - at_high)
                areas[n, i, j] = area
                by_x[n, i, j] = max(min(v, half_at_u) + half_at_u, 0.0)
                by_y[n, i, j] = max(min(u, half_at_v) + half_at_v, 0.0)


@dataclass(frozen=True, eq=False)
class SpreadDiscs:
    """Pictures of discs on square windows of pixels, as shares of the disc's own light per pixel.

    Attributes:
        light: (N, W, W) area of the disc in each pixel after the spread. [px^2]
        by_x, by_y, by_sigma: (N, W, W) its derivatives by the centre and by the spread.
    """

    light: Array
    by_x: Array
    by_y: Array
    by_sigma: Array


def spread_discs(centers_px: Array, radii_px: Array, sigma_px: Array, half: int, cells: int) -> SpreadDiscs:
    """Pictures of discs, or of ellipses along rows and columns.

    Args:
        centers_px: (N, 2) from the middles of their windows.
        radii_px: (N,), or (N, 2) along rows and along columns.
        sigma_px: (N,) standard deviation of the Gaussian spread.
        half: windows have 2 half + 1 pixels a side.
        cells: per side of a pixel, in which the spread is computed.
    """
    size, sigma = 2 * half + 1, np.maximum(sigma_px, _LEAST_SIGMA_PX)
    reach = int(np.ceil(_REACH_SIGMA * sigma.max() * cells)) + 1
    places = np.arange(size * cells + 2 * reach) - reach
    edges = np.append(places, places[-1] + 1) / cells - half - 0.5
    x, y = edges - centers_px[:, :1], edges - centers_px[:, 1:]
    area, by_x, by_y = (np.empty((*x.shape, x.shape[1])) for _ in range(3))
    # A disc is stretched along its rows.
    along, across = radii_px.reshape(len(x), -1)[:, [0, -1]].astype(np.float64).T
    stretch = (along / across)[:, None]
    disc_areas_below(x / stretch, y, np.ascontiguousarray(across), area, by_x, by_y)
    area *= stretch[..., None]
    by_y *= stretch[..., None]
    spread = _spread(places, size, cells, sigma)
    broader = (_spread(places, size, cells, sigma + _STEP_PX) - _spread(places, size, cells, sigma - _STEP_PX)) / (
        2 * _STEP_PX
    )

    def pixels(corners: Array, rows: Array, columns: Array) -> Array:
        covered = np.diff(np.diff(corners, axis=1), axis=2)
        light: Array = rows @ covered @ columns.transpose(0, 2, 1)
        return light

    return SpreadDiscs(
        pixels(area, spread, spread),
        # Moving the disc moves the edges the other way.
        -pixels(by_x, spread, spread),
        -pixels(by_y, spread, spread),
        pixels(area, broader, spread) + pixels(area, spread, broader),
    )


def spread_ring_shares(
    middles_px: Array, maps: Array, edges: tuple[float, float], sigma_px: float, half: int, cells: int
) -> Array:
    """(N, 2, W, W) shares of each pixel's light from within the inner edge and from beyond the outer edge of a ring.

    Args:
        middles_px: (N, 2) the ring's middle from the middles of the windows.
        maps: (N, 2, 2) from the ring's plane to pixels.
        edges: inner and outer radius in the ring's plane.
        sigma_px, half, cells: as in `spread_discs`; all windows have one spread.
    """
    size, sigma = 2 * half + 1, max(sigma_px, _LEAST_SIGMA_PX)
    reach = int(np.ceil(_REACH_SIGMA * sigma * cells)) + 1
    places = np.arange(size * cells + 2 * reach) - reach
    # Whole pixels are too wide to take an edge in them as straight.
    parts = 2 if cells == 1 else 1
    at = (np.arange(len(places) * parts) + 0.5) / (cells * parts) - reach / cells - half - 0.5
    x, y = at - middles_px[:, :1, None], at[:, None] - middles_px[:, 1:, None]
    inverse = np.linalg.inv(maps)[..., None, None]
    u, v = inverse[:, 0, 0] * x + inverse[:, 0, 1] * y, inverse[:, 1, 0] * x + inverse[:, 1, 1] * y
    radius = np.maximum(np.hypot(u, v), 1e-9)
    by_x, by_y = (inverse[:, 0, k] * u / radius + inverse[:, 1, k] * v / radius for k in (0, 1))
    slope = np.hypot(by_x, by_y)
    wide, narrow = np.maximum(np.abs(by_x), np.abs(by_y)) / slope, np.minimum(np.abs(by_x), np.abs(by_y)) / slope
    spread = _spread(places, size, cells, np.array([sigma]))[0]

    def picture(edge: float) -> Array:
        inside = _below_line((edge - radius) / slope * (cells * parts), wide, np.maximum(narrow, _LEAST_SLANT))
        joined = inside.reshape(len(inside), len(places), parts, len(places), parts).mean(axis=(2, 4))
        light: Array = spread @ joined @ spread.T / cells**2
        return light

    return np.stack([picture(edges[0]), 1 - picture(edges[1])], axis=1)


def _below_line(distance: Array, wide: Array, narrow: Array) -> Array:
    """Share of a unit square on one side of a line at a distance from its middle: the sum of two uniform variables.

    Args:
        distance: towards the line, below zero where the middle is beyond it.
        wide, narrow: larger and smaller component of the line's unit normal, both above zero.
    """
    total = np.zeros_like(distance)
    for sign, end in ((1, wide + narrow), (-1, wide - narrow), (-1, narrow - wide), (1, -wide - narrow)):
        total = total + sign * np.maximum(distance + end / 2, 0) ** 2 / 2
    share: Array = total / (wide * narrow)
    return share


def _spread(places: NDArray[np.int64], size: int, cells: int, sigma_px: Array) -> Array:
    """(N, size, L) shares of the light of cells in a row that each pixel of the row gets, sampled from a Gaussian."""
    steps = np.arange(size * cells)[:, None] - places
    weights = np.exp(-(steps**2) / (2 * (sigma_px[:, None, None] * cells) ** 2))
    # All cells get as much as they give: the same sum for each cell far from the ends.
    total = weights[:, size * cells // 2].sum(axis=1)[:, None, None]
    shares: Array = (weights / total).reshape(len(sigma_px), size, cells, -1).sum(axis=2)
    return shares
