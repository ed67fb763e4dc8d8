"""Building blocks of painted maps: noise, panels, rivets, streaks, wear, stitches, bands and roundels, in metres.

A painter makes a `MapGrid` of the surface's size, computes layers as (rows, columns) shares in [0, 1], and lays them
over a colour by `covered` and `shaded`; `finished` gives what `PaintedMesh` takes. Every layer comes from its seed
alone, whatever was made before. Sizes are in metres, so that a map of another resolution shows the same pattern; what
is narrower than a texel covers its share of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drogue_models.painted_mesh import HIGHEST_REFLECTANCE, LOWEST_REFLECTANCE
from geometry.se3 import Array

Layer = NDArray[np.float64]

# Streams of the seeds, one for each kind of layer.
_NOISE, _PANELS, _STREAKS, _ROUNDEL = range(4)


@dataclass(frozen=True)
class MapGrid:
    """Texel centres of a map over a surface.

    Attributes:
        width_m, height_m: of the surface along u and v. [m]
        columns, rows: of the map.
        wraps: whether u runs once around the surface, so that patterns continue from the last column to the first.
    """

    width_m: float
    height_m: float
    columns: int
    rows: int
    wraps: bool = False

    @property
    def x_m(self) -> Array:
        """(columns,) texel centres along u. [m]"""
        x: Array = (np.arange(self.columns) + 0.5) * self.texel_m[0]
        return x

    @property
    def y_m(self) -> Array:
        """(rows,) texel centres along v. [m]"""
        y: Array = (np.arange(self.rows) + 0.5) * self.texel_m[1]
        return y

    @property
    def texel_m(self) -> tuple[float, float]:
        """Size of a texel along u and v. [m]"""
        return self.width_m / self.columns, self.height_m / self.rows


def even_paint(grid: MapGrid, rgb: ArrayLike) -> NDArray[np.float64]:
    """(rows, columns, 3) map of one colour."""
    return np.tile(np.asarray(rgb, dtype=np.float64), (grid.rows, grid.columns, 1))


def covered(paint: NDArray[np.float64], layer: Layer, rgb: ArrayLike) -> NDArray[np.float64]:
    """Paint under another colour, or map of colours, where a layer covers it."""
    share = layer[..., None]
    result: NDArray[np.float64] = paint * (1.0 - share) + np.asarray(rgb) * share
    return result


def shaded(paint: NDArray[np.float64], factor: Layer) -> NDArray[np.float64]:
    """Paint that reflects so many times as much."""
    return paint * factor[..., None]


def finished(paint: NDArray[np.float64]) -> NDArray[np.float32]:
    """The map for `PaintedMesh`, within what real surfaces reflect."""
    limited: NDArray[np.float32] = np.clip(paint, LOWEST_REFLECTANCE, HIGHEST_REFLECTANCE).astype(np.float32)
    return limited


def fractal_noise(
    grid: MapGrid, seed: int, largest_m: float | tuple[float, float], octaves: int = 4, persistence: float = 0.5
) -> Layer:
    """(rows, columns) smooth noise with mean 0 and standard deviation 1 over the map.

    Octaves of cubic B-splines over random lattices, each half as wide as the last one. Source: K. Perlin, SIGGRAPH
    1985, doi:10.1145/325165.325247, section "turbulence".

    Args:
        grid: of the map.
        seed: of the pattern.
        largest_m: size of the largest blotches, or along u and v each: unequal ones make streaks. [m]
        octaves: how many sizes; those below half a texel are left out.
        persistence: amplitude of an octave over that of the one before.
    """
    along_u_m, along_v_m = (largest_m, largest_m) if isinstance(largest_m, int | float) else largest_m
    total = np.zeros((grid.rows, grid.columns))
    for octave in range(octaves):
        step_m = along_u_m / 2**octave, along_v_m / 2**octave
        if octave and all(step < texel / 2 for step, texel in zip(step_m, grid.texel_m, strict=True)):
            break
        across = _spline_weights(grid.x_m, grid.width_m, step_m[0], grid.wraps)
        down = _spline_weights(grid.y_m, grid.height_m, step_m[1], False)
        lattice = np.random.default_rng([seed, _NOISE, octave]).standard_normal((down.shape[1], across.shape[1]))
        total += persistence**octave * (down @ lattice @ across.T)
    spread = float(total.std())
    result: Layer = (total - total.mean()) / (spread if spread > 0 else 1.0)
    return result


def _spline_weights(place_m: Array, length_m: float, step_m: float, wraps: bool) -> Array:
    """(N, knots) weights of the knots of a uniform cubic B-spline at N places."""
    count = max(round(length_m / step_m), 1) if wraps else int(np.ceil(length_m / step_m)) + 3
    at = place_m * (count / length_m if wraps else 1.0 / step_m)
    first = np.floor(at).astype(int)
    t = at - first
    pieces = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    weights = np.zeros((len(place_m), count))
    for offset, piece in enumerate(pieces):
        np.add.at(weights, (np.arange(len(place_m)), (first + offset) % count), piece / 6)
    return weights


def cover_share(likelihood: Layer, share: float, softness: float = 0.15) -> Layer:
    """(rows, columns) cover of the most likely places.

    Args:
        likelihood: where the cover lies first, such as noise plus what draws it to edges.
        share: of the map under cover, in [0, 1], on average.
        softness: width of the blurred border in standard deviations of the likelihood.
    """
    if share <= 0:
        return np.zeros_like(likelihood)
    if share >= 1:
        return np.ones_like(likelihood)
    level = np.quantile(likelihood, 1.0 - share)
    width = max(softness * float(likelihood.std()), 1e-12)
    cover: Layer = np.clip((likelihood - level) / width + 0.5, 0.0, 1.0)
    return cover


def edge_wear(grid: MapGrid, seed: int, distance_m: Layer, reach_m: float, share: float) -> Layer:
    """(rows, columns) chips where paint is rubbed through, most of them within `reach_m` of an edge.

    Args:
        grid: of the map.
        seed: of the chips.
        distance_m: (rows, columns) distance from the nearest edge. [m]
        reach_m: distance over which wear falls to a third. [m]
        share: of the map that is worn, in [0, 1].
    """
    chips = fractal_noise(grid, seed, 3.0 * reach_m, octaves=5, persistence=0.7)
    return cover_share(0.6 * chips + 3.0 * np.exp(-distance_m / reach_m), share)


def lines(grid: MapGrid, at_m: Sequence[float] | Array, width_m: float, across: bool = False) -> Layer:
    """(rows, columns) lines at places along u, or across it along v; where they overlap, one covers.

    Args:
        grid: of the map.
        at_m: middles of the lines. [m]
        width_m: of each line. [m]
        across: at places along v instead.
    """
    place, texel = (grid.y_m, grid.texel_m[1]) if across else (grid.x_m, grid.texel_m[0])
    period = grid.width_m if grid.wraps and not across else None
    cover = np.zeros(len(place))
    for middle in at_m:
        cover = np.maximum(cover, _interval_cover(_offset(place, middle, period), texel, width_m))
    if across:
        return np.repeat(cover[:, None], grid.columns, axis=1)
    return np.repeat(cover[None, :], grid.rows, axis=0)


def _offset(place: Array, middle: float, period: float | None) -> Array:
    """Places from a middle, the short way round."""
    away: Array = place - middle
    return away if period is None else away - period * np.rint(away / period)


def _interval_cover(away: Array, texel: float, width: float) -> Array:
    """Share of texels so far from an interval's middle that the interval covers."""
    low = np.maximum(away - texel / 2, -width / 2)
    high = np.minimum(away + texel / 2, width / 2)
    share: Array = np.maximum(high - low, 0.0) / texel
    return share


