"""The drogue, with the light of other surfaces smoothed over each surface and many rays to edges and shadows."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe import RenderSettings
from geometry.stereo import Eye
from render.mitsuba_engine.jit_arrays import jit_array
from render.mitsuba_engine.launches import FrameRays, Sampled, and_some_again, means_by_pixel
from render.mitsuba_engine.noise import TWICE_EVERY
from render.mitsuba_engine.sun_sky_paths import trace_first
from render.mitsuba_engine.surface_light import SMOOTHING_M, SurfaceLight
from render.mitsuba_engine.traced import Plan

MOST_SMOOTHING_STEPS = 2.5
"""Largest standard deviation of the smoothing, in steps from one known centre to the next."""
# `samples_per_px` is the count where the smoothing is this wide; narrower ones take more.
_SMOOTHING_AT_COUNT_PX = 2.4


class SmoothedPaths:
    """Traces one frame, its drogue at one distance."""

    def __init__(self, rays: FrameRays, settings: RenderSettings, px_per_m: float, moves_px: float) -> None:
        """With the scale of the image at the drogue [px/m], and how far things move during the exposure. [px]"""
        self._rays, self._settings, self._moves_px = rays, settings, moves_px
        self._sigma_px = min(SMOOTHING_M * px_per_m, MOST_SMOOTHING_STEPS)

    def trace(self, plans: dict[Eye, Plan], centers: dict[str, NDArray[np.int64]]) -> Sampled:
        """Trace the planned pixels of the drogue, and some of them once more.

        Args:
            plans: of both eyes.
            centers: pixels from whose centres paths start: `open` and `hidden`, by whether most of the sky is seen
                from what stands there.
        """
        rays, settings = self._rays, self._settings
        kinds = ("open", "sheltered", "deep")
        inside = np.concatenate([rays.of_both(plans, kind) for kind in kinds])
        edges = np.concatenate([rays.of_both(plans, kind) for kind in ("edges", "deep_edges")])
        light = self._surface_light(centers)
        # Stratified samples err by their count to the power of 3/4: the error over all of the drogue stays the same.
        share = len(edges) / max(len(edges) + len(inside), 1)
        fine = max(settings.samples_per_px, grid_count(settings.edge_samples_per_px * share ** (2 / 3)))
        of_inside = looked_up(rays, light, and_some_again(inside), settings.open_samples_per_px, at_edges=False)
        of_edges = looked_up(rays, light, and_some_again(edges), fine, at_edges=True)
        twice = [(inside, of_inside), (edges, of_edges)]
        again = [found[len(pixel) :] for pixel, found in twice]
        return Sampled(
            np.concatenate([inside, edges]),
            np.concatenate([found[: len(pixel), :4] for pixel, found in twice]),
            np.concatenate([pixel[::TWICE_EVERY] for pixel, _ in twice]),
            np.concatenate([found[:, :4] for found in again]),
            np.concatenate([found[:, 4:] for found in again]),
        )

    def _surface_light(self, centers: dict[str, NDArray[np.int64]]) -> SurfaceLight:
        settings = self._settings
        pixel = np.concatenate([centers["hidden"], centers["open"]])
        hidden = np.arange(len(pixel)) < len(centers["hidden"])
        most = max(settings.samples_per_px, settings.edge_samples_per_px)
        count = min(settings.samples_per_px * (_SMOOTHING_AT_COUNT_PX / self._sigma_px) ** 2, most)
        light = SurfaceLight(self._rays, pixel, 1 + self._moves_px)
        counts = [(hidden, grid_count(count / 2)), (~hidden, grid_count(settings.open_samples_per_px / 2))]
        light.trace(counts, settings.max_depth)
        light.smooth(hidden, MOST_SMOOTHING_STEPS)
        return light


def looked_up(
    rays: FrameRays, light: SurfaceLight, pixel: NDArray[np.int64], count: int, at_edges: bool
) -> NDArray[np.float32]:
    """(P, 7) radiance, coverage and error of the smoothed light, of pixels of the lattice itself or `at_edges` any."""
    return np.concatenate([_launch(rays, light, part, count, at_edges) for part in rays.parts(pixel, count)])


def _launch(
    rays: FrameRays, light: SurfaceLight, pixel: NDArray[np.int64], count: int, at_edges: bool
) -> NDArray[np.float32]:
    if not len(pixel):
        return np.zeros((0, 7), dtype=np.float32)
    lanes = len(pixel) * count
    sampler = rays.sampler(lanes, count)
    of_pixel = dr.gather(mi.UInt32, jit_array(mi.UInt32, pixel), dr.arange(mi.UInt32, lanes) // count)
    place = sampler.next_2d()
    ray = rays.through(of_pixel, place, sampler.next_1d())
    radiance, hit, surface, known = trace_first(rays.scene, rays.lights, ray)
    reflectance = surface.bsdf(ray).eval_diffuse_reflectance(surface, hit)
    other, error = light.towards(of_pixel, place, surface, known) if at_edges else light.at_center(of_pixel)
    radiance += dr.select(hit, reflectance * other, 0.0)
    error = dr.select(hit, reflectance * error, 0.0)
    channels: list[Any] = [*radiance, dr.select(hit, mi.Float(1.0), 0.0), *error]
    means = means_by_pixel(channels, count)
    # What is known of the sky's light can come out larger than what paths take away of it.
    means[:, :3] = np.maximum(means[:, :3], 0.0)
    return means


def grid_count(count: float) -> int:
    """One of few counts, as each compiles kernels of its own: the nearest square from 4 on, a whole number below."""
    if count < 4:
        return max(int(count), 1)
    side = math.sqrt(count)
    return round(side) ** 2 if side < 4 else (2 * round(side / 2)) ** 2
