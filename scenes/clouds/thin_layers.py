"""Clouds that light shines through: cirrus, contrails, shafts of rain, and the patches of mist."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.types.environment import CloudLayer, Mist
from geometry.compiled_loops import compiled
from scenes.clouds.cloud_density import tile_at
from scenes.clouds.cloud_textures import BLOBS_PER_TILE, body_tile, ice_tiles

_Field = NDArray[np.float32]
_BODY_SLOPE, _STRAND_SLOPE, _MIST_SLOPE = 2.6, 1.6, 2.2
_RAIN_STEPS, _RAIN_REACH_M, _RAIN_LEAN = 24, 3e4, 0.35
# At most so many steps through mist, up to an optical depth behind which nothing is seen; patches are so many
# visibilities large. A step is so many patches long, far away so much of its distance: longer ones would miss what lies
# between, and stripes would show where the ways of neighbouring rays are cut into other steps.
_MIST_STEPS, _MIST_DEPTH, _PATCH_PER_VISIBILITY, _LEAST_PATCH_M = 48, 5.0, 0.5, 60.0
_MIST_STEP, _MIST_GROWTH = 0.1, 0.15
_PATCH_SHADE = 0.3
# Cirrus covers a place with more than this of the layer's optical depth; places along a side that tell its cover.
_ICE_EDGE, _ICE_SAMPLES = 0.1, 128
_ICE_GAPS = 0.005
# How fast ice thins out, and its depth over its amount.
_ICE_SOFT, _ICE_DEPTH = 1.5, 0.3

_FRESH_M = 60.0
# Contrails: at most so many, the widths that they spread to with age, and how far they bend aside. [m]
_MOST_TRAILS, _TRAIL_WIDTH_M, _TRAIL_BEND_M = 6, (_FRESH_M, 1200.0), 600.0
# Their height and the size of their puffs, in their width; steps through the height.
_TRAIL_HEIGHT, _PUFF, _TRAIL_STEPS = 0.35, 0.15, 4
# The ray goes at most so far per height: its opacity is not of a lower rise either (`_render_ice`).
_MOST_SLANT = 12.0


@compiled
def _ice_amounts(
    tiles: NDArray[np.float32], body: NDArray[np.float32], places: NDArray[np.float64], found: NDArray[np.float32]
) -> None:
    """Fill in the amount of ice with patches everywhere, and the logarithm of how its fibres differ from it.

    Args:
        tiles: as `ice_tiles` gives them.
        body: texture of the patches.
        places: (N, 3) along and across the wind, and width of the ray, in sizes of the largest patches.
        found: (N, 2) filled in.
    """
    for index in range(places.shape[0]):
        u, v, width = places[index, 0], places[index, 1], places[index, 2]
        bend = tile_at(tiles[2], 28.0 * u, 28.0 * v)
        other = tile_at(tiles[2], 28.0 * v + 211.0, 28.0 * u + 97.0)
        pu, pv = u + 0.06 * bend, v + 0.08 * other
        patch = tile_at(body, 55.0 * pu, 70.0 * pv)
        wide = tile_at(tiles[0], 90.0 * pu, 160.0 * pv)
        fine = tile_at(tiles[0], 260.0 * pu + 60.0, 500.0 * pv + 5.0 * other)
        # Faint where its texels are finer than the rays.
        seen = min(1.0 / (1400.0 * width), 1.0) if width > 0.0 else 1.0
        finest = seen * tile_at(tiles[0], 700.0 * pu, 1400.0 * pv + 20.0 * other)
        trail = tile_at(tiles[1], 58.0 * pu, 80.0 * pv)
        found[index, 0] = 0.5 + 0.65 * patch + 0.5 * wide + 0.35 * fine + 0.5 * (trail - 1.0)
        found[index, 1] = 0.12 * wide + 0.18 * fine + 0.18 * finest


def _ice_at(places: NDArray[np.float64], texture_seed: int) -> _Field:
    found = np.empty((len(places), 2), dtype=np.float32)
    _ice_amounts(ice_tiles(texture_seed), body_tile(texture_seed, _BODY_SLOPE), places, found)
    return found


@lru_cache(maxsize=16)
def _ice_samples(texture_seed: int) -> _Field:
    """(N, 2) results of `_ice_amounts` at places evenly spread over eight largest patches along and across."""
    side = (np.arange(_ICE_SAMPLES) + 0.5) * (BLOBS_PER_TILE / _ICE_SAMPLES)
    u, v = (axis.ravel() for axis in np.meshgrid(side, side))
    return _ice_at(np.column_stack([u, v, np.zeros_like(u)]), texture_seed)


def _ice_threshold(layer: CloudLayer) -> np.float32:
    """What must be taken off the amount of ice so that it covers its share of the plan."""
    if layer.cover_fraction == 0.0:
        return np.float32(np.inf)
    amount, fibres = _ice_samples(layer.texture_seed).T
    # Where `_ice_depth` is `_ICE_EDGE`.
    edge = np.log(np.expm1(_ICE_SOFT * _ICE_EDGE / _ICE_DEPTH * np.exp(-fibres))) / _ICE_SOFT
    # The thinnest of all places does not decide how thick an overcast is.
    return np.float32(np.quantile(amount - edge, max(1.0 - layer.cover_fraction, _ICE_GAPS)))


def _ice_depth(layer: CloudLayer, found: _Field) -> _Field:
    """(N,) vertical optical depth, over the layer's, of (N, 2) results of `_ice_amounts`."""
    amount, fibres = found.T
    # Smooth from nothing to much: ice thins out over a long way.
    smooth = np.log1p(np.exp(np.float32(_ICE_SOFT) * (amount - _ice_threshold(layer)))) * np.float32(1 / _ICE_SOFT)
    depth: _Field = np.float32(_ICE_DEPTH) * smooth * np.exp(fibres)
    return depth


