"""Detection with a tracker over the pairs of a sequence: the detector starts, checks and restarts the tracker.

`TrackedDetector` gives boxes alone. `TrackedObserver` measures markers in the boxes, and tells the tracker where a
filter of their poses expects the drogue.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter

from datasets_manifest.types.estimates import Mode, PoseEstimate, Region
from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from geometry.stereo import EYES, Eye, StereoRig
from nav.detector.detector import Detection, Detector, StereoDetection
from nav.filtering.motion_model import FilterSettings
from nav.filtering.pose_filter import PoseFilter
from nav.pair_measurement import PairMeasurement, regions_of
from nav.pair_navigator import DETECTOR, PairNavigator
from nav.pose.pose_method import Solution
from nav.tracking.region import rim_boxes
from nav.tracking.tracker import (
    MOST_UNCONFIRMED,
    REDETECT_EVERY,
    Tracker,
    begins_sequence,
    is_same_place,
    open_tracker,
)

# Where both eyes have lost the drogue the detector runs at once. Where one has, it runs at the second consecutive miss
# and every third one after it, since the drogue may be out of one view for long.
_FIRST_RETRY, _RETRY_EVERY = 2, 3
_NOWHERE = StereoDetection(None, None)
# Shape, bits and encoding.
_ImageKind = tuple[tuple[int, ...], int, str]


def _image_kind(images: StereoImages) -> _ImageKind:
    """The format of images; the appearance learned from one does not apply to another."""
    return images.left.shape, images.bits, images.encoding


class TrackedDetector:
    """A detector that returns a tracker's boxes; another detector starts and restarts the tracker.

    Pairs must come in the order of their time. An eye that lost the drogue has no box until it is found again. The
    detector also runs at intervals while nothing is lost, since a tracker cannot know that it follows the wrong thing.
    After `MOST_UNCONFIRMED` pairs in which it has found nothing, nothing is followed any more.

    Attributes:
        name: names of detector and tracker, joined by a plus sign.
    """

    def __init__(self, detector: Detector, tracker: Tracker) -> None:
        self.name = f"{detector.name}+{tracker.name}"
        self._detector, self._tracker = detector, tracker
        self._time_s: float | None = None
        self._image_kind: _ImageKind | None = None
        self._is_following = False
        self._misses: dict[Eye, int] = {}
        self._since_detection = self._unconfirmed = 0

    def restart(self) -> None:
        """Let the detector look at the next pair: one between them was lost."""
        self._is_following = False

    def detect(self, images: StereoImages) -> StereoDetection:
        """Boxes in the next pair."""
        image_kind = _image_kind(images)
        if begins_sequence(self._time_s, images.time_s) or image_kind != self._image_kind:
            self._is_following = False
        self._time_s, self._image_kind = images.time_s, image_kind
        if not self._is_following:
            return self._start_from(images, self._detector.detect(images))
        followed = self._tracker.follow(images, _NOWHERE)
        lost = [eye for eye in EYES if followed.of(eye) is None]
        self._misses = {eye: self._misses.get(eye, 0) + 1 for eye in lost}
        self._since_detection, self._unconfirmed = self._since_detection + 1, self._unconfirmed + 1
        if not self._wants_detector(lost):
            return followed
        found, self._since_detection = self._detector.detect(images), 0
        if found != _NOWHERE:
            self._unconfirmed = 0
        elif self._unconfirmed >= MOST_UNCONFIRMED:
            return self._start_from(images, found)
        both = [eye for eye in EYES if eye not in lost and found.of(eye) is not None]
        if len(lost) == len(EYES) or any(not _both_show_same(followed.of(eye), found.of(eye)) for eye in both):
            return self._start_from(images, found)
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

    def _start_from(self, images: StereoImages, found: StereoDetection) -> StereoDetection:
        """The detector's boxes, from which the tracker starts anew."""
        self._is_following = found != _NOWHERE
        self._misses, self._since_detection, self._unconfirmed = {}, 0, 0
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


