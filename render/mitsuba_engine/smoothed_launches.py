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
from render.mitsuba_engine.edge_samples import PILOT_COUNT, PlacedSamples, counts_by_variance, in_parts
from render.mitsuba_engine.in_picture import InPicture
from render.mitsuba_engine.jit_arrays import jit_array
from render.mitsuba_engine.launches import FrameRays, Sampled, and_some_again, means_by_pixel
from render.mitsuba_engine.noise import TWICE_EVERY, SensorNoise
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

    def trace(self, plans: dict[Eye, Plan], centers: dict[str, NDArray[np.int64]], picture: InPicture) -> Sampled:
        """Trace the planned pixels of the drogue, and some of them once more.

        Args:
            plans: of both eyes.
            centers: pixels from whose centres paths start: `open` and `hidden`, by whether most of the sky is seen
                from what stands there.
            picture: what the light will be seen in.
        """
        rays, settings = self._rays, self._settings
        kinds = ("open", "sheltered", "deep")
        inside = np.concatenate([rays.of_both(plans, kind) for kind in kinds])
        edges = np.concatenate([rays.of_both(plans, kind) for kind in ("edges", "deep_edges")])
        light = self._surface_light(centers)
        of_inside = looked_up(rays, light, and_some_again(inside), settings.open_samples_per_px, at_edges=False)
        counts = self._edge_counts(light, edges, (inside[::TWICE_EVERY], of_inside[len(inside) :]), picture)
        of_edges = looked_up_often(rays, light, and_some_again(edges), and_some_again(counts))
        twice = [(inside, of_inside), (edges, of_edges)]
        again = [found[len(pixel) :] for pixel, found in twice]
        return Sampled(
            np.concatenate([inside, edges]),
            np.concatenate([found[: len(pixel), :4] for pixel, found in twice]),
            np.concatenate([pixel[::TWICE_EVERY] for pixel, _ in twice]),
            np.concatenate([found[:, :4] for found in again]),
            np.concatenate([found[:, 4:] for found in again]),
        )

    def _edge_counts(
        self,
        light: SurfaceLight,
        edges: NDArray[np.int64],
        inside: tuple[NDArray[np.int64], NDArray[np.float32]],
        picture: InPicture,
    ) -> NDArray[np.int64]:
        """(P,) how many rays edges take for the noise that is aimed at; `inside` is some of the other pixels."""
        if not len(edges):
            return np.zeros(0, dtype=np.int64)
        sensor, (inside_pixel, of_inside) = SensorNoise.of(picture.frame), inside
        pilot = pilot_rays(self._rays, light, edges)
        samples, share = picture.radiance(edges, pilot[..., :4])
        samples_inside, share_inside = picture.radiance(inside_pixel, of_inside[:, None, :4])
        means = np.concatenate([samples.mean(axis=1), samples_inside[:, 0]])
        errors = np.concatenate([share * pilot[..., 4:].mean(axis=1), share_inside * of_inside[:, 4:]])
        # As in what is stated of a frame's noise; of a drogue that no centre sees, all that may see it counts.
        judged = picture.shows_drogue(edges)
        judged |= not (judged.any() or len(inside_pixel))
        weight = np.concatenate([judged.astype(float), np.full(len(inside_pixel), float(TWICE_EVERY))])
        mean = np.average(means, axis=0, weights=weight)
        of_light = np.average((errors @ sensor.weights) ** 2, axis=0, weights=weight).mean()
        aim = self._settings.noise_over_sensor**2 * sensor.variance(mean[None])
        # What the smoothed light errs by is known before, and edges may err by what it leaves.
        allowed = max(aim - of_light, aim / 4) / sensor.left_by_lens**2 * weight.sum()
        share_of_edges = len(edges) / (len(edges) + TWICE_EVERY * len(inside_pixel))
        # Stratified samples err by their count to the power of 3/4: the error over all of the drogue stays the same.
        most = self._settings.edge_samples_per_px * share_of_edges ** (2 / 3)
        variance = self._rays.spread(edges, np.var(samples @ sensor.weights, axis=1, ddof=1).mean(axis=-1))
        return counts_by_variance(variance, judged, allowed, most)

    def _surface_light(self, centers: dict[str, NDArray[np.int64]]) -> SurfaceLight:
        settings = self._settings
        pixel = np.concatenate([centers["hidden"], centers["open"]])
        hidden = np.arange(len(pixel)) < len(centers["hidden"])
        most = max(settings.samples_per_px, settings.edge_samples_per_px)
        # Not the square, which would keep the error: far away most pixels are edges, and their rays err more.
        count = min(settings.samples_per_px * (_SMOOTHING_AT_COUNT_PX / self._sigma_px) ** 1.5, most)
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


