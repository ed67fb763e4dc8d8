"""Hose, tanker and other objects: rays to the first surfaces, and indirect light from a coarse lattice of pixels.

Indirect light changes slowly over large parts, and here it needs to be free of speckles rather than exact to the per
cent. So one pixel centre in every few rows and columns takes the paths of a quarter of the pixels around it. One ray
through each pixel shows where edges and shadows are, and only those pixels take more rays.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import RenderSettings
from render.mitsuba_engine.paths.denoised_paths import MOST_SMOOTHING_STEPS, denoised_light
from render.mitsuba_engine.paths.drogue_paths import mean_radiance
from render.mitsuba_engine.paths.rays import FrameRays
from render.mitsuba_engine.paths.surface_light import SurfaceLight
from render.mitsuba_engine.trace_request import CONTEXT_DEPTH

_LATTICE_STEP_PX = 3
# A sheen takes so many times the paths of matt paint, and the pixels around a lamp so many times the rays.
_TIMES_AT_SHEEN, _TIMES_AT_LAMPS = 16, 16
# Where neighbours differ by more than this share, or a part is narrower than a pixel, so many times the rays leave a
# twentieth of the contrast as noise.
_SHARP, _TIMES_WHERE_SHARP = 0.25, 4
# Neighbours that differ by no more than this share show one surface in one light.
_EVEN = 0.05


@dataclass(frozen=True, eq=False)
class SeenContext:
    """What is known of the pixels of both eyes.

    Attributes:
        covered: (2 H W,) which see something at their centre.
        shiny: (2 H W,) which may see a surface with a sheen, whose light cannot be smoothed.
        lamps: (2 H W,) which may see a lamp, smaller than a pixel perhaps.
        narrow: (2 H W,) which may see a part that is narrower than a pixel.
    """

    covered: NDArray[np.bool_]
    shiny: NDArray[np.bool_]
    lamps: NDArray[np.bool_]
    narrow: NDArray[np.bool_]


def trace_context(
    rays: FrameRays, pixel: NDArray[np.int64], seen: SeenContext, settings: RenderSettings, moves_px: float
) -> NDArray[np.float32]:
    """Trace pixels that see no drogue.

    Args:
        rays: of the frame.
        pixel: (P,) flat indices.
        seen: what the pixels see.
        settings: samples and depths.
        moves_px: largest motion of the image from mid-exposure to either end. [px]

    Returns:
        (P, 4) radiance and coverage.
    """
    count = settings.surround_samples_per_px
    if not settings.denoise:
        return mean_radiance(rays, pixel, count, CONTEXT_DEPTH).radiance_and_coverage()
    found = np.zeros((len(pixel), 4), dtype=np.float32)
    shiny = seen.shiny[pixel]
    if shiny.any():
        traced = mean_radiance(rays, pixel[shiny], _TIMES_AT_SHEEN * count, CONTEXT_DEPTH)
        found[shiny] = traced.radiance_and_coverage()
    center = _lattice(rays, pixel)
    center = center[seen.covered[center] & ~seen.shiny[center]]
    if not len(center):
        rest = mean_radiance(rays, pixel[~shiny], count, CONTEXT_DEPTH)
        found[~shiny] = rest.radiance_and_coverage()
        return found
    light = SurfaceLight(rays, center, _LATTICE_STEP_PX + moves_px, _LATTICE_STEP_PX, fills_gaps=True)
    chosen = np.ones(len(center), dtype=np.bool_)
    light.trace([], CONTEXT_DEPTH, (chosen, 2 ** round(np.log2(max(count * _LATTICE_STEP_PX**2 / 4, 1)))))
    light.smooth(chosen, _LATTICE_STEP_PX * MOST_SMOOTHING_STEPS)
    found[~shiny] = denoised_light(
        rays, light, pixel[~shiny], np.ones(np.count_nonzero(~shiny), dtype=np.int64), at_edges=True
    )[:, :4]
    contrast = _contrast(rays, pixel, found)
    times = np.where(contrast > _EVEN, 1, 0)
    times[(contrast > _SHARP) | seen.narrow[pixel]] = _TIMES_WHERE_SHARP
    times[seen.lamps[pixel]] = _TIMES_AT_LAMPS
    again = (times > 0) & ~shiny
    found[again] = denoised_light(rays, light, pixel[again], times[again] * count, at_edges=True)[:, :4]
    return found


def _lattice(rays: FrameRays, pixel: NDArray[np.int64]) -> NDArray[np.int64]:
    """Flat indices of the lattice points at the corners of the squares that hold pixels, and of the squares around."""
    step = _LATTICE_STEP_PX
    row, column = np.divmod(pixel, rays.width_px)
    near = np.zeros((-(-2 * rays.size // rays.width_px // step), -(-rays.width_px // step)), dtype=np.uint8)
    near[row // step, column // step] = 1
    down, right = np.nonzero(cv2.dilate(near, np.ones((3, 3), dtype=np.uint8)))
    return step * (down * rays.width_px + right)


def _contrast(rays: FrameRays, pixel: NDArray[np.int64], found: NDArray[np.float32]) -> NDArray[np.float32]:
    """(P,) share by which each pixel and its eight neighbours differ; pixels that were not traced count as dark."""
    radiance = np.zeros((2 * rays.size // rays.width_px, rays.width_px), dtype=np.float32)
    radiance.reshape(-1)[pixel] = found[:, :3].sum(axis=1)
    rows = np.flatnonzero(radiance.any(axis=1))
    if not len(rows):
        return np.zeros(len(pixel), dtype=np.float32)
    window, neighbours = slice(max(rows[0] - 1, 0), rows[-1] + 2), np.ones((3, 3), dtype=np.uint8)
    most = cv2.dilate(radiance[window], neighbours)
    contrast = np.zeros(radiance.shape, dtype=np.float32)
    contrast[window] = (most - cv2.erode(radiance[window], neighbours)) / np.maximum(most, np.float32(1e-30))
    of_pixels: NDArray[np.float32] = contrast.reshape(-1)[pixel]
    return of_pixels
