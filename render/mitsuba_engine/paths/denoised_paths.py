"""The drogue, with the light of other surfaces smoothed over each surface and many rays to edges and shadows."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import RenderSettings
from geometry.stereo import Eye
from render.compositing import InPicture
from render.mitsuba_engine.jit_arrays import jit_array
from render.mitsuba_engine.paths.rays import FrameRays, Sampled, and_some_again, means_by_pixel
from render.mitsuba_engine.paths.sample_allocation import PILOT_COUNT, NoiseBudget, PlacedSamples, in_parts
from render.mitsuba_engine.paths.sun_sky_integrator import trace_first
from render.mitsuba_engine.paths.surface_light import SMOOTHING_M, SurfaceLight
from render.mitsuba_engine.render_noise import TWICE_EVERY
from render.mitsuba_engine.trace_request import Plan

MOST_SMOOTHING_STEPS = 2.5
"""Largest standard deviation of the smoothing, in steps from one known centre to the next."""
# `samples_per_px` is the count where the smoothing is this wide; narrower ones take more.
_SMOOTHING_AT_COUNT_PX = 2.4
# Of the squared noise that is aimed at: what the smoothed light may err by when its paths are traced once more.
_LIGHTS_SHARE = 0.5
# So many times the paths, or it stays as it is; and no more than so many times.
_WORTH_IT, _MOST_TIMES = 1.5, 16.0
# Where it is less than this share of the light's squared error, more paths would not show.
_COUNTS_FROM = 0.1


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
        inside, edges = (
            np.concatenate([rays.of_both(plans, kind) for kind in kinds])
            for kinds in (("open", "sheltered", "deep"), ("edges", "deep_edges"))
        )
        pixel = np.concatenate([centers["hidden"], centers["open"]])
        hidden = np.arange(len(pixel)) < len(centers["hidden"])
        light = SurfaceLight(rays, pixel, 1 + self._moves_px)
        # In each of two estimates, where the sky is hidden and in the open.
        paths = np.array([self._paths_of_centers(), settings.open_samples_per_px]) / 2
        self._trace_light(light, hidden, paths)
        light.smooth(hidden, MOST_SMOOTHING_STEPS)
        of_inside, counts = self._looked_up_inside(light, inside), np.zeros(0, dtype=np.int64)
        if len(edges):
            budget = self._budget(light, picture, edges, inside, of_inside)
            if budget.of_light.sum() > _WORTH_IT * _LIGHTS_SHARE * budget.aim:
                # What is in the open otherwise has something close by before it.
                light.smooth(~hidden, MOST_SMOOTHING_STEPS)
                of_inside = self._looked_up_inside(light, inside)
                budget = self._budget(light, picture, edges, inside, of_inside)
                if self._traced_more(light, hidden, paths, budget):
                    of_inside = self._looked_up_inside(light, inside)
            counts = budget.edge_counts(settings.edge_samples_per_px)
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

    def _paths_of_centers(self) -> float:
        """Paths from each centre where the sky is hidden."""
        settings = self._settings
        most = max(settings.samples_per_px, settings.edge_samples_per_px)
        # Not the square, which would keep the error: far away most pixels are edges, and their rays err more.
        paths: float = settings.samples_per_px * (_SMOOTHING_AT_COUNT_PX / self._sigma_px) ** 1.5
        return min(paths, most)

    def _trace_light(self, light: SurfaceLight, hidden: NDArray[np.bool_], paths: NDArray[np.float64]) -> None:
        """All of it, with some so many paths where the sky is `hidden` and in the open in each of two estimates."""
        of_hidden, of_open = (grid_count(count) for count in paths)
        light.trace([(hidden, of_hidden), (~hidden, of_open)], self._settings.max_depth)

    def _traced_more(
        self, light: SurfaceLight, hidden: NDArray[np.bool_], paths: NDArray[np.float64], budget: NoiseBudget
    ) -> bool:
        """Trace and smooth all light once more, with more paths where it errs, if it errs by too much; tell the budget.

        Returns:
            Whether it was.
        """
        times = min(budget.of_light.sum() / (_LIGHTS_SHARE * budget.aim), _MOST_TIMES)
        if times <= _WORTH_IT:
            return False
        more = paths * np.where(budget.of_light > _COUNTS_FROM * budget.of_light.sum(), times, 1.0)
        self._trace_light(light, hidden, more)
        light.smooth(np.ones(len(hidden), dtype=np.bool_), MOST_SMOOTHING_STEPS)
        budget.of_light *= [grid_count(before) / grid_count(now) for before, now in zip(paths, more, strict=True)]
        return True

    def _looked_up_inside(self, light: SurfaceLight, inside: NDArray[np.int64]) -> NDArray[np.float32]:
        return looked_up(self._rays, light, and_some_again(inside), self._settings.open_samples_per_px, at_edges=False)

    def _budget(
        self,
        light: SurfaceLight,
        picture: InPicture,
        edges: NDArray[np.int64],
        inside: NDArray[np.int64],
        of_inside: NDArray[np.float32],
    ) -> NoiseBudget:
        """By rays beforehand through pixels on edges, and what is found inside."""
        pilot = edges, pilot_rays(self._rays, light, edges)
        some_inside = inside[::TWICE_EVERY], of_inside[len(inside) :]
        return NoiseBudget(picture, pilot, some_inside, self._settings.noise_over_sensor)


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
