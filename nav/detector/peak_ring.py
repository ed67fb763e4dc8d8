"""A detector for small markers that needs no training: it looks for peaks of light in the drogue's arrangement."""

from __future__ import annotations

from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from geometry.stereo import EYES, Eye
from nav.centroids.small_centroids import small_centroids
from nav.detector.color_blob import circle_box
from nav.detector.detector import Detection, StereoDetection
from nav.matching.marker_channel import marker_channel, marker_color
from nav.matching.ring_matching import RingMatch

# Diameters of the rim that are tried; the matching takes scales within a factor of 1.6. [px]
_SMALLEST_RIM_PX, _STEP = 14.0, 2.0
# With fewer markers, a few peaks of anything are in their arrangement.
_LEAST_MARKERS = 4


class PeakRingDetector:
    """Finds the drogue's arrangement among the brightest peaks of the whole image; nothing for a drogue without one.

    Attributes:
        name: `peak-ring`.
    """

    name = "peak-ring"

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
        if self._layout.count < _LEAST_MARKERS:
            return None
        channel, best = marker_channel(images, eye, self._color), None
        rim_px = _SMALLEST_RIM_PX
        while rim_px < 2 * min(images.size_px):
            ring = small_centroids(channel, (0, 0), self._layout, rim_px / (2 * self._rim_radius_m)).ring
            if ring is not None and (best is None or _rank(ring) > _rank(best)):
                best = ring
            rim_px *= _STEP
        if best is None:
            return None
        score = best.count / self._layout.count * max(0.0, 1 - best.rms_fraction)
        return Detection(circle_box(best.affine, self._rim_radius_m), score)


def _rank(ring: RingMatch) -> tuple[int, float]:
    return ring.count, -ring.rms_fraction
