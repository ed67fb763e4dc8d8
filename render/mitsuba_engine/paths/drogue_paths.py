"""Every pixel's light from its own paths alone."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import RenderSettings
from geometry.stereo import Eye
from render.mitsuba_engine.jit_arrays import jit_array
from render.mitsuba_engine.paths.rays import FrameRays, Sampled, and_some_again, means_by_pixel
from render.mitsuba_engine.paths.sun_sky_integrator import trace_first, trace_rest
from render.mitsuba_engine.render_noise import TWICE_EVERY
from render.mitsuba_engine.trace_request import Plan


@dataclass(frozen=True, eq=False)
class PathLight:
    """Means over the samples of each pixel: what `trace_first` and `trace_rest` give, and coverage; (P, 3|3|1)."""

    first: NDArray[np.float32]
    rest: NDArray[np.float32]
    coverage: NDArray[np.float32]

    def seen(self) -> NDArray[np.float32]:
        """(P, 4) radiance and coverage."""
        # The rest of a dark pixel can come out below the first part's zero.
        return np.concatenate([np.maximum(self.first + self.rest, 0.0), self.coverage], axis=1)

    def with_first_of(self, other: PathLight) -> PathLight:
        """The same with what more samples say of the first surfaces."""
        return PathLight(other.first, self.rest, other.coverage)

    def __getitem__(self, part: slice) -> PathLight:
        return PathLight(self.first[part], self.rest[part], self.coverage[part])


def trace_paths(rays: FrameRays, plans: dict[Eye, Plan], settings: RenderSettings) -> Sampled:
    """Trace the planned pixels of the drogue, and some of them once more."""
    opened, sheltered, deep, edges = (rays.of_both(plans, kind) for kind in ("open", "sheltered", "deep", "edges"))
    deep_edges = rays.of_both(plans, "deep_edges")
    deep = np.concatenate([deep, deep_edges])
    depth, count = settings.max_depth, settings.samples_per_px
    fine = max(count, settings.edge_samples_per_px)
    of_open = mean_light(rays, and_some_again(opened), settings.open_samples_per_px, depth)
    of_sheltered = mean_light(rays, and_some_again(sheltered), count, depth)
    of_deep = mean_light(rays, and_some_again(deep), fine, depth)
    of_edges = mean_light(rays, and_some_again(edges), count, depth)
    if fine > count:
        of_edges = of_edges.with_first_of(mean_light(rays, and_some_again(edges), fine, 1))
    twice = [(opened, of_open), (sheltered, of_sheltered), (deep, of_deep), (edges, of_edges)]
    again = np.concatenate([pixel[::TWICE_EVERY] for pixel, _ in twice])
    return Sampled(
        np.concatenate([pixel for pixel, _ in twice]),
        np.concatenate([light[: len(pixel)].seen() for pixel, light in twice]),
        again,
        np.concatenate([light[len(pixel) :].seen() for pixel, light in twice]),
        np.zeros((len(again), 3), dtype=np.float32),
    )


def mean_light(rays: FrameRays, pixel: NDArray[np.int64], count: int, max_depth: int) -> PathLight:
    """Means over paths through random places of each pixel, at random times of the exposure.

    Args:
        rays: of the frame.
        pixel: (P,) flat indices.
        count: samples a pixel.
        max_depth: longest path in segments; 1 leaves out the light that comes by way of other surfaces.
    """
    means = [_launch(rays, part, count, max_depth) for part in rays.parts(pixel, count)]
    result = np.concatenate(means)
    return PathLight(result[:, :3], result[:, 4:], result[:, 3:4])


def _launch(rays: FrameRays, pixel: NDArray[np.int64], count: int, max_depth: int) -> NDArray[np.float32]:
    """(P, 7) means over the paths of each pixel: light of first surfaces, coverage, rest of the light."""
    sums = np.zeros((len(pixel), 7), dtype=np.float32)
    if not len(pixel):
        return sums
    lanes = len(pixel) * count
    sampler = rays.sampler(lanes, count)
    of_pixel = dr.gather(mi.UInt32, jit_array(mi.UInt32, pixel), dr.arange(mi.UInt32, lanes) // count)
    ray = rays.through(of_pixel, sampler.next_2d(), sampler.next_1d())
    first, hit, surface, known = trace_first(rays.scene, rays.lights, ray)
    channels = [*first, dr.select(hit, mi.Float(1.0), 0.0)]
    if max_depth > 1:
        channels += [*trace_rest(rays.scene, rays.lights, sampler, (surface, hit, known), max_depth)]
    sums[:, : len(channels)] = means_by_pixel(channels, count)
    return sums
