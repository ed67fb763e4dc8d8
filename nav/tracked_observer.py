"""Markers of pair after pair where a tracker says that the drogue is; the detector begins, checks and begins again."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

from datasets_manifest.types.estimates import Mode, PoseEstimate, Region
from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from geometry.stereo import EYES, Eye, StereoRig
from nav.detector.detector import StereoDetection
from nav.filtering.motion_model import FilterSettings
from nav.filtering.pose_filter import PoseFilter
from nav.navigator import DETECTOR, Navigator
from nav.pair_measurement import Sighting, regions_of
from nav.pose.pose_method import Solution
from nav.tracking.rim_boxes import rim_boxes
from nav.tracking.tracker import Tracker, is_same_place

_NOWHERE = StereoDetection(None, None)


class TrackedObserver:
    """Observes the pairs of one sequence after the other, with one drogue and one rig.

    The tracker is told where a filter of the markers' rough poses expects the drogue's rim, and afterwards where the
    pair's own rough pose shows it. The detector looks at a pair where nothing is followed, an eye that should see the
    drogue has lost it, or the tracker's boxes show no ring of markers; and at every N-th pair that is followed.
    """

    def __init__(
        self,
        navigator: Navigator,
        tracker: Tracker,
        rig: StereoRig,
        drogue: DrogueParameters,
        redetect_every: int,
        settings: FilterSettings,
    ) -> None:
        """Follow nothing yet.

        Args:
            navigator: measures, and has the detector.
            tracker: follows.
            rig, drogue: of all pairs.
            redetect_every: the detector checks after so many pairs without it.
            settings: of the filter that says where the drogue is to be expected.
        """
        self._navigator, self._tracker = navigator, tracker
        self._rig, self._rim_radius_m = rig, drogue.rim_radius_m
        self._redetect_every = redetect_every
        self._filter = PoseFilter(settings, marker_layout(drogue).symmetry_order)
        self._is_following = False
        self._since_detection = 0

    def reset(self) -> None:
        """Forget everything: another sequence begins."""
        self._filter.reset()
        self._is_following = False

    def observe(self, images: StereoImages) -> Sighting:
        """Measure the markers of the next pair in time."""
        if not self._is_following:
            sighting = self._navigator.observe(images)
            return self._learned(images, sighting, True)
        start = perf_counter()
        state = self._filter.predict(images.time_s)
        expected = _NOWHERE if state is None else rim_boxes(self._rig, self._rim_radius_m, state.left_from_drogue)
        followed = regions_of(self._tracker.follow(images, expected), self._tracker.name)
        stage_s = {"track": perf_counter() - start}
        sighting = _timed(self._navigator.measure(images, followed), stage_s)
        self._since_detection += 1
        expected_eyes = [eye for eye in EYES if state is None or expected.of(eye) is not None]
        has_lost = len(followed) < len(expected_eyes) or sighting.markers[1] == 0
        if has_lost or self._since_detection >= self._redetect_every:
            return self._checked(images, sighting, followed)
        return self._learned(images, sighting, False)

    def _checked(self, images: StereoImages, tracked: Sighting, followed: tuple[Region, ...]) -> Sighting:
        """What the detector's boxes show, where they show more than those of the tracker."""
        start = perf_counter()
        found = regions_of(self._navigator.detector.detect(images), DETECTOR)
        tracked = _timed(tracked, {"detect": perf_counter() - start})
        self._since_detection = 0
        by_eye: dict[Eye, Region] = {region.eye: region for region in followed}
        is_new = any(
            region.eye not in by_eye or not is_same_place(region.box_xywh_px, by_eye[region.eye].box_xywh_px)
            for region in found
        )
        # At the same place a tracker's box may still cut markers off which the detector's has within.
        shows_less = tracked.markers[0] == 0 and bool(found)
        if not (is_new or shows_less):
            return self._learned(images, tracked, False)
        merged = by_eye | {region.eye: region for region in found}
        again = _timed(
            self._navigator.measure(images, tuple(merged[eye] for eye in EYES if eye in merged)), tracked.stage_s
        )
        if again.markers > tracked.markers:
            return self._learned(images, again, True)
        return self._learned(images, replace(tracked, stage_s=again.stage_s), False)

    def _learned(self, images: StereoImages, sighting: Sighting, is_new: bool) -> Sighting:
        """The same, after filter and tracker have learned from it.

        Args:
            images: the pair.
            sighting: in it.
            is_new: whether the tracker is to begin anew.
        """
        sighting = sighting.with_rough()
        if not isinstance(sighting.rough, Solution):
            self._is_following = False
            return sighting
        start = perf_counter()
        rough = _estimate(sighting.rough)
        if not self._filter.update(images.time_s, rough).accepted:
            # The ring of markers is where it was seen, however it came there.
            self._filter.reset()
            self._filter.update(images.time_s, rough)
        boxes = rim_boxes(self._rig, self._rim_radius_m, sighting.rough.left_from_drogue)
        if boxes == _NOWHERE:
            self._is_following = False
        elif is_new or not self._is_following:
            self._tracker.start(images, boxes)
            self._is_following, self._since_detection = True, 0
        else:
            self._tracker.correct(images, boxes)
        return _timed(sighting, {"correct": perf_counter() - start})


def _timed(sighting: Sighting, stage_s: dict[str, float]) -> Sighting:
    """The same with times of further stages, which may have run before."""
    stages = stage_s | {stage: stage_s.get(stage, 0.0) + spent_s for stage, spent_s in sighting.stage_s.items()}
    return replace(sighting, stage_s=stages)


def _estimate(rough: Solution) -> PoseEstimate:
    return PoseEstimate(
        frame_index=0,
        method="rough",
        left_from_drogue=rough.left_from_drogue,
        covariance=rough.covariance,
        modes=tuple(Mode(left_from_drogue=mode.left_from_drogue, weight=mode.weight) for mode in rough.modes),
    )
