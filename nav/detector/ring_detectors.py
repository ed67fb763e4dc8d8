"""Detectors that need no training: they look for the drogue's arrangement among bright regions or peaks of light."""

from __future__ import annotations

from abc import ABC, abstractmethod

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.images import Pixels, StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from geometry.se3 import Array
from geometry.stereo import EYES, Eye
from nav.centroids.binary_centroids import small_centroids
from nav.detector.detector import Detection, StereoDetection
from nav.matching.face_ring import DROWNED_RADIUS_PX, find_face_ring, has_narrow_face
from nav.matching.marker_channel import OTHERS_WEIGHTS, disc_like_blobs, marker_channel, marker_color
from nav.matching.ring_matching import RingMatch, match_ring

# A marker of 5 px diameter covers about 20 pixels; after blurring, half of them stay above half its contrast.
_MIN_AREA_PX2 = 7.0
# The peak is the level that at least this many pixels reach: the pixels of the smallest ring of markers.
_PEAK_PIXELS = 30
# Thresholds, as fractions of that peak: markers in shade reach a tenth of the level of a sunlit red object.
_LEVELS = tuple(0.8 * 0.75**step for step in range(11))
# Below this level there is only quantisation noise.
_MIN_LEVEL_DN = 2.0
_MAX_BLOBS = 150
# Diameters of the rim that are tried; the matching takes scales within a factor of 1.6. [px]
_SMALLEST_RIM_PX, _STEP = 14.0, 2.0


class RingDetector(ABC):
    """Finds the drogue by the arrangement of its markers; nothing for a drogue with too few of them.

    Attributes:
        name: of the detector.
    """

    name: str
    _least_markers: int

    def __init__(self, drogue: DrogueParameters) -> None:
        self._layout = marker_layout(drogue)
        self._rim_radius_m = drogue.rim_radius_m
        self._color = marker_color(drogue)

    def detect(self, images: StereoImages) -> StereoDetection:
        """Boxes around the rim in both images."""
        return StereoDetection(self._detect_eye(images, "left"), self._detect_eye(images, "right"))

    def candidates(self, images: StereoImages, least_score: float) -> dict[Eye, tuple[Detection, ...]]:
        """At most one box in each image: the ring with the most markers."""
        found = {eye: self._detect_eye(images, eye) for eye in EYES}
        return {eye: (one,) if one is not None and one.score >= least_score else () for eye, one in found.items()}

    def _detect_eye(self, images: StereoImages, eye: Eye) -> Detection | None:
        found = None if self._layout.count < self._least_markers else self._find(images, eye)
        return None if found is None else Detection(_circle_box(found[0], self._rim_radius_m), found[1])

    @abstractmethod
    def _find(self, images: StereoImages, eye: Eye) -> tuple[Array, float] | None:
        """Map (2, 3) from the rim plane [m] to pixels of the likeliest drogue in one image, and its score."""

    def _scored(self, ring: RingMatch | None) -> tuple[Array, float] | None:
        if ring is None:
            return None
        return ring.affine, ring.count / self._layout.count * max(0.0, 1 - ring.rms_fraction)


class ColorBlobDetector(RingDetector):
    """Finds the ring of markers at the brightness threshold that shows most of them."""

    name = "color-blob"
    _least_markers = 3

    def _find(self, images: StereoImages, eye: Eye) -> tuple[Array, float] | None:
        best: RingMatch | None = None
        for weight in OTHERS_WEIGHTS:
            best = self._best_ring(marker_channel(images, eye, self._color, weight), best)
            if best is not None and best.count == self._layout.count:
                break
        return self._scored(best)

    def _best_ring(self, channel: Pixels, best: RingMatch | None) -> RingMatch | None:
        """The ring with the most markers over all thresholds of a channel, or `best` where none has more."""
        smooth = cv2.blur(channel, (3, 3))
        for level in _levels(smooth):
            mask: NDArray[np.uint8] = (smooth > level).view(np.uint8)
            match = match_ring(disc_like_blobs(mask, _MIN_AREA_PX2, _MAX_BLOBS), self._layout)
            if match is not None and (best is None or match.count > best.count):
                best = match
            if best is not None and best.count == self._layout.count:
                break
        return best


class PeakRingDetector(RingDetector):
    """Finds the arrangement of small markers among the brightest peaks of the whole image, or on a narrow face."""

    name = "peak-ring"
    # With fewer markers, a few peaks of anything are in their arrangement.
    _least_markers = 4

    def _find(self, images: StereoImages, eye: Eye) -> tuple[Array, float] | None:
        channel, best = marker_channel(images, eye, self._color), None
        rim_px = _SMALLEST_RIM_PX
        while rim_px < 2 * min(images.size_px):
            ring = small_centroids(channel, (0, 0), self._layout, rim_px / (2 * self._rim_radius_m)).ring
            if ring is not None and (best is None or _rank(ring) > _rank(best)):
                best = ring
            rim_px *= _STEP
        # Beside smaller lamps on a narrow face, peaks of the sky next to it may be in the arrangement of the lamps.
        is_clear = best is not None and self._layout.radius_m * best.scale_px_per_m > DROWNED_RADIUS_PX
        face = None if is_clear or not has_narrow_face(self._layout) else find_face_ring(channel, self._layout)
        return self._scored(best) if face is None else (face.affine, face.explained)


def _rank(ring: RingMatch) -> tuple[int, float]:
    return ring.count, -ring.rms_fraction


def _levels(channel: Pixels) -> list[float]:
    """Brightness thresholds, the highest first."""
    top = int(np.iinfo(channel.dtype).max) + 1
    histogram = cv2.calcHist([channel], [0], None, [top], [0, top]).ravel()
    at_least = np.cumsum(histogram[::-1])[::-1]
    peak = float(np.flatnonzero(at_least >= min(_PEAK_PIXELS, channel.size))[-1])
    return [share * peak for share in _LEVELS if share * peak >= _MIN_LEVEL_DN]


def _circle_box(affine: Array, radius_m: float) -> tuple[float, float, float, float]:
    """Bounding box x, y, width, height of the image of a circle around the layout's origin. [px]"""
    half_width, half_height = radius_m * np.hypot(affine[:, 0], affine[:, 1])
    x, y = affine[:, 2]
    return float(x - half_width), float(y - half_height), float(2 * half_width), float(2 * half_height)