def bands(grid: MapGrid, limits_m: Sequence[tuple[float, float]], across: bool = True) -> Layer:
    """(rows, columns) bands between pairs of limits along v, or along u."""
    total = np.zeros((grid.rows, grid.columns))
    for low, high in limits_m:
        total = np.maximum(total, lines(grid, [(low + high) / 2], high - low, across))
    return total


def stripes(grid: MapGrid, period_m: float, width_m: float, angle_deg: float = 0.0) -> Layer:
    """(rows, columns) even stripes; at angle 0 they follow v, one after the other along u.

    On a grid that wraps, stripes along v have the nearest period that fits around.
    """
    turn = np.radians(angle_deg)
    if grid.wraps and angle_deg == 0:
        fitted = grid.width_m / max(round(grid.width_m / period_m), 1)
        period_m, width_m = fitted, width_m * fitted / period_m
    away = grid.x_m[None, :] * np.cos(turn) + grid.y_m[:, None] * np.sin(turn)
    texel = abs(grid.texel_m[0] * np.cos(turn)) + abs(grid.texel_m[1] * np.sin(turn))
    away = (away + period_m / 2) % period_m - period_m / 2
    # A texel at a stripe's far side may reach into the next one.
    cover = [_interval_cover(away + shift, texel, width_m) for shift in (-period_m, 0.0, period_m)]
    result: Layer = np.clip(np.sum(cover, axis=0), 0.0, 1.0)
    return result