class TrackedObserver:
    """Measures the pairs of one sequence after the other, with one drogue and one rig.

    For each pair the tracker gets the drogue's rim as a filter of the rough poses predicts it, and afterwards the rim
    by the pair's own rough pose. The detector runs when no drogue is tracked, when the images have another format, when
    an eye that should see the drogue has lost it, when the tracker's boxes show no ring of markers, and at every N-th
    tracked pair.
    """

    def __init__(
        self,
        navigator: PairNavigator,
        tracker: Tracker,
        rig: StereoRig,
        drogue: DrogueParameters,
        redetect_every: int,
        settings: FilterSettings,
    ) -> None:
        """Create an observer that tracks nothing yet.

        Args:
            navigator: measures markers, and holds the detector.
            tracker: follows the drogue's box in each eye.
            rig, drogue: of all pairs.
            redetect_every: the detector checks the tracker after this many pairs without detection.
            settings: of the filter that predicts the drogue's rim.
        """
        self._navigator, self._tracker = navigator, tracker
        self._rig, self._rim_radius_m = rig, drogue.rim_radius_m
        self._redetect_every = redetect_every
        self._filter = PoseFilter(settings, marker_layout(drogue).symmetry_order)
        self._image_kind: _ImageKind | None = None
        self._is_following = False
        self._since_detection = 0

    def reset(self) -> None:
        """Forget the current sequence before another one begins."""
        self._filter.reset()
        self._is_following = False

    def observe(self, images: StereoImages) -> PairMeasurement:
        """Measure the markers of the next pair in time."""
        image_kind = _image_kind(images)
        if image_kind != self._image_kind:
            self._image_kind, self._is_following = image_kind, False
        if not self._is_following:
            measurement = self._navigator.observe(images)
            return self._updated(images, measurement, True)
        start = perf_counter()
        state = self._filter.predict(images.time_s)
        expected = _NOWHERE if state is None else rim_boxes(self._rig, self._rim_radius_m, state.left_from_drogue)
        followed = regions_of(self._tracker.follow(images, expected), self._tracker.name)
        stage_s = {"track": perf_counter() - start}
        measurement = _with_stage_times(self._navigator.measure(images, followed), stage_s)
        self._since_detection += 1
        expected_eyes = [eye for eye in EYES if state is None or expected.of(eye) is not None]
        has_lost = len(followed) < len(expected_eyes) or measurement.markers[1] == 0
        if has_lost or self._since_detection >= self._redetect_every:
            return self._checked(images, measurement, followed)
        return self._updated(images, measurement, False)

    def _checked(self, images: StereoImages, tracked: PairMeasurement, followed: tuple[Region, ...]) -> PairMeasurement:
        """The measurement in the detector's boxes where they show more markers than the tracker's."""
        start = perf_counter()
        found = regions_of(self._navigator.detector.detect(images), DETECTOR)
        tracked = _with_stage_times(tracked, {"detect": perf_counter() - start})
        self._since_detection = 0
        by_eye: dict[Eye, Region] = {region.eye: region for region in followed}
        is_new = any(
            region.eye not in by_eye or not is_same_place(region.box_xywh_px, by_eye[region.eye].box_xywh_px)
            for region in found
        )
        # At the same place the tracker's box may cut off markers that the detector's box contains.
        shows_less = tracked.markers[0] == 0 and bool(found)
        if not (is_new or shows_less):
            return self._updated(images, tracked, False)
        merged = by_eye | {region.eye: region for region in found}
        again = _with_stage_times(
            self._navigator.measure(images, tuple(merged[eye] for eye in EYES if eye in merged)), tracked.stage_s
        )
        if again.markers > tracked.markers:
            return self._updated(images, again, True)
        return self._updated(images, replace(tracked, stage_s=again.stage_s), False)

    def _updated(self, images: StereoImages, measurement: PairMeasurement, is_new: bool) -> PairMeasurement:
        """Update filter and tracker with a measurement, and return it with its rough pose.

        Args:
            images: the pair.
            measurement: of the pair.
            is_new: whether the tracker starts anew.
        """
        measurement = measurement.with_rough()
        if not isinstance(measurement.rough, Solution):
            self._is_following = False
            return measurement
        start = perf_counter()
        rough = _estimate(measurement.rough)
        if not self._filter.update(images.time_s, rough).accepted:
            # The filter rejects the ring that was measured: the measurement counts, and the filter starts from it.
            self._filter.reset()
            self._filter.update(images.time_s, rough)
        boxes = rim_boxes(self._rig, self._rim_radius_m, measurement.rough.left_from_drogue)
        if boxes == _NOWHERE:
            self._is_following = False
        elif is_new or not self._is_following:
            self._tracker.start(images, boxes)
            self._is_following, self._since_detection = True, 0
        else:
            self._tracker.correct(images, boxes)
        return _with_stage_times(measurement, {"correct": perf_counter() - start})


def _with_stage_times(measurement: PairMeasurement, stage_s: dict[str, float]) -> PairMeasurement:
    """A measurement with the times of further stages added, which may have run before."""
    stages = stage_s | {stage: stage_s.get(stage, 0.0) + spent_s for stage, spent_s in measurement.stage_s.items()}
    return replace(measurement, stage_s=stages)


def _estimate(rough: Solution) -> PoseEstimate:
    return PoseEstimate(
        frame_index=0,
        method="rough",
        left_from_drogue=rough.left_from_drogue,
        covariance=rough.covariance,
        modes=tuple(Mode(left_from_drogue=mode.left_from_drogue, weight=mode.weight) for mode in rough.modes),
    )
