"""Light by way of other surfaces, smoothed over each surface: what `trace_rest` gives, without its noise.

What a matt surface receives from other surfaces and from a partly hidden sky varies over centimetres, and neither a
paint's colour nor an edge in the image nor a shadow of the sun is in it. So paths from what the pixel centres see are
enough, and their mean over neighbours on the same surface is all but free of noise. Rays to edges and shadows, many to
a pixel, then look it up. The neighbours' weights come from places and normals and never from what the paths found, so
that the mean errs only by how much the light varies over the reach.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from drogue_models.parts import Part
from render.mitsuba_engine.jit_arrays import jit_array
from render.mitsuba_engine.paths.rays import FrameRays, means_by_pixel, rows_of
from render.mitsuba_engine.paths.sun_sky_integrator import trace_first, trace_rest
from render.mitsuba_engine.scene import by_shape

SMOOTHING_M = 0.008
"""Standard deviation of the smoothing on a surface: ribs are this wide. [m]"""
# The hub's light is even; the coupling has a recess of 0.1 m whose walls get darker quickly. Shadows of the sky under a
# wing are as wide as pods are thick. [m]
_SMOOTHING_BY_PART_M = {Part.HUB: 0.016, Part.COUPLING: 0.005, Part.TANKER: 0.25}
# A neighbour's plane may miss a point by this much [m], or by this share of the weights' reach: large parts are round.
_SAME_PLANE_M = 0.005
_SAME_PLANE_PER_REACH = 0.25
# cos^16: half the weight at 17 degrees.
_NORMAL_POWER = 4
_LEAST_REFLECTANCE = 1e-4
# Of neighbours on other surfaces: what they receive is the best guess where no other is near.
_WEIGHT_ROUND_CORNERS = 1e-4
# Of the part's mean light, which counts where no centre around sees the surface.
_LEAST_WEIGHT = 1e-8


class SurfaceLight:
    """Irradiance over pi by way of other surfaces, on what the centres of some pixels see."""

    def __init__(self, rays: FrameRays, pixel: NDArray[np.int64], looking_px: float, every_px: int = 1) -> None:
        """From pixels whose centres see something.

        Args:
            rays: of the frame.
            pixel: (P,) flat indices; rows and columns of both are multiples of `every_px`.
            looking_px: rays look for these within about so many pixels.
            every_px: step from one to the next.
        """
        self._rays, self.pixel, self._looking_px, self._every_px = rays, pixel, looking_px, every_px
        self._none = len(pixel)
        self._columns = -(-rays.width_px // every_px)
        self._cells = self._columns * -(-2 * rays.size // rays.width_px // every_px)
        place = np.full(self._cells + 1, self._none, dtype=np.uint32)
        place[self._cell_of(pixel)] = np.arange(len(pixel))
        self._place = jit_array(mi.UInt32, place)
        surface = self._surface(jit_array(mi.UInt32, pixel))
        shape: Any = dr.reinterpret_array(mi.UInt32, surface.shape)
        # Else each use of them would send the rays again.
        normal = surface.sh_frame.n
        dr.eval(normal, surface.p, surface.t, shape)
        smoothing_m = np.full(256, SMOOTHING_M, dtype=np.float32)
        for part, part_m in _SMOOTHING_BY_PART_M.items():
            smoothing_m[part] = part_m
        self._smoothing_m = dr.gather(mi.Float, jit_array(mi.Float, by_shape(rays.scene, smoothing_m)), shape)
        self._part = jit_array(mi.UInt32, by_shape(rays.scene, np.arange(256, dtype=np.uint32)))
        self._part_of_row = np.array(dr.gather(mi.UInt32, self._part, shape))
        known = np.array(dr.gather(mi.Float, rays.lights.in_open, shape))
        self._normal, self._point = _rows(normal, known), _rows(surface.p, np.array(surface.t))
        self._mean = self._error = self._point

    def _surface(self, pixel: Any) -> Any:
        ray = self._rays.through(pixel, mi.Point2f(0.5, 0.5), dr.opaque(mi.Float, 0.5))
        return self._rays.scene.ray_intersect(ray, mi.RayFlags.ShadingFrame, True)

    def trace(self, chosen: list[tuple[NDArray[np.bool_], int]], max_depth: int) -> None:
        """Trace paths and smooth what they find.

        Args:
            chosen: (P,) which of the pixels, and how many paths from each for each of two estimates.
            max_depth: longest path in segments.
        """
        halves = np.zeros((2, self._none + 257, 4), dtype=np.float32)
        for mask, count in chosen:
            place = np.flatnonzero(mask)
            # Twice the same pixel: samples of one pixel are spread evenly, and its halves would not be independent.
            halves[:, place, :3] = self._traced(np.tile(self.pixel[place], 2), count, max_depth).reshape(2, -1, 3)
        for half in halves:
            half[self._none + 1 :] = self._by_part(half[: self._none])
        mean, error = (halves[0] + halves[1]) / 2, (halves[0] - halves[1]) / 2
        self._mean, self._error = jit_array(mi.Float, mean.ravel()), jit_array(mi.Float, error.ravel())

    def _by_part(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """(256, 4) means by part id, 0 where no centre sees a part."""
        rows = self._part_of_row
        total = np.stack([np.bincount(rows, weights=channel, minlength=256) for channel in light.T], axis=-1)
        mean: NDArray[np.float32] = total / np.maximum(np.bincount(rows, minlength=256), 1)[:, None]
        return mean.astype(np.float32)

    def _traced(self, pixel: NDArray[np.int64], count: int, max_depth: int) -> NDArray[np.float32]:
        """(P, 3) means over paths. [cd/m2]"""
        if not len(pixel):
            return np.zeros((0, 3), dtype=np.float32)
        return np.concatenate([self._launch(part, count, max_depth) for part in self._rays.parts(pixel, count)])

    def _launch(self, pixel: NDArray[np.int64], count: int, max_depth: int) -> NDArray[np.float32]:
        rays, lanes = self._rays, len(pixel) * count
        of_pixel = dr.gather(mi.UInt32, jit_array(mi.UInt32, pixel), dr.arange(mi.UInt32, lanes) // count)
        ray = rays.through(of_pixel, mi.Point2f(0.5, 0.5), dr.opaque(mi.Float, 0.5))
        _, hit, surface, known = trace_first(rays.scene, rays.lights, ray)
        rest = trace_rest(rays.scene, rays.lights, rays.sampler(lanes, count), (surface, hit, known), max_depth)
        reflectance = surface.bsdf(ray).eval_diffuse_reflectance(surface, hit)
        return means_by_pixel([*(rest / dr.maximum(reflectance, _LEAST_REFLECTANCE))], count)

    def smooth(self, mask: NDArray[np.bool_], most_px: float) -> None:
        """Replace the light of some of the pixels by means over their neighbours.

        Args:
            mask: (P,) which.
            most_px: largest standard deviation of the weights over the distance between places.
        """
        row = jit_array(mi.UInt32, np.flatnonzero(mask))
        if not len(row):
            return
        normal, point = (_gathered(rows, row) for rows in (self._normal, self._point))
        pixel = jit_array(mi.UInt32, self.pixel[mask])
        sigma_m = dr.minimum(dr.gather(mi.Float, self._smoothing_m, row), self._width_m(point.w, most_px))
        mean, error = self._around(pixel, (normal, point), sigma_m, math.ceil(2 * most_px / self._every_px))
        smoothed = [dr.copy(self._mean), dr.copy(self._error)]
        for rows, values in zip(smoothed, (mean, error), strict=True):
            dr.scatter(rows, values, row)
        dr.eval(smoothed)
        self._mean, self._error = smoothed

    def towards(self, pixel: Any, place: Any, surface: Any, known: Any) -> tuple[Any, Any]:
        """Light on surfaces that rays meet, by what the four nearest centres see.

        Args:
            pixel, place: where the rays go, as in `CameraRays.rays`.
            surface, known: what they meet, as from `trace_first`.

        Returns:
            Light of those on the same surface, or the mean over its part where none of them sees it, and its error.
            [cd/m2]
        """
        reach_m = dr.maximum(self._width_m(surface.t, self._looking_px), SMOOTHING_M)
        row = pixel // self._rays.width_px
        column = pixel - row * self._rays.width_px
        # Of the square of four centres that a ray goes through.
        corner = self._cell(
            row - dr.select(place.y < 0.5, mi.UInt32(1), 0), column - dr.select(place.x < 0.5, mi.UInt32(1), 0)
        )
        shape: Any = dr.reinterpret_array(mi.UInt32, surface.shape)
        part = dr.opaque(mi.UInt32, self._none + 1) + dr.gather(mi.UInt32, self._part, shape, surface.is_valid())
        total: Any = mi.Float(_LEAST_WEIGHT)
        mean, error = (total * _gathered(rows, part) for rows in (self._mean, self._error))
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            row = self._row_at(corner, down, right)
            weight = self._weight(row, (surface.sh_frame.n, surface.p, known), reach_m)
            mean += weight * _gathered(self._mean, row)
            error += weight * _gathered(self._error, row)
            total += weight
        return mi.Color3f(mean.xyz / total), mi.Color3f(error.xyz / total)

    def at_center(self, pixel: Any) -> tuple[Any, Any]:
        """Light on what the centres of pixels see, and its error. [cd/m2]"""
        row = dr.gather(mi.UInt32, self._place, self._cell_of(pixel))
        mean, error = (_gathered(rows, row) for rows in (self._mean, self._error))
        return mi.Color3f(mean.xyz), mi.Color3f(error.xyz)

    def _cell_of(self, pixel: Any) -> Any:
        """Place of pixels in the table of those that are known, rounded down; for arrays of either library."""
        row = pixel // self._rays.width_px
        return self._cell(row, pixel - row * self._rays.width_px)

    def _cell(self, row: Any, column: Any) -> Any:
        return row // self._every_px * self._columns + column // self._every_px

    def _row_at(self, cell: Any, down: Any, right: Any) -> Any:
        """Number of the pixel that is so many steps from a cell. Places before the first wrap to beyond the last."""
        at = dr.minimum(cell + down * mi.UInt32(self._columns) + right, mi.UInt32(self._cells))
        return dr.gather(mi.UInt32, self._place, at)

    def _width_m(self, distance_m: Any, width_px: float) -> Any:
        """What so many pixels are at a distance. [m]"""
        return distance_m * dr.opaque(mi.Float, width_px / self._rays.focal_px)

    def _around(self, pixel: Any, seen: tuple[Any, Any], sigma_m: Any, reach: int) -> tuple[Any, Any]:
        """Weighted means of light and error, of the pixels around.

        Args:
            pixel: the middle ones.
            seen: normal and known share of the sky's light of surfaces, and places on them.
            sigma_m: standard deviation of the weights. [m]
            reach: how many steps away neighbours may be in the image.
        """
        normal, point = seen
        side, back = dr.opaque(mi.UInt32, 2 * reach + 1), dr.opaque(mi.UInt32, reach)
        cell = self._cell_of(pixel)

        def more(tap: Any, *_: Any) -> Any:
            return tap < side * side

        def add(tap: Any, total: Any, mean: Any, error: Any) -> tuple[Any, Any, Any, Any]:
            down = tap // side
            row = self._row_at(cell, down - back, tap - down * side - back)
            weight = self._weight(row, (normal.xyz, point.xyz, normal.w), sigma_m)
            mean_there, error_there = (_gathered(rows, row) for rows in (self._mean, self._error))
            return tap + 1, total + weight, mean + weight * mean_there, error + weight * error_there

        nothing: Any = dr.zeros(mi.Vector4f, dr.width(pixel))
        _, total, mean, error = dr.while_loop(
            (mi.UInt32(0), dr.zeros(mi.Float, dr.width(pixel)), nothing, nothing), more, add
        )
        per_weight = 1.0 / dr.maximum(total, 1e-12)
        return mean * per_weight, error * per_weight

    def _weight(self, row: Any, seen: tuple[Any, Any, Any], reach_m: Any) -> Any:
        """How far what a centre sees is of the surface with this normal, point, and known share of the sky's light."""
        normal, point, known = seen
        normal_there, point_there = (_gathered(rows, row) for rows in (self._normal, self._point))
        away = point_there.xyz - point
        facing = dr.maximum(dr.dot(normal_there.xyz, normal), 0.0)
        for _ in range(_NORMAL_POWER):
            facing = facing * facing
        off_plane = dr.dot(away, normal) / dr.maximum(_SAME_PLANE_PER_REACH * reach_m, _SAME_PLANE_M)
        same = facing * dr.exp(-off_plane * off_plane) + _WEIGHT_ROUND_CORNERS
        return dr.select(normal_there.w == known, same * dr.exp(-0.5 * dr.dot(away, away) / dr.square(reach_m)), 0.0)


def _gathered(rows: Any, row: Any) -> Any:
    """The four numbers of rows."""
    return dr.gather(mi.Vector4f, rows, row)


def _rows(vector: Any, last: NDArray[np.float32]) -> Any:
    """(P + 1, 4) numbers in one array, by pixel; row P is of pixels whose centres see nothing, all of it -1."""
    rows = np.full((len(last) + 1, 4), -1.0, dtype=np.float32)
    rows[:-1, :3], rows[:-1, 3] = rows_of(vector), last
    return jit_array(mi.Float, rows.ravel())
