"""Light from beyond the dark face around the markers, which reaches their windows at long range.

The share of it in each pixel is an own term of the disc model, pixels with too much of it are left out, and pixels that
a glaring sky reaches are left out altogether.
"""

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

# Largest share of a glaring sky in a used pixel: a hundredth equals a faint marker's noise.
_MOST_GLARE = 0.015
# Light from beyond glares where pixels beside an outline vary by more than this share of the contrast.
_GLARING_SHARE = 0.2
# Least share of every edge that must remain: small images of a narrow face would leave the fit too few pixels.
_LEAST_LEFT, _EDGE_PX = 0.5, 1.5
# Pixels further than this from an outline show one side only. [px]
_CLEAR_PX = 1.0


def pixels_without_glare(
    pixels: OutlinePixels, signal: MarkerSignal, inwards_px: Array32, near: Callable[[float], Array32]
) -> NDArray[np.bool_] | None:
    """Pixels that a glaring background hardly reaches; None where it does not glare.

    A bright sky is many times the contrast of a marker on the face, and an error of the modelled face's edge of
    hundredths of a pixel leaves more than the noise.

    Args:
        pixels: of outlines on the face.
        signal: one of the signals that the pixels are from, with `shows_glare`.
        inwards_px: (N, K) inward distances from the outlines on the face. [px]
        near: (N, K) shares of light from beyond the face as a function of the pixels by which it is taken narrower.
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
    # Pixels that differ by more than the contrast count as beyond too, in case the face ends earlier than modelled.
    clear &= ~(outside & (np.abs(pixels.values - level) > contrast))
    edge = present & (np.abs(inwards_px) < _EDGE_PX)
    return clear if ((edge & clear).sum(axis=1) >= _LEAST_LEFT * edge.sum(axis=1)).all() else None


# Fewer markers do not determine an affine map.
_LEAST_MARKERS = 3
# Pixels with a larger share of light from beyond are left out: ribs, hose, hub and sky are not even. The light that the
# lens spreads from there over the other pixels is fitted as if it were even.
_MOST_BEYOND = 0.5
# The blur carries light over this distance into a window, which lies about a rough position. [px]
_BESIDE_WINDOW_PX = 2.0
# Light from beyond this margin around a disc stays out of its window in a difference of colours. [px]
VISIBLE_MARGIN_PX = OUTER_DIFFERENCE_PX + _BESIDE_WINDOW_PX


@dataclass(frozen=True, eq=False)
class FaceBackground:
    """The drogue's face, by the positions of the fitted markers on it.

    Attributes:
        places_m: (M, 2) positions of the markers in the rim plane, in the order of the discs. [m]
        edges_m: inner and outer radius of the face about the origin of the rim plane. [m]
        margin_px: width of the face beside the discs.
    """

    places_m: Array
    edges_m: tuple[float, float]
    margin_px: float = 0.0

    def take(self, index: np.ndarray[tuple[int], np.dtype[np.int64]]) -> FaceBackground:
        """Those of some discs."""
        return replace(self, places_m=self.places_m[index])

    def maps_px(self, eyes: NDArray[np.int64], centers_px: Array, variances_px2: Array | None = None) -> Array | None:
        """(M, 2, 3) affine map from the rim plane [m] to pixels by the markers of each one's own eye.

        Args:
            eyes: (M,) of the markers.
            centers_px: (M, 2) where they are.
            variances_px2: (M, 2) of these; all count alike when None.

        Returns:
            None where an eye has too few markers for a map.
        """
        maps = np.empty((len(eyes), 2, 3))
        for eye in np.unique(eyes):
            mine = np.flatnonzero(eyes == eye)
            if len(mine) < _LEAST_MARKERS:
                return None
            design = np.column_stack([self.places_m[mine], np.ones(len(mine))])
            if variances_px2 is None:
                maps[mine] = np.linalg.lstsq(design, centers_px[mine], rcond=None)[0].T
                continue
            for axis in (0, 1):
                root = 1 / np.sqrt(variances_px2[mine, axis])
                weighted = root * centers_px[mine, axis]
                maps[mine, axis] = np.linalg.lstsq(design * root[:, None], weighted, rcond=None)[0]
        return None if (np.abs(np.linalg.det(maps[..., :2])) < np.finfo(float).eps).any() else maps


def visible_margin_px(signal: MarkerSignal) -> float:
    """Margin around a disc within which light from beyond the face reaches its window. [px]"""
    return signal.outer_px + signal.beside_px + _BESIDE_WINDOW_PX


def pixels_on_face(
    face: FaceBackground,
    discs: Ellipses,
    pixels: OutlinePixels,
    further: Array32,
    motions: Array | None,
    signal: MarkerSignal,
) -> OutlinePixels:
    """The pixels without those that get too much light from beyond the face.

    Args:
        face, discs, pixels, motions: see `background_shares`.
        further: from there.
        signal: one of those that the pixels are from.
    """
    chosen = (further < _MOST_BEYOND).all(axis=1)
    if not signal.shows_glare:
        return pixels.only(chosen)

    def beyond(nearer_px: float) -> Array32:
        shares = background_shares(face, discs, pixels, START_WIDTH_PX, motions, nearer_px) if nearer_px else further
        assert shares is not None
        most: Array32 = shares.max(axis=1)
        return most

    clear = pixels_without_glare(pixels, signal, edge_distances(discs.shapes_px, pixels.x_px, pixels.y_px), beyond)
    return pixels.only(chosen if clear is None else clear)


def background_shares(
    face: FaceBackground,
    discs: Ellipses,
    pixels: OutlinePixels,
    width_px: float,
    motions: Array | None,
    nearer_px: float = 0.0,
) -> Array32 | None:
    """Shares of each pixel's light from the face's opening and from beyond the rim.

    An affine map of the eye's own markers gives the face's image, shifted so that each disc lies where it was found:
    perspective within the drogue moves the rim against a marker by hundredths of a pixel at such distances.

    Args:
        face: the face.
        discs: the markers, placed to a tenth of a pixel or so.
        pixels: of the discs.
        width_px: Gaussian width of edges.
        motions: (N, 3) of the discs while the shutter is open, None of still ones.
        nearer_px: by how much the face is taken to be narrower on either side.

    Returns:
        (N, 2, K), or None where an eye has too few markers for the map.
    """
    maps = face.maps_px(discs.eyes, discs.centers_px)
    if maps is None:
        return None
    middles = discs.centers_px - np.einsum("nij,nj->ni", maps[..., :2], face.places_m) - pixels.origins_px
    shape = plane_shapes(maps[..., :2])
    nearer_m = nearer_px / np.sqrt(np.linalg.det(shape))[:, None, None]
    shapes = np.stack([(face.edges_m[0] + nearer_m) * shape, (face.edges_m[1] - nearer_m) * shape])
    x = pixels.x_px - middles[:, :1].astype(np.float32)
    y = pixels.y_px - middles[:, 1:].astype(np.float32)
    in_opening = 1 - blurred_share_outside(shapes[0], x, y, width_px, motions)
    beyond_rim = blurred_share_outside(shapes[1], x, y, width_px, motions)
    shares: Array32 = np.stack([in_opening, beyond_rim], axis=1)
    return shares
