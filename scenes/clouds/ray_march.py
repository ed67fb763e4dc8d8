"""Ray marching through a cloud layer: optical depth of each ray, and where the cloud's surface is."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from scenes.clouds.cloud_density import CloudDensity

_Field = NDArray[np.float32]

# Steps through a layer by kind: inside a cloud, and at its edges, where a ray may hit little of it.
_STEPS = {"cumulus": 30, "stratus": 16}
_EDGE_STEPS = {"cumulus": 36, "stratus": 20}
# A ray at an edge starts before the nearest cloud around it, and ends behind the farthest, by these factors.
_BEFORE_CLOUD, _BEHIND_CLOUD = np.float32(0.92), np.float32(1.05)
# Lengths of the steps towards the sun, in thicknesses of the layer.
_SUN_STEPS = (0.05, 0.09, 0.16, 0.3)
# A surface is visible behind less optical depth than this; behind the other depth nothing is visible.
_SEEN_AT_DEPTH, _MOST_DEPTH = 0.5, np.float32(16.0)
_SURFACE_ITERATIONS = 2
# Light comes on average from this optical depth inside the surface.
_LIGHT_DEPTH = 1.5
# Neighbouring rays that differ by this factor in distance, or by this much in transmission, have an edge between them.
_EDGE_DISTANCE, _EDGE_THROUGH = 1.08, 0.25
_ROW = 256
# Rays that are marched at a time, so that they fit the processor's cache.
_RAYS_AT_ONCE = 12_000
_NOWHERE_M = 1e9


@dataclass(frozen=True, eq=False)
class MarchResult:
    """Cloud along rays.

    Attributes:
        depth: (H, W) optical depth of all cloud in the ray.
        distance_m: (H, W) distance of its surface. [m]
        towards_sun: (H, W) optical depth from the surface towards the sun.
    """

    depth: _Field
    distance_m: _Field
    towards_sun: _Field


def march(density: CloudDensity, directions: NDArray[np.float32], sun: NDArray[np.float64], every: int) -> MarchResult:
    """March (H, W, 3) unit directions.

    Args:
        density: of the layer.
        directions: neighbours in the array must be neighbours in direction if `every` is not 1.
        sun: (3,) unit vector.
        every: march one in so many rays down and across, and of the others those at edges.
    """
    kind = density.layer.kind
    if every == 1:
        return _march_all(density, directions, sun, _EDGE_STEPS[kind])
    coarse = _march_all(density, np.ascontiguousarray(directions[::every, ::every]), sun, _STEPS[kind])
    size = (directions.shape[0], directions.shape[1])
    # Distance and light are undefined where there is no cloud: both are interpolated with the cloud's weight.
    weight = 1.0 - np.exp(-coarse.depth) + np.float32(1e-3)
    stacked = np.stack([coarse.depth, weight, coarse.distance_m * weight, coarse.towards_sun * weight], axis=-1)
    fine = upsample(stacked, every, size)
    depth, distance_m, towards_sun = fine[..., 0], fine[..., 2] / fine[..., 1], fine[..., 3] / fine[..., 1]
    edges, nearest_m, last_m = _edges(coarse)
    edge = np.flatnonzero(upsample(edges, every, size) > 0)
    if len(edge):
        # Whole rows of rays, because textures are sampled as images.
        padded = np.resize(edge, (-(-len(edge) // _ROW), _ROW))
        block = padded // size[1] // every, padded % size[1] // every
        ends_m = _BEFORE_CLOUD * nearest_m[block], last_m[block] + np.float32(density.layer.thickness_m)
        near = _march_all(density, directions.reshape(-1, 3)[padded], sun, _EDGE_STEPS[kind], ends_m)
        for values, marched in ((depth, near.depth), (distance_m, near.distance_m), (towards_sun, near.towards_sun)):
            values.reshape(-1)[padded] = marched
    return MarchResult(depth=depth, distance_m=distance_m, towards_sun=towards_sun)


def upsample(image: NDArray[np.float32], every: int, size: tuple[int, int]) -> NDArray[np.float32]:
    """An image of every `every`-th ray, interpolated to all (H, W) rays."""
    to_coarse = np.array([[1.0 / every, 0.0, 0.0], [0.0, 1.0 / every, 0.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    large: NDArray[np.float32] = cv2.warpAffine(
        image, to_coarse, size[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    return large


def _edges(coarse: MarchResult) -> tuple[_Field, _Field, _Field]:
    """Where edges of cloud are, and where cloud begins and ends.

    Returns:
        (H, W) 1 at rays next to an edge of the cloud or between two clouds, 0 elsewhere; (H, W) distance of the nearest
        cloud in the ray or its eight neighbours, 0 without any [m]; and (H, W) distance behind which there is none,
        known where one of them has little or none. [m]
    """
    block = np.ones((3, 3), dtype=np.uint8)
    through = np.exp(-coarse.depth)
    cloudy = through < 0.97
    farthest = cv2.dilate(np.where(cloudy, coarse.distance_m, np.float32(0.0)), block)
    nearest = cv2.erode(np.where(cloudy, coarse.distance_m, np.float32(_NOWHERE_M)), block)
    clearest = cv2.dilate(through, block)
    frayed = clearest - cv2.erode(through, block) > _EDGE_THROUGH
    edge: _Field = (frayed | (farthest > _EDGE_DISTANCE * nearest)).astype(np.float32)
    last = np.where((clearest > 0.5) & (farthest > 0), _BEHIND_CLOUD * farthest, np.float32(_NOWHERE_M))
    return edge, np.where(nearest < _NOWHERE_M, nearest, np.float32(0.0)), last


def _march_all(
    density: CloudDensity,
    directions: NDArray[np.float32],
    sun: NDArray[np.float64],
    steps: int,
    ends_m: tuple[_Field, _Field] | None = None,
) -> MarchResult:
    """March every ray, between distances `ends_m` (H, W) where those lie inside the layer."""
    rise = directions[..., 2] * np.float32(1.0 if density.layer.is_above else -1.0)
    near_m, far_m = density.crossing(rise)
    if ends_m is not None:
        near_m, far_m = (np.clip(end_m, near_m, far_m) for end_m in ends_m)
    depth, distance_m, towards_sun = (np.empty_like(near_m) for _ in range(3))
    inside_m = np.float32(_LIGHT_DEPTH / density.extinction_per_m)
    several = max(1, _RAYS_AT_ONCE // directions.shape[1])
    for first in range(0, directions.shape[0], several):
        rows = slice(first, first + several)
        depth[rows], distance_m[rows] = _through(density, directions[rows], (near_m[rows], far_m[rows]), steps)
        if depth[rows].any():
            place = density.place(directions[rows], distance_m[rows] + inside_m)
            towards_sun[rows] = _depth_towards_sun(density, place, sun)
        else:
            towards_sun[rows] = 0.0
    return MarchResult(depth=depth, distance_m=distance_m, towards_sun=towards_sun)


def _through(
    density: CloudDensity, directions: NDArray[np.float32], ends_m: tuple[_Field, _Field], steps: int
) -> tuple[_Field, _Field]:
    """Optical depth between two distances, and distance of the surface.

    Density is linear between samples, so that its edge is between them and not at one of them.
    """
    near_m, far_m = ends_m
    total = np.zeros(near_m.shape, dtype=np.float32)
    step_m = (far_m - near_m) / np.float32(steps)
    per_step = step_m * np.float32(density.extinction_per_m)
    before = density.excess(directions, near_m)
    entry_m, outside, inside = near_m.copy(), np.full_like(near_m, -1e-6), np.full_like(near_m, 1e6)
    for index in range(1, steps + 1):
        here = density.excess(directions, near_m + np.float32(index) * step_m)
        enters = (before <= 0) & (here > 0) & (total < _SEEN_AT_DEPTH)
        np.copyto(entry_m, near_m + np.float32(index - 1) * step_m, where=enters)
        np.copyto(outside, before, where=enters)
        np.copyto(inside, here, where=enters)
        total += np.minimum(_mean_positive(before, here) * np.float32(density.steepness), 1.0) * per_step
        before = here
        if total.min() >= _MOST_DEPTH:
            break
    np.minimum(total, _MOST_DEPTH, out=total)
    # The surface between the two samples, by regula falsi; each iteration keeps the end that still brackets it.
    low, high = np.zeros_like(entry_m), np.ones_like(entry_m)
    for _ in range(_SURFACE_ITERATIONS):
        part = low + (high - low) * outside / (outside - inside)
        value = density.excess(directions, entry_m + part * step_m)
        beyond = value > 0
        high, inside = np.where(beyond, part, high), np.where(beyond, value, inside)
        low, outside = np.where(beyond, low, part), np.where(beyond, outside, value)
    return total, entry_m + (low + (high - low) * outside / (outside - inside)) * step_m


def _mean_positive(first: _Field, last: _Field) -> _Field:
    """Mean of the positive part of a value that varies linearly from `first` to `last`."""
    change = last - first
    flat = np.abs(change) < 1e-4
    a, b = np.maximum(first, 0.0), np.maximum(last, 0.0)
    mean: _Field = np.where(flat, 0.5 * (a + b), 0.5 * (b * b - a * a) / np.where(flat, np.float32(1.0), change))
    return mean


def _depth_towards_sun(density: CloudDensity, place: NDArray[np.float32], sun: NDArray[np.float64]) -> _Field:
    """(H, W) optical depth from (H, W, 3) positions towards the sun."""
    total = np.zeros(place.shape[:2], dtype=np.float32)
    reached = 0.0
    for step in _SUN_STEPS:
        length_m = step * density.layer.thickness_m
        at = place + sun.astype(np.float32) * np.float32(reached + 0.5 * length_m)
        inside = np.clip(density.excess_at(at) * np.float32(density.steepness), 0.0, 1.0)
        total += inside * np.float32(length_m * density.extinction_per_m)
        reached += length_m
    return total
