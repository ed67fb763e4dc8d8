"""What lies beyond the dark face around the markers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.centroids.blurred_edges import START_WIDTH_PX
from nav.centroids.ellipses import Ellipses, plane_shapes
from nav.centroids.marker_signal import OUTER_DIFFERENCE_PX, MarkerSignal
from nav.centroids.motion_blur import blurred_share_outside
from nav.centroids.outline_pixels import OutlinePixels, edge_distances
from nav.numerics.compiled import Array32

# Of a glaring sky a hundredth in a pixel is as much as a faint marker's noise.
_MOST_GLARE = 0.015
# Light from beyond is glaring where pixels beside an outline vary by more than this share of the contrast.
_GLARING_SHARE = 0.2
# So much of every edge must be left: on smaller images of a narrow face a fit would have too little to go by.
_LEAST_LEFT, _EDGE_PX = 0.5, 1.5
# Pixels so far from an outline show one side only. [px]
_CLEAR_PX = 1.0


def pixels_without_glare(
    pixels: OutlinePixels, signal: MarkerSignal, inwards_px: Array32, near: Callable[[float], Array32]
) -> NDArray[np.bool_] | None:
    """Which pixels hardly see what lies beyond a dark face, where it glares; None where it does not.

    Before a bright sky it is many times the contrast of what lies on the face, and a model of the face's edge that is
    off by hundredths of a pixel leaves more than the noise.

    Args:
        pixels: of outlines on the face.
        signal: one of those that they are from, which `shows_glare`.
        inwards_px: (N, K) distances into what lies on the face. [px]
        near: gives the (N, K) shares of light from beyond the face, were it narrower by so many pixels.
    """
    clear: NDArray[np.bool_] = near(signal.beside_px) < _MOST_GLARE
    present, outside = pixels.present > 0, inwards_px < -_CLEAR_PX
    lit, dark, beyond = (
        pixels.values[present & part] for part in (inwards_px > _CLEAR_PX, outside & clear, outside & ~clear)
    )
    if min(map(len, (lit, dark, beyond))) == 0:
        return None
    level = np.median(dark)
    contrast = np.median(lit) - level
    glare = np.sqrt(max(np.mean((beyond - level) ** 2) - np.var(dark), 0.0))
    if glare < _GLARING_SHARE * contrast:
        return None
    # What differs by more than that lies beyond too, should the face end earlier than it is said to.
    clear &= ~(outside & (np.abs(pixels.values - level) > contrast))
    edge = present & (np.abs(inwards_px) < _EDGE_PX)
    return clear if ((edge & clear).sum(axis=1) >= _LEAST_LEFT * edge.sum(axis=1)).all() else None


# Fewer markers than this do not tell an affine map.
_LEAST_MARKERS = 3
# Pixels that see more of what lies beyond are left out: ribs, hose, hub and sky are not even. What the lens spreads
# from there over the others is fitted as if it were.
_MOST_BEYOND = 0.5
# A window lies about the rough place, and what begins a blur beyond its end is seen in it. [px]
_BESIDE_WINDOW_PX = 2.0
# So near a disc in a difference of colours of the same place. [px]
VISIBLE_MARGIN_PX = OUTER_DIFFERENCE_PX + _BESIDE_WINDOW_PX


@dataclass(frozen=True, eq=False)
class FaceBackground:
    """The face of the drogue by the places of the fitted markers on it.

    Attributes:
        places_m: (M, 2) of the markers in the rim plane, in the order of the discs. [m]
        edges_m: radii about the origin of the rim plane within which the face begins and ends. [m]
        margin_px: width of the face beside the discs.
    """

    places_m: Array
    edges_m: tuple[float, float]
    margin_px: float = 0.0

    def take(self, index: np.ndarray[tuple[int], np.dtype[np.int64]]) -> FaceBackground:
        """Those of some discs."""
        return replace(self, places_m=self.places_m[index])


def visible_margin_px(signal: MarkerSignal) -> float:
    """What begins this near a disc may be seen in its window. [px]"""
    return signal.outer_px + signal.beside_px + _BESIDE_WINDOW_PX


def pixels_on_face(
    around: FaceBackground,
    discs: Ellipses,
    pixels: OutlinePixels,
    further: Array32,
    ways: Array | None,
    signal: MarkerSignal,
) -> OutlinePixels:
    """The pixels without those that see too much of what lies beyond the face.

    Args:
        around, discs, pixels, ways: see `shares_beyond`.
        further: from there.
        signal: one of those that the pixels are from.
    """
    chosen = (further < _MOST_BEYOND).all(axis=1)
    if not signal.shows_glare:
        return pixels.only(chosen)

    def beyond(nearer_px: float) -> Array32:
        shares = background_shares(around, discs, pixels, START_WIDTH_PX, ways, nearer_px) if nearer_px else further
        assert shares is not None
        most: Array32 = shares.max(axis=1)
        return most

    clear = pixels_without_glare(pixels, signal, edge_distances(discs.shapes_px, pixels.x_px, pixels.y_px), beyond)
    return pixels.only(chosen if clear is None else clear)


def background_shares(
    around: FaceBackground,
    discs: Ellipses,
    pixels: OutlinePixels,
    width_px: float,
    ways: Array | None,
    nearer_px: float = 0.0,
) -> Array32 | None:
    """How much of each pixel's light comes from within the face's opening, and from beyond the rim.

    The face is where an affine map of the eye's own markers shows it, shifted so that the disc itself lies where it was
    found: perspective within the drogue moves the rim against a marker by hundredths of a pixel at such distances.

    Args:
        around: the face.
        discs: the markers, placed to a tenth of a pixel or so.
        pixels: of the discs.
        width_px: Gaussian width of edges.
        ways: (N, 3) of the discs while the shutter is open, None of still ones.
        nearer_px: by how much the face is taken to be narrower on either side.

    Returns:
        (N, 2, K), or None where an eye has too few markers to tell.
    """
    count = len(discs)
    middles, shapes = np.empty((count, 2)), np.empty((2, count, 2, 2))
    for eye in np.unique(discs.eyes):
        mine = np.flatnonzero(discs.eyes == eye)
        if len(mine) < _LEAST_MARKERS:
            return None
        design = np.column_stack([around.places_m[mine], np.ones(len(mine))])
        affine = np.linalg.lstsq(design, discs.centers_px[mine], rcond=None)[0].T
        if abs(np.linalg.det(affine[:, :2])) < np.finfo(float).eps:
            return None
        middles[mine] = discs.centers_px[mine] - around.places_m[mine] @ affine[:, :2].T - pixels.origins_px[mine]
        shape = plane_shapes(affine[None, :, :2])[0]
        nearer_m = nearer_px / np.sqrt(np.linalg.det(shape))
        edges_m = around.edges_m[0] + nearer_m, around.edges_m[1] - nearer_m
        shapes[:, mine] = np.multiply.outer(edges_m, shape)[:, None]
    x = pixels.x_px - middles[:, :1].astype(np.float32)
    y = pixels.y_px - middles[:, 1:].astype(np.float32)
    in_opening = 1 - blurred_share_outside(shapes[0], x, y, width_px, ways)
    beyond_rim = blurred_share_outside(shapes[1], x, y, width_px, ways)
    shares: Array32 = np.stack([in_opening, beyond_rim], axis=1)
    return shares
