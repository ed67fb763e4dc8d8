"""A basket, leaves, ribbons or a cone with denoising: both eyes share their light, and each part takes its own paths.

Light inside a body comes through gaps between narrow parts, so that single paths differ by as much as their mean. What
an image shows of a strut or a fold is too narrow to average over. So light is averaged in space (`SurfaceCells`), and
each part takes as many paths as lessen the error of the picture most: a dark strut few, white cloth many.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from drogue_models.parts import FIRST_MARKER_ID, INSTANCE_STEP
from geometry.se3 import Array
from render.compositing import Compositor
from render.mitsuba_engine.paths.denoised_paths import LEAST_TIMES, MOST_TIMES, DenoisedPaths
from render.mitsuba_engine.paths.rays import FrameRays, rows_of
from render.mitsuba_engine.paths.surface_cells import SurfaceCells
from render.mitsuba_engine.paths.surface_light import SurfaceLight
from render.mitsuba_engine.render_noise import MOST_COUNT, NoiseBudget
from render.mitsuba_engine.trace_request import DROGUE_PARTS

# Step of the lattice over the smoothing of the other drogues, and in the image where these are far away: the light is
# blurred as much as theirs.
_STEPS_PER_SMOOTHING, _STEPS_ON_MARKERS, _LEAST_STEP_PX = 2.5, 1.0, 1.6
# White cloth in the sun takes so many paths that its light is averaged over so many times the step.
_MANY_PATHS, _WIDER = 4_000_000, 1.5
# Share of the squared noise that is aimed at which the light may have: more than half, as its paths take most time.
_LIGHT_SHARE = 0.6
# The error falls with the number of paths to about this power: few gain more by stratification, many less.
_GAIN_POWER = 1.2
# The first paths only tell how many it takes.
_FIRST_PATHS = 100_000
_EACH_PART = np.arange(256, dtype=np.uint8)


class DenoisedBodyPaths(DenoisedPaths):
    """Traces one frame of a drogue with a body."""

    def _trace_light_of(
        self,
        centers: dict[str, NDArray[np.int64]],
        compositor: Compositor,
        edges: NDArray[np.int64],
        interior: NDArray[np.int64],
    ) -> tuple[SurfaceLight, NDArray[np.float32], NDArray[np.int64]]:
        pixel = np.concatenate([centers["hidden"], centers["open"]])
        light = SharedLight(self._rays, pixel, 1 + self._moves_px, _LEAST_STEP_PX / self._px_per_m)
        first = np.full(256, np.clip(_FIRST_PATHS // len(pixel), 1, MOST_COUNT))
        if not len(edges):
            light.trace_parts(np.full(256, math.ceil(self._paths_where_hidden() / 2)), self._settings.max_depth)
            return light, self._interior_light(light, interior), np.zeros(0, dtype=np.int64)
        light.trace_parts(first, self._settings.max_depth)
        interior_light = self._interior_light(light, interior)
        budget = self._budget(light, compositor, edges, (interior, interior_light), _EACH_PART)
        if budget.light_error.sum() > LEAST_TIMES * _LIGHT_SHARE * budget.aim:
            self._trace_more_of(light, first, budget)
            interior_light = self._interior_light(light, interior)
        return light, interior_light, budget.edge_counts(self._settings.edge_samples_per_px)

    def _trace_more_of(self, light: SharedLight, first: NDArray[np.int64], budget: NoiseBudget) -> None:
        """Trace as many paths as leave the light's share of the noise; update the budget."""
        aim, most = _LIGHT_SHARE * budget.aim, MOST_TIMES * self._paths_where_hidden() * len(light.pixel)
        before = light.squared_error()
        paths = _paths_by_part(first, light.centers_of_part, budget.light_error, aim, most)
        if 2 * paths @ light.centers_of_part > _MANY_PATHS:
            light.widen(_WIDER)
            error = budget.light_error * light.squared_error() / np.maximum(before, 1e-30)
            paths = _paths_by_part(first, light.centers_of_part, error, aim, most)
        light.trace_parts(paths, self._settings.max_depth)
        budget.light_error *= light.squared_error() / np.maximum(before, 1e-30)


