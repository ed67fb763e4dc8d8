"""The pixels around outlines, gathered for all outlines at once and padded to one length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.images import Pixels
from geometry.se3 import Array
from nav.centroids.ellipses import Ellipses, shape_inverses, shape_radii
from nav.centroids.marker_signal import MarkerSignal
from nav.numerics.compiled import Array32, compiled

# Arrays of integers, or of an image's numbers.
Cells = NDArray[Any]
_ZERO, _ONE = np.float32(0), np.float32(1)


@compiled
def _inwards(y: np.float32, x: Array32, inverse: Array32, radius: np.float32, inwards: Array32) -> None:
    """Approximate inward distances from an outline about the origin, along a row."""
    a, b, c = inverse[0, 0], inverse[0, 1], inverse[1, 1]
    for k in range(len(x)):
        w0, w1 = a * x[k] + b * y, b * x[k] + c * y
        inwards[k] = radius * (_ONE - np.sqrt(w0 * w0 + w1 * w1))


@compiled
def choose_cells(
    offsets: Array32,
    starts: Array32,
    outlines: tuple[Array32, Array32],
    holes: tuple[Array32, Array32, Array32],
    limits: tuple[np.float32, np.float32],
    thin: int,
    frames: Cells,
    cells: Cells,
) -> tuple[Cells, NDArray[np.bool_]]:
    """Choose the pixels of square windows that a fit of the outlines needs; see `_gather`.

    Args:
        offsets: (S,) of the windows' columns, and rows, from their middles.
        starts: (N, 2) the middles, from the outlines' centres.
        outlines: inverse shapes (N, 2, 2) and radii (N,).
        holes: centres (N, 2), inverse shapes (N, 2, 2) and radii (N,) of holes in the outlines; empty arrays for none.
        limits: largest distance outside the outline, and distance from an edge within which every pixel is taken. [px]
        thin: elsewhere every `thin`-th row and column is taken.
        frames: (N, 4) left, top, right, bottom of the windows' cells on the image, the last two exclusive.
        cells: (N, S S) to be filled with row S + column.

    Returns:
        (N,) numbers of chosen cells, and whether cells of an outline lie outside the image.
    """
    size, (reach, band), has_holes = len(offsets), limits, len(holes[0]) > 0
    counts, cut = np.zeros(len(starts), np.int64), np.zeros(len(starts), np.bool_)
    x, inwards, into_hole = np.empty_like(offsets), np.empty_like(offsets), np.empty_like(offsets)
    middle = size // 2
    for n in range(len(starts)):
        left, top, right, bottom = frames[n]
        count = 0
        for row in range(size):
            for k in range(size):
                x[k] = starts[n, 0] + offsets[k]
            y = starts[n, 1] + offsets[row]
            _inwards(y, x, outlines[0][n], outlines[1][n], inwards)
            if has_holes:
                for k in range(size):
                    x[k] -= holes[0][n, 0]
                _inwards(y - holes[0][n, 1], x, holes[1][n], holes[2][n], into_hole)
            for column in range(size):
                if inwards[column] < -reach:
                    continue
                at_edge = inwards[column] <= band and inwards[column] >= -band
                if has_holes:
                    if into_hole[column] > band:
                        continue
                    at_edge |= into_hole[column] >= -band
                if not at_edge and ((row - middle) % thin != 0 or (column - middle) % thin != 0):
                    continue
                if column < left or column >= right or row < top or row >= bottom:
                    cut[n] = True
                    continue
                cells[n, count] = row * size + column
                count += 1
        counts[n] = count
    return counts, cut


@compiled
def place_cells(
    cells: Cells, counts: Cells, starts: Array32, offsets: Array32, x: Array32, y: Array32, present: Array32
) -> None:
    """Fill (N, K) places of chosen cells from the outlines' centres, and 1; zeros behind the counts (N,).

    Args:
        cells, counts, starts, offsets: as in `choose_cells`.
        x, y, present: filled.
    """
    size = len(offsets)
    for n in range(len(x)):
        for k in range(counts[n]):
            x[n, k] = starts[n, 0] + offsets[cells[n, k] % size]
            y[n, k] = starts[n, 1] + offsets[cells[n, k] // size]
            present[n, k] = _ONE
        x[n, counts[n] :], y[n, counts[n] :], present[n, counts[n] :] = _ZERO, _ZERO, _ZERO


@compiled
def take_cells(
    picture: Cells, rows: Cells, firsts: Cells, every: int, size: int, cells: Cells, counts: Cells, taken: Array32
) -> None:
    """Fill some rows of (N, K) with a picture's values at the chosen cells of windows; zeros behind the counts (N,).

    Args:
        picture: of any kind of numbers.
        rows: numbers of the rows.
        firsts: (N, 2) column and row of each window's first cell on the picture.
        every: pixels between neighbouring cells.
        size: cells of a window's side.
        cells, counts: as in `choose_cells`.
        taken: filled.
    """
    for n in rows:
        for k in range(counts[n]):
            row, column = firsts[n, 1] + every * (cells[n, k] // size), firsts[n, 0] + every * (cells[n, k] % size)
            taken[n, k] = picture[row, column]
        taken[n, counts[n] :] = _ZERO


# Discs up to this radius are used whole. Of larger discs the pixels within the band of the edge are used, and every
# fourth row and column of the rest, which determines only level and shading: 8 % more noise where shading is fitted,
# half the time. Of a mosaic's sites, which lie two pixels apart, that is every second row and column.
WHOLE_RADIUS_PX = 24.0
_BAND_PX = 2.5
_THIN_PX = 4

_Picture = Array32 | Pixels | NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class OutlinePixels:
    """Pixels of N outlines.

    Attributes:
        x_px, y_px: (N, K) places relative to `origins_px`.
        values: (N, K) signal, 0 in the padding.
        others: (N, K) the other colours that a difference subtracts, up to a constant, None where not known.
        present: (N, K) 1, or 0 in the padding.
        clipped: (N, K).
        origins_px: (N, 2) initial centres.
        truncated: (N,) whether the window reaches beyond the image.
    """

    x_px: Array32
    y_px: Array32
    values: Array32
    present: Array32
    clipped: NDArray[np.bool_]
    origins_px: Array
    truncated: NDArray[np.bool_]
    others: Array32 | None = None

    def only(self, chosen: NDArray[np.bool_]) -> OutlinePixels:
        """The same outlines with padding for the pixels that were not chosen, (N, K)."""
        return replace(self, present=self.present * chosen)


def edge_distances(shapes_px: Array, x_px: Array32, y_px: Array32) -> Array32:
    """Approximate inward distances from outlines about the origin, exact for circles. [px]

    Args:
        shapes_px: (N, 2, 2).
        x_px, y_px: (N, ...), of shapes that fit each other.
    """
    inverse = shape_inverses(shapes_px).astype(np.float32)
    a, b, c = (inverse[:, i, j].reshape((-1,) + (1,) * (x_px.ndim - 1)) for i, j in ((0, 0), (0, 1), (1, 1)))
    radii = shape_radii(shapes_px).astype(np.float32).reshape(a.shape)
    # For x (N, 1, W) and y (N, H, 1) only the terms of both are computed on the whole grid.
    w0, w1 = a * x_px + b * y_px, b * x_px + c * y_px
    w0 *= w0
    w1 *= w1
    w0 += w1
    distances: Array32 = np.sqrt(w0, out=w0)
    np.subtract(1, distances, out=distances)
    distances *= radii
    return distances


def disc_pixels(
    signals: Sequence[MarkerSignal], discs: Ellipses, everything: bool = False, blur_px: float = 0.0
) -> OutlinePixels:
    """Pixels in and around discs, whose edges motion spreads by `blur_px` to either side.

    With `everything`, all pixels of large discs, not only every fourth row and column far from the edge.
    """
    whole = everything or bool(discs.radii_px.max() <= WHOLE_RADIUS_PX)
    return _gather(signals, discs, thin=1 if whole else _thin_cells(signals), blur_px=blur_px)


def coarse_pixels(signals: Sequence[MarkerSignal], discs: Ellipses) -> OutlinePixels:
    """One in four by four of the pixels in and around discs."""
    return _gather(signals, discs, every=_thin_cells(signals))


def annulus_pixels(
    signals: Sequence[MarkerSignal], outer: Ellipses, inner: Ellipses, blur_px: float = 0.0
) -> OutlinePixels:
    """Pixels on and around annuli, `blur_px` as for `disc_pixels`; of the hole only those near its edge."""
    return _gather(signals, outer, thin=_thin_cells(signals), holes=inner, blur_px=blur_px)


def _thin_cells(signals: Sequence[MarkerSignal]) -> int:
    """Distance in sites between the rows and columns that are used far from edges."""
    return _THIN_PX // signals[0].pitch_px


def _gather(
    signals: Sequence[MarkerSignal],
    outlines: Ellipses,
    every: int = 1,
    thin: int = 1,
    holes: Ellipses | None = None,
    blur_px: float = 0.0,
) -> OutlinePixels:
    """Pixels in and around outlines, not in their holes.

    Args:
        signals: of both eyes.
        outlines: of both eyes.
        every: pixels between the rows and columns of the window.
        thin: far from edges, every `thin`-th of those rows and columns is used.
        holes: within the outlines.
        blur_px: distance by which motion spreads an edge to either side.
    """
    pitch = signals[0].pitch_px
    reach_px = blur_px + signals[0].outer_px
    extents = np.sqrt(np.einsum("mij,mij->mi", outlines.shapes_px, outlines.shapes_px)) + reach_px
    half = -(-(int(np.ceil(extents.max() / pitch)) + 1) // every) * every
    size = 2 * (half // every) + 1
    firsts_px = np.array([signal.first_px for signal in signals])[outlines.eyes]
    middles = np.rint((outlines.centers_px - firsts_px) / pitch).astype(np.int64)
    starts = (firsts_px + pitch * middles - outlines.centers_px).astype(np.float32)
    offsets = (pitch * (every * np.arange(size) - half)).astype(np.float32)
    windows = middles - half
    # Cells of the windows that lie on the image, column and row, from the first to behind the last.
    sides = np.array([signal.values.shape[::-1] for signal in signals])[outlines.eyes]
    frames = np.concatenate([-(windows // every), (sides - windows + every - 1) // every], axis=1)
    inside = np.zeros((0, 2), np.float32), np.zeros((0, 2, 2), np.float32), np.zeros(0, np.float32)
    if holes is not None:
        inside = (holes.centers_px - outlines.centers_px).astype(np.float32), *_inverses_and_radii(holes)
    limits = np.float32(reach_px), np.float32(_BAND_PX + blur_px)
    cells = np.empty((len(outlines), size * size), np.int32)
    outline = _inverses_and_radii(outlines)
    counts, truncated = choose_cells(offsets, starts, outline, inside, limits, thin, frames, cells)
    shape = len(outlines), max(1, int(counts.max()))
    x, y, present = (np.empty(shape, np.float32) for _ in range(3))
    place_cells(cells, counts, starts, offsets, x, y, present)
    rows_of_eyes = [np.flatnonzero(outlines.eyes == eye) for eye in range(len(signals))]

    def taken(pictures: Sequence[_Picture]) -> Array32:
        values = np.empty(shape, np.float32)
        for rows, picture in zip(rows_of_eyes, pictures, strict=True):
            take_cells(picture, rows, windows, every, size, cells, counts, values)
        return values

    values = taken([signal.values for signal in signals])
    own = [signal.own for signal in signals if signal.own is not None]
    return OutlinePixels(
        x,
        y,
        values,
        present,
        taken([signal.clipped for signal in signals]) > 0,
        outlines.centers_px,
        truncated,
        taken(own) - values if len(own) == len(signals) else None,
    )


def _inverses_and_radii(outlines: Ellipses) -> tuple[Array32, Array32]:
    return shape_inverses(outlines.shapes_px).astype(np.float32), outlines.radii_px.astype(np.float32)
