"""The drogue with denoising: indirect light smoothed over each surface, and many rays to edges and shadows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import RenderSettings
from geometry.stereo import Eye
from render.compositing import Compositor
from render.mitsuba_engine.jit_arrays import jit_array
from render.mitsuba_engine.paths.rays import (
    FrameRays,
    SampledLight,
    StratifiedSamples,
    chunks_by_count,
    with_duplicates,
)
from render.mitsuba_engine.paths.sun_sky_integrator import trace_direct
from render.mitsuba_engine.paths.surface_light import SMOOTHING_M, SurfaceLight
from render.mitsuba_engine.render_noise import DUPLICATE_EVERY, PILOT_COUNT, NoiseBudget
from render.mitsuba_engine.trace_request import OPEN_TO_SKY, SamplingPlan

MOST_SMOOTHING_STEPS = 2.5
"""Largest standard deviation of the smoothing, in steps from one traced pixel centre to the next."""
PATHS_BESIDE = 8
"""Paths from each centre on surfaces beside the drogue for each of two estimates: for a picture without speckles."""
# `samples_per_px` paths are traced where the smoothing is this wide; narrower smoothing takes more.
_SMOOTHING_AT_COUNT_PX = 2.4
# Nothing but slow shading varies inside a part of one paint: one ray there does for so many through a map.
_RAYS_FOR_ONE_EVEN = 4
LIGHT_SHARE = 0.5
"""Share of the squared noise that is aimed at which the denoised light may have after it is traced again."""
LEAST_TIMES, MOST_TIMES = 1.5, 16.0
"""Light is traced again only with at least so many times the paths, and with at most so many times."""
# A group of centres with less than this share of the light's squared error takes no more paths: they would not show.
_LEAST_ERROR_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class _CenterLight:
    """Indirect light at pixel centres.

    Attributes:
        light: traced and smoothed.
        hidden: (P,) at which centres much of the sky is hidden.
        drogue: (P,) which centres see no surface beside the drogue, whose light is smooth in any case.
        paths: (2,) from each centre where the sky is hidden, and in the open, for each of two estimates.
    """

    light: SurfaceLight
    hidden: NDArray[np.bool_]
    drogue: NDArray[np.bool_]
    paths: NDArray[np.float64]


class DenoisedPaths:
    """Traces one frame, its drogue at one distance."""

    def __init__(self, rays: FrameRays, settings: RenderSettings, px_per_m: float, moves_px: float) -> None:
        """Prepare the tracing of a frame.

        Args:
            rays: of the frame.
            settings: samples and depths.
            px_per_m: scale of the image at the drogue. [px/m]
            moves_px: largest motion of the image from mid-exposure to either end. [px]
        """
        self._rays, self._settings, self._moves_px, self._px_per_m = rays, settings, moves_px, px_per_m
        self._sigma_px = min(SMOOTHING_M * px_per_m, MOST_SMOOTHING_STEPS)

    def trace(
        self, plans: dict[Eye, SamplingPlan], centers: dict[str, NDArray[np.int64]], compositor: Compositor
    ) -> SampledLight:
        """Trace the planned pixels of the drogue, and some of them a second time.

        Args:
            plans: of both eyes.
            centers: pixels from whose centres paths start: `open` and `hidden`, by whether most of the sky is visible
                from the surface there.
            compositor: shows the light behind the air and over the background.
        """
        interior = self._planned(plans, ("open", "sheltered", "deep"))
        edges = self._planned(plans, ("edges", "deep_edges"))
        light, interior_light, edge_counts = self._trace_light_of(centers, compositor, edges, interior)
        edge_light = denoised_light(
            self._rays, light, with_duplicates(edges), with_duplicates(edge_counts), at_edges=True
        )
        return _without_duplicates([(interior, interior_light), (edges, edge_light)])

    def _planned(self, plans: dict[Eye, SamplingPlan], kinds: tuple[str, ...]) -> NDArray[np.int64]:
        return np.concatenate([self._rays.pixels_of_both_eyes(plans, kind) for kind in kinds])

    def _trace_light_of(
        self,
        centers: dict[str, NDArray[np.int64]],
        compositor: Compositor,
        edges: NDArray[np.int64],
        interior: NDArray[np.int64],
    ) -> tuple[SurfaceLight, NDArray[np.float32], NDArray[np.int64]]:
        """Trace the indirect light at centres until it is as little noisy as `edges` and `interior` pixels need.

        Returns:
            The light, its result for the interior pixels, and how many rays each pixel with an edge takes.
        """
        centered = self._trace_centers(centers)
        interior_light = self._interior_light(centered.light, interior)
        if not len(edges):
            return centered.light, interior_light, np.zeros(0, dtype=np.int64)
        interior_light, budget = self._meet_budget(centered, compositor, edges, (interior, interior_light))
        return centered.light, interior_light, budget.edge_counts(self._settings.edge_samples_per_px)

    def _trace_centers(self, centers: dict[str, NDArray[np.int64]]) -> _CenterLight:
        """Indirect light at the pixel centres, smoothed where the sky is hidden."""
        pixel = np.concatenate([centers["hidden"], centers["open"]])
        hidden = np.arange(len(pixel)) < len(centers["hidden"])
        light = SurfaceLight(self._rays, pixel, 1 + self._moves_px)
        paths = np.array([self._paths_where_hidden(), self._settings.open_samples_per_px]) / 2
        self._trace_light(light, hidden, paths)
        light.smooth(hidden | light.beside, MOST_SMOOTHING_STEPS)
        return _CenterLight(light=light, hidden=hidden, drogue=~light.beside, paths=paths)

    def _paths_where_hidden(self) -> float:
        """Paths from each centre where much of the sky is hidden."""
        settings = self._settings
        most = max(settings.samples_per_px, settings.edge_samples_per_px)
        # Not the square, which would keep the error: far away most pixels are edges, whose rays err more.
        paths: float = settings.samples_per_px * (_SMOOTHING_AT_COUNT_PX / self._sigma_px) ** 1.5
        return min(paths, most)

    def _trace_light(self, light: SurfaceLight, hidden: NDArray[np.bool_], paths: NDArray[np.float64]) -> None:
        """Trace the light of all centres; `paths` as in `_CenterLight`."""
        of_hidden, of_open = _whole_counts(paths).tolist()
        on_drogue = [(hidden & ~light.beside, of_hidden), (~hidden & ~light.beside, of_open)]
        light.trace(on_drogue, self._settings.max_depth, (light.beside, PATHS_BESIDE))

    def _meet_budget(
        self,
        centered: _CenterLight,
        compositor: Compositor,
        edges: NDArray[np.int64],
        interior: tuple[NDArray[np.int64], NDArray[np.float32]],
    ) -> tuple[NDArray[np.float32], NoiseBudget]:
        """Smooth more, and then trace more paths, while the denoised light is too noisy for the noise aimed at.

        Args:
            centered: is changed.
            compositor: shows the light behind the air and over the background.
            edges: pixels with edges.
            interior: pixels inside parts, and their light so far.

        Returns:
            The light of the interior pixels, and the noise budget with what is left of the light's error.
        """
        light, hidden = centered.light, centered.hidden
        pixel, interior_light = interior
        budget = self._budget(light, compositor, edges, (pixel, interior_light))
        if budget.light_error.sum() > LEAST_TIMES * LIGHT_SHARE * budget.aim:
            # In this frame something close hides the sky also from parts that are usually in the open.
            light.smooth(~hidden & centered.drogue, MOST_SMOOTHING_STEPS)
            interior_light = self._interior_light(light, pixel)
            budget = self._budget(light, compositor, edges, (pixel, interior_light))
            if self._trace_more(centered, budget):
                interior_light = self._interior_light(light, pixel)
        return interior_light, budget

    def _trace_more(self, centered: _CenterLight, budget: NoiseBudget) -> bool:
        """Trace and smooth all light again, with more paths where it is noisy, if it is too noisy; update the budget.

        Returns:
            Whether it was traced again.
        """
        paths = centered.paths
        times = min(budget.light_error.sum() / (LIGHT_SHARE * budget.aim), MOST_TIMES)
        if times <= LEAST_TIMES:
            return False
        more = paths * np.where(budget.light_error > _LEAST_ERROR_SHARE * budget.light_error.sum(), times, 1.0)
        self._trace_light(centered.light, centered.hidden, more)
        centered.light.smooth(np.ones(len(centered.hidden), dtype=np.bool_), MOST_SMOOTHING_STEPS)
        budget.light_error *= _whole_counts(paths) / _whole_counts(more)
        return True

    def _interior_light(self, light: SurfaceLight, interior: NDArray[np.int64]) -> NDArray[np.float32]:
        most = self._settings.open_samples_per_px
        has_map = self._rays.has_map[light.parts_at(interior)]
        counts = np.where(has_map, most, math.ceil(most / _RAYS_FOR_ONE_EVEN))
        return denoised_light(self._rays, light, with_duplicates(interior), with_duplicates(counts), at_edges=False)

    def _budget(
        self,
        light: SurfaceLight,
        compositor: Compositor,
        edges: NDArray[np.int64],
        interior: tuple[NDArray[np.int64], NDArray[np.float32]],
        group_of_part: NDArray[np.uint8] = OPEN_TO_SKY,
    ) -> NoiseBudget:
        """From pilot rays through pixels with edges, and the light of interior pixels."""
        pixel, interior_light = interior
        return NoiseBudget(
            compositor=compositor,
            edges=(edges, pilot_rays(self._rays, light, edges)),
            interior=(pixel[::DUPLICATE_EVERY], interior_light[len(pixel) :]),
            noise_over_sensor=self._settings.noise_over_sensor,
            group_of_part=group_of_part,
        )


def _without_duplicates(groups: list[tuple[NDArray[np.int64], NDArray[np.float32]]]) -> SampledLight:
    """Pixels and their (P + A, 7) light, separated into first samples and the A duplicates of each group."""
    duplicates = [found[len(pixel) :] for pixel, found in groups]
    return SampledLight(
        pixel=np.concatenate([pixel for pixel, _ in groups]),
        light=np.concatenate([found[: len(pixel), :4] for pixel, found in groups]),
        duplicate_pixel=np.concatenate([pixel[::DUPLICATE_EVERY] for pixel, _ in groups]),
        duplicate_light=np.concatenate([found[:, :4] for found in duplicates]),
        duplicate_error=np.concatenate([found[:, 4:] for found in duplicates]),
    )


def denoised_light(
    rays: FrameRays, light: SurfaceLight, pixel: NDArray[np.int64], counts: NDArray[np.int64], at_edges: bool
) -> NDArray[np.float32]:
    """Direct light of rays through each pixel, with the denoised indirect light.

    Args:
        rays: of the frame.
        light: indirect light at pixel centres.
        pixel: (P,) flat indices.
        counts: (P,) rays through each.
        at_edges: interpolate the indirect light between centres; otherwise each pixel must be one of the light's own.

    Returns:
        (P, 7) radiance, coverage and error of the denoised light.
    """
    found = [np.zeros((0, 7), dtype=np.float32)]
    for chunk, chunk_counts in chunks_by_count(pixel, counts):
        samples = StratifiedSamples(rays, chunk, chunk_counts)
        channels = _channels(rays, light, samples.pixel, samples.place, samples.moment, at_edges)
        found.append(_not_negative(samples.means(channels)))
    return np.concatenate(found)


def pilot_rays(rays: FrameRays, light: SurfaceLight, pixel: NDArray[np.int64]) -> NDArray[np.float32]:
    """(P, PILOT_COUNT, 7) radiance, coverage and error of single rays through each pixel."""
    chunks = rays.launch_chunks(pixel, PILOT_COUNT)
    found = [_channels(rays, light, *_random_places(rays, chunk, PILOT_COUNT)) for chunk in chunks]
    dr.eval(found)
    rows = np.concatenate([np.stack([np.array(channel) for channel in channels], axis=-1) for channels in found])
    single: NDArray[np.float32] = rows.reshape(len(pixel), PILOT_COUNT, 7)
    return single


def _random_places(rays: FrameRays, pixel: NDArray[np.int64], count: int) -> tuple[Any, Any, Any]:
    """Pixel, place in it and moment of `count` neighbouring lanes for each pixel."""
    lanes = len(pixel) * count
    sampler = rays.sampler(lanes, count)
    of_pixel = dr.gather(mi.UInt32, jit_array(mi.UInt32, pixel), dr.arange(mi.UInt32, lanes) // count)
    return of_pixel, sampler.next_2d(), sampler.next_1d()


def _channels(
    rays: FrameRays, light: SurfaceLight, of_pixel: Any, place: Any, moment: Any, at_edges: bool = True
) -> list[Any]:
    """Radiance, coverage and error of the denoised light of single rays: 7 arrays."""
    ray = rays.through(of_pixel, place, moment)
    radiance, hit, surface, known = trace_direct(rays.scene, rays.lights, ray)
    reflectance = surface.bsdf(ray).eval_diffuse_reflectance(surface, hit)
    indirect, error = light.towards(of_pixel, place, surface, known) if at_edges else light.at_center(of_pixel)
    radiance += dr.select(hit, reflectance * indirect, 0.0)
    error = dr.select(hit, reflectance * error, 0.0)
    return [*radiance, dr.select(hit, mi.Float(1.0), 0.0), *error]


def _not_negative(means: NDArray[np.float32]) -> NDArray[np.float32]:
    """Radiance of at least 0, in place: the residual can subtract more than the known light of the sky."""
    means[:, :3] = np.maximum(means[:, :3], 0.0)
    return means


def _whole_counts(paths: NDArray[np.float64]) -> NDArray[np.int64]:
    counts: NDArray[np.int64] = np.maximum(np.rint(paths), 1).astype(np.int64)
    return counts
