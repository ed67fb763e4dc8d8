"""Hose, tanker and bystanders: rays to the first surfaces, and light of other surfaces from a coarse lattice.

That light changes slowly on large parts. It is wanted for a picture without speckles and not to the per cent, so one
centre in every few rows and columns takes the paths of a quarter of the pixels around it. One ray through each pixel
shows where edges and shadows are, and only these take more.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import RenderSettings
from render.mitsuba_engine.paths.denoised_paths import MOST_SMOOTHING_STEPS, grid_count, looked_up
from render.mitsuba_engine.paths.drogue_paths import mean_light
from render.mitsuba_engine.paths.rays import FrameRays
from render.mitsuba_engine.paths.surface_light import SurfaceLight
from render.mitsuba_engine.trace_request import SURROUND_DEPTH

_EVERY_PX = 3
# Neighbours that differ by no more than this share show one surface in one light.
_EVEN = 0.05


def trace_around(
    rays: FrameRays, pixel: NDArray[np.int64], met: NDArray[np.bool_], settings: RenderSettings, moves_px: float
) -> NDArray[np.float32]:
    """Trace pixels that see no drogue.

    Args:
        rays: of the frame.
        pixel: (P,) flat indices.
        met: (2 H W,) which pixels of both eyes see something at their centre.
        settings: of the recipe.
        moves_px: how far things move during the exposure.

    Returns:
        (P, 4) radiance and coverage.
    """
    count = settings.surround_samples_per_px
    if settings.denoise:
        center = _lattice(rays, pixel)
        center = center[met[center]]
        if len(center):
            light = SurfaceLight(rays, center, _EVERY_PX + moves_px, _EVERY_PX)
            chosen = np.ones(len(center), dtype=np.bool_)
            light.trace([(chosen, grid_count(count * _EVERY_PX**2 / 4))], SURROUND_DEPTH)
            light.smooth(chosen, _EVERY_PX * MOST_SMOOTHING_STEPS)
            found = looked_up(rays, light, pixel, 1, at_edges=True)[:, :4]
            uneven = _uneven(rays, pixel, found)
            found[uneven] = looked_up(rays, light, pixel[uneven], count, at_edges=True)[:, :4]
            return found
    return mean_light(rays, pixel, count, SURROUND_DEPTH).seen()


def _lattice(rays: FrameRays, pixel: NDArray[np.int64]) -> NDArray[np.int64]:
    """Corners of the squares of the lattice that pixels lie in, and of those around."""
    row, column = np.divmod(pixel, rays.width_px)
    near = np.zeros((-(-2 * rays.size // rays.width_px // _EVERY_PX), -(-rays.width_px // _EVERY_PX)), dtype=np.uint8)
    near[row // _EVERY_PX, column // _EVERY_PX] = 1
    down, right = np.nonzero(cv2.dilate(near, np.ones((3, 3), dtype=np.uint8)))
    return _EVERY_PX * (down * rays.width_px + right)


def _uneven(rays: FrameRays, pixel: NDArray[np.int64], found: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(P,) which of the pixels see something else than one of the eight around; those left out count as dark."""
    radiance = np.zeros((2 * rays.size // rays.width_px, rays.width_px), dtype=np.float32)
    radiance.reshape(-1)[pixel] = found[:, :3].sum(axis=1)
    rows = np.flatnonzero(radiance.any(axis=1))
    if not len(rows):
        return np.zeros(len(pixel), dtype=np.bool_)
    window, around = slice(max(rows[0] - 1, 0), rows[-1] + 2), np.ones((3, 3), dtype=np.uint8)
    most = cv2.dilate(radiance[window], around)
    uneven = np.zeros(radiance.shape, dtype=np.bool_)
    uneven[window] = most - cv2.erode(radiance[window], around) > _EVEN * most
    marked: NDArray[np.bool_] = uneven.reshape(-1)[pixel]
    return marked
