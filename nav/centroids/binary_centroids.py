"""Finds markers in a part of an image: regions above thresholds, or peaks of light where they are a pixel or less.

Regions are the seed paper's chain: region of interest, channel, Otsu, median, opening, binary centre of mass.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.images import Pixels
from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array
from nav.matching.face_ring import fit_face_ring, has_narrow_face
from nav.matching.marker_channel import Blobs, Window, disc_like_blobs
from nav.matching.ring_matching import RingMatch, match_ring
from nav.numerics.medians import median

# Share of the box added on every side, so that a slightly small box cuts no marker.
_BOX_MARGIN_FRACTION = 0.06
_LEAST_AREA_PX2 = 7.0
_LEAST_SIDE_PX = 3
# Thresholds of ever darker classes; each leaves half of the range or less, the last a tenth of a marker's.
_MOST_DARKER = 5
# Below this there is only noise.
_LEAST_RANGE_DN = 4
# A drogue has some ten discs; more regions than this in its box are noise.
_MOST_BLOBS = 60
# Below this diameter the 3x3 median and opening eat the disc's outline (0.2 px instead of 0.09 px at 5 px), and the
# area filter rejects noise as well as they do.
_LEAST_DIAMETER_FOR_MORPHOLOGY_PX = 14.0
# Median and opening flip two or three outline pixels of a disc at random (measured); each moves its centre by 1/(pi r).
_FLIPPED_PIXELS = 2.4
# Spread of a point's light by lens and pixel. [px]
_POINT_SIGMA_PX = 0.6
# In standard deviations of the picture's peaks: fainter ones are noise.
_LEAST_PEAK_SIGMA = 4.0
_SIGMA_OF_MAD = 1.4826
# A drogue has up to 32 markers; the time of the matching grows with the square of the number of peaks.
_MOST_PEAKS = 48
_LEAST_PEAK_SIDE_PX = 7
# A marker's peak lies within this share of the gap between neighbours around its place by the map.
_ROOM_FRACTION = 0.3
# Standard deviation of a peak's place. [px]
_PEAK_SIGMA_PX = 0.25

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class BinaryCentroids:
    """Measured centres of bright regions in one image.

    Attributes:
        blobs: centres [px] and areas, in full-image coordinates.
        cov_px2: (M, 2, 2) covariances of the centres.
        ring: the drogue's ring among them, None where it was not searched or not found.
        room_m: of peaks without a size, whose areas stand for it: radius of the room that a marker has to itself. [m]
    """

    blobs: Blobs
    cov_px2: Array
    ring: RingMatch | None = None
    room_m: float | None = None


NO_CENTROIDS = BinaryCentroids(blobs=Blobs(np.zeros((0, 2)), np.zeros(0)), cov_px2=np.zeros((0, 2, 2)))


def binary_centroids(
    channel: Pixels, box_xywh_px: tuple[float, float, float, float], layout: MarkerLayout
) -> BinaryCentroids:
    """As `window_centroids`, of the window of a box.

    Args:
        channel: (H, W) marker channel of the whole image.
        box_xywh_px: the detector's box in pixel-centre coordinates.
        layout: the drogue's markers.
    """
    left, top, right, bottom = box_window((channel.shape[1], channel.shape[0]), box_xywh_px)
    return window_centroids(channel[top:bottom, left:right], (left, top), layout)


def window_centroids(channel: Pixels, corner_px: tuple[int, int], layout: MarkerLayout) -> BinaryCentroids:
    """Centres of mass of the regions above Otsu's threshold in a part of an image.

    Where the threshold does not show all markers that the part's edge leaves whole, Otsu's thresholds of the brighter
    class (white markers that merge with a bright sky) and of the darker class (markers in shade beside sunlit ones)
    are tried. Where none of them shows a ring, thresholds of ever darker classes follow (grey markers before a bright
    sky). Small discs get no median and opening, which would erode them. Regions that touch the edge of the part or of
    the image are dropped, since their centre of mass is not the marker's.

    Args:
        channel: (H, W) marker channel of the part, see `box_window`.
        corner_px: column and row of its first pixel in the image.
        layout: the drogue's markers.

    Source: the seed paper, section 3.2; Otsu, doi:10.1109/TSMC.1979.4310076.
    """
    if min(channel.shape) < _LEAST_SIDE_PX:
        return NO_CENTROIDS
    blobs, opened, ring = _best_regions(channel, layout)
    moved = Blobs(blobs.centers_px + np.array(corner_px), blobs.areas_px2)
    variance = quantisation_variance_px2(moved.radii_px)
    if opened:
        variance = variance + morphology_variance_px2(moved.radii_px)
    return BinaryCentroids(moved, variance[:, None, None] * np.eye(2), None if ring is None else ring.moved(corner_px))


def _otsu(levels: Pixels) -> float:
    """Otsu's threshold of (P,) levels."""
    return float(cv2.threshold(levels, 0, 1, cv2.THRESH_BINARY | cv2.THRESH_OTSU)[0])