def looked_up_often(
    rays: FrameRays, light: SurfaceLight, pixel: NDArray[np.int64], counts: NDArray[np.int64]
) -> NDArray[np.float32]:
    """The same at edges, of pixels that take so many rays each."""
    found = [np.zeros((0, 7), dtype=np.float32)]
    for part, part_counts in in_parts(pixel, counts):
        samples = PlacedSamples(rays, part, part_counts)
        found.append(_bounded(samples.means(_channels(rays, light, samples.pixel, samples.place, samples.moment))))
    return np.concatenate(found)


def pilot_rays(rays: FrameRays, light: SurfaceLight, pixel: NDArray[np.int64]) -> NDArray[np.float32]:
    """(P, PILOT_COUNT, 7) the same of single rays."""
    found = [_channels(rays, light, *_places(rays, part, PILOT_COUNT)) for part in rays.parts(pixel, PILOT_COUNT)]
    dr.eval(found)
    rows = np.concatenate([np.stack([np.array(channel) for channel in channels], axis=-1) for channels in found])
    single: NDArray[np.float32] = rows.reshape(len(pixel), PILOT_COUNT, 7)
    return single


def _launch(
    rays: FrameRays, light: SurfaceLight, pixel: NDArray[np.int64], count: int, at_edges: bool
) -> NDArray[np.float32]:
    if not len(pixel):
        return np.zeros((0, 7), dtype=np.float32)
    return _bounded(means_by_pixel(_channels(rays, light, *_places(rays, pixel, count), at_edges), count))


def _places(rays: FrameRays, pixel: NDArray[np.int64], count: int) -> tuple[Any, Any, Any]:
    """Pixel, place and moment of `count` neighbouring lanes for each pixel."""
    lanes = len(pixel) * count
    sampler = rays.sampler(lanes, count)
    of_pixel = dr.gather(mi.UInt32, jit_array(mi.UInt32, pixel), dr.arange(mi.UInt32, lanes) // count)
    return of_pixel, sampler.next_2d(), sampler.next_1d()


def _channels(
    rays: FrameRays, light: SurfaceLight, of_pixel: Any, place: Any, moment: Any, at_edges: bool = True
) -> list[Any]:
    """Radiance, coverage and error of the smoothed light of single rays: 7 arrays."""
    ray = rays.through(of_pixel, place, moment)
    radiance, hit, surface, known = trace_first(rays.scene, rays.lights, ray)
    reflectance = surface.bsdf(ray).eval_diffuse_reflectance(surface, hit)
    other, error = light.towards(of_pixel, place, surface, known) if at_edges else light.at_center(of_pixel)
    radiance += dr.select(hit, reflectance * other, 0.0)
    error = dr.select(hit, reflectance * error, 0.0)
    return [*radiance, dr.select(hit, mi.Float(1.0), 0.0), *error]


def _bounded(means: NDArray[np.float32]) -> NDArray[np.float32]:
    """What is known of the sky's light can come out larger than what paths take away of it: light is not below 0."""
    means[:, :3] = np.maximum(means[:, :3], 0.0)
    return means


def grid_count(count: float) -> int:
    """One of few counts, as each compiles kernels of its own: the nearest square from 4 on, a whole number below."""
    if count < 4:
        return max(int(count), 1)
    side = math.sqrt(count)
    return round(side) ** 2 if side < 4 else (2 * round(side / 2)) ** 2
