"""Marching of rays through cloud layers: how much of each ray a layer hides, where, and how deep inside."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.compiled_loops import compiled, inlined

_Field = NDArray[np.float32]

EARTH_M = 6.371e6
# Shapes of clouds with depth; the numbers are known to the compiled loops.
HEAP, SHEET, CELLS = 0, 1, 2
# Of a ray; a step is at least this share of the distance.
_MOST_STEPS, _LEAST_STEP, _CROWD = 180, 0.006, 0.12
_SURFACE_ITERATIONS = 3
# Behind this optical depth nothing is seen; light comes on average from the other.
MOST_DEPTH = 2.6
_NOWHERE_M = 1e9
_SUN_STEPS = 5
# A ray that grazes a rim goes on to another cloud. So many clouds are told apart; one with less of what is seen than
# this has no say in how bright that is. Their mean light is that of a beam with this share of the extinction.
_PARTS, _LEAST_PART, _EVEN_EXTINCTION, _LEAST_LIGHT = 4, 0.1, 0.2, 1e-30
# Each octave of lumps is finer by this factor and turned by these cosines and sines about two axes.
_FINER = 2.13
_MASK, _TILE_PX, _LUMPS_MASK = 511, 512.0, 63
# No lump of `lump_volume` is higher.
HIGHEST_LUMP = 0.33
# Lumps grow on the surface, and outside it down to this share of their amount.
_LUMP_REACH = 0.3
# Heaps of cloud are narrower below this share of their height, by so much at the base.
_ROUND_BELOW, _UNDERCUT = 0.3, 0.9
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
    # The patterns repeat along axes at this angle to the flight; otherwise repeats would line up in the view ahead.
    texels_per_m, lumps_per_m = _BLOB_TEXELS / size_m, 1.0 / lump_m
    u = (x_m * 0.93233 + y_m * 0.36162) * texels_per_m
    v = (y_m * 0.93233 - x_m * 0.36162) * texels_per_m
    lx, ly, lz = x_m * lumps_per_m + shift, y_m * lumps_per_m + 0.37 * shift, height_m * lumps_per_m
    if kind == HEAP:
        square = h * h
        # Bodies are rounded below, so that the sun does not shine through their lower rims.
        under = max(1.0 - h * (1.0 / _ROUND_BELOW), 0.0)
        fall = shape[12] * square + shape[13] * square * square + _UNDERCUT * under * under
        wide = tile_at(body, u, v) - threshold
        wide /= 1.0 + 0.25 * max(wide, 0.0)
        amount = lump_amount * (0.35 + h)
        # The most that lumps of all sizes can add.
        most = metric_m * (wide + amount * 1.5 * HIGHEST_LUMP - fall) + HIGHEST_LUMP * fine_amount_m / (1.0 - gain)
        if most < 0.0 and seen > 1.0:
            return float(most)
        swell = lump_at(lumps, lx, ly, lz)
        most += metric_m * amount * (swell - HIGHEST_LUMP)
        if most < 0.0 and seen > 1.0:
            return float(most)
        turret = lump_at(lumps, 2.2 * ly + 0.3, 2.2 * lz, 2.2 * lx)
        excess = metric_m * (wide + amount * (swell + 0.5 * turret) - fall)
        floor = height_m - 0.03 * thick_m * (1.0 - swell)
        fine = min(max(0.35 + 2.5 * h, 0.35), 1.0)
        excess = min(excess, floor)
    elif kind == SHEET:
        swell = lump_at(lumps, lx, ly, 0.6 * lz)
        wide = tile_at(body, u, v)
        other = tile_at(body, 1.9 * v + 131.0, 1.9 * u)
        top = thick_m * (0.68 + lump_amount * swell + 0.10 * other)
        floor = height_m - thick_m * (0.14 - 0.13 * swell + 0.04 * other)
        fine = min(max(0.25 + 1.6 * h, 0.25), 1.0)
        excess = min(min(top - height_m, floor), metric_m * (wide - threshold + 0.4 * swell))
    else:
        patch = tile_at(body, 0.11 * u, 0.15 * v) + 0.4 * tile_at(body, v, u)
        cell = lump_at(lumps, lx, ly, 0.4 * lz)
        small = lump_at(lumps, 2.3 * ly, 2.3 * lx + 0.5, 0.9 * lz)
        middle = 2.0 * h - 1.0
        excess = metric_m * (lump_amount * (cell + 0.45 * small) + 0.45 * patch - threshold - 0.9 * middle * middle)
        fine = 1.0
    remaining_m = fine * fine_amount_m / (1.0 - gain)
    amount_m, scale = fine * fine_amount_m, 1.0 / fine_m
    deep_m = 3.0 * shape[11]
    px, py, pz = x_m * scale + 1.7 * shift, y_m * scale, height_m * scale
    while seen > 1.0:
        if excess + HIGHEST_LUMP * remaining_m < 0.0:
            return float(excess + HIGHEST_LUMP * remaining_m)
        if excess - remaining_m > deep_m:
            return float(excess - remaining_m)
        excess = _with_lump(excess, amount_m * min(seen - 1.0, 1.0), lump_at(lumps, px, py, pz))
        remaining_m -= amount_m
        amount_m *= gain
        seen *= 1.0 / _FINER
        px, py, pz = _FINER * (0.8 * py + 0.6 * pz) + 0.31, _FINER * (0.8 * pz - 0.6 * py), _FINER * px
    return float(excess)


@compiled
def lumps_at(
    shape: NDArray[np.float64], lumps: NDArray[np.float32], x_m: float, y_m: float, height_m: float, detail_m: float
) -> float:
    """How far lumps stand out of the larger shape at a place; negative in the creases. [m]"""
    amount_m, scale, total_m = shape[8], 1.0 / shape[7], 0.0
    seen = 0.7 * shape[7] / detail_m
    px, py, pz = x_m * scale + 1.7 * shape[10], y_m * scale, height_m * scale
    while seen > 1.0:
        total_m += amount_m * min(seen - 1.0, 1.0) * lump_at(lumps, px, py, pz)
        amount_m *= shape[9]
        seen *= 1.0 / _FINER
        px, py, pz = _FINER * (0.8 * py + 0.6 * pz) + 0.31, _FINER * (0.8 * pz - 0.6 * py), _FINER * px
    return total_m


@inlined
def _height_m(z: float, distance_m: float, bend: float, base_m: float) -> float:
    return z * distance_m + bend * distance_m * distance_m - base_m


@compiled
def _depth_towards(
    shape: NDArray[np.float64],
    body: NDArray[np.float32],
    lumps: NDArray[np.float32],
    x_m: float,
    y_m: float,
    height_m: float,
    sun: NDArray[np.float64],
    detail_m: float,
    extinction: float,
) -> float:
    """Optical depth from a place towards the sun, in steps that grow up to the layer's thickness."""
    softness_m, thick_m = shape[11], shape[2]
    way_m, step_m, towards = 0.0, max(5.0, detail_m), 0.0
    for step in range(_SUN_STEPS):
        middle_m = way_m + 0.5 * step_m
        inner = excess_at(
            shape,
            body,
            lumps,
            x_m + sun[0] * middle_m,
            y_m + sun[1] * middle_m,
            height_m + sun[2] * middle_m,
            max(2.0 * detail_m, 0.5 * step_m),
        )
        soft_m = max(5.0 * softness_m, 0.5 * step_m)
        towards += min(max(inner / soft_m, 0.0), 1.0) * extinction * step_m
        way_m += step_m
        step_m *= 2.6
        if step == _SUN_STEPS - 2:
            step_m = max(step_m, 0.8 * thick_m - way_m)
    return towards


