"""Finds markers of a pixel or less: peaks of light that are bright in all directions, and the ring among them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from datasets_manifest.types.images import Pixels
from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array
from nav.centroids.binary_centroids import NO_CENTROIDS, BinaryCentroids
from nav.matching.marker_channel import Blobs
from nav.matching.ring_matching import match_ring

# Spread of a point's light by lens and pixel. [px]
_POINT_SIGMA_PX = 0.6
# In standard deviations of the picture's peaks: fainter ones are noise.
_LEAST_PEAK_SIGMA = 4.0
_SIGMA_OF_MAD = 1.4826
# A drogue has up to 32 markers; the time of the matching grows with the square of the number of peaks.
_MOST_PEAKS = 48
_LEAST_SIDE_PX = 7
# A marker's peak lies within this share of the gap between neighbours around its place by the map.
_ROOM_FRACTION = 0.3
# Standard deviation of a peak's place. [px]
_PEAK_SIGMA_PX = 0.25


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
    if min(channel.shape) < _LEAST_SIDE_PX or layout.count < 2:
        return NO_CENTROIDS
    peaks = _peaks(channel, layout.radius_m * scale_px_per_m)
    room_m = _ROOM_FRACTION * smallest_gap_m(layout)
    blobs = Blobs(peaks, np.full(len(peaks), np.pi * (room_m * scale_px_per_m) ** 2))
    ring = match_ring(blobs, layout_with_room(layout, room_m))
    moved = replace(blobs, centers_px=peaks + np.array(corner_px))
    cov = np.broadcast_to(_PEAK_SIGMA_PX**2 * np.eye(2), (len(peaks), 2, 2)).copy()
    return BinaryCentroids(moved, cov, None if ring is None else ring.moved(corner_px), room_m)


@lru_cache(maxsize=16)
def layout_with_room(layout: MarkerLayout, room_m: float) -> MarkerLayout:
    """The layout with the room that each marker has to itself in place of its radius. [m]"""
    return replace(layout, radius_m=room_m)


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
