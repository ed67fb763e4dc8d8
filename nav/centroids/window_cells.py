"""Which pixels of windows around outlines tell of them, compiled; see `nav.centroids.patches`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nav.numerics.compiled import Array32, compiled

# Of whole numbers, or a picture's.
Cells = NDArray[Any]
_ONE = np.float32(1)


@compiled
def _inwards(y: np.float32, x: Array32, inverse: Array32, radius: np.float32, inwards: Array32) -> None:
    """Rough distances inwards from an outline about the origin, along a row."""
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
    """Choose the pixels of square windows that tell of outlines; see `nav.centroids.patches`.

    Args:
        offsets: (S,) of the windows' columns, and rows, from their middles.
        starts: (N, 2) the middles, from the outlines' centres.
        outlines: inverse shapes (N, 2, 2) and radii (N,).
        holes: centres (N, 2), inverse shapes and radii of what lies within them, of none of them.
        limits: how far outwards pixels are taken, and how far from an edge all of them are.
        thin: elsewhere one in so many by so many is taken; 1 for all.
        frames: (N, 4) of the windows' cells on the image: first column, first row, and behind the last ones.
        cells: (N, S S) to be filled with row S + column.

    Returns:
        (N,) how many were chosen, and whether some of an outline's lie beside the image.
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
def take_cells(picture: Cells, firsts: Cells, every: int, size: int, cells: Cells, filled: Array32) -> None:
    """Fill (M, K) with a picture's values at the cells (M, at least K), -1 for none, of windows that begin at `firsts`.

    Args:
        picture: of any kind of numbers.
        firsts: (M, 2) column and row of each window's first cell on it.
        every: pixels between neighbouring cells.
        size: cells of a window's side.
        cells: row S + column.
        filled: zero where there is no cell.
    """
    for n in range(len(filled)):
        for k in range(filled.shape[1]):
            cell = cells[n, k]
            if cell < 0:
                break
            row, column = firsts[n, 1] + every * (cell // size), firsts[n, 0] + every * (cell % size)
            filled[n, k] = picture[row, column]
