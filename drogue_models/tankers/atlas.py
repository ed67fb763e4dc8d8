"""The texture atlas of an aircraft: a rectangle of texels for every surface, with the same texels per metre."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from drogue_models.tankers.airframe_grids import SurfaceGrid
from geometry.se3 import Array

ATLAS_WIDTH_PX, ATLAS_HEIGHT_PX = 2048, 1024
_FEWEST_PX = 4
_FEWEST_PER_M, _MOST_PER_M = 4.0, 1200.0


@dataclass(frozen=True, eq=False)
class Chart:
    """The rectangle of one surface: its columns run along it from the first ring to the last, its rows around it.

    Attributes:
        grid: the surface.
        row, column: first texel.
        height, width: in texels.
        along: (S,) place of each ring over the surface's length.
        around: (N + 1,) place of each point over the girth.
        length_m, girth_m: of the surface; the girth where it is widest.
    """

    grid: SurfaceGrid
    row: int
    column: int
    height: int
    width: int
    along: Array
    around: Array
    length_m: float
    girth_m: float

    @property
    def uv(self) -> Array:
        """(S, N + 1, 2) texture coordinates of the surface's points; outer texels have their centres on the seam."""
        u = (self.column + 0.5 + self.along * (self.width - 1)) / ATLAS_WIDTH_PX
        v = (self.row + 0.5 + self.around * (self.height - 1)) / ATLAS_HEIGHT_PX
        return np.stack(np.broadcast_arrays(u[:, None], v[None]), axis=-1)

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns in the atlas."""
        return slice(self.row, self.row + self.height), slice(self.column, self.column + self.width)

    def points_m(self) -> NDArray[np.float32]:
        """(height, width, 3) points of the surface at the texel centres, in body axes. [m]"""
        points = np.concatenate([self.grid.points_m, self.grid.points_m[:, :1]], axis=1).astype(np.float32)
        columns = _between(points, self.along, np.linspace(0.0, 1.0, self.width))
        return _between(columns.transpose(1, 0, 2), self.around, np.linspace(0.0, 1.0, self.height))

    def finish(self) -> NDArray[np.uint8]:
        """(width,) finish of each column, that of the ring before it."""
        before = np.searchsorted(self.along, np.linspace(0.0, 1.0, self.width) + 1e-9, side="right") - 1
        return self.grid.finish[np.clip(before, 0, len(self.grid.finish) - 1)]


def _between(rows: NDArray[np.float32], places: Array, wanted: Array) -> NDArray[np.float32]:
    """Linear interpolation along the first axis."""
    after = np.clip(np.searchsorted(places, wanted, side="right"), 1, len(places) - 1)
    step = np.maximum(places[after] - places[after - 1], 1e-12)
    share = np.clip((wanted - places[after - 1]) / step, 0.0, 1.0).astype(np.float32)[:, None, None]
    result: NDArray[np.float32] = rows[after - 1] * (1 - share) + rows[after] * share
    return result


def lay_out(grids: Sequence[SurfaceGrid]) -> list[Chart]:
    """A chart for every surface, in the given order, as large as fits the atlas."""
    measures = [_measure(part) for part in grids]
    per_m = _MOST_PER_M
    needed = sum(
        length * girth * part.texel_share**2 for part, (_, _, length, girth) in zip(grids, measures, strict=True)
    )
    per_m = min(per_m, 1.05 * float(np.sqrt(ATLAS_WIDTH_PX * ATLAS_HEIGHT_PX / needed)))
    while per_m > _FEWEST_PER_M:
        sizes = [
            (
                max(_FEWEST_PX, round(girth * per_m * part.texel_share)),
                max(_FEWEST_PX, round(length * per_m * part.texel_share)),
            )
            for part, (_, _, length, girth) in zip(grids, measures, strict=True)
        ]
        places = _packed(sizes)
        if places is not None:
            return [
                Chart(part, row, column, height, width, *measure)
                for part, (row, column), (height, width), measure in zip(grids, places, sizes, measures, strict=True)
            ]
        per_m *= 0.97
    raise ValueError("grids: too many surfaces for one atlas")


def _measure(part: SurfaceGrid) -> tuple[Array, Array, float, float]:
    """Places of rings and points, length and girth of a surface."""
    points = np.concatenate([part.points_m, part.points_m[:, :1]], axis=1)
    along = np.linalg.norm(np.diff(points, axis=0), axis=-1).mean(axis=1)
    around = np.linalg.norm(np.diff(points, axis=1), axis=-1)
    girth_m = float(around.sum(axis=1).max())
    # The caps that close an end are a texel of its rim.
    along = np.maximum(along, 1e-6 * along.sum())
    mean = np.maximum(around.mean(axis=0), 1e-6 * around.mean())
    places = np.concatenate([[0.0], np.cumsum(along)]) / along.sum()
    return places, np.concatenate([[0.0], np.cumsum(mean)]) / mean.sum(), float(along.sum()), girth_m


def _packed(sizes: Sequence[tuple[int, int]]) -> list[tuple[int, int]] | None:
    """Row and column of every (height, width), or None where they do not fit.

    The tallest come first, each as low as possible on top of those before.
    """
    skyline = np.zeros(ATLAS_WIDTH_PX, dtype=np.intp)
    places = [(0, 0)] * len(sizes)
    for index in sorted(range(len(sizes)), key=lambda index: (-sizes[index][0], index)):
        height, width = sizes[index]
        if width > ATLAS_WIDTH_PX:
            return None
        rows = sliding_window_view(skyline, width).max(axis=1)
        column = int(np.argmin(rows))
        row = int(rows[column])
        if row + height > ATLAS_HEIGHT_PX:
            return None
        skyline[column : column + width] = row + height
        places[index] = (row, column)
    return places