def ice_sample_depths(layer: CloudLayer) -> _Field:
    """(N,) vertical optical depths of cirrus at places evenly spread over its plan."""
    return np.float32(layer.optical_depth) * _ice_depth(layer, _ice_samples(layer.texture_seed))


@compiled
def _trail_depth(
    tiles: NDArray[np.float32], trails: NDArray[np.float64], places: NDArray[np.float64], depth: NDArray[np.float32]
) -> None:
    """Fill in depth over its amount in a fresh contrail, as the mean over the way through its height.

    Args:
        tiles: as `ice_tiles` gives them.
        trails: (K, 4) cosine and sine of the direction, distance from the origin across it, and width. [m]
        places: (N, 5) east, north, width of the ray [m], and how far east and north the ray goes per height.
        depth: (N,) filled in.
    """
    for index in range(places.shape[0]):
        x_m, y_m, ray_m = places[index, 0], places[index, 1], places[index, 2]
        total = 0.0
        for which in range(trails.shape[0]):
            cosine, sine, aside_m, width_m = trails[which, 0], trails[which, 1], trails[which, 2], trails[which, 3]
            along_m, across_m = x_m * cosine + y_m * sine, y_m * cosine - x_m * sine - aside_m
            across_m += _TRAIL_BEND_M * 0.3 * tile_at(tiles[2], along_m / 260.0, 90.0 * which)
            high_m = _TRAIL_HEIGHT * width_m
            way_along_m = high_m * (places[index, 3] * cosine + places[index, 4] * sine)
            way_across_m = high_m * (places[index, 4] * cosine - places[index, 3] * sine)
            if abs(across_m) > 6.0 * width_m + 3.0 * ray_m + 0.5 * abs(way_across_m):
                continue
            # What lies between two steps, or two pixels, is seen as its mean.
            slant = np.sqrt(1.0 + places[index, 3] ** 2 + places[index, 4] ** 2)
            between_m = max(abs(way_along_m) / _TRAIL_STEPS, ray_m * slant)
            seen = 1.0 / np.sqrt(1.0 + (between_m / (_PUFF * width_m)) ** 2)
            spread = 0.0
            for step in range(_TRAIL_STEPS):
                share = (step + 0.5) / _TRAIL_STEPS - 0.5
                a, c = along_m + share * way_along_m, across_m + share * way_across_m
                # Puffs hang below a trail, once as far apart as its own width.
                puff = seen * tile_at(tiles[2], a / width_m * 28.0, 40.0 * which + c / width_m * 9.0)
                strand = seen * tile_at(tiles[0], a / width_m * 9.0, c / width_m * 40.0)
                spread_m = np.sqrt(width_m * width_m * (1.0 + 0.25 * puff) ** 2 + 0.25 * ray_m * ray_m)
                near = c / spread_m + 0.35 * puff
                # One edge is sharper, for the wind draws the other out.
                fall = near * near * (0.35 if near > 0.0 else 1.6)
                spread += np.exp(-fall + 0.30 * strand + 0.25 * puff) * np.sqrt(_FRESH_M / spread_m)
            total += spread / _TRAIL_STEPS
        depth[index] = total


