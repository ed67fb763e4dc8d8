"""Marching of rays through cloud layers: how much of each ray a layer hides, where, and how deep inside."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.compiled_loops import compiled, inlined
from scenes.clouds.cloud_density import excess_at, lumps_at, softness_m

_Field = NDArray[np.float32]

EARTH_M = 6.371e6
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
    thick_m = shape[2]
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
            soft_m = max(softness_m(shape, body, x * at_m + east_m, y * at_m + north_m, height_m), 1.5 * detail_m)
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
            relief += share * lumps_at(shape, body, lumps, px, py, pz, detail_m)
        found[index, 1] = parts[:, 1].sum() / weight
        found[index, 2] = -np.log(max(through / seen, _LEAST_LIGHT)) / _EVEN_EXTINCTION
        found[index, 3] = height / seen
        found[index, 4] = relief / seen


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