@compiled
def march_rays(
    shape: NDArray[np.float64],
    body: NDArray[np.float32],
    lumps: NDArray[np.float32],
    rays: NDArray[np.float32],
    ends_m: NDArray[np.float32],
    place: NDArray[np.float64],
    sun: NDArray[np.float64],
    found: NDArray[np.float32],
) -> None:
    """March every ray and fill in what it met.

    Args:
        shape, body, lumps: as in `excess_at`.
        rays: (N, 3) unit directions.
        ends_m: (N, 2) distances at which each ray enters and leaves the layer. [m]
        place: east and north of the camera [m], height of the base over it [m], bend of level [1/m], angle between
            rays [rad], extinction [1/m].
        sun: (3,) unit vector.
        found: (N, 6) filled in: optical depth, distance of the visible cloud [m], optical depth from there towards the
            sun, height there over the layer's thickness, how far it stands out of the larger shape [m], and the
            distance at which the ray enters cloud [m]. Where a ray sees several clouds behind each other, these are
            means over the clouds, the depth towards the sun that of their mean light.
    """
    east_m, north_m, base_m, bend = place[0], place[1], place[2], place[3]
    pixel_rad, extinction = place[4], place[5]
    thick_m, softness_m = shape[2], shape[11]
    layer_m = abs(base_m) + thick_m
    # Of each part of the ray that is inside: how much of what is seen it is, and that times its distance.
    parts = np.zeros((_PARTS, 2))
    for index in range(rays.shape[0]):
        x, y, z = float(rays[index, 0]), float(rays[index, 1]), float(rays[index, 2])
        near_m, far_m = float(ends_m[index, 0]), float(ends_m[index, 1])
        at_m, before_m, depth, part = near_m, near_m, 0.0, 0
        parts[:] = 0.0
        inside, steps, outside_m, entry_m = False, 0, -1.0, _NOWHERE_M
        while at_m < far_m and depth < MOST_DEPTH and steps < _MOST_STEPS:
            steps += 1
            # Far away clouds stand behind each other closer than rays do.
            crowd = 1.0 + _CROWD * at_m / layer_m
            detail_m, least_m = at_m * pixel_rad * crowd, _LEAST_STEP * at_m
            height_m = _height_m(z, at_m, bend, base_m)
            deep_m = excess_at(shape, body, lumps, x * at_m + east_m, y * at_m + north_m, height_m, detail_m)
            if deep_m <= 0.0:
                if inside and parts[part, 0] > 0.0:
                    part = min(part + 1, _PARTS - 1)
                inside = False
                before_m, outside_m = at_m, min(deep_m, -1e-3)
                at_m += max(-0.7 * deep_m, least_m, 1.5 * detail_m, 3.0)
                continue
            if not inside:
                inside = True
                low_m, high_m, low, high = before_m, at_m, outside_m, deep_m
                if at_m > near_m:
                    # By regula falsi after Illinois: an end that stays counts half.
                    for _ in range(_SURFACE_ITERATIONS):
                        middle_m = low_m + (high_m - low_m) * low / (low - high)
                        height_m = _height_m(z, middle_m, bend, base_m)
                        value = excess_at(
                            shape, body, lumps, x * middle_m + east_m, y * middle_m + north_m, height_m, detail_m
                        )
                        if value > 0.0:
                            high_m, high, low = middle_m, value, 0.5 * low
                        else:
                            low_m, low, high = middle_m, min(value, -1e-3), 0.5 * high
                at_m = high_m
                entry_m = min(entry_m, at_m)
            soft_m = max(softness_m * (1.0 + 4.0 * max(1.0 - 3.0 * height_m / thick_m, 0.0)), 1.5 * detail_m)
            step_m = max(0.8 / extinction, 0.5 * soft_m, 0.5 * least_m)
            middle_m = at_m + 0.5 * step_m
            height_m = _height_m(z, middle_m, bend, base_m)
            dense = excess_at(
                shape, body, lumps, x * middle_m + east_m, y * middle_m + north_m, height_m, 3.0 * detail_m
            )
            dense = min(max(dense / soft_m, 0.0), 1.0)
            dense *= dense
            more = dense * extinction * step_m
            hides = np.exp(-depth) * (1.0 - np.exp(-more))
            parts[part, 0] += hides
            parts[part, 1] += hides * middle_m
            depth += more
            before_m, outside_m = at_m, -1e-3
            at_m += step_m
        found[index, 0] = depth
        found[index, 5] = entry_m
        weight = parts[:, 0].sum()
        if weight <= 0.0:
            found[index, 1] = near_m
            found[index, 2:5] = 0.0
            continue
        seen, through, height, relief = 0.0, 0.0, 0.0, 0.0
        for which in range(part + 1):
            share = parts[which, 0] / weight
            if share < _LEAST_PART:
                continue
            at_m = parts[which, 1] / parts[which, 0]
            detail_m = at_m * pixel_rad
            px, py, pz = x * at_m + east_m, y * at_m + north_m, _height_m(z, at_m, bend, base_m)
            towards = _depth_towards(shape, body, lumps, px, py, pz, sun, detail_m, extinction)
            seen += share
            through += share * np.exp(-_EVEN_EXTINCTION * towards)
            height += share * pz / thick_m
            relief += share * lumps_at(shape, lumps, px, py, pz, detail_m)
        found[index, 1] = parts[:, 1].sum() / weight
        found[index, 2] = -np.log(max(through / seen, _LEAST_LIGHT)) / _EVEN_EXTINCTION
        found[index, 3] = height / seen
        found[index, 4] = relief / seen


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


