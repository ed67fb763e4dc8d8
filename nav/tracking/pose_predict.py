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
from nav.matching.blobs import Blobs, disc_like_blobs
from nav.tracking.box_motion import BoxMotion
from nav.tracking.region import Box, EyeImage, ImageRegion, box_center, box_size, grown, image_region, moved

# The box is looked at with so many pixels across it, not enlarged: in colour, and in grey, where only the narrow dark
# margin around a marker keeps it from running together with the sky.
_GRID, _GREY_GRID = 128, 256
_LEAST_AREA, _MOST_SPOTS = 5.0, 40
# Spots of one drogue have one size, up to blur and tilt.
_SIZE_FACTOR = 1.6
_LEAST_SPOTS = 4
# They lie far apart in the box, unlike what noise makes of one lamp: largest distance from the middle, in box sides.
_LEAST_SPREAD, _MOST_SPREAD = 0.25, 0.55
# The same share of a drogue's markers as the ring search asks for, see `nav.matching.ring_matching`.
_LEAST_SHARE = 0.6
# A spot lies where it is expected within this many of its radii, and the box's size has changed by no more.
_NEAR_RADII = 1.0
_LARGEST_LOG_SCALE = 0.15
_SCALES = (1.0, 0.94, 1.06)
# Below so many levels there is only quantisation noise.
_LEAST_LEVEL = 2.0


@dataclass(frozen=True, eq=False)
class Constellation:
    """Spots of one drogue.

    Attributes:
        plane: in which of `_planes` they stand out.
        places: (S, 2) from the box's middle, in box sides.
        radius: of each, in box sides.
    """

    plane: int
    places: Array
    radius: float

    def find(self, image: EyeImage, box: Box, reach_px: float) -> tuple[Box, float] | None:
        """The box that carries its spots onto those of an image.

        Args:
            image: of the eye that the constellation was learned in.
            box: where it is expected.
            reach_px: how far from there it may be. [px]

        Returns:
            The box and the share of spots that are there; None where these are too few.
        """
        region = image_region(image, grown(box, reach_px + 0.1 * box[2], reach_px + 0.1 * box[3]), _step_px(image, box))
        if region is None:
            return None
        best: tuple[Box, float] | None = None
        for blobs in _spots(_planes(region.pixels)[self.plane]):
            found = self._fit(region, blobs, box)
            if found is not None and (best is None or found[1] > best[1]):
                best = found
            if best is not None and best[1] == 1:
                break
        return best

    def _fit(self, region: ImageRegion, blobs: Blobs, box: Box) -> tuple[Box, float] | None:
        radius_px = self.radius * box_size(box)
        radii_px = blobs.radii_px * float(np.sqrt(region.step_px.prod()))
        alike = (radii_px < _SIZE_FACTOR * radius_px) & (radius_px < _SIZE_FACTOR * radii_px)
        spots = region.image(blobs.centers_px[alike])
        if len(spots) < max(_LEAST_SPOTS, _LEAST_SHARE * len(self.places)):
            return None
        side = np.array(box[2:])
        near = _NEAR_RADII * radius_px
        shift, scale, hits = self._best_shift(spots, box, near)
        for _ in range(2):
            expected = box_center(box) + shift + scale * self.places * side
            gaps = np.linalg.norm(expected[:, None] - spots, axis=2)
            hit, partner = gaps.min(axis=1) < near, gaps.argmin(axis=1)
            hits = int(hit.sum())
            if hits < max(_LEAST_SPOTS, _LEAST_SHARE * len(self.places)):
                return None
            shift, scale = _similarity(self.places[hit] * side, spots[partner[hit]] - box_center(box))
        if not abs(np.log(max(scale, 1e-6))) < 2 * _LARGEST_LOG_SCALE:
            return None
        return moved(box, box_center(box) + shift, scale), hits / len(self.places)

    def _best_shift(self, spots: Array, box: Box, near: float) -> tuple[Array, float, int]:
        """The move that carries most places onto spots, of those that carry one place onto one spot."""
        best: tuple[Array, float, int] = np.zeros(2), 1.0, -1
        nearest = np.inf
        for scale in _SCALES:
            places = box_center(box) + scale * self.places * np.array(box[2:])
            shifts = (spots[:, None] - places).reshape(-1, 2)
            gaps = np.linalg.norm((places + shifts[:, None])[:, :, None] - spots, axis=3).min(axis=2)
            counts = (gaps < near).sum(axis=1)
            error = np.minimum(gaps, near).sum(axis=1)
            index = int(np.lexsort((error, -counts))[0])
            if (int(counts[index]), -float(error[index])) > (best[2], -nearest):
                best, nearest = (shifts[index], scale, int(counts[index])), float(error[index])
        return best


