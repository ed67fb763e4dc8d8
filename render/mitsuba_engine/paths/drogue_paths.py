"""The drogue without denoising: the light of every pixel from its own paths alone."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import RenderSettings
from geometry.stereo import Eye
from render.mitsuba_engine.jit_arrays import jit_array
from render.mitsuba_engine.paths.rays import FrameRays, SampledLight, means_by_pixel, with_duplicates
from render.mitsuba_engine.paths.sun_sky_integrator import trace_direct, trace_residual
from render.mitsuba_engine.render_noise import DUPLICATE_EVERY
from render.mitsuba_engine.trace_request import SamplingPlan


@dataclass(frozen=True, eq=False)
class PathRadiance:
    """Means over the samples of each pixel.

    Attributes:
        direct: (P, 3) of `trace_direct`. [cd/m2]
        residual: (P, 3) of `trace_residual`. [cd/m2]
        coverage: (P, 1) share of the pixel that parts cover.
    """

    direct: NDArray[np.float32]
    residual: NDArray[np.float32]
    coverage: NDArray[np.float32]

    def radiance_and_coverage(self) -> NDArray[np.float32]:
        """(P, 4) radiance of parts, and coverage."""
        # The residual of a dark pixel can be less than minus its direct light.
        return np.concatenate([np.maximum(self.direct + self.residual, 0.0), self.coverage], axis=1)

    def with_direct_of(self, other: PathRadiance) -> PathRadiance:
        """The same with direct light and coverage from another estimate, of more samples."""
        return PathRadiance(direct=other.direct, residual=self.residual, coverage=other.coverage)

    def __getitem__(self, rows: slice) -> PathRadiance:
        return PathRadiance(direct=self.direct[rows], residual=self.residual[rows], coverage=self.coverage[rows])


def trace_paths(rays: FrameRays, plans: dict[Eye, SamplingPlan], settings: RenderSettings) -> SampledLight:
    """Trace the planned pixels of the drogue, and some of them a second time."""
    opened, sheltered, deep, edges = (
        rays.pixels_of_both_eyes(plans, kind) for kind in ("open", "sheltered", "deep", "edges")
    )
    deep_edges = rays.pixels_of_both_eyes(plans, "deep_edges")
    deep = np.concatenate([deep, deep_edges])
    depth, count = settings.max_depth, settings.samples_per_px
    fine = max(count, settings.edge_samples_per_px)
    of_open = mean_radiance(rays, with_duplicates(opened), settings.open_samples_per_px, depth)
    of_sheltered = mean_radiance(rays, with_duplicates(sheltered), count, depth)
    of_deep = mean_radiance(rays, with_duplicates(deep), fine, depth)
    of_edges = mean_radiance(rays, with_duplicates(edges), count, depth)
    if fine > count:
        of_edges = of_edges.with_direct_of(mean_radiance(rays, with_duplicates(edges), fine, 1))
    groups = [(opened, of_open), (sheltered, of_sheltered), (deep, of_deep), (edges, of_edges)]
    duplicate_pixel = np.concatenate([pixel[::DUPLICATE_EVERY] for pixel, _ in groups])
    return SampledLight(
        pixel=np.concatenate([pixel for pixel, _ in groups]),
        light=np.concatenate([found[: len(pixel)].radiance_and_coverage() for pixel, found in groups]),
        duplicate_pixel=duplicate_pixel,
        duplicate_light=np.concatenate([found[len(pixel) :].radiance_and_coverage() for pixel, found in groups]),
        duplicate_error=np.zeros((len(duplicate_pixel), 3), dtype=np.float32),
    )


def mean_radiance(rays: FrameRays, pixel: NDArray[np.int64], count: int, max_depth: int) -> PathRadiance:
    """Means over paths through random places of each pixel, at random times of the exposure.

    Args:
        rays: of the frame.
        pixel: (P,) flat indices.
        count: samples per pixel.
        max_depth: longest path in segments; 1 leaves out the light reflected by other surfaces.
    """
    means = [_path_means(rays, chunk, count, max_depth) for chunk in rays.launch_chunks(pixel, count)]
    result = np.concatenate(means)
    return PathRadiance(direct=result[:, :3], residual=result[:, 4:], coverage=result[:, 3:4])


def _path_means(rays: FrameRays, pixel: NDArray[np.int64], count: int, max_depth: int) -> NDArray[np.float32]:
    """(P, 7) means over the paths of each pixel: direct light, coverage, residual light."""
    means = np.zeros((len(pixel), 7), dtype=np.float32)
    if not len(pixel):
        return means
    lanes = len(pixel) * count
    sampler = rays.sampler(lanes, count)
    of_pixel = dr.gather(mi.UInt32, jit_array(mi.UInt32, pixel), dr.arange(mi.UInt32, lanes) // count)
    ray = rays.through(of_pixel, sampler.next_2d(), sampler.next_1d())
    direct, hit, surface, known = trace_direct(rays.scene, rays.lights, ray)
    channels = [*direct, dr.select(hit, mi.Float(1.0), 0.0)]
    if max_depth > 1:
        channels += [*trace_residual(rays.scene, rays.lights, sampler, (surface, hit, known), max_depth)]
    means[:, : len(channels)] = means_by_pixel(channels, count)
    return means
