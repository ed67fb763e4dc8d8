"""Connected regions of a mask: their boxes, areas and centres of mass.

OpenCV's `connectedComponentsWithStats` gives the same regions in another order, and writes a label of four bytes for
every pixel on the way, which takes several times as long. Here a region is a set of runs: neighbouring pixels of one
row. Large masks are mostly empty, and eight empty pixels are skipped at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.numerics.compiled import compiled

_WORD = 8  # pixels
_EIGHT_ONES = np.uint64(0x0101010101010101)


@dataclass(frozen=True, eq=False)
class ConnectedRegions:
    """Regions of pixels that are neighbours along an axis or a diagonal, in the order of their first pixels by rows.

    Attributes:
        boxes: (M, 4) left, top, width, height. [px]
        areas_px2: (M,) numbers of pixels.
        centers_px: (M, 2) centres of mass.
    """

    boxes: NDArray[np.int64]
    areas_px2: NDArray[np.int64]
    centers_px: Array


def connected_regions(mask: NDArray[np.uint8]) -> ConnectedRegions:
    """The regions of a mask (H, W), which is 0 outside; ones inside are the quickest."""
    flat = np.ascontiguousarray(mask).reshape(-1)
    words = flat[: len(flat) // _WORD * _WORD].view(np.uint64)
    runs = _runs(flat, words, mask.shape[1])
    regions = _joined_runs(*runs, np.searchsorted(runs[0], np.arange(mask.shape[0] + 1)))
    left, top, right, bottom, area, sum_x, sum_y = regions.T
    boxes = np.stack([left, top, right - left, bottom - top], axis=1)
    return ConnectedRegions(boxes, area, np.stack([sum_x / area, sum_y / area], axis=1))


@compiled
def _runs(
    pixels: NDArray[np.uint8], words: NDArray[np.uint64], width: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Rows, starts and ends of runs in ascending order; the end is the column behind the last pixel."""
    most = len(pixels) // 2 + len(pixels) // width + 1
    rows, starts, ends = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    count, at = 0, 0
    while True:
        while at < len(pixels) and pixels[at] == 0:
            at += 1
            while at % _WORD == 0 and at // _WORD < len(words) and words[at // _WORD] == 0:
                at += _WORD
        if at >= len(pixels):
            return rows[:count], starts[:count], ends[:count]
        row = at // width
        begin, end = row * width, (row + 1) * width
        rows[count], starts[count] = row, at - begin
        while at < end and pixels[at] != 0:
            at += 1
            while at % _WORD == 0 and at + _WORD <= end and words[at // _WORD] == _EIGHT_ONES:
                at += _WORD
        ends[count] = at - begin
        count += 1


@compiled
def _joined_runs(
    rows: NDArray[np.int64], starts: NDArray[np.int64], ends: NDArray[np.int64], first_of_row: NDArray[np.int64]
) -> NDArray[np.int64]:
    """(M, 7) left, top, right, bottom (the last two exclusive), area, and sums of columns and rows of regions.

    Args:
        rows, starts, ends: (R,) of the runs.
        first_of_row: (H + 1,) number of the first run of each row, or of the next row that has any.
    """
    parents = np.arange(len(rows))
    for row in range(1, len(first_of_row) - 1):
        above, last_above = first_of_row[row - 1], first_of_row[row]
        for run in range(first_of_row[row], first_of_row[row + 1]):
            # A run touches those above that it overlaps when it is one pixel longer at either end.
            while above < last_above and ends[above] < starts[run]:
                above += 1
            touching = above
            while touching < last_above and starts[touching] <= ends[run]:
                _join(parents, touching, run)
                touching += 1
    number, count = np.empty(len(rows), np.int64), 0
    regions = np.empty((len(rows), 7), np.int64)
    for run in range(len(rows)):
        root = _root(parents, run)
        if root == run:
            number[run] = count
            regions[count] = (starts[run], rows[run], ends[run], rows[run] + 1, 0, 0, 0)
            count += 1
        region, length = regions[number[root]], ends[run] - starts[run]
        region[0], region[2] = min(region[0], starts[run]), max(region[2], ends[run])
        region[3] = rows[run] + 1
        region[4] += length
        region[5] += length * (starts[run] + ends[run] - 1) // 2
        region[6] += length * rows[run]
    return regions[:count]


@compiled
def _root(parents: NDArray[np.int64], run: int) -> int:
    while parents[run] != run:
        parents[run] = parents[parents[run]]
        run = parents[run]
    return run


@compiled
def _join(parents: NDArray[np.int64], one: int, other: int) -> None:
    """Join two regions under the root that comes first, so that a root's number is the lowest of its region."""
    first, second = _root(parents, one), _root(parents, other)
    parents[max(first, second)] = min(first, second)
