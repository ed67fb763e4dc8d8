"""Answers with the box that the motion so far predicts, once the drogue's markers are seen in it.

The markers are the spots that stood in the box when it was given (`nav.tracking.constellation`); the predicted box is
moved and scaled by them. There is no search beyond the reach of the prediction's error, and nothing else of the image
counts.
"""

from __future__ import annotations

import numpy as np

from nav.detector.detector import Detection
from nav.tracking.box_motion import BoxMotion
from nav.tracking.constellation import Constellation, learn_constellation
from nav.tracking.region import Box, EyeImage, box_size

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
