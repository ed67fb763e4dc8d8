"""Stereo pairs in the order of time: regions, markers, the pose by every method, and its filtered motion.

The navigator gets the images, time stamps, rig and drogue of each pair and nothing else. A jump of the time stamps
begins a new sequence. A pair in which the drogue is not seen gets no pose, even where a filter or a smoother could
predict one from other pairs. An exception within a pair ends the work on that pair alone: it gets no pose, with the
exception as the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter

from datasets_manifest.storage.blind import BlindPair
from datasets_manifest.storage.pair_faults import fault_reason
from datasets_manifest.types.estimates import Estimate, NoFix, PoseEstimate
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from geometry.stereo import StereoRig
from nav.detector.detector import Detector
from nav.docking import docking_quantities
from nav.filtering.motion_model import FilterSettings
from nav.filtering.pose_filter import FILTER_SUFFIX, PoseFilter
from nav.filtering.roll_decoder import DecodedRoll, RollDecoder, turned_to, with_decoded_roll, with_own_numbers
from nav.filtering.smoother import SMOOTHER_SUFFIX
from nav.pair_measurement import PairMeasurement
from nav.pair_navigator import RIM_METHODS, CentroidChoice, PairNavigator
from nav.pose.pose_method import NoFixReason
from nav.tracked_detection import TrackedObserver
from nav.tracking.tracker import REDETECT_EVERY, begins_sequence, open_tracker


@dataclass(frozen=True)
class SequenceSettings:
    """What navigation measures and how.

    Attributes:
        methods: names of pose methods.
        centroids: see `PairNavigator`.
        tracker: name of the tracker, or None where the detector looks at every pair.
        redetect_every: the detector checks the tracker every this many pairs.
        filtered: whether to add filtered estimates of each method, named with the suffix `+filter`.
        smoothed: whether to add smoothed estimates of each method, named with the suffix `+smoother`.
        capture_radius_m: of the docking quantities of filtered and smoothed estimates; None for the drogue's own, see
            `nav.docking.capture_radius_m`. [m]
        motion: settings of the filters.
    """

    methods: tuple[str, ...]
    centroids: CentroidChoice = "own"
    tracker: str | None = None
    redetect_every: int = REDETECT_EVERY
    filtered: bool = False
    smoothed: bool = False
    capture_radius_m: float | None = None
    motion: FilterSettings = field(default_factory=FilterSettings)

    def __post_init__(self) -> None:
        if self.redetect_every < 1:
            raise ValueError(f"redetect_every: must be at least 1, got {self.redetect_every}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all estimates: methods with and without suffixes."""
        suffixes = ["", *([FILTER_SUFFIX] if self.filtered else []), *([SMOOTHER_SUFFIX] if self.smoothed else [])]
        return tuple(method + suffix for method in self.methods for suffix in suffixes)


@dataclass(frozen=True, eq=False)
class MeasuredPair:
    """A pair whose markers were measured roughly, before its pose is estimated.

    Attributes:
        pair: the pair.
        navigator: for its rig and drogue.
        measurement: the markers found.
        begins: whether it is the first of a sequence.
        fault: the exception that ended the measurement, or None.
    """

    pair: BlindPair
    navigator: PairNavigator
    measurement: PairMeasurement
    begins: bool
    fault: str | None = None


@dataclass(frozen=True, eq=False)
class PairEstimates:
    """All estimates of one pair.

    Attributes:
        frame_index: of the pair.
        time_s: of its images. [s]
        rig, drogue: of the pair.
        begins: whether it is the first of a sequence.
        estimates: of every method in their order, and then the filtered ones.
        stage_s: seconds by stage, of all methods together. [s]
        latency_s: from the arrival of the pair to these estimates, where pairs arrive at a rate. [s]
        fault: the exception that ended the work on the pair, or None.
    """

    frame_index: int
    time_s: float
    rig: StereoRig
    drogue: DrogueParameters
    begins: bool
    estimates: tuple[Estimate, ...]
    stage_s: dict[str, float]
    latency_s: float | None = None
    fault: str | None = None


