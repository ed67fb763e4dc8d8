"""The pixels that tell of an outline, gathered for all outlines at once and padded to one length."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.images import Pixels
from geometry.se3 import Array
from nav.centroids.ellipses import Ellipses, shape_inverses, shape_radii
from nav.centroids.marker_signal import Array32, MarkerSignal

# Pixels this far outside the edge are seen; a plain picture needs more of them to know its background. [px]
OUTER_DIFFERENCE_PX = 2.5
OUTER_PLAIN_PX = 5.0
# Discs up to this radius are taken whole. Of larger ones the pixels within the band of the edge are, and of the rest,
# which tells only level and shading, one in four by four: 8 % more noise where shading is fitted, half the time.
WHOLE_RADIUS_PX = 24.0
_BAND_PX = 2.5
_THIN = 4

_Picture = Array32 | Pixels | NDArray[np.bool_]
_Chooser = Callable[[Array32, Array32, NDArray[np.bool_]], NDArray[np.bool_]]


@dataclass(frozen=True, eq=False)
class PixelSet:
    """Pixels of N outlines.

    Attributes:
        x_px, y_px: (N, K) places relative to `origins_px`.
        values: (N, K) signal, 0 in the padding.
        others: (N, K) what a difference of colours has taken off, up to a constant, None where that is not known.
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
    others: Array32 | None = None

    def only(self, chosen: NDArray[np.bool_]) -> PixelSet:
        """The same outlines with padding for the pixels that were not chosen, (N, K)."""
        return replace(self, present=self.present * chosen)


def edge_distances(shapes_px: Array, x_px: Array32, y_px: Array32) -> Array32:
    """Rough distances inwards from outlines about the origin, exact for circles. [px]

    Args:
        shapes_px: (N, 2, 2).
        x_px, y_px: (N, ...), of shapes that fit each other.
    """
    inverse = shape_inverses(shapes_px).astype(np.float32)
    a, b, c = (inverse[:, i, j].reshape((-1,) + (1,) * (x_px.ndim - 1)) for i, j in ((0, 0), (0, 1), (1, 1)))
    radii = shape_radii(shapes_px).astype(np.float32).reshape(a.shape)
    # Of x (N, 1, W) and y (N, H, 1) only what needs both is computed on the whole grid.
    w0, w1 = a * x_px + b * y_px, b * x_px + c * y_px
    w0 *= w0
    w1 *= w1
    w0 += w1
    distances: Array32 = np.sqrt(w0, out=w0)
    np.subtract(1, distances, out=distances)
    distances *= radii
    return distances


def disc_pixels(signals: Sequence[MarkerSignal], discs: Ellipses, everything: bool = False) -> PixelSet:
    """Pixels in and around discs; with `everything`, those far from the edge of large discs too."""
    outer = np.float32(OUTER_DIFFERENCE_PX if signals[0].is_difference else OUTER_PLAIN_PX)
    whole = everything or bool(discs.radii_px.max() <= WHOLE_RADIUS_PX)

    def choose(x: Array32, y: Array32, thin: NDArray[np.bool_]) -> NDArray[np.bool_]:
        distance = edge_distances(discs.shapes_px, x, y)
        chosen: NDArray[np.bool_] = distance >= -outer
        if not whole:
            taken = distance <= _BAND_PX
            if outer > _BAND_PX:
                taken &= distance >= -_BAND_PX
            taken |= thin
            chosen &= taken
        return chosen

    return _gather(signals, discs, float(outer), choose)


def coarse_pixels(signals: Sequence[MarkerSignal], discs: Ellipses) -> PixelSet:
    """One in four by four of the pixels in and around discs."""
    outer = np.float32(OUTER_DIFFERENCE_PX if signals[0].is_difference else OUTER_PLAIN_PX)

    def choose(x: Array32, y: Array32, thin: NDArray[np.bool_]) -> NDArray[np.bool_]:
        chosen: NDArray[np.bool_] = edge_distances(discs.shapes_px, x, y) >= -outer
        return chosen

    return _gather(signals, discs, float(outer), choose, _THIN)


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


def _gather(
    signals: Sequence[MarkerSignal], outlines: Ellipses, reach_px: float, choose: _Chooser, every: int = 1
) -> PixelSet:
    """Pixels of squares around the outlines that `choose` takes; it is given places and a sparse grid."""
    pitch = signals[0].pitch_px
    extents = np.sqrt(np.einsum("mij,mij->mi", outlines.shapes_px, outlines.shapes_px)) + reach_px
    half = int(np.ceil(extents.max() / pitch)) + 1
    steps = np.arange(-half, half + 1, every)
    firsts = np.array([signal.first_px for signal in signals])[outlines.eyes]
    middles = np.rint((outlines.centers_px - firsts) / pitch).astype(np.int64)
    starts = (firsts + pitch * middles - outlines.centers_px).astype(np.float32)
    along = (pitch * steps).astype(np.float32)
    x, y = starts[:, 0, None, None] + along[:, None].T, starts[:, 1, None, None] + along[:, None]
    chosen = choose(x, y, (steps[:, None] % _THIN == 0) & (steps % _THIN == 0))
    columns, rows = (middles[:, axis, None] + steps for axis in (0, 1))
    heights, widths = np.array([signal.values.shape for signal in signals]).T[:, outlines.eyes, None]
    on_image = (rows >= 0) & (rows < heights), (columns >= 0) & (columns < widths)
    truncated = np.zeros(len(outlines), np.bool_)
    if not (on_image[0].all() and on_image[1].all()):
        seen = on_image[0][:, :, None] & on_image[1][:, None]
        truncated = (chosen & ~seen).any(axis=(1, 2))
        chosen &= seen
    # Flat indices are found and split faster than those of three axes.
    cell = np.flatnonzero(chosen)
    patch = cell // len(steps) ** 2
    cell -= len(steps) ** 2 * patch
    row = cell // len(steps)
    column = cell - len(steps) * row
    counts = np.bincount(patch, minlength=len(outlines))
    present = np.arange(max(1, int(counts.max()))) < counts[:, None]
    eye = outlines.eyes[patch]
    sites = [
        (mine, middles[patch[mine], 1] + steps[row[mine]], middles[patch[mine], 0] + steps[column[mine]])
        for mine in (np.flatnonzero(eye == index) for index in range(len(signals)))
    ]

    def padded(values: Array32 | NDArray[np.bool_]) -> Array32:
        array = np.zeros(present.shape, np.float32)
        array[present] = values
        return array

    def at_sites(pictures: Sequence[_Picture]) -> Array32:
        values = np.empty(len(patch), np.float32)
        for picture, (mine, at_rows, at_columns) in zip(pictures, sites, strict=True):
            values[mine] = picture[at_rows, at_columns]
        return values

    values = at_sites([signal.values for signal in signals])
    own = [signal.own for signal in signals if signal.own is not None]
    return PixelSet(
        padded(starts[patch, 0] + along[column]),
        padded(starts[patch, 1] + along[row]),
        padded(values),
        present.astype(np.float32),
        padded(at_sites([signal.clipped for signal in signals])) > 0,
        outlines.centers_px,
        truncated,
        padded(at_sites(own) - values) if len(own) == len(signals) else None,
    )