def _best_regions(roi: Pixels, layout: MarkerLayout) -> tuple[Blobs, bool, RingMatch | None]:
    """Regions by the threshold that shows most markers of the ring, the first of equals, and that ring.

    No further threshold is tried once all markers are found that the part's edge does not cut, and none within the
    darker classes once there is any ring.
    """
    best, most = (Blobs(np.zeros((0, 2)), np.zeros(0)), False), -1
    shown: RingMatch | None = None
    for level, dark in _thresholds(roi):
        if dark is not None and shown is not None:
            break
        regions = _regions(roi, level, dark)
        ring = match_ring(regions[0], layout)
        count = 0 if ring is None else ring.count
        if count > most:
            best, most, shown = regions, count, ring
        if shown is not None and most + shown.cut(layout, (roi.shape[1], roi.shape[0])).sum() >= layout.count:
            break
    return *best, shown


def _thresholds(roi: Pixels) -> Iterator[tuple[float, Mask | None]]:
    """Otsu's threshold, those of its brighter and darker class, then those of ever darker classes with their masks.

    A pixel at the border of a dark class gets light from beside it, which may be as bright as a marker and would join
    a nearby marker to the sky. The masks are therefore eroded by one pixel.
    """
    level = _otsu(roi.ravel())
    yield level, None
    for part in (roi[roi > level], roi[roi <= level]):
        if part.size:
            yield _otsu(part), None
    for _ in range(_MOST_DARKER):
        dark: Mask = cv2.erode((roi <= level).view(np.uint8), np.ones((3, 3), np.uint8)).view(np.bool_)
        levels = roi[dark]
        if levels.size == 0 or np.ptp(levels) < _LEAST_RANGE_DN:
            return
        level = _otsu(levels)
        yield level, dark