@dataclass(frozen=True)
class SkippedPair:
    """A pair that was not worked on.

    Attributes:
        frame_index: of the pair.
        fault: why it cannot be read; None where a newer pair arrived before its turn came.
    """

    frame_index: int
    fault: str | None = None


class SequenceNavigator:
    """Processes pairs in two stages, `measure` and `estimate`.

    Each stage needs the pairs in their order. Without a tracker, `measure` does not depend on what `estimate` did with
    earlier pairs, so the two stages may run at the same time on different pairs. A tracker starts anew where `estimate`
    fails.
    """

    def __init__(self, settings: SequenceSettings, make_detector: Callable[[DrogueParameters], Detector]) -> None:
        """Prepare for the first pair.

        Raises:
            ValueError: the settings name a tracker that does not exist.
        """
        self._settings = settings
        self._make_detector = make_detector
        self._tracker = None if settings.tracker is None else open_tracker(settings.tracker)
        self._scene: tuple[StereoRig, DrogueParameters] | None = None
        self._last_s: float | None = None
        self._navigator: PairNavigator | None = None
        self._observer: TrackedObserver | None = None
        self._filters: dict[str, PoseFilter] = {}
        self._roll_decoder: RollDecoder | None = None
        self._has_failed = False

    @property
    def detects_every_pair(self) -> bool:
        """Whether the detector runs on every pair, without a tracker."""
        return self._tracker is None

    def process(self, pair: BlindPair) -> PairEstimates:
        """Run both stages on the next pair."""
        return self.estimate(self.measure(pair))

    def restart(self) -> None:
        """Begin a new sequence with the next pair to measure, as after a pair that cannot be read."""
        self._last_s = None

    def measure(self, pair: BlindPair) -> MeasuredPair:
        """Find the drogue in the next pair, and measure its markers roughly."""
        scene, time_s = (pair.rig, pair.drogue), pair.images.time_s
        is_same = self._scene is not None and scene[0] is self._scene[0] and scene[1] == self._scene[1]
        begins = not is_same or begins_sequence(self._last_s, time_s)
        self._scene, self._last_s = scene, time_s
        if self._navigator is None or not is_same:
            detector = self._make_detector(pair.drogue)
            self._navigator = PairNavigator(pair.rig, pair.drogue, detector, self._settings.centroids)
            self._observer = self._observer_of(self._navigator, pair)
        elif begins and self._observer is not None:
            self._observer.reset()
        observe = self._navigator.observe if self._observer is None else self._observer.observe
        try:
            return MeasuredPair(pair, self._navigator, observe(pair.images), begins)
        except Exception as error:
            fault = fault_reason(pair.frame_index, error)
        # The tracker may have learnt half of the pair, so the next one begins anew.
        self.restart()
        return MeasuredPair(pair, self._navigator, PairMeasurement(NoFixReason(fault), {}), begins, fault)

    def estimate(self, measured: MeasuredPair) -> PairEstimates:
        """Estimate the pose by every method, and its motion."""
        pair, settings, fault = measured.pair, self._settings, measured.fault
        if self._has_failed:
            measured, self._has_failed = replace(measured, begins=True), False
        try:
            estimates, filtered = self._estimate_all(measured)
        except Exception as error:
            fault = fault_reason(pair.frame_index, error)
            # A filter may have taken half of the pair, so the next one begins anew.
            self._has_failed = True
            if self._tracker is not None:
                self.restart()
            estimates = _without_fix(pair, settings.methods, fault)
            names = [name + FILTER_SUFFIX for name in settings.methods] if settings.filtered else []
            filtered = _without_fix(pair, names, fault)
        return PairEstimates(
            frame_index=pair.frame_index,
            time_s=pair.images.time_s,
            rig=pair.rig,
            drogue=pair.drogue,
            begins=measured.begins,
            estimates=(*estimates, *filtered),
            stage_s=_total_stage_times(estimates, filtered),
            fault=fault,
        )

    def _estimate_all(self, measured: MeasuredPair) -> tuple[list[Estimate], list[Estimate]]:
        """Estimates of a pair by every method, and the filtered ones where they are asked for."""
        pair, settings = measured.pair, self._settings
        estimates = measured.navigator.estimate_measured(
            pair.frame_index, pair.images, measured.measurement, settings.methods
        )
        roll = self._decoded_roll(measured, estimates)
        # The rim leaves the roll open, and so its poses are at none that the markers' symmetry allows.
        rolls = [None if method in RIM_METHODS else roll for method in settings.methods]
        estimates = [
            with_decoded_roll(estimate, pair.drogue, roll) for estimate, roll in zip(estimates, rolls, strict=True)
        ]
        if not settings.filtered:
            return estimates, []
        if measured.begins or not self._filters:
            order = marker_layout(pair.drogue).symmetry_order
            self._filters = {method: PoseFilter(settings.motion, order) for method in settings.methods}
        return estimates, [self._filtered(pair, *each) for each in zip(estimates, rolls, strict=True)]

    def _decoded_roll(self, measured: MeasuredPair, estimates: Sequence[Estimate]) -> DecodedRoll | None:
        """The roll by the blinking of lamps, of the first method that has a pose; None where lamps do not blink."""
        pair = measured.pair
        if pair.drogue.marker_code is None:
            return None
        if measured.begins or self._roll_decoder is None:
            self._roll_decoder = RollDecoder(pair.rig, pair.drogue)
        poses = (
            estimate.left_from_drogue
            for estimate in estimates
            if isinstance(estimate, PoseEstimate) and estimate.method not in RIM_METHODS
        )
        pose = next(poses, None)
        return None if pose is None else self._roll_decoder.decode(pair.images, pose)

    def _observer_of(self, navigator: PairNavigator, pair: BlindPair) -> TrackedObserver | None:
        if self._tracker is None:
            return None
        settings = self._settings
        every = settings.redetect_every
        return TrackedObserver(navigator, self._tracker, pair.rig, pair.drogue, every, settings.motion)

    def _filtered(self, pair: BlindPair, measured: Estimate, roll: DecodedRoll | None) -> Estimate:
        """The filtered estimate with a decoded roll; without a pose where there is no fix or the filter rejects it."""
        method = measured.method + FILTER_SUFFIX
        if isinstance(measured, NoFix):
            return measured.model_copy(update={"method": method})
        start = perf_counter()
        update = self._filters[measured.method].update(pair.images.time_s, measured)
        if update.state is None or not update.accepted:
            stage_s = {**measured.stage_s, "filter": perf_counter() - start}
            return NoFix(
                frame_index=pair.frame_index,
                method=method,
                reason=f"the filter does not take the fix: {update.reason}",
                features=measured.features,
                stage_s=stage_s,
                regions=measured.regions,
            )
        docking = docking_quantities(update.state, pair.rig, pair.drogue, self._settings.capture_radius_m)
        estimate = update.state.to_estimate(pair.frame_index, method, measured)
        estimate = estimate if roll is None else turned_to(estimate, pair.drogue, roll)
        estimate = with_own_numbers(estimate, measured, pair.drogue)
        stage_s = {**measured.stage_s, "filter": perf_counter() - start}
        return estimate.model_copy(update={"docking": docking, "stage_s": stage_s})


def _without_fix(pair: BlindPair, names: Sequence[str], reason: str) -> list[Estimate]:
    return [NoFix(frame_index=pair.frame_index, method=name, reason=reason) for name in names]


def _total_stage_times(measured: Sequence[Estimate], filtered: Sequence[Estimate]) -> dict[str, float]:
    """Seconds by stage of a pair: stages that the methods share count once, each method's own add up. [s]"""
    total: dict[str, float] = {}
    for estimate in measured:
        for stage, spent_s in estimate.stage_s.items():
            total[stage] = max(total.get(stage, 0.0), spent_s)
    for stage, estimates in (("pose", measured), ("filter", filtered)):
        if estimates:
            total[stage] = sum(estimate.stage_s.get(stage, 0.0) for estimate in estimates)
    return total