def _trails(layer: CloudLayer) -> NDArray[np.float64]:
    """(K, 4) contrails of a layer; see `_trail_depth`. Most lie along the heading, as airways do."""
    rng = frame_generator(layer.texture_seed, 0, "contrails")
    count = 1 + round(layer.cover_fraction * (_MOST_TRAILS - 1))
    turned = np.radians(layer.heading_deg + rng.normal(0.0, 14.0, _MOST_TRAILS)) + (
        np.pi / 2 * (rng.random(_MOST_TRAILS) < 0.2)
    )
    aside_m = rng.uniform(-4.0, 4.0, _MOST_TRAILS) * layer.feature_size_m
    low, high = np.log(_TRAIL_WIDTH_M)
    width_m = np.exp(low + (high - low) * rng.random(_MOST_TRAILS) ** 1.5)
    trails: NDArray[np.float64] = np.stack([np.cos(turned), np.sin(turned), aside_m, width_m], axis=-1)[:count]
    return trails


def thin_depth(
    layer: CloudLayer,
    directions: NDArray[np.float32],
    distance_m: _Field,
    pixel_rad: float,
    offset_m: tuple[float, float],
) -> _Field:
    """(H, W) vertical optical depth at distances along (H, W, 3) directions that are `pixel_rad` apart."""
    east_m = directions[..., 0].astype(np.float64) * distance_m + offset_m[0]
    north_m = directions[..., 1].astype(np.float64) * distance_m + offset_m[1]
    width_m = distance_m.astype(np.float64) * pixel_rad
    if layer.kind == "contrail":
        rise = np.maximum(np.abs(directions[..., 2:].astype(np.float64)), 1.0 / _MOST_SLANT)
        slant = (directions[..., :2] / rise).reshape(-1, 2)
        places = np.column_stack([east_m.ravel(), north_m.ravel(), width_m.ravel(), slant])
        depth = np.empty(distance_m.size, dtype=np.float32)
        _trail_depth(ice_tiles(layer.texture_seed), _trails(layer), places, depth)
    else:
        cosine, sine = (float(turn(np.radians(layer.heading_deg))) for turn in (np.cos, np.sin))
        along_m, across_m = east_m * cosine + north_m * sine, north_m * cosine - east_m * sine
        places = np.stack([along_m.ravel(), across_m.ravel(), width_m.ravel()], axis=-1) / layer.feature_size_m
        depth = _ice_depth(layer, _ice_at(places, layer.texture_seed))
    result: _Field = np.float32(layer.optical_depth) * depth.reshape(distance_m.shape)
    return result


@compiled
def _shaft_depth(
    body: NDArray[np.float32],
    fibres: NDArray[np.float32],
    rays: NDArray[np.float32],
    ends_m: NDArray[np.float32],
    numbers: NDArray[np.float64],
    found: NDArray[np.float32],
) -> None:
    """Fill in (N, 2) optical depth and mean distance [m] of rain along (N, 3) rays between (N, 2) distances.

    Args:
        body, fibres: textures of the showers, and of the strands in them.
        rays, ends_m: see above.
        numbers: east and north of the camera, height of the lower end over it, thickness, size of the showers [m],
            threshold, extinction [1/m], and lean east and north per height.
        found: see above.
    """
    east_m, north_m, base_m, thick_m, size_m = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    for index in range(rays.shape[0]):
        x, y, z = float(rays[index, 0]), float(rays[index, 1]), float(rays[index, 2])
        near_m, far_m = float(ends_m[index, 0]), min(float(ends_m[index, 1]), float(ends_m[index, 0]) + _RAIN_REACH_M)
        step_m = (far_m - near_m) / _RAIN_STEPS
        depth, weighted_m = 0.0, 0.0
        for step in range(_RAIN_STEPS):
            at_m = near_m + (step + 0.5) * step_m
            h = min(max((z * at_m + at_m * at_m / 1.2742e7 - base_m) / thick_m, 0.0), 1.0)
            fallen_m = (1.0 - h) * thick_m
            u = (x * at_m + east_m + numbers[7] * fallen_m) / size_m
            v = (y * at_m + north_m + numbers[8] * fallen_m) / size_m
            shower = tile_at(body, 64.0 * u, 64.0 * v) - numbers[5]
            if shower <= -0.5:
                continue
            strand = tile_at(fibres, 300.0 * u, 300.0 * v) + tile_at(fibres, 130.0 * v + 77.0, 130.0 * u)
            # Drops evaporate on their way: the weaker the shower, the earlier; none begins sharply.
            left = min(max(2.2 * h + 0.8 * shower - 0.5, 0.0), 1.0) * min(8.0 * (1.0 - h), 1.0)
            more = left * min(shower + 0.5, 1.5) * np.exp(0.35 * strand) * numbers[6] * step_m
            depth += more
            weighted_m += more * at_m
        found[index, 0] = depth
        found[index, 1] = weighted_m / depth if depth > 0.0 else near_m