def learn_constellation(image: EyeImage, box: Box) -> Constellation | None:
    """What stands in a box like markers: most spots of one size that lie apart; None where there are too few."""
    region = image_region(image, grown(box, 0.08 * box[2], 0.08 * box[3]), _step_px(image, box))
    if region is None:
        return None
    best: Constellation | None = None
    for plane, picture in enumerate(_planes(region.pixels)):
        for blobs in _spots(picture):
            places = (region.image(blobs.centers_px) - box_center(box)) / box[2:]
            radii = blobs.radii_px * float(np.sqrt(region.step_px.prod())) / box_size(box)
            for radius in radii:
                kept = (radii < _SIZE_FACTOR * radius) & (radius < _SIZE_FACTOR * radii)
                spread = np.hypot(*places.T)
                kept &= (spread > _LEAST_SPREAD) & (spread < _MOST_SPREAD)
                if kept.sum() >= max(_LEAST_SPOTS, 1 + (0 if best is None else len(best.places))):
                    best = Constellation(plane, places[kept], float(np.median(radii[kept])))
    return best


def _step_px(image: EyeImage, box: Box) -> float:
    return max(1.0, box_size(box) / (_GRID if image.pixels.ndim == 3 else _GREY_GRID))


def _planes(pixels: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """Pictures in which markers may stand out: how much each colour leads the others, and the brightness."""
    if pixels.shape[2] == 1:
        return [pixels[:, :, 0]]
    red, green, blue = cv2.split(pixels)
    pairs = ((red, green, blue), (green, red, blue), (blue, red, green))
    leads = [np.asarray(cv2.subtract(own, cv2.max(one, other)), dtype=np.uint8) for own, one, other in pairs]
    return [*leads, np.asarray(cv2.min(cv2.min(red, green), blue), dtype=np.uint8)]


def _spots(picture: NDArray[np.uint8]) -> Iterator[Blobs]:
    """Disc-like regions above Otsu's threshold, and above those of its brighter and its darker class."""
    level = _otsu(picture.ravel())
    for part in (None, picture[picture > level], picture[picture <= level]):
        if part is not None and not part.size:
            continue
        at = level if part is None else _otsu(part)
        if at < _LEAST_LEVEL:
            continue
        mask: NDArray[np.uint8] = (picture > at).view(np.uint8)
        blobs = disc_like_blobs(mask, _LEAST_AREA, _MOST_SPOTS)
        if len(blobs) >= _LEAST_SPOTS:
            yield blobs


def _otsu(levels: NDArray[np.uint8]) -> float:
    return float(cv2.threshold(levels, 0, 1, cv2.THRESH_BINARY | cv2.THRESH_OTSU)[0])


def _similarity(places: Array, spots: Array) -> tuple[Array, float]:
    """Shift and scale without turn that carry (S, 2) places onto spots best."""
    from_middle = places - places.mean(axis=0)
    scale = float((from_middle * (spots - spots.mean(axis=0))).sum() / (from_middle**2).sum())
    shift: Array = spots.mean(axis=0) - scale * places.mean(axis=0)
    return shift, scale


# Markers may be off by so many standard deviations of the prediction, and never by more than this. [px]
_REACH_SD, _MOST_REACH_PX, _MOST_REACH = 3.0, 100.0, 0.5
# A better box that is off by more than this, in box sides, is no longer what the spots were learned in.
_SAME_BOX = 0.02


class PosePredictEyeTracker:
    """One eye of the tracker `pose-predict`."""

    _box: Box
    _motion: BoxMotion
    _spots: Constellation | None

    def __init__(self, image: EyeImage, box: Box) -> None:
        self._restart(image, box)

    def look(self, image: EyeImage, predicted: Box | None, sd_px: float | None) -> Detection | None:
        """See `EyeTracker`."""
        if self._spots is None:
            return None
        expected = self._motion.expect(image.time_s, predicted, sd_px)
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
        off = np.abs(np.subtract(box, self._box)).max() / box_size(box)
        if off > _SAME_BOX or self._spots is None:
            self._restart(image, box)
        else:
            self._motion.update(box, image.time_s)
            self._box = box

    def _restart(self, image: EyeImage, box: Box) -> None:
        self._box = box
        self._motion = BoxMotion(box, image.time_s)
        self._spots = learn_constellation(image, box)
