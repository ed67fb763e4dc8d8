"""Pairs in the order of time: where the drogue is, its markers, its pose by every method, and its motion.

Nothing is known of the pairs but their images, time stamps, rig and drogue: another sequence begins where time stamps
jump. No pair in which the drogue is not seen gets a pose, whatever a filter or a smoother could tell from other pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter

from datasets_manifest.storage.blind import BlindPair
from datasets_manifest.types.estimates import Estimate, NoFix
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from geometry.stereo import StereoRig
from nav.detector.detector import Detector
from nav.docking import docking_of
from nav.filtering.motion_model import FilterSettings
from nav.filtering.pose_filter import FILTER_SUFFIX, PoseFilter
from nav.filtering.smoother import SMOOTHER_SUFFIX
from nav.navigator import CentroidChoice, Navigator
from nav.pair_measurement import Sighting
from nav.tracked_observer import TrackedObserver
from nav.tracking.tracker import REDETECT_EVERY, begins_sequence, open_tracker


@dataclass(frozen=True)
class SequenceSettings:
    """What is asked of navigation.

    Attributes:
        methods: names of pose methods.
        centroids: see `Navigator`.
        tracker: name of the tracker, or None where the detector looks at every pair.
        redetect_every: the detector checks the tracker at every so many pairs.
        filtered: whether each method also gets filtered estimates, under its name with `+filter`.
        smoothed: whether each method also gets smoothed ones, under its name with `+smoother`.
        capture_radius_m: of the docking quantities, which filtered and smoothed estimates have; None for the drogue's
            own, see `nav.docking.capture_radius_m`. [m]
        motion: of the filters.
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
        """All names under which there are estimates."""
        suffixes = ["", *([FILTER_SUFFIX] if self.filtered else []), *([SMOOTHER_SUFFIX] if self.smoothed else [])]
        return tuple(method + suffix for method in self.methods for suffix in suffixes)


@dataclass(frozen=True, eq=False)
class SoughtPair:
    """A pair whose markers were looked for.

    Attributes:
        pair: the pair.
        navigator: of its rig and drogue.
        sighting: what was found.
        begins: whether it is the first of a sequence.
    """

    pair: BlindPair
    navigator: Navigator
    sighting: Sighting
    begins: bool


@dataclass(frozen=True, eq=False)
class PairAnswers:
    """All answers to one pair.

    Attributes:
        frame_index: of the pair.
        time_s: of its images. [s]
        rig, drogue: as the pair's.
        begins: whether it is the first of a sequence.
        estimates: of every method as it measured, in their order, and then the filtered ones.
        stage_s: seconds by stage, of all methods together. [s]
        latency_s: from the moment at which the pair came until these answers, where pairs come at a rate. [s]
    """

    frame_index: int
    time_s: float
    rig: StereoRig
    drogue: DrogueParameters
    begins: bool
    estimates: tuple[Estimate, ...]
    stage_s: dict[str, float]
    latency_s: float | None = None


@dataclass(frozen=True)
class LatePair:
    """A pair that came while older ones were worked on, and had to make way for a newer one."""

    frame_index: int


class SequenceNavigator:
    """Goes through pairs in two stages, `seek` and `solve`.

    Each stage must be given the pairs in their order. What `seek` does to a pair does not depend on what `solve` did to
    those before it, so that both may be at work at the same time, on different pairs.
    """

    def __init__(self, settings: SequenceSettings, make_detector: Callable[[DrogueParameters], Detector]) -> None:
        """Begin before the first pair.

        Raises:
            ValueError: no such tracker, or nonsense among the settings.
        """
        self._settings = settings
        self._make_detector = make_detector
        self._tracker = None if settings.tracker is None else open_tracker(settings.tracker)
        self._scene: tuple[StereoRig, DrogueParameters] | None = None
        self._last_s: float | None = None
        self._navigator: Navigator | None = None
        self._observer: TrackedObserver | None = None
        self._filters: dict[str, PoseFilter] = {}

    @property
    def seeks_by_detector(self) -> bool:
        """Whether the detector looks at every pair, and no tracker follows."""
        return self._tracker is None

    def answer(self, pair: BlindPair) -> PairAnswers:
        """Both stages of the next pair."""
        return self.solve(self.seek(pair))

    def seek(self, pair: BlindPair) -> SoughtPair:
        """Find the drogue in the next pair, and measure its markers roughly."""
        scene, time_s = (pair.rig, pair.drogue), pair.images.time_s
        is_same = self._scene is not None and scene[0] is self._scene[0] and scene[1] == self._scene[1]
        begins = not is_same or begins_sequence(self._last_s, time_s)
        self._scene, self._last_s = scene, time_s
        if self._navigator is None or not is_same:
            detector = self._make_detector(pair.drogue)
            self._navigator = Navigator(pair.rig, pair.drogue, detector, self._settings.centroids)
            self._observer = self._observer_of(self._navigator, pair)
        elif begins and self._observer is not None:
            self._observer.reset()
        observe = self._navigator.observe if self._observer is None else self._observer.observe
        return SoughtPair(pair, self._navigator, observe(pair.images), begins)

    def solve(self, sought: SoughtPair) -> PairAnswers:
        """The pose by every method, and its motion."""
        pair, settings = sought.pair, self._settings
        measured = sought.navigator.answer(pair.frame_index, pair.images, sought.sighting, settings.methods)
        if sought.begins and settings.filtered:
            order = marker_layout(pair.drogue).symmetry_order
            self._filters = {method: PoseFilter(settings.motion, order) for method in settings.methods}
        filtered = [self._filtered(pair, estimate) for estimate in measured] if settings.filtered else []
        return PairAnswers(
            frame_index=pair.frame_index,
            time_s=pair.images.time_s,
            rig=pair.rig,
            drogue=pair.drogue,
            begins=sought.begins,
            estimates=(*measured, *filtered),
            stage_s=_together(measured, filtered),
        )

    def _observer_of(self, navigator: Navigator, pair: BlindPair) -> TrackedObserver | None:
        if self._tracker is None:
            return None
        settings = self._settings
        every = settings.redetect_every
        return TrackedObserver(navigator, self._tracker, pair.rig, pair.drogue, every, settings.motion)

    def _filtered(self, pair: BlindPair, measured: Estimate) -> Estimate:
        """What the filter makes of a fix; no fix, and one that it does not believe, stay without a pose."""
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
        docking = docking_of(update.state, pair.rig, pair.drogue, self._settings.capture_radius_m)
        estimate = update.state.to_estimate(pair.frame_index, method, measured)
        stage_s = {**measured.stage_s, "filter": perf_counter() - start}
        return estimate.model_copy(update={"docking": docking, "stage_s": stage_s})


def _together(measured: Sequence[Estimate], filtered: Sequence[Estimate]) -> dict[str, float]:
    """Seconds by stage of a pair: what methods share counts once, what each needs for itself adds up. [s]"""
    total: dict[str, float] = {}
    for estimate in measured:
        for stage, spent_s in estimate.stage_s.items():
            total[stage] = max(total.get(stage, 0.0), spent_s)
    for stage, estimates in (("pose", measured), ("filter", filtered)):
        if estimates:
            total[stage] = sum(estimate.stage_s.get(stage, 0.0) for estimate in estimates)
    return total
