"""A detector for sequences of pairs, which follows the drogue by a tracker and detects it only where it is lost."""

from __future__ import annotations

from collections.abc import Callable

from datasets_manifest.types.images import StereoImages
from drogue_models.parameters import DrogueParameters
from geometry.stereo import EYES, Eye
from nav.detector.detector import Detection, Detector, StereoDetection
from nav.tracking.tracker import REDETECT_EVERY, Tracker, begins_sequence, is_same_place, open_tracker

# Where both eyes have lost the drogue the detector runs at once. Where one has, it runs at the second consecutive miss
# and every third one after it, since the drogue may be out of one view for long.
_FIRST_RETRY, _RETRY_EVERY = 2, 3
_NO_BOXES = StereoDetection(None, None)


class TrackedDetector:
    """A detector that returns a tracker's boxes; another detector starts and restarts the tracker.

    Pairs must come in the order of their time. An eye that lost the drogue has no box until it is found again. The
    detector also runs at intervals while nothing is lost, since a tracker cannot know that it follows the wrong thing.

    Attributes:
        name: names of detector and tracker, joined by a plus sign.
    """

    def __init__(self, detector: Detector, tracker: Tracker) -> None:
        self.name = f"{detector.name}+{tracker.name}"
        self._detector, self._tracker = detector, tracker
        self._time_s: float | None = None
        self._image_kind: tuple[object, ...] = ()
        self._is_following = False
        self._misses: dict[Eye, int] = {}
        self._since_detection = 0

    def detect(self, images: StereoImages) -> StereoDetection:
        """Boxes in the next pair."""
        # Appearance learned from images of one format does not apply to another.
        image_kind = (images.left.shape, images.bits, images.encoding)
        if begins_sequence(self._time_s, images.time_s) or image_kind != self._image_kind:
            self._is_following = False
        self._time_s, self._image_kind = images.time_s, image_kind
        if not self._is_following:
            return self._restart(images, self._detector.detect(images))
        followed = self._tracker.follow(images, _NO_BOXES)
        lost = [eye for eye in EYES if followed.of(eye) is None]
        self._misses = {eye: self._misses.get(eye, 0) + 1 for eye in lost}
        self._since_detection += 1
        if not self._wants_detector(lost):
            return followed
        found, self._since_detection = self._detector.detect(images), 0
        both = [eye for eye in EYES if eye not in lost and found.of(eye) is not None]
        if len(lost) == len(EYES) or any(not _both_show_same(followed.of(eye), found.of(eye)) for eye in both):
            return self._restart(images, found)
        new = {eye: found.of(eye) for eye in lost}
        if any(new.values()):
            self._tracker.correct(images, StereoDetection(new.get("left"), new.get("right")))
        return StereoDetection(followed.left or new.get("left"), followed.right or new.get("right"))

    def candidates(self, images: StereoImages, least_score: float) -> dict[Eye, tuple[Detection, ...]]:
        """See `Detector`; at most one for each eye."""
        found = self.detect(images)
        best = {eye: found.of(eye) for eye in EYES}
        return {eye: (one,) if one is not None and one.score >= least_score else () for eye, one in best.items()}

    def _wants_detector(self, lost: list[Eye]) -> bool:
        if len(lost) == len(EYES) or self._since_detection >= REDETECT_EVERY:
            return True
        late_misses = [self._misses[eye] - _FIRST_RETRY for eye in lost]
        return any(each >= 0 and each % _RETRY_EVERY == 0 for each in late_misses)

    def _restart(self, images: StereoImages, found: StereoDetection) -> StereoDetection:
        """The detector's boxes, from which the tracker starts anew."""
        self._is_following = found != _NO_BOXES
        self._misses, self._since_detection = {}, 0
        if self._is_following:
            self._tracker.start(images, found)
        return found


def tracked_detector_factory(
    detector_of: Callable[[DrogueParameters], Detector], tracker: str
) -> Callable[[DrogueParameters], Detector]:
    """A factory of tracked detectors, which returns the same one while the drogue stays the same.

    Args:
        detector_of: factory of the detector that starts the tracker.
        tracker: one of `nav.tracking.tracker.tracker_names`.

    Raises:
        ValueError: no such tracker.
    """
    open_tracker(tracker)
    last: list[tuple[DrogueParameters, TrackedDetector]] = []

    def open_detector(drogue: DrogueParameters) -> Detector:
        if not last or last[0][0] != drogue:
            last[:] = [(drogue, TrackedDetector(detector_of(drogue), open_tracker(tracker)))]
        return last[0][1]

    return open_detector


def _both_show_same(one: Detection | None, other: Detection | None) -> bool:
    return one is not None and other is not None and is_same_place(one.box_xywh_px, other.box_xywh_px)