def _paths_by_part(
    first: NDArray[np.int64], centers: NDArray[np.int64], error: Array, aim: float, most: float
) -> NDArray[np.int64]:
    """(256,) paths from each centre on a part for each of two estimates, for the least error at their total number.

    The error of n paths is e n^-a, as their first directions are stratified. The sum of the errors at a given sum of
    the c n is least for n in proportion to (e / c)^(1 / (1 + a)).

    Args:
        first: (256,) paths with which the error came out.
        centers: (256,) on each part.
        error: (256,) mean square error by each part's light. [cd2/m4]
        aim: mean square error that is aimed at. [cd2/m4]
        most: paths altogether.
    """
    of_one = error * first**_GAIN_POWER
    need = (of_one / np.maximum(centers, 1)) ** (1 / (1 + _GAIN_POWER))
    seen = of_one > 0
    error_of_need = float(np.sum(of_one[seen] * need[seen] ** -_GAIN_POWER))
    total = float(centers @ need)
    scale = min((error_of_need / aim) ** (1 / _GAIN_POWER), most / 2 / total)
    paths = scale * need
    # What stands beside the drogue has no error that counts.
    paths[DROGUE_PARTS == 0] = scale * total / centers.sum()
    counts: NDArray[np.int64] = np.clip(np.ceil(paths), 1, MOST_COUNT).astype(np.int64)
    return counts


class SharedLight(SurfaceLight):
    """Indirect light that is smoothed in space over what both eyes see.

    Attributes:
        centers_of_part: (256,) number of pixel centres on each part.
    """

    def __init__(self, rays: FrameRays, pixel: NDArray[np.int64], lookup_px: float, least_step_m: float) -> None:
        """Find surfaces and neighbours; arguments as for `SurfaceLight`, and the least step of the lattice. [m]"""
        super().__init__(rays, pixel, lookup_px)
        # Blurred light would move the centroids of markers.
        self._is_marker = self._part_of_row % INSTANCE_STEP >= FIRST_MARKER_ID
        steps = np.where(self._is_marker, _STEPS_ON_MARKERS, _STEPS_PER_SMOOTHING).astype(np.float32)
        self._step_m = np.maximum(steps * np.array(self._smoothing_m), np.float32(least_step_m))
        self._neighbours = self._cells_of(self._step_m)
        self.centers_of_part: NDArray[np.int64] = np.bincount(self._part_of_row, minlength=256)

    def _cells_of(self, step_m: NDArray[np.float32]) -> SurfaceCells:
        place, normal = rows_of(self._points.place), rows_of(self._points.normal)
        return SurfaceCells(self._part_of_row, place, normal, step_m)

    def trace_parts(self, paths: NDArray[np.int64], max_depth: int) -> None:
        """Trace and smooth the light; it replaces the light so far.

        Args:
            paths: (256,) from each centre on a part, for each of two estimates.
            max_depth: longest path in segments.
        """
        self._counts = paths[self._part_of_row]
        rows = np.arange(len(self._counts))
        self._traced = np.concatenate([self._path_means(rows, self._counts, max_depth) for _ in range(2)], axis=1)
        self._smooth_traced()

    def widen(self, times: float) -> None:
        """Smooth the light over so many times the step of the lattice, on markers over the same."""
        self._neighbours = self._cells_of(np.where(self._is_marker, self._step_m, self._step_m * np.float32(times)))
        self._smooth_traced()

    def _smooth_traced(self) -> None:
        halves = np.zeros((2, self._none + 257, 4), dtype=np.float32)
        halves[:, : self._none, :3] = np.stack(np.split(self._neighbours.means(self._traced, self._counts), 2, axis=1))
        self._keep(halves)

    def squared_error(self) -> Array:
        """(256,) sums over the centres on each part of the light's squared error. [cd2/m4]"""
        error = np.array(self._error).reshape(-1, 4)[: self._none, :3].astype(np.float64)
        return np.bincount(self._part_of_row, weights=np.sum(error**2, axis=1), minlength=256).astype(np.float64)