def dots(grid: MapGrid, centers_m: ArrayLike, radius_m: float) -> Layer:
    """(rows, columns) round dots, such as rivets and screws, with the area of a circle however coarse the map.

    Args:
        grid: of the map.
        centers_m: (N, 2) along u and v. [m]
        radius_m: of each. [m]
    """
    centers = np.asarray(centers_m, dtype=np.float64).reshape(-1, 2)
    cover = np.zeros((grid.rows, grid.columns))
    du, dv = grid.texel_m
    # A dot smaller than a texel becomes a square of its area around its centre.
    reach = int(np.ceil(radius_m / min(du, dv))) + 1
    side = np.arange(-reach, reach + 1)
    column, row = np.floor(centers[:, 0] / du).astype(int), np.floor(centers[:, 1] / dv).astype(int)
    columns, rows = column[:, None, None] + side[None, None, :], row[:, None, None] + side[None, :, None]
    away = np.hypot((columns + 0.5) * du - centers[:, 0, None, None], (rows + 0.5) * dv - centers[:, 1, None, None])
    texel = (du * dv) ** 0.5
    share = np.clip((radius_m - away) / texel + 0.5, 0.0, 1.0)
    sums = np.maximum(share.sum(axis=(1, 2), keepdims=True), 1e-12)
    share = np.minimum(share * (np.pi * radius_m**2 / (du * dv)) / sums, 1.0)
    columns, rows = np.broadcast_arrays(columns % grid.columns if grid.wraps else columns, rows)
    inside = (columns >= 0) & (columns < grid.columns) & (rows >= 0) & (rows < grid.rows)
    np.maximum.at(cover, (rows[inside], columns[inside]), share[inside])
    return cover


def rivet_rows(
    grid: MapGrid, at_m: Sequence[float] | Array, pitch_m: float, radius_m: float, across: bool = False
) -> Layer:
    """(rows, columns) rows of rivets along lines as in `lines`; the pitch is fitted to the surface."""
    length = grid.width_m if across else grid.height_m
    count = max(round(length / pitch_m), 1)
    along = (np.arange(count) + 0.5) * length / count
    there, here = np.meshgrid(np.asarray(at_m, dtype=np.float64), along)
    centers = np.stack([here, there] if across else [there, here], axis=-1)
    return dots(grid, centers, radius_m)


def panel_tints(grid: MapGrid, seed: int, u_limits_m: ArrayLike, v_limits_m: ArrayLike, spread: float) -> Layer:
    """(rows, columns) factor with mean 1 by panel, as plates from several lots of paint fade unlike.

    Args:
        grid: of the map.
        seed: of the tints.
        u_limits_m, v_limits_m: where panels meet, ascending; on a map that wraps, u limits as many as panels. [m]
        spread: standard deviation between panels.
    """
    column = np.searchsorted(np.asarray(u_limits_m, dtype=np.float64), grid.x_m)
    row = np.searchsorted(np.asarray(v_limits_m, dtype=np.float64), grid.y_m)
    if grid.wraps:
        column = column % max(np.size(u_limits_m), 1)
    drawn = np.random.default_rng([seed, _PANELS]).standard_normal((int(row.max()) + 1, int(column.max()) + 1))
    tint = 1.0 + spread * np.clip(drawn, -2.0, 2.0)[row[:, None], column[None, :]]
    result: Layer = tint / tint.mean()
    return result


def stitches(
    grid: MapGrid, at_m: Sequence[float] | Array, pitch_m: float, size_m: tuple[float, float], across: bool = False
) -> Layer:
    """(rows, columns) dashes of thread along lines as in `lines`.

    Args:
        grid: of the map.
        at_m: places of the seams. [m]
        pitch_m: from one stitch to the next, fitted to the surface. [m]
        size_m: length and width of a stitch. [m]
        across: at places along v instead.
    """
    seam = lines(grid, at_m, size_m[1], across)
    place, texel, length = (
        (grid.x_m, grid.texel_m[0], grid.width_m) if across else (grid.y_m, grid.texel_m[1], grid.height_m)
    )
    pitch = length / max(round(length / pitch_m), 1)
    away = (place % pitch) - pitch / 2
    dash = np.sum([_interval_cover(away + shift, texel, size_m[0]) for shift in (-pitch, 0.0, pitch)], axis=0)
    dashes: Layer = seam * (dash[None, :] if across else dash[:, None])
    return dashes


