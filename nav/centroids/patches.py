"""The pixels that tell of an outline, gathered for all outlines at once and padded to one length."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.centroids.ellipses import Ellipses
from nav.centroids.marker_signal import Array32, MarkerSignal

# Pixels this far outside the edge are seen; a plain picture needs more of them to know its background. [px]
OUTER_DIFFERENCE_PX = 2.5
OUTER_PLAIN_PX = 5.0
# Discs up to this radius are taken whole. Of larger ones the pixels within the band of the edge are, and of the rest,
# which tells only level and shading, one in three by three.
WHOLE_RADIUS_PX = 12.0
_BAND_PX = 3.0
_THIN = 3

_Chooser = Callable[[Array32, Array32, NDArray[np.bool_]], NDArray[np.bool_]]


@dataclass(frozen=True, eq=False)
class PixelSet:
    """Pixels of N outlines.

    Attributes:
        x_px, y_px: (N, K) places relative to `origins_px`.
        values: (N, K) signal, 0 in the padding.
        present: (N, K) 1, or 0 in the padding.
        clipped: (N, K).
        origins_px: (N, 2) initial centres.
        truncated: (N,) whether the window reaches over the edge of the image.
    """

    x_px: Array32
    y_px: Array32
    values: Array32
    present: Array32
    clipped: NDArray[np.bool_]
    origins_px: Array
    truncated: NDArray[np.bool_]


def edge_distances(shapes_px: Array, x_px: Array32, y_px: Array32) -> Array32:
    """Rough distances inwards from outlines about the origin, exact for circles. [px]

    Args:
        shapes_px: (N, 2, 2).
        x_px, y_px: (N, ...).
    """
    inverse = np.linalg.inv(shapes_px).astype(np.float32)
    a, b, c = (inverse[:, i, j].reshape((-1,) + (1,) * (x_px.ndim - 1)) for i, j in ((0, 0), (0, 1), (1, 1)))
    radii = np.sqrt(np.linalg.det(shapes_px)).astype(np.float32).reshape(a.shape)
    w0, w1 = a * x_px + b * y_px, b * x_px + c * y_px
    distances: Array32 = radii * (1 - np.sqrt(w0 * w0 + w1 * w1))
    return distances


def disc_pixels(signals: Sequence[MarkerSignal], discs: Ellipses) -> PixelSet:
    """Pixels in and around discs."""
    outer = np.float32(OUTER_DIFFERENCE_PX if signals[0].is_difference else OUTER_PLAIN_PX)
    whole = bool(discs.radii_px.max() <= WHOLE_RADIUS_PX)

    def choose(x: Array32, y: Array32, thin: NDArray[np.bool_]) -> NDArray[np.bool_]:
        distance = edge_distances(discs.shapes_px, x, y)
        chosen: NDArray[np.bool_] = distance >= -outer
        if not whole:
            chosen &= (np.abs(distance) <= _BAND_PX) | thin
        return chosen

    return _gather(signals, discs, float(outer), choose)


def coarse_pixels(signals: Sequence[MarkerSignal], discs: Ellipses) -> PixelSet:
    """One in three by three of the pixels in and around discs."""
    outer = np.float32(OUTER_DIFFERENCE_PX if signals[0].is_difference else OUTER_PLAIN_PX)

    def choose(x: Array32, y: Array32, thin: NDArray[np.bool_]) -> NDArray[np.bool_]:
        chosen: NDArray[np.bool_] = thin & (edge_distances(discs.shapes_px, x, y) >= -outer)
        return chosen

    return _gather(signals, discs, float(outer), choose)


def annulus_pixels(signals: Sequence[MarkerSignal], outer: Ellipses, inner: Ellipses) -> PixelSet:
    """Pixels on and around annuli; of the hole only what lies near its edge."""
    reach = np.float32(OUTER_DIFFERENCE_PX if signals[0].is_difference else OUTER_PLAIN_PX)
    shift = (inner.centers_px - outer.centers_px).astype(np.float32)[:, :, None, None]

    def choose(x: Array32, y: Array32, thin: NDArray[np.bool_]) -> NDArray[np.bool_]:
        to_outer = edge_distances(outer.shapes_px, x, y)
        to_inner = edge_distances(inner.shapes_px, x - shift[:, 0], y - shift[:, 1])
        chosen: NDArray[np.bool_] = (to_outer >= -reach) & (to_inner <= _BAND_PX)
        return chosen & ((np.abs(to_outer) <= _BAND_PX) | (np.abs(to_inner) <= _BAND_PX) | thin)

    return _gather(signals, outer, float(reach), choose)


def _gather(signals: Sequence[MarkerSignal], outlines: Ellipses, reach_px: float, choose: _Chooser) -> PixelSet:
    """Pixels of squares around the outlines that `choose` takes; it is given places and a sparse grid."""
    pitch = signals[0].pitch_px
    extents = np.sqrt(np.einsum("mij,mij->mi", outlines.shapes_px, outlines.shapes_px)) + reach_px
    half = int(np.ceil(extents.max() / pitch)) + 1
    steps = np.arange(-half, half + 1)
    firsts = np.array([signal.first_px for signal in signals])[outlines.eyes]
    middles = np.rint((outlines.centers_px - firsts) / pitch).astype(np.int64)
    starts = (firsts + pitch * middles - outlines.centers_px).astype(np.float32)
    along = (pitch * steps).astype(np.float32)
    x, y = np.broadcast_arrays(
        starts[:, 0, None, None] + along[None, None, :], starts[:, 1, None, None] + along[None, :, None]
    )
    chosen = choose(x, y, (steps[:, None] % _THIN == 0) & (steps[None, :] % _THIN == 0))
    patch, row, column = np.nonzero(chosen)
    columns, rows = middles[patch, 0] + steps[column], middles[patch, 1] + steps[row]
    sizes = np.array([signal.values.shape for signal in signals])[outlines.eyes[patch]]
    seen = (columns >= 0) & (rows >= 0) & (columns < sizes[:, 1]) & (rows < sizes[:, 0])
    truncated = np.bincount(patch[~seen], minlength=len(outlines)) > 0
    patch, row, column, rows, columns = (index[seen] for index in (patch, row, column, rows, columns))
    counts = np.bincount(patch, minlength=len(outlines))
    place = np.arange(len(patch)) - (np.cumsum(counts) - counts)[patch]
    shape = (len(outlines), max(1, int(counts.max())))
    arrays = {name: np.zeros(shape, np.float32) for name in ("x", "y", "values", "present")}
    clipped = np.zeros(shape, np.bool_)
    arrays["x"][patch, place], arrays["y"][patch, place] = x[patch, row, column], y[patch, row, column]
    arrays["present"][patch, place] = 1
    for eye, signal in enumerate(signals):
        mine = outlines.eyes[patch] == eye
        site = rows[mine], columns[mine]
        arrays["values"][patch[mine], place[mine]] = signal.values[site]
        clipped[patch[mine], place[mine]] = signal.clipped[site]
    return PixelSet(
        arrays["x"], arrays["y"], arrays["values"], arrays["present"], clipped, outlines.centers_px, truncated
    )
