"""Tracker `pose-predict`: confirms the predicted box by the constellation of markers in it.

The markers are the spots that stood in the box when it was given. They are found again in the next image, and the
predicted box is shifted and scaled to fit them. There is no search beyond the prediction's error, and no other part of
the image counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.detector.detector import Detection
from nav.matching.marker_channel import Blobs, disc_like_blobs
from nav.numerics.compiled import compiled
from nav.tracking.box_motion import BoxMotion
from nav.tracking.region import Box, EyeImage, ImageRegion, box_center, box_size, expand_box, image_region, move_box

# The box is resampled to at most this many pixels across it, never enlarged: in colour, and in grey, where only the
# narrow dark margin around a marker separates it from the sky.
_GRID, _GREY_GRID = 128, 256
_LEAST_AREA, _MOST_SPOTS = 5.0, 40
# Largest ratio of sizes of one drogue's spots, which differ by blur and tilt.
_SIZE_FACTOR = 1.6
_LEAST_SPOTS = 4
# Distances of the spots from the box's centre, in box sides; spots that noise makes of one lamp lie closer.
_LEAST_SPREAD, _MOST_SPREAD = 0.25, 0.55
# Smallest share of the spots that must be found, as in the ring search of `nav.matching.ring_matching`.
_SMALLEST_SHARE = 0.6
# Tolerance on the position of a spot in its radii, and on the size of the box as a log-scale.
_TOLERANCE_RADII = 1.0
_LARGEST_LOG_SCALE = 0.15
_SCALES = (1.0, 0.94, 1.06)
# Thresholds below this are in the quantisation noise. [DN]
_LEAST_LEVEL = 2.0


@dataclass(frozen=True, eq=False)
class MarkerConstellation:
    """Positions of a drogue's bright spots in its box.

    Attributes:
        plane: number of the plane that shows them, see `_color_plane`.
        places: (S, 2) from the box's centre. [box sides]
        radius: of each. [box sides]
    """

    plane: int
    places: Array
    radius: float

    def find(self, image: EyeImage, box: Box, reach_px: float) -> tuple[Box, float] | None:
        """Fit the constellation to the spots of an image.

        Args:
            image: of the eye in which the constellation was learned.
            box: the predicted box.
            reach_px: largest distance from the prediction. [px]

        Returns:
            The fitted box and the share of spots that were found; None where these are too few.
        """
        region = image_region(
            image, expand_box(box, reach_px + 0.1 * box[2], reach_px + 0.1 * box[3]), _step_px(image, box)
        )
        if region is None:
            return None
        best: tuple[Box, float] | None = None
        for blobs in _spots(_color_plane(region.pixels, self.plane)):
            found = self._match(region, blobs, box)
            if found is not None and (best is None or found[1] > best[1]):
                best = found
            if best is not None and best[1] == 1:
                break
        return best

    def _match(self, region: ImageRegion, blobs: Blobs, box: Box) -> tuple[Box, float] | None:
        radius_px = self.radius * box_size(box)
        radii_px = blobs.radii_px * float(np.sqrt(region.step_px.prod()))
        similar = (radii_px < _SIZE_FACTOR * radius_px) & (radius_px < _SIZE_FACTOR * radii_px)
        spots = region.to_image(blobs.centers_px[similar])
        if len(spots) < max(_LEAST_SPOTS, _SMALLEST_SHARE * len(self.places)):
            return None
        side = np.array(box[2:])
        tolerance_px = _TOLERANCE_RADII * radius_px
        shift, scale, matches = self._best_match(spots, box, tolerance_px)
        for _ in range(2):
            expected = box_center(box) + shift + scale * self.places * side
            gaps = np.linalg.norm(expected[:, None] - spots, axis=2)
            matched, partner = gaps.min(axis=1) < tolerance_px, gaps.argmin(axis=1)
            matches = int(matched.sum())
            if matches < max(_LEAST_SPOTS, _SMALLEST_SHARE * len(self.places)):
                return None
            shift, scale = _similarity(self.places[matched] * side, spots[partner[matched]] - box_center(box))
        if not abs(np.log(max(scale, 1e-6))) < 2 * _LARGEST_LOG_SCALE:
            return None
        return move_box(box, box_center(box) + shift, scale), matches / len(self.places)

    def _best_match(self, spots: Array, box: Box, tolerance_px: float) -> tuple[Array, float, int]:
        """Shift, scale and number of matches of the best hypothesis; each aligns one position with one spot."""
        best: tuple[Array, float, int] = np.zeros(2), 1.0, -1
        nearest_px = np.inf
        for scale in _SCALES:
            places_px = box_center(box) + scale * self.places * np.array(box[2:])
            shift_px, matches, error_px = _best_shift(places_px, spots, tolerance_px)
            if (matches, -error_px) > (best[2], -nearest_px):
                best, nearest_px = (shift_px, scale, matches), error_px
        return best


@compiled
def _best_shift(places_px: Array, spots_px: Array, tolerance_px: float) -> tuple[Array, int, float]:
    """The shift from one place to one spot that brings most places near a spot, of equals with the smallest error.

    Args:
        places_px: (P, 2). [px]
        spots_px: (S, 2). [px]
        tolerance_px: nearer ones match. [px]

    Returns:
        (2,) shift [px], number of matches, and the sum of distances, each at most the tolerance [px].
    """
    shift_px, most, least_px = np.zeros(2), -1, np.inf
    for spot in range(len(spots_px)):
        for place in range(len(places_px)):
            x_px, y_px = spots_px[spot, 0] - places_px[place, 0], spots_px[spot, 1] - places_px[place, 1]
            matches, error_px = 0, 0.0
            for moved in range(len(places_px)):
                gap_px2 = tolerance_px**2
                for other in range(len(spots_px)):
                    across_px = places_px[moved, 0] + x_px - spots_px[other, 0]
                    down_px = places_px[moved, 1] + y_px - spots_px[other, 1]
                    gap_px2 = min(gap_px2, across_px**2 + down_px**2)
                matches += gap_px2 < tolerance_px**2
                error_px += np.sqrt(gap_px2)
            if matches > most or (matches == most and error_px < least_px):
                shift_px[0], shift_px[1], most, least_px = x_px, y_px, matches, error_px
    return shift_px, most, least_px


def learn_constellation(image: EyeImage, box: Box) -> MarkerConstellation | None:
    """The largest set of spots in a box that have one size and lie apart as markers do; None with too few spots."""
    region = image_region(image, expand_box(box, 0.08 * box[2], 0.08 * box[3]), _step_px(image, box))
    if region is None:
        return None
    best: MarkerConstellation | None = None
    for plane in range(_plane_count(region.pixels)):
        for blobs in _spots(_color_plane(region.pixels, plane)):
            places = (region.to_image(blobs.centers_px) - box_center(box)) / box[2:]
            radii = blobs.radii_px * float(np.sqrt(region.step_px.prod())) / box_size(box)
            for radius in radii:
                members = (radii < _SIZE_FACTOR * radius) & (radius < _SIZE_FACTOR * radii)
                spread = np.hypot(*places.T)
                members &= (spread > _LEAST_SPREAD) & (spread < _MOST_SPREAD)
                if members.sum() >= max(_LEAST_SPOTS, 1 + (0 if best is None else len(best.places))):
                    best = MarkerConstellation(plane, places[members], float(np.median(radii[members])))
    return best


def _step_px(image: EyeImage, box: Box) -> float:
    return max(1.0, box_size(box) / (_GRID if image.pixels.ndim == 3 else _GREY_GRID))


_PLANES = 4
# Index of a colour and of the two that are subtracted from it.
_OTHER_COLORS = ((0, 1, 2), (1, 0, 2), (2, 0, 1))


def _plane_count(pixels: NDArray[np.uint8]) -> int:
    return 1 if pixels.shape[2] == 1 else _PLANES


def _color_plane(pixels: NDArray[np.uint8], plane: int) -> NDArray[np.uint8]:
    """An image in which markers may stand out: a colour minus the larger other one, or the smallest of the three."""
    if pixels.shape[2] == 1:
        return pixels[:, :, 0]
    colors = cv2.split(pixels)
    if plane == len(_OTHER_COLORS):
        return np.asarray(cv2.min(cv2.min(colors[0], colors[1]), colors[2]), dtype=np.uint8)
    own, one, other = _OTHER_COLORS[plane]
    return np.asarray(cv2.subtract(colors[own], cv2.max(colors[one], colors[other])), dtype=np.uint8)


def _spots(plane_image: NDArray[np.uint8]) -> Iterator[Blobs]:
    """Disc-like regions above Otsu's threshold, and above Otsu's thresholds of its brighter and darker class."""
    level = _otsu(plane_image.ravel())
    for part in (None, plane_image[plane_image > level], plane_image[plane_image <= level]):
        if part is not None and not part.size:
            continue
        threshold = level if part is None else _otsu(part)
        if threshold < _LEAST_LEVEL:
            continue
        mask: NDArray[np.uint8] = (plane_image > threshold).view(np.uint8)
        blobs = disc_like_blobs(mask, _LEAST_AREA, _MOST_SPOTS)
        if len(blobs) >= _LEAST_SPOTS:
            yield blobs


def _otsu(levels: NDArray[np.uint8]) -> float:
    return float(cv2.threshold(levels, 0, 1, cv2.THRESH_BINARY | cv2.THRESH_OTSU)[0])


def _similarity(places: Array, spots: Array) -> tuple[Array, float]:
    """Least-squares shift and scale, without rotation, from (S, 2) positions to spots."""
    middle, middle_spot = places.sum(axis=0) / len(places), spots.sum(axis=0) / len(spots)
    from_middle = places - middle
    scale = float((from_middle * (spots - middle_spot)).sum() / (from_middle**2).sum())
    shift: Array = middle_spot - scale * middle
    return shift, scale


# Largest distance from the prediction: in its standard deviations, and at most the sum of pixels and box sides.
_REACH_SD, _MOST_REACH_PX, _MOST_REACH = 3.0, 100.0, 0.5
# A correction by more than this, in box sides, learns the spots anew.
_SAME_BOX = 0.02


class PosePredictEyeTracker:
    """One eye of the tracker `pose-predict`."""

    _box: Box
    _motion: BoxMotion
    _spots: MarkerConstellation | None

    def __init__(self, image: EyeImage, box: Box) -> None:
        self._restart(image, box)

    def locate(self, image: EyeImage, predicted: Box | None, sd_px: float | None) -> Detection | None:
        """See `EyeTracker`."""
        if self._spots is None:
            return None
        expected = self._motion.predict(image.time_s, predicted, sd_px)
        most = _MOST_REACH_PX + _MOST_REACH * box_size(expected.box)
        found = self._spots.find(image, expected.box, min(_REACH_SD * float(expected.sd[:2].max()), most))
        return None if found is None else Detection(*found)

    def learn(self, image: EyeImage, found: Detection | None) -> None:
        """See `EyeTracker`."""
        if found is not None:
            self._box = found.box_xywh_px
            self._motion.update(self._box, image.time_s)

    def correct(self, image: EyeImage, box: Box) -> None:
        """See `EyeTracker`."""
        change = np.abs(np.subtract(box, self._box)).max() / box_size(box)
        if change > _SAME_BOX or self._spots is None:
            self._restart(image, box)
        else:
            self._motion.update(box, image.time_s)
            self._box = box

    def _restart(self, image: EyeImage, box: Box) -> None:
        self._box = box
        self._motion = BoxMotion(box, image.time_s)
        self._spots = learn_constellation(image, box)