def _regions(roi: Pixels, level: float, dark: Mask | None) -> tuple[Blobs, bool]:
    """Disc-like regions above a level, within the dark mask if given, and whether median and opening were applied."""
    inside = roi > level if dark is None else (roi > level) & dark
    mask: NDArray[np.uint8] = inside.view(np.uint8)
    blobs = disc_like_blobs(mask, _LEAST_AREA_PX2, _MOST_BLOBS)
    if len(blobs) == 0 or 2 * median(blobs.radii_px) < _LEAST_DIAMETER_FOR_MORPHOLOGY_PX:
        return blobs, False
    opened = cv2.morphologyEx(cv2.medianBlur(mask, 3), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return disc_like_blobs(np.asarray(opened), _LEAST_AREA_PX2, _MOST_BLOBS), True


def quantisation_variance_px2(radii_px: Array) -> Array:
    """Variance per axis of the centre of mass of a disc drawn in black and white pixels. [px^2]

    Each of the 2r rows errs at both ends by a uniform fraction of a pixel (variance 1/12), with the lever x = r cos a:
    `sum x^2 / 12 = 2 r^3 / 9`; divided by the squared area `(pi r^2)^2`, `sigma = 0.150 px / sqrt(r)`.

    Args:
        radii_px: (M,) radii. [px]
    """
    variance: Array = 2 / (9 * np.pi**2 * radii_px)
    return variance


def morphology_variance_px2(radii_px: Array) -> Array:
    """Variance per axis that median and opening add to the centre of mass of a disc of radius (M,). [px^2]"""
    variance: Array = _FLIPPED_PIXELS / (2 * np.pi**2 * radii_px**2)
    return variance


def box_window(size_px: tuple[int, int], box_xywh_px: tuple[float, float, float, float]) -> Window:
    """The widened box on an image of (width, height); empty where the box lies outside the image."""
    x, y, width, height = box_xywh_px
    margin_x, margin_y = _BOX_MARGIN_FRACTION * width + 1, _BOX_MARGIN_FRACTION * height + 1
    left, top = max(0, int(np.floor(x - margin_x))), max(0, int(np.floor(y - margin_y)))
    right = min(size_px[0], int(np.ceil(x + width + margin_x)) + 1)
    bottom = min(size_px[1], int(np.ceil(y + height + margin_y)) + 1)
    return left, top, max(left, right), max(top, bottom)


def small_centroids(
    channel: Pixels, corner_px: tuple[int, int], layout: MarkerLayout, scale_px_per_m: float
) -> BinaryCentroids:
    """Peaks of light in a part of an image, with the drogue's ring among them if there is one.

    Peaks have no size: each is given the room that a marker has to itself at the scale of the drogue's box.

    Args:
        channel: (H, W) marker channel of the part.
        corner_px: column and row of its first pixel in the image.
        layout: the drogue's markers.
        scale_px_per_m: size of the drogue's image, right to a half.
    """
    if min(channel.shape) < _LEAST_PEAK_SIDE_PX or layout.count < 2:
        return NO_CENTROIDS
    room_m = _ROOM_FRACTION * smallest_gap_m(layout)
    peaks = _peaks(channel, layout.radius_m * scale_px_per_m)
    blobs = Blobs(peaks, np.full(len(peaks), np.pi * (room_m * scale_px_per_m) ** 2))
    return _centroids_of_peaks(blobs, match_ring(blobs, layout_with_room(layout, room_m)), corner_px, room_m)


def face_centroids(
    channel: Pixels, corner_px: tuple[int, int], layout: MarkerLayout, scale_px_per_m: float
) -> BinaryCentroids | None:
    """Markers of a pixel or less on a narrow face in the middle of a part of an image, by the picture of them all.

    Arguments as those of `small_centroids`; None where no such picture is there.
    """
    if not has_narrow_face(layout):
        return None
    middle_px = (np.array(channel.shape[::-1]) - 1) / 2
    face = fit_face_ring(channel, layout, middle_px, scale_px_per_m)
    if face is None:
        return None
    room_m = _ROOM_FRACTION * smallest_gap_m(layout)
    places = layout.centers_m[:, :2] @ face.affine[:, :2].T + face.affine[:, 2]
    blobs = Blobs(places, np.full(layout.count, np.pi * (room_m * scale_px_per_m) ** 2))
    return _centroids_of_peaks(blobs, RingMatch(face.affine, np.arange(layout.count), 0.0), corner_px, room_m)


def _centroids_of_peaks(
    blobs: Blobs, ring: RingMatch | None, corner_px: tuple[int, int], room_m: float
) -> BinaryCentroids:
    """Peaks in a part of an image as centroids in the image."""
    moved = replace(blobs, centers_px=blobs.centers_px + np.array(corner_px))
    cov = np.broadcast_to(_PEAK_SIGMA_PX**2 * np.eye(2), (len(blobs), 2, 2)).copy()
    return BinaryCentroids(moved, cov, None if ring is None else ring.moved(corner_px), room_m)


@lru_cache(maxsize=16)
def layout_with_room(layout: MarkerLayout, room_m: float) -> MarkerLayout:
    """The layout with the room that each marker has to itself in place of its radius. [m]"""
    return replace(layout, radius_m=room_m)


@lru_cache(maxsize=16)
def smallest_gap_m(layout: MarkerLayout) -> float:
    """Smallest distance between two markers. [m]"""
    squares = ((layout.centers_m[:, None] - layout.centers_m) ** 2).sum(axis=2)
    return float(np.sqrt(squares[np.triu_indices(layout.count, 1)].min()))


def _peaks(channel: Pixels, radius_px: float) -> Array:
    """(M, 2) places of the brightest peaks. [px]

    The curvature that is weakest in any direction tells a peak from the edge of a bright sky, which is curved in one
    direction only.
    """
    sigma_px = float(np.hypot(_POINT_SIGMA_PX, radius_px / 2))
    smooth = cv2.GaussianBlur(channel.astype(np.float32), (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE)
    middle, slope_y, slope_x = smooth[1:-1, 1:-1], smooth[2:] - smooth[:-2], smooth[:, 2:] - smooth[:, :-2]
    by_xx = smooth[1:-1, 2:] + smooth[1:-1, :-2] - 2 * middle
    by_yy = smooth[2:, 1:-1] + smooth[:-2, 1:-1] - 2 * middle
    by_xy = (slope_x[2:] - slope_x[:-2]) / 4
    curved = -((by_xx + by_yy) / 2 + np.sqrt(((by_xx - by_yy) / 2) ** 2 + by_xy**2))
    spread = _SIGMA_OF_MAD * float(np.median(np.abs(curved - np.median(curved))))
    highest = cv2.dilate(curved, np.ones((3, 3), np.uint8))
    found = np.argwhere((curved == highest) & (curved > max(_LEAST_PEAK_SIGMA * spread, np.finfo(np.float32).eps)))
    rows, columns = found[np.argsort(-curved[found[:, 0], found[:, 1]], kind="stable")][:_MOST_PEAKS].T
    # One Newton step to the top of the smoothed picture.
    gradient = np.stack([slope_x[rows + 1, columns], slope_y[rows, columns + 1]], axis=1) / 2
    hessian = np.empty((len(rows), 2, 2))
    hessian[:, 0, 0], hessian[:, 1, 1] = by_xx[rows, columns], by_yy[rows, columns]
    hessian[:, 0, 1] = hessian[:, 1, 0] = by_xy[rows, columns]
    steps = -np.linalg.solve(hessian, gradient[..., None])[..., 0]
    places: Array = np.stack([columns, rows], axis=1) + 1 + np.clip(steps, -0.5, 0.5)
    return places