def shaft_depth(
    layer: CloudLayer, directions: NDArray[np.float32], ends_m: tuple[_Field, _Field], offset_m: tuple[float, float]
) -> tuple[_Field, _Field]:
    """Optical depth of rain along (H, W, 3) directions between two (H, W) distances, and its mean distance. [m]"""
    lean = _RAIN_LEAN * np.array([np.cos(np.radians(layer.heading_deg)), np.sin(np.radians(layer.heading_deg))])
    numbers = np.array(
        [
            *offset_m,
            layer.height_above_camera_m,
            layer.thickness_m,
            layer.feature_size_m,
            float(ndtri(np.clip(1.0 - layer.cover_fraction, 1e-4, 1.0 - 1e-4))),
            layer.optical_depth / layer.thickness_m,
            *lean,
        ]
    )
    found = np.empty((directions.shape[0] * directions.shape[1], 2), dtype=np.float32)
    body, fibres = body_tile(layer.texture_seed, _BODY_SLOPE), body_tile(layer.texture_seed + 1, _STRAND_SLOPE)
    rays = np.ascontiguousarray(directions.reshape(-1, 3), dtype=np.float32)
    _shaft_depth(body, fibres, rays, np.stack([end_m.ravel() for end_m in ends_m], axis=-1), numbers, found)
    return found[:, 0].reshape(directions.shape[:2]), found[:, 1].reshape(directions.shape[:2])


@compiled
def _mist_depth(
    body: NDArray[np.float32], rays: NDArray[np.float32], numbers: NDArray[np.float64], found: NDArray[np.float32]
) -> None:
    """Fill in (N, 2) optical depth of patchy mist along (N, 3) rays, and how dense the visible part is.

    Args:
        body: texture of the patches.
        rays: see above.
        numbers: east and north of the camera, extent of the mist above and below [m], extinction [1/m], patchiness,
            and size of the patches [m].
        found: see above.
    """
    above_m, below_m, extinction, patchy, size_m = numbers[2], numbers[3], numbers[4], numbers[5], numbers[6]
    for index in range(rays.shape[0]):
        x, y, z = float(rays[index, 0]), float(rays[index, 1]), float(rays[index, 2])
        reach_m = (above_m if z > 0.0 else below_m) / max(abs(z), 1e-6)
        start_m, total, dense, weight = 0.0, 0.0, 0.0, 1e-6
        for _ in range(_MIST_STEPS):
            if start_m >= reach_m or total > _MIST_DEPTH:
                break
            length_m = min(max(_MIST_STEP * size_m, _MIST_GROWTH * start_m), reach_m - start_m)
            at_m = start_m + 0.5 * length_m
            start_m += length_m
            u, v, h = (x * at_m + numbers[0]) / size_m, (y * at_m + numbers[1]) / size_m, z * at_m / size_m
            noise = tile_at(body, 64.0 * u + 31.0 * h, 64.0 * v + 9.0 * h)
            noise += 0.6 * tile_at(body, 210.0 * h, 70.0 * u + 25.0 * v) + 0.5 * tile_at(body, 200.0 * v, 200.0 * u)
            # Around the camera it is what its visibility says.
            near = at_m / (at_m + 0.1 * size_m)
            more = np.exp(patchy * near * (0.9 * noise - 0.6 * patchy)) * extinction * length_m
            hides = np.exp(-total) * (1.0 - np.exp(-more))
            dense += hides * noise * near
            weight += hides
            total += more
        found[index, 0] = total + (reach_m - start_m) * extinction
        found[index, 1] = dense / weight


def mist_depth(
    mist: Mist, directions: NDArray[np.floating[Any]], offset_m: tuple[float, float]
) -> tuple[_Field, _Field]:
    """Optical depth of mist along (..., 3) unit directions, and its light over the mean; both (...).

    Dense patches stop the light from above; the air between them is brighter.
    """
    rays = np.ascontiguousarray(np.reshape(directions, (-1, 3)), dtype=np.float32)
    found = np.empty((len(rays), 2), dtype=np.float32)
    size_m = max(_PATCH_PER_VISIBILITY * mist.visibility_m, _LEAST_PATCH_M)
    numbers = np.array([*offset_m, mist.above_m, mist.below_m, mist.extinction_per_m, mist.patchiness, size_m])
    _mist_depth(body_tile(mist.texture_seed, _MIST_SLOPE), rays, numbers, found)
    size = np.shape(directions)[:-1]
    tone = np.exp(np.float32(-_PATCH_SHADE * mist.patchiness) * np.clip(found[:, 1], -1.5, 1.5))
    return found[:, 0].reshape(size), tone.reshape(size)
