"""Indirect light smoothed over each surface: the same as paths give, without their noise.

The indirect light that a matt surface receives, from other surfaces and from a partly hidden sky, varies over
centimetres; it holds no paint pattern, no edge of the image and no shadow of the sun. So it is enough to trace paths
from what the pixel centres see, and to average them over neighbours on the same surface, which removes nearly all
noise. Rays to edges and shadows, many per pixel, then look it up. The neighbours' weights come from positions and
normals, never from the traced light, so that the only error of the mean is the variation of light over its reach.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from drogue_models.parts import Part
from render.mitsuba_engine.jit_arrays import jit_array
from render.mitsuba_engine.paths.rays import (
    FrameRays,
    StratifiedSamples,
    chunks_by_count,
    means_by_pixel,
    rows_of,
    stratified_over_image,
)
from render.mitsuba_engine.paths.received_light import matt_points, sky_received, sky_seen_and_hidden, trace_received
from render.mitsuba_engine.scene import by_shape
from render.mitsuba_engine.trace_request import DROGUE_PARTS

SMOOTHING_M = 0.008
"""Standard deviation of the smoothing on a surface: ribs are this wide. [m]"""
# Light on the hub is even; the walls of the coupling's recess of 0.1 m darken quickly with depth. Sky shadows under a
# wing are as wide as pods are thick; those on probe and hose as wide as these are. [m]
_SMOOTHING_BY_PART_M = {Part.HUB: 0.016, Part.COUPLING: 0.005, Part.TANKER: 0.25}
_SMOOTHING_BESIDE_M = 0.03
# Along a surface that is seen at a grazing angle, a pixel is at most so many times as long as across.
_MOST_FORESHORTENING = 8.0
# A neighbour counts as on the same plane within this distance [m], or this share of the reach: large parts are round.
_SAME_PLANE_M = 0.005
_SAME_PLANE_PER_REACH = 0.25
# cos^16: half the weight at 17 degrees.
_NORMAL_POWER = 4
# Whether more light comes from the sky or is hidden changes over tens of pixels, and samples of one place cannot tell.
_AROUND_STEPS = 5
# Weight of neighbours on other surfaces: their light is the best estimate where no other is near.
_WEIGHT_ROUND_CORNERS = 1e-4
# A ray whose nearest centres weigh less than this sees a surface that no centre does.
_LEAST_KNOWN_WEIGHT = 0.01
# Weight of the part's mean light, which is used where no centre nearby sees the surface.
_LEAST_WEIGHT = 1e-8


class SurfaceLight:
    """Indirect irradiance over pi on the surfaces that some pixel centres see.

    Attributes:
        beside: (P,) which centres see a matt surface that is not a drogue's.
    """

    def __init__(
        self,
        rays: FrameRays,
        pixel: NDArray[np.int64],
        lookup_px: float,
        step_px: int = 1,
        fills_gaps: bool = False,
    ) -> None:
        """Find the surfaces at pixel centres.

        Args:
            rays: of the frame.
            pixel: (P,) flat indices of pixels whose centres see something, in rows and columns that are multiples of
                `step_px`.
            lookup_px: rays look up the light of centres within about so many pixels.
            step_px: distance between the centres.
            fills_gaps: whether a ray to a surface that no centre near by sees takes a path of its own, for the light of
                the sky alone.
        """
        self._fills_gaps = fills_gaps
        self._rays, self.pixel, self._lookup_px, self._step_px = rays, pixel, lookup_px, step_px
        self._none = len(pixel)
        self._columns = -(-rays.width_px // step_px)
        self._cells = self._columns * -(-2 * rays.size // rays.width_px // step_px)
        place = np.full(self._cells + 1, self._none, dtype=np.uint32)
        place[self._cell_of(pixel)] = np.arange(len(pixel))
        self._row_of_cell, self._place = place, jit_array(mi.UInt32, place)
        surface = self._surface(jit_array(mi.UInt32, pixel))
        shape: Any = dr.reinterpret_array(mi.UInt32, surface.shape)
        # Otherwise each use of them would trace the rays again.
        normal = surface.sh_frame.n
        dr.eval(normal, surface.p, surface.t, shape)
        smoothing_m = np.where(DROGUE_PARTS > 0, np.float32(SMOOTHING_M), np.float32(_SMOOTHING_BESIDE_M))
        for part, part_m in _SMOOTHING_BY_PART_M.items():
            smoothing_m[part] = part_m
        self._smoothing_m = dr.gather(mi.Float, jit_array(mi.Float, by_shape(rays.scene, smoothing_m)), shape)
        self._part = jit_array(mi.UInt32, by_shape(rays.scene, np.arange(256, dtype=np.uint32)))
        self._part_of_row = np.array(dr.gather(mi.UInt32, self._part, shape))
        self._points = matt_points(surface, dr.gather(mi.Float, rays.lights.open_to_sky, shape))
        dr.eval(self._points)
        self._known = known = np.array(self._points.known)
        self.beside: NDArray[np.bool_] = (DROGUE_PARTS[self._part_of_row] == 0) & (known > 0)
        length = _foreshortening(surface)
        dr.eval(length)
        self._pixel_length = jit_array(mi.Float, np.where(self.beside, np.array(length), np.float32(1.0)))
        self._normal, self._point = _rows(normal, known), _rows(surface.p, np.array(surface.t))
        self._mean = self._error = self._point
        open_sky = self._points.known * rays.lights.sky.towards(normal)
        dr.eval(open_sky)
        self._open_sky = rows_of(open_sky)

    def _surface(self, pixel: Any) -> Any:
        ray = self._rays.through(pixel, mi.Point2f(0.5, 0.5), dr.opaque(mi.Float, 0.5))
        return self._rays.scene.ray_intersect(ray, mi.RayFlags.ShadingFrame, True)

    def trace(
        self,
        chosen: list[tuple[NDArray[np.bool_], int]],
        max_depth: int,
        of_sky: tuple[NDArray[np.bool_], int],
    ) -> None:
        """Trace paths; their means replace the light so far.

        Args:
            chosen: (P,) masks of pixels, and the number of paths from each of them for each of two estimates.
            max_depth: longest path in segments.
            of_sky: the same for the light of the sky alone; the number is a power of two.
        """
        halves = np.zeros((2, self._none + 257, 4), dtype=np.float32)
        mask, count = of_sky
        for half in halves:
            half[np.flatnonzero(mask), :3] = self._sky_means(np.flatnonzero(mask), count)
        for mask, count in chosen:
            place = np.flatnonzero(mask)
            counts = np.full(len(place), count)
            # The samples of one pixel are stratified, so that their halves would not be independent.
            for half in halves:
                half[place, :3] = self._path_means(place, counts, max_depth)
        self._keep(halves)

    def _keep(self, halves: NDArray[np.float32]) -> None:
        """Take two independent estimates of the light, (2, P + 257, 4), as the light so far."""
        for half in halves:
            half[self._none + 1 :] = self._part_means(half[: self._none])
        mean, error = (halves[0] + halves[1]) / 2, (halves[0] - halves[1]) / 2
        self._mean, self._error = jit_array(mi.Float, mean.ravel()), jit_array(mi.Float, error.ravel())

    def _part_means(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """(256, 4) means by part id, 0 where no centre sees a part."""
        rows = self._part_of_row
        total = np.stack([np.bincount(rows, weights=channel, minlength=256) for channel in light.T], axis=-1)
        mean: NDArray[np.float32] = total / np.maximum(np.bincount(rows, minlength=256), 1)[:, None]
        return mean.astype(np.float32)

    def _path_means(self, row: NDArray[np.int64], counts: NDArray[np.int64], max_depth: int) -> NDArray[np.float32]:
        """(R, 3) means over (R,) numbers of paths from each of these centres. [cd/m2]"""
        found = [np.zeros((0, 3), dtype=np.float32)]
        for chunk, chunk_counts in chunks_by_count(row, counts):
            # What the samples take for pixels are rows of the centres.
            samples = StratifiedSamples(self._rays, chunk, chunk_counts)
            points = self._points.at(samples.pixel)
            found.append(samples.means(trace_received(self._rays, points, samples.place, max_depth)))
        return np.concatenate(found)

    def _sky_means(self, row: NDArray[np.int64], count: int) -> NDArray[np.float32]:
        """(P, 3) means over paths that end at the next surface. [cd/m2]

        The sky that is hidden is subtracted from that of an open place, or the sky that is seen is taken, whichever
        varies less around: inside an engine's intake the glow of a low sun would leave blotches where it is hidden.
        """
        if not len(row):
            return np.zeros((0, 3), dtype=np.float32)
        found = []
        lattice = [place // self._step_px for place in np.divmod(self.pixel, self._rays.width_px)]
        for chunk in self._rays.launch_chunks(row, count):
            if len(chunk):
                first = stratified_over_image(self._rays, (lattice[0][chunk], lattice[1][chunk]), count)
                of_lane = dr.arange(mi.UInt32, len(chunk) * count) // dr.opaque(mi.UInt32, count)
                points = self._points.at(dr.gather(mi.UInt32, jit_array(mi.UInt32, chunk), of_lane))
                seen, hidden = sky_seen_and_hidden(self._rays, points, first)
                channels = [*seen, *hidden, dr.square(dr.sum(seen)), dr.square(dr.sum(hidden))]
                found.append(means_by_pixel(channels, count))
        means = np.concatenate(found)
        seen, hidden = means[:, :3], means[:, 3:6]
        varies = [
            self._around(row, np.maximum(squares - light.sum(axis=1) ** 2, 0.0))
            for light, squares in ((seen, means[:, 6]), (hidden, means[:, 7]))
        ]
        # Running sums leave a rounding error, of either sign, where nothing varies.
        share = np.clip(varies[0] / np.maximum(varies[0] + varies[1], np.float32(1e-30)), 0.0, 1.0)
        share = (self._known[row] * np.where(varies[1] > 0, share, np.float32(1.0)))[:, None]
        mean: NDArray[np.float32] = (1 - share) * (seen - self._open_sky[row]) - share * hidden
        return mean

    def _around(self, row: NDArray[np.int64], values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(P,) means of the values of these rows over the centres around each."""
        down, right = np.divmod(self._cell_of(self.pixel[row]), self._columns)
        # In a window with empty cells around, for most of the picture may see other things.
        down, right = down - down.min() + _AROUND_STEPS, right - right.min() + _AROUND_STEPS
        grids = np.zeros((2, down.max() + _AROUND_STEPS + 1, right.max() + _AROUND_STEPS + 1), dtype=np.float32)
        grids[0, down, right], grids[1, down, right] = values, 1.0
        sums, counts = (cv2.boxFilter(grid, -1, (_AROUND_STEPS, _AROUND_STEPS))[down, right] for grid in grids)
        mean: NDArray[np.float32] = sums / counts
        return mean

    def smooth(self, mask: NDArray[np.bool_], most_px: float) -> None:
        """Replace the light of some pixels by weighted means over their neighbours.

        Args:
            mask: (P,) which pixels.
            most_px: largest standard deviation of the weights by distance, in the image. [px]
        """
        row = jit_array(mi.UInt32, np.flatnonzero(mask))
        if not len(row):
            return
        normal, point = (_gathered(rows, row) for rows in (self._normal, self._point))
        pixel = jit_array(mi.UInt32, self.pixel[mask])
        most_m = self._width_m(point.w, most_px) * dr.gather(mi.Float, self._pixel_length, row)
        sigma_m = dr.minimum(dr.gather(mi.Float, self._smoothing_m, row), most_m)
        mean, error = self._neighbour_means(pixel, (normal, point), sigma_m, math.ceil(2 * most_px / self._step_px))
        smoothed = [dr.copy(self._mean), dr.copy(self._error)]
        for rows, values in zip(smoothed, (mean, error), strict=True):
            dr.scatter(rows, values, row)
        dr.eval(smoothed)
        self._mean, self._error = smoothed

    def towards(self, pixel: Any, place: Any, surface: Any, known: Any) -> tuple[Any, Any]:
        """Light on surfaces that rays hit, from the four nearest pixel centres.

        Args:
            pixel, place: where the rays pass, as in `CameraRays.rays`.
            surface, known: what they hit, as from `trace_direct`.

        Returns:
            Light of the centres that see the same surface, or the mean over its part where none does, and its error.
            [cd/m2]
        """
        reach_m = self._width_m(surface.t, self._lookup_px)
        if self._fills_gaps:
            reach_m *= _foreshortening(surface)
        reach_m = dr.maximum(reach_m, SMOOTHING_M)
        row = pixel // self._rays.width_px
        column = pixel - row * self._rays.width_px
        # The first of the four centres around the ray.
        up, left = (place.y < 0.5) & (row > 0), (place.x < 0.5) & (column > 0)
        corner = self._cell(row - dr.select(up, mi.UInt32(1), 0), column - dr.select(left, mi.UInt32(1), 0))
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
        light, error = mi.Color3f(mean.xyz / total), mi.Color3f(error.xyz / total)
        if self._fills_gaps:
            lost = surface.is_valid() & (total < _LEAST_KNOWN_WEIGHT)
            numbers = self._rays.sampler(dr.width(pixel), 1).next_2d()
            own = sky_received(self._rays, matt_points(surface, known), numbers, lost)
            light = dr.select(lost, own, light)
        return light, error

    def parts_at(self, pixel: NDArray[np.int64]) -> NDArray[np.uint32]:
        """(P,) ids of the parts that these centres see, 0 for pixels that are none."""
        part_of_row = np.append(self._part_of_row, np.uint32(Part.SKY))
        parts: NDArray[np.uint32] = part_of_row[self._row_of_cell[self._cell_of(pixel)]]
        return parts

    def at_center(self, pixel: Any) -> tuple[Any, Any]:
        """Light on the surfaces at the centres of pixels, and its error. [cd/m2]"""
        row = dr.gather(mi.UInt32, self._place, self._cell_of(pixel))
        mean, error = (_gathered(rows, row) for rows in (self._mean, self._error))
        return mi.Color3f(mean.xyz), mi.Color3f(error.xyz)

    def _cell_of(self, pixel: Any) -> Any:
        """Cells of pixels in the table of centres, rounded down; for arrays of NumPy and of Dr.Jit."""
        row = pixel // self._rays.width_px
        return self._cell(row, pixel - row * self._rays.width_px)

    def _cell(self, row: Any, column: Any) -> Any:
        return row // self._step_px * self._columns + column // self._step_px

    def _row_at(self, cell: Any, down: Any, right: Any) -> Any:
        """Row of the centre that is so many steps from a cell. Cells before the first wrap to one beyond the last."""
        at = dr.minimum(cell + down * mi.UInt32(self._columns) + right, mi.UInt32(self._cells))
        return dr.gather(mi.UInt32, self._place, at)

    def _width_m(self, distance_m: Any, width_px: float) -> Any:
        """Size of so many pixels at a distance. [m]"""
        return distance_m * dr.opaque(mi.Float, width_px / self._rays.focal_px)

    def _neighbour_means(self, pixel: Any, seen: tuple[Any, Any], sigma_m: Any, reach: int) -> tuple[Any, Any]:
        """Weighted means of light and error over neighbouring centres.

        Args:
            pixel: the middle pixels.
            seen: normals with the known share of the sky's light, and points, of their surfaces.
            sigma_m: standard deviation of the weights. [m]
            reach: largest number of steps to a neighbour in the image.
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
        """Weight of a centre's surface for the surface with this normal, point, and known share of the sky's light."""
        normal, point, known = seen
        normal_there, point_there = (_gathered(rows, row) for rows in (self._normal, self._point))
        away = point_there.xyz - point
        facing = dr.maximum(dr.dot(normal_there.xyz, normal), 0.0)
        for _ in range(_NORMAL_POWER):
            facing = facing * facing
        off_plane = dr.dot(away, normal) / dr.maximum(_SAME_PLANE_PER_REACH * reach_m, _SAME_PLANE_M)
        same = facing * dr.exp(-off_plane * off_plane) + _WEIGHT_ROUND_CORNERS
        return dr.select(normal_there.w == known, same * dr.exp(-0.5 * dr.dot(away, away) / dr.square(reach_m)), 0.0)


def _foreshortening(surface: Any) -> Any:
    """Length over width of a pixel's image on surfaces, at most `_MOST_FORESHORTENING`."""
    return 1.0 / dr.maximum(dr.abs(surface.wi.z), 1.0 / _MOST_FORESHORTENING)


def _gathered(rows: Any, row: Any) -> Any:
    """The four values of each row."""
    return dr.gather(mi.Vector4f, rows, row)


def _rows(vector: Any, last: NDArray[np.float32]) -> Any:
    """(P + 1, 4) values in one array, a row per centre; row P stands for pixels whose centres see nothing, all -1."""
    rows = np.full((len(last) + 1, 4), -1.0, dtype=np.float32)
    rows[:-1, :3], rows[:-1, 3] = rows_of(vector), last
    return jit_array(mi.Float, rows.ravel())
