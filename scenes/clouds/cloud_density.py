"""The density of clouds with depth: how deep a place is inside, from textures of bodies and lumps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.compiled_loops import compiled, inlined

# Shapes of clouds with depth; the numbers are known to the compiled loops.
HEAP, SHEET, CELLS = 0, 1, 2
# Each octave of lumps is finer by this factor and turned by these cosines and sines about two axes.
_FINER = 2.13
_MASK, _LUMPS_MASK = 511, 63
# No lump of `lump_volume` is higher.
HIGHEST_LUMP = 0.33
# Lumps grow on the surface, and outside it down to this share of their amount.
_LUMP_REACH = 0.3
# Heaps of cloud are narrower below this share of their height, by so much at the base.
_ROUND_BELOW, _UNDERCUT = 0.3, 0.9
# Dry air that mixes in at the sides of heaps tears them: the edge gets deeper by this factor, and instead of the lumps
# so much of the creases between them stands out. Edges get deeper towards the base, too.
_TORN_DEPTH, _TORN_CREASES, _HEAP_BASE_DEPTH, _BASE_DEPTH = 8.0, 0.8, 3.0, 4.0
# Sheets thin out towards their gaps, over a share of the larger shape's unit.
_GAP_EDGE = 1.5
# Lumps of heaps are bent by this much of their size, so that they differ in size and form.
_BENT = 0.2
_BLOB_TEXELS, _LUMP_TEXELS = 64.0, 64.0 / 6.0


@inlined
def tile_at(tile: NDArray[np.float32], u: float, v: float) -> float:
    """Value of a (512, 512) periodic tile at column u and row v, bilinear."""
    left, top = np.floor(u), np.floor(v)
    a, b = u - left, v - top
    i, j = int(left) & _MASK, int(top) & _MASK
    right, below = (i + 1) & _MASK, (j + 1) & _MASK
    upper = tile[j, i] + a * (tile[j, right] - tile[j, i])
    lower = tile[below, i] + a * (tile[below, right] - tile[below, i])
    return float(upper + b * (lower - upper))


@inlined
def lump_at(volume: NDArray[np.float32], x: float, y: float, z: float) -> float:
    """Value of the periodic volume of lumps at a place in lumps, trilinear."""
    x, y, z = x * _LUMP_TEXELS, y * _LUMP_TEXELS, z * _LUMP_TEXELS
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    a, b, c = x - fx, y - fy, z - fz
    i, j, k = int(fx) & _LUMPS_MASK, int(fy) & _LUMPS_MASK, int(fz) & _LUMPS_MASK
    i1, j1, k1 = (i + 1) & _LUMPS_MASK, (j + 1) & _LUMPS_MASK, (k + 1) & _LUMPS_MASK
    e = volume[k, j, i] + a * (volume[k, j, i1] - volume[k, j, i])
    f = volume[k, j1, i] + a * (volume[k, j1, i1] - volume[k, j1, i])
    g = volume[k1, j, i] + a * (volume[k1, j, i1] - volume[k1, j, i])
    h = volume[k1, j1, i] + a * (volume[k1, j1, i1] - volume[k1, j1, i])
    e += b * (f - e)
    g += b * (h - g)
    return float(e + c * (g - e))


@inlined
def _with_lump(excess: float, amount: float, lump: float) -> float:
    """An excess with a lump on it, which is less outside than on the surface, for no lump floats alone."""
    if lump > 0.0 and excess < 0.0:
        lump *= max(1.0 + excess / (_LUMP_REACH * amount), 0.0)
    return float(excess + amount * lump)


@inlined
def _plan_texels(size_m: float, x_m: float, y_m: float, height_m: float) -> tuple[float, float, float]:
    """Column and row of a place in the texture of bodies, and its height in texels."""
    texels_per_m = _BLOB_TEXELS / size_m
    # The patterns repeat along axes at this angle to the flight; otherwise repeats would line up in the view ahead.
    u, v = (x_m * 0.93233 + y_m * 0.36162) * texels_per_m, (y_m * 0.93233 - x_m * 0.36162) * texels_per_m
    return u, v, height_m * texels_per_m


@inlined
def _torn_share(body: NDArray[np.float32], u: float, v: float, wide: float, h: float) -> float:
    """How far dry air tears a heap at a place: 0 not at all, 1 wholly. Thin bodies and low places are torn more."""
    torn = 0.65 + 0.45 * tile_at(body, 0.43 * v + 77.0, 0.43 * u) - 0.5 * wide - 0.35 * h
    return float(min(max(torn, 0.0), 1.0))


@inlined
def _gap_share(wide: float) -> float:
    """How close a place of a sheet is to a gap: 0 not at all, 1 at its edge and beyond."""
    return float(min(max(1.0 - _GAP_EDGE * wide, 0.0), 1.0))


@inlined
def _edge_depth(kind: int, torn: float, h: float) -> float:
    """Depth over which an edge gets dense, over that of a top which is not torn."""
    base = _HEAP_BASE_DEPTH if kind == HEAP else _BASE_DEPTH
    return float(1.0 + max(base * max(1.0 - 3.0 * h, 0.0), _TORN_DEPTH * torn))


@inlined
def _stands_out(torn: float) -> float:
    """Factor by which lumps stand out of a heap; below 0 their creases do."""
    return float(1.0 - (1.0 + _TORN_CREASES) * min(max(6.0 * torn - 3.0, 0.0), 1.0))


@inlined
def _bends(body: NDArray[np.float32], u: float, v: float, up: float) -> tuple[float, float]:
    """Two values that bend lumps, from oblique cuts through a texture, so that they change with the height, too."""
    bend = tile_at(body, 1.3 * v + up + 211.0, 1.3 * u - 0.7 * up)
    return bend, tile_at(body, 1.3 * u - up + 97.0, 1.3 * v + 0.7 * up + 301.0)


@inlined
def _fine_lumps(
    body: NDArray[np.float32], u: float, v: float, up: float, h: float, turn: float
) -> tuple[float, float, float, float]:
    """Of finer lumps on a heap: by how many lumps they are shifted along three axes, and their amount."""
    x = _BENT * tile_at(body, 4.1 * v + 3.0 * up, 4.3 * u - 2.0 * up + 50.0)
    y = _BENT * tile_at(body, 4.3 * u + 3.0 * up + 250.0, 4.1 * v + 2.0 * up)
    rough = min(max(0.85 + 0.3 * turn, 0.5), 1.0)
    return x, y, 0.7 * (x - y), rough * min(max(0.5 + 2.5 * h, 0.5), 1.0)


@compiled
def excess_at(
    shape: NDArray[np.float64],
    body: NDArray[np.float32],
    lumps: NDArray[np.float32],
    x_m: float,
    y_m: float,
    height_m: float,
    detail_m: float,
) -> float:
    """How deep a place is inside the cloud, about; negative outside. [m]

    Where detail is seen but cannot change the side of the surface, it is a bound: the place is at most as deep, or at
    least. Without detail, with a `detail_m` above all lumps, it is exact.

    Args:
        shape: see `CloudShape`.
        body, lumps: textures.
        x_m, y_m: place east and north of the layer's origin. [m]
        height_m: over the base. [m]
        detail_m: size of the smallest detail that matters. [m]
    """
    kind, size_m, thick_m, threshold = int(shape[0]), shape[1], shape[2], shape[3]
    metric_m, lump_m, lump_amount = shape[4], shape[5], shape[6]
    fine_m, fine_amount_m, gain, shift = shape[7], shape[8], shape[9], shape[10]
    h = height_m * (1.0 / thick_m)
    if h < -0.1:
        return float(-0.5 * thick_m - (-0.1 - h) * thick_m)
    if h > 1.2:
        return float(-0.1 * thick_m - (h - 1.2) * thick_m)
    # A lump of less than 1.4 details is not seen, one of 2.8 fully.
    seen = 0.7 * fine_m / detail_m
    u, v, up = _plan_texels(size_m, x_m, y_m, height_m)
    lumps_per_m = 1.0 / lump_m
    px, py, pz = x_m / fine_m + 1.7 * shift, y_m / fine_m, height_m / fine_m
    stands_out, highest, torn = 1.0, HIGHEST_LUMP, 0.0
    lx, ly, lz = x_m * lumps_per_m + shift, y_m * lumps_per_m + 0.37 * shift, height_m * lumps_per_m
    if kind == HEAP:
        square = h * h
        # Bodies are rounded below, so that the sun does not shine through their lower rims.
        under = max(1.0 - h * (1.0 / _ROUND_BELOW), 0.0)
        fall = shape[12] * square + shape[13] * square * square + _UNDERCUT * under * under
        wide = tile_at(body, u, v) - threshold
        width = wide / (1.0 + 0.25 * max(wide, 0.0))
        amount = lump_amount * (0.35 + h)
        # The most that lumps of all sizes can add.
        most = metric_m * (width + amount * 1.5 * HIGHEST_LUMP - fall) + _LUMP_REACH * fine_amount_m
        if most < 0.0 and seen > 1.0:
            return float(most)
        bend, turn = _bends(body, u, v, up)
        lx, ly, lz = lx + _BENT * bend, ly + _BENT * turn, lz + 0.5 * _BENT * (bend - turn)
        swell = lump_at(lumps, lx, ly, lz)
        most += metric_m * amount * (swell - HIGHEST_LUMP)
        if most < 0.0 and seen > 1.0:
            return float(most)
        turret = lump_at(lumps, 2.2 * ly + 0.3, 2.2 * lz, 2.2 * lx)
        excess = metric_m * (width + amount * (swell + 0.5 * turret) - fall)
        floor = height_m - 0.03 * thick_m * (1.0 - swell)
        excess = min(excess, floor)
        torn = _torn_share(body, u, v, wide, h)
        stands_out = _stands_out(torn)
        highest = max(HIGHEST_LUMP * stands_out, -stands_out)
        across, ahead, above, fine = _fine_lumps(body, u, v, up, h, turn)
        px, py, pz = px + across, py + ahead, pz + above
    elif kind == SHEET:
        swell = lump_at(lumps, lx, ly, 0.6 * lz)
        wide = tile_at(body, u, v) - threshold
        torn = _gap_share(wide)
        other = tile_at(body, 1.9 * v + 131.0, 1.9 * u)
        top = thick_m * (0.68 + lump_amount * swell + 0.10 * other)
        floor = height_m - thick_m * (0.14 - 0.13 * swell + 0.04 * other)
        fine = min(max(0.25 + 1.6 * h, 0.25), 1.0)
        excess = min(min(top - height_m, floor), metric_m * (wide + 0.4 * swell))
    else:
        patch = tile_at(body, 0.11 * u, 0.15 * v) + 0.4 * tile_at(body, v, u)
        cell = lump_at(lumps, lx, ly, 0.4 * lz)
        small = lump_at(lumps, 2.3 * ly, 2.3 * lx + 0.5, 0.9 * lz)
        middle = 2.0 * h - 1.0
        excess = metric_m * (lump_amount * (cell + 0.45 * small) + 0.45 * patch - threshold - 0.9 * middle * middle)
        fine = 1.0
    remaining_m = fine * fine_amount_m / (1.0 - gain)
    amount_m, deep_m = fine * fine_amount_m, 3.0 * shape[11] * _edge_depth(kind, torn, h)
    while seen > 1.0:
        most_m = min(highest * remaining_m, _LUMP_REACH * amount_m)
        if excess + most_m < 0.0:
            return float(excess + most_m)
        if excess - remaining_m > deep_m:
            return float(excess - remaining_m)
        excess = _with_lump(excess, amount_m * min(seen - 1.0, 1.0), stands_out * lump_at(lumps, px, py, pz))
        remaining_m -= amount_m
        amount_m *= gain
        seen *= 1.0 / _FINER
        px, py, pz = _FINER * (0.8 * py + 0.6 * pz) + 0.31, _FINER * (0.8 * pz - 0.6 * py), _FINER * px
    return float(excess)


@compiled
def lumps_at(
    shape: NDArray[np.float64],
    body: NDArray[np.float32],
    lumps: NDArray[np.float32],
    x_m: float,
    y_m: float,
    height_m: float,
    detail_m: float,
) -> float:
    """How far lumps stand out of the larger shape at a place; negative in the creases. [m]"""
    amount_m, scale, total_m = shape[8], 1.0 / shape[7], 0.0
    seen = 0.7 * shape[7] / detail_m
    px, py, pz = x_m * scale + 1.7 * shape[10], y_m * scale, height_m * scale
    if int(shape[0]) == HEAP:
        u, v, up = _plan_texels(shape[1], x_m, y_m, height_m)
        h = height_m / shape[2]
        across, ahead, above, fine = _fine_lumps(body, u, v, up, h, _bends(body, u, v, up)[1])
        px, py, pz = px + across, py + ahead, pz + above
        amount_m *= fine * _stands_out(_torn_share(body, u, v, tile_at(body, u, v) - shape[3], h))
    while seen > 1.0:
        total_m += amount_m * min(seen - 1.0, 1.0) * lump_at(lumps, px, py, pz)
        amount_m *= shape[9]
        seen *= 1.0 / _FINER
        px, py, pz = _FINER * (0.8 * py + 0.6 * pz) + 0.31, _FINER * (0.8 * pz - 0.6 * py), _FINER * px
    return total_m


@compiled
def softness_m(shape: NDArray[np.float64], body: NDArray[np.float32], x_m: float, y_m: float, height_m: float) -> float:
    """Depth over which the edge at a place gets dense. [m]"""
    kind, h, torn = int(shape[0]), height_m / shape[2], 0.0
    if kind != CELLS:
        u, v, _ = _plan_texels(shape[1], x_m, y_m, height_m)
        wide = tile_at(body, u, v) - shape[3]
        torn = _torn_share(body, u, v, wide, h) if kind == HEAP else _gap_share(wide)
    return float(shape[11] * _edge_depth(kind, torn, h))


@compiled
def layer_excess(
    shape: NDArray[np.float64],
    body: NDArray[np.float32],
    lumps: NDArray[np.float32],
    places_m: NDArray[np.float64],
    detail_m: float,
) -> NDArray[np.float64]:
    """(N,) results of `excess_at` for (N, 3) places: east, north, and height over the base. [m]"""
    excess_m = np.empty(places_m.shape[0])
    for index in range(places_m.shape[0]):
        x_m, y_m, height_m = places_m[index, 0], places_m[index, 1], places_m[index, 2]
        excess_m[index] = excess_at(shape, body, lumps, x_m, y_m, height_m, detail_m)
    return excess_m
