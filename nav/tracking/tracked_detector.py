"""A detector that looks only where its tracker has lost the drogue: for pairs that follow each other in time."""

from __future__ import annotations

from collections.abc import Callable

from datasets_manifest.types.images import StereoImages
from drogue_models.parameters import DrogueParameters
from geometry.stereo import EYES, Eye
from nav.detector.detector import Detection, Detector, StereoDetection
from nav.tracking.tracker import REDETECT_EVERY, Tracker, begins_sequence, is_same_place, open_tracker

# The detector is asked at once where both eyes have lost the drogue. Where one has, that is at the second pair in a row
# and every third one from there, for the drogue may be out of one view for long.
_ASKED_AT_MISS, _ASKED_EVERY = 2, 3
_NOWHERE = StereoDetection(None, None)


class TrackedDetector:
    """Answers with a tracker's boxes; a detector starts it, and starts it again.

    Pairs must come in the order of their time. An eye that lost the drogue has no box until it is found again. Now and
    then the detector looks although nothing is lost, for a tracker stays on whatever it was started with.

    Attributes:
        name: of detector and tracker.
    """

    def __init__(self, detector: Detector, tracker: Tracker) -> None:
        self.name = f"{detector.name}+{tracker.name}"
        self._detector, self._tracker = detector, tracker
        self._time_s: float | None = None
        self._kind: tuple[object, ...] = ()
        self._is_following = False
        self._misses: dict[Eye, int] = {}
        self._since_detection = 0

    def detect(self, images: StereoImages) -> StereoDetection:
        """Boxes in the next pair."""
        # What was learned from images of one kind cannot be compared with those of another.
        kind = (images.left.shape, images.bits, images.encoding)
        if begins_sequence(self._time_s, images.time_s) or kind != self._kind:
            self._is_following = False
        self._time_s, self._kind = images.time_s, kind
        if not self._is_following:
            return self._begun(images, self._detector.detect(images))
        followed = self._tracker.follow(images, _NOWHERE)
        lost = [eye for eye in EYES if followed.of(eye) is None]
        self._misses = {eye: self._misses.get(eye, 0) + 1 for eye in lost}
        self._since_detection += 1
        if not self._wants_detector(lost):
            return followed
        found, self._since_detection = self._detector.detect(images), 0
        both = [eye for eye in EYES if eye not in lost and found.of(eye) is not None]
        if len(lost) == len(EYES) or any(not _same_place(followed.of(eye), found.of(eye)) for eye in both):
            return self._begun(images, found)
        new = {eye: found.of(eye) for eye in lost}
        if any(new.values()):
            self._tracker.correct(images, StereoDetection(new.get("left"), new.get("right")))
        return StereoDetection(followed.left or new.get("left"), followed.right or new.get("right"))

    def candidates(self, images: StereoImages, least_score: float) -> dict[Eye, tuple[Detection, ...]]:
        """At most one an eye."""
        found = self.detect(images)
        best = {eye: found.of(eye) for eye in EYES}
        return {eye: (one,) if one is not None and one.score >= least_score else () for eye, one in best.items()}

    def _wants_detector(self, lost: list[Eye]) -> bool:
        if len(lost) == len(EYES) or self._since_detection >= REDETECT_EVERY:
            return True
        past = [self._misses[eye] - _ASKED_AT_MISS for eye in lost]
        return any(each >= 0 and each % _ASKED_EVERY == 0 for each in past)

    def _begun(self, images: StereoImages, found: StereoDetection) -> StereoDetection:
        """The detector's answer, from which the tracker goes on."""
        self._is_following = found != _NOWHERE
        self._misses, self._since_detection = {}, 0
        if self._is_following:
            self._tracker.start(images, found)
        return found


def tracked_detector_factory(
    detector_of: Callable[[DrogueParameters], Detector], tracker: str
) -> Callable[[DrogueParameters], Detector]:
    """What makes a tracked detector of a drogue; the same one as before while the drogue stays the same.

    Args:
        detector_of: makes the detector that starts the tracker.
        tracker: one of `nav.tracking.tracker.tracker_names`.

    Raises:
        ValueError: no such tracker.
    """
    open_tracker(tracker)
    last: list[tuple[DrogueParameters, TrackedDetector]] = []

    def of(drogue: DrogueParameters) -> Detector:
        if not last or last[0][0] != drogue:
            last[:] = [(drogue, TrackedDetector(detector_of(drogue), open_tracker(tracker)))]
        return last[0][1]

    return of


def _same_place(one: Detection | None, other: Detection | None) -> bool:
    return one is not None and other is not None and is_same_place(one.box_xywh_px, other.box_xywh_px)