def streaks(
    grid: MapGrid, seed: int, starts_m: ArrayLike, length_m: float, width_m: float, upstream: bool = False
) -> Layer:
    """(rows, columns) streaks of oil or soot that start at points and thin out along +v, or along -v.

    Args:
        grid: of the map.
        seed: of the streaks' lengths and bends.
        starts_m: (N, 2) along u and v. [m]
        length_m: over which a streak thins to a third, on average. [m]
        width_m: of a streak at its start; it spreads to twice that over `length_m`. [m]
        upstream: towards -v.
    """
    starts = np.asarray(starts_m, dtype=np.float64).reshape(-1, 2)
    rng = np.random.default_rng([seed, _STREAKS])
    # Drawn for every streak in turn, so that a further one leaves the others as they are.
    drawn = rng.random((len(starts), 4))
    total = np.zeros((grid.rows, grid.columns))
    for (u, v), (longer, wider, bend, strength) in zip(starts, drawn, strict=True):
        down = (v - grid.y_m if upstream else grid.y_m - v)[:, None]
        reach = length_m * (0.4 + 1.2 * longer)
        half = 0.5 * width_m * (0.6 + 0.8 * wider) * (1.0 + np.clip(down / length_m, 0.0, 3.0))
        sway = 0.5 * width_m * np.sin(down / (0.35 * length_m) + 2 * np.pi * bend)
        aside = _offset(grid.x_m[None, :] - sway, u, grid.width_m if grid.wraps else None)
        begins = np.clip(down / grid.texel_m[1] + 0.5, 0.0, 1.0)
        dark = (0.4 + 0.6 * strength) * begins * np.exp(-np.maximum(down, 0.0) / reach - (aside / half) ** 2)
        total = np.maximum(total, dark)
    return total


_EMBLEM_COLORS = (
    (0.75, 0.74, 0.70),
    (0.03, 0.06, 0.20),
    (0.45, 0.05, 0.04),
    (0.62, 0.42, 0.04),
    (0.03, 0.16, 0.08),
    (0.05, 0.05, 0.05),
    (0.10, 0.32, 0.38),
)
_SUBTEXELS = 3


def roundel(
    grid: MapGrid, seed: int, center_m: tuple[float, float], radius_m: float, toned_down: bool = False
) -> tuple[Layer, NDArray[np.float64]]:
    """An invented emblem on a disc: sectors, a lens or a ring of dots inside one or two rings; no nation's mark.

    Args:
        grid: of the map.
        seed: of the emblem.
        center_m: along u and v. [m]
        radius_m: of the disc. [m]
        toned_down: in two greys, as on grey aircraft.

    Returns:
        (rows, columns) share of each texel under the emblem, and (rows, columns, 3) its colours.
    """
    rng = np.random.default_rng([seed, _ROUNDEL])
    palette = rng.permutation(len(_EMBLEM_COLORS))[:3]
    colors = np.array([_EMBLEM_COLORS[index] for index in palette])
    if toned_down:
        colors = np.array([[0.13, 0.135, 0.14], [0.24, 0.245, 0.25], [0.18, 0.185, 0.19]])
    form, count, turn = int(rng.integers(3)), int(rng.integers(2, 6)) * 2 - 1, rng.random() * 2 * np.pi
    inner, middle = rng.uniform(0.55, 0.72), rng.uniform(0.84, 0.92)
    shift = (np.arange(_SUBTEXELS) + 0.5) / _SUBTEXELS - 0.5
    share, total = np.zeros((grid.rows, grid.columns)), np.zeros((grid.rows, grid.columns, 3))
    for down in shift * grid.texel_m[1]:
        for aside in shift * grid.texel_m[0]:
            x = _offset(grid.x_m + aside, center_m[0], grid.width_m if grid.wraps else None)[None, :] / radius_m
            y = (grid.y_m + down - center_m[1])[:, None] / radius_m
            kind = _emblem(x, y, (form, count, turn), (inner, middle))
            on = kind >= 0
            share += on
            total += np.where(on[..., None], colors[kind], 0.0)
    rgb = np.where(share[..., None] > 0, total / np.maximum(share, 1)[..., None], colors[0])
    return share / _SUBTEXELS**2, rgb


def _emblem(x: Array, y: Array, figure: tuple[int, int, float], rings: tuple[float, float]) -> NDArray[np.int64]:
    """Colour index of points of the unit disc, -1 outside."""
    form, count, turn = figure
    radius, angle = np.hypot(x, y), np.arctan2(y, x) + turn
    if form == 0:
        inside = (np.floor(angle * (count + 1) / (2 * np.pi)) % 2).astype(np.int64)
    elif form == 1:
        along, off = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
        inside = (np.hypot(along, np.abs(off) + 0.4) < 0.62).astype(np.int64)
    else:
        step = 2 * np.pi / (count + 2)
        nearest = np.rint(angle / step) * step - turn
        away = np.hypot(x - 0.36 * np.cos(nearest), y - 0.36 * np.sin(nearest))
        inside = (away < 0.3 * np.sin(step / 2)).astype(np.int64)
    kind = np.where(radius < rings[0], inside, np.where(radius < rings[1], 2, 0))
    result: NDArray[np.int64] = np.where(radius < 1.0, kind, -1)
    return result