@compiled
def starts_of(entry_m: NDArray[np.float32], every: int, index: NDArray[np.int64], width: int) -> NDArray[np.float32]:
    """Distance before which rays surely meet no cloud, or 1e9 where none is near. [m]

    Args:
        entry_m: (h, w) distances at which every `every`-th ray down and across enters cloud, 1e9 for none. [m]
        every: see there.
        index: (N,) flat indices of the rays in a picture.
        width: of that picture.
    """
    height, across = entry_m.shape
    starts = np.empty(index.size, dtype=np.float32)
    for which in range(index.size):
        row, column = index[which] // width // every, index[which] % width // every
        least = np.float32(_NOWHERE_M)
        for j in range(max(row - 1, 0), min(row + 3, height)):
            for i in range(max(column - 1, 0), min(column + 3, across)):
                least = min(least, entry_m[j, i])
        starts[which] = least
    return starts


@compiled
def enlarge(
    coarse: NDArray[np.float32],
    seen: NDArray[np.float32],
    by_opacity: bool,
    every: int,
    contrast: float,
    large: NDArray[np.float32],
    edge: NDArray[np.bool_],
) -> None:
    """Fill in a picture between every `every`-th of its rays, and mark where that is not good enough.

    Args:
        coarse: (h, w, 4) light times opacity, and opacity, of every `every`-th ray down and across.
        seen: (h, w, 3) light of these rays with what is behind the layer.
        by_opacity: whether opacity marks edges too, because what is behind is not known.
        every: see there.
        contrast: of light in any channel, over that of the brightest corner, or of opacity, between corners that marks
            an edge.
        large: (H, W, 4) filled in.
        edge: (H, W) filled in.
    """
    height, width = coarse.shape[0], coarse.shape[1]
    for row in range(large.shape[0]):
        j, b = row // every, np.float32(row % every) / np.float32(every)
        k = min(j + 1, height - 1)
        for column in range(large.shape[1]):
            i, a = column // every, np.float32(column % every) / np.float32(every)
            right = min(i + 1, width - 1)
            one = np.float32(1.0)
            for c in range(4):
                upper = coarse[j, i, c] * (one - a) + coarse[j, right, c] * a
                lower = coarse[k, i, c] * (one - a) + coarse[k, right, c] * a
                large[row, column, c] = upper * (one - b) + lower * b
            marked = False
            if a > 0 or b > 0:
                for c in range(3):
                    most = max(max(seen[j, i, c], seen[j, right, c]), max(seen[k, i, c], seen[k, right, c]))
                    least = min(min(seen[j, i, c], seen[j, right, c]), min(seen[k, i, c], seen[k, right, c]))
                    marked = marked or most - least > contrast * most
                if by_opacity and not marked:
                    most = max(max(coarse[j, i, 3], coarse[j, right, 3]), max(coarse[k, i, 3], coarse[k, right, 3]))
                    least = min(min(coarse[j, i, 3], coarse[j, right, 3]), min(coarse[k, i, 3], coarse[k, right, 3]))
                    marked = most - least > contrast
            edge[row, column] = marked


def upsample(image: NDArray[np.float32], every: int, size: tuple[int, int]) -> NDArray[np.float32]:
    """An image of every `every`-th ray, interpolated to all (H, W) rays."""
    to_coarse = np.array([[1.0 / every, 0.0, 0.0], [0.0, 1.0 / every, 0.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    large: NDArray[np.float32] = cv2.warpAffine(
        image, to_coarse, size[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    return large
