"""Pairs in their order: tracker and detector, loss and return, filters and docking, and where sequences begin."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from datasets_manifest.storage.blind import BlindPair
from datasets_manifest.types.estimates import NoFix, PoseEstimate
from datasets_manifest.types.images import StereoImages
from drogue_models.parameters import DrogueParameters
from drogue_models.presets import PRESETS
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES
from nav.detector.detector import Detection, StereoDetection
from nav.detector.ring_detectors import ColorBlobDetector
from nav.filtering.motion_model import FilterSettings
from nav.pair_navigator import PairNavigator
from nav.runner import add_smoothed, open_navigator, process_dataset
from nav.sequence_navigator import SequenceNavigator, SequenceSettings
from nav.tracked_detection import TrackedObserver
from nav.tracking.tracker import tracker_names
from tests.support.painted_pairs import fly_past

DETECTOR = "color-blob"
STEP_M = (0.012, -0.006, -0.02)
HIDDEN = range(4, 8)


class CountedDetector(ColorBlobDetector):
    """Remembers which time stamps it was shown."""

    def __init__(self, drogue: DrogueParameters) -> None:
        super().__init__(drogue)
        self.shown_s = []

    def detect(self, images: StereoImages) -> StereoDetection:
        self.shown_s.append(images.time_s)
        return super().detect(images)


def place(x_m: float, y_m: float, z_m: float) -> RigidTransform:
    return RigidTransform(rotation_from_angles(*np.radians([4, -3, 5])), np.array([x_m, y_m, z_m]))


def way(count: int, start: tuple[float, ...] = (0.0, 0.05, 5.0)) -> list[RigidTransform]:
    """Places of a drogue that comes nearer and moves by some pixels from pair to pair."""
    return [place(*(np.array(start) + k * np.array(STEP_M))) for k in range(count)]


@pytest.fixture(scope="module")
def steady() -> list[BlindPair]:
    """A drogue that is always in view."""
    return fly_past(way(12))


@pytest.fixture(scope="module")
def hidden_places() -> list[RigidTransform | None]:
    """Places of a drogue that hides in the pairs of `HIDDEN` and comes back a ring's width beside where it went."""
    before = HIDDEN.start
    return [*way(before), *(None for _ in HIDDEN), *way(5, start=(0.5, -0.3, 4.8))]


@pytest.fixture(scope="module")
def hidden_flight(hidden_places: list[RigidTransform | None]) -> list[BlindPair]:
    return fly_past(hidden_places)


def answers_by_method(
    pairs: list[BlindPair], settings: SequenceSettings, detector: Any = None
) -> tuple[dict[str, Any], CountedDetector]:
    """{method: [estimate of each pair]} and the detector that was used."""
    shown = CountedDetector(PRESETS["red-8"])
    navigator = SequenceNavigator(settings, lambda drogue: shown)
    found = {name: [] for name in settings.names}
    for estimate in add_smoothed((navigator.process(pair) for pair in pairs), settings):
        found[estimate.method].append(estimate)
    return found, shown


def sources(estimate: PoseEstimate) -> set[str]:
    return {region.source for region in estimate.regions}


@pytest.mark.parametrize("tracker", tracker_names())
def test_a_tracker_finds_the_same_poses_as_the_detector(steady: list[BlindPair], tracker: str) -> None:
    alone, _ = answers_by_method(steady[:8], SequenceSettings(("joint-hub",)))
    followed, detector = answers_by_method(steady[:8], SequenceSettings(("joint-hub",), tracker=tracker))
    for one, other in zip(alone["joint-hub"], followed["joint-hub"], strict=True):
        # Other boxes are other Otsu thresholds, from which the same edges are fitted: a hundredth of a pixel in
        # disparity is 2 mm of depth here, and the fits start that near each other at worst.
        np.testing.assert_allclose(one.left_from_drogue.translation_m, other.left_from_drogue.translation_m, atol=2e-3)
        assert sources(one) == {"detector"}
    assert [sources(estimate) for estimate in followed["joint-hub"]] == [{"detector"}] + 7 * [{tracker}]
    assert detector.shown_s == [0.0]


def test_the_detector_checks_at_every_nth_pair(steady: list[BlindPair]) -> None:
    _, detector = answers_by_method(steady[:10], SequenceSettings(("joint",), tracker="bernoulli", redetect_every=3))
    assert np.rint(25 * np.array(detector.shown_s)).tolist() == [0, 3, 6, 9]


@pytest.mark.parametrize("tracker", [None, *tracker_names()])
def test_a_hidden_drogue_has_no_pose_and_is_found_again(
    hidden_flight: list[BlindPair], hidden_places: list[RigidTransform | None], tracker: str | None
) -> None:
    settings = SequenceSettings(("joint-hub", "paper"), tracker=tracker, filtered=True, smoothed=True)
    found, detector = answers_by_method(hidden_flight, settings)
    for name, estimates in found.items():
        assert [e.frame_index for e in estimates] == list(range(len(hidden_places))), name
        assert all(isinstance(estimates[index], NoFix) for index in HIDDEN), name
        assert all(estimates[index].reason for index in HIDDEN), name
    for index, (where, estimate) in enumerate(zip(hidden_places, found["joint-hub"], strict=True)):
        if where is not None:
            assert isinstance(estimate, PoseEstimate), (index, estimate.reason)
            # Position noise at 5 m is a few millimetres: 0.03 px of disparity are worth 6 mm.
            off_m = estimate.left_from_drogue.translation_m - where.translation_m
            assert np.linalg.norm(off_m) < 0.03
    if tracker is not None:
        # At the first pair, while it is hidden, and when it is there again.
        assert np.rint(25 * np.array(detector.shown_s)).tolist() == [0, *HIDDEN, HIDDEN.stop]


def with_left_half(pair: BlindPair) -> BlindPair:
    left, right = (image[:, :320] for image in (pair.images.left, pair.images.right))
    return replace(pair, images=replace(pair.images, left=left, right=right))


def in_grey(pair: BlindPair) -> BlindPair:
    left, right = (np.ascontiguousarray(image[..., 0]) for image in (pair.images.left, pair.images.right))
    return replace(pair, images=replace(pair.images, left=left, right=right))


@pytest.mark.parametrize("tracker", tracker_names())
def test_a_tracker_starts_anew_where_images_have_other_planes(steady: list[BlindPair], tracker: str) -> None:
    pairs = [*map(in_grey, steady[:2]), *steady[2:4], *map(in_grey, steady[4:6])]
    found, _ = answers_by_method(pairs, SequenceSettings(("joint",), tracker=tracker))
    assert [sources(estimate) for estimate in found["joint"]] == 3 * [{"detector"}, {tracker}]
    assert all(isinstance(estimate, PoseEstimate) for estimate in found["joint"])


@pytest.mark.parametrize("tracker", tracker_names())
def test_a_tracker_never_sees_an_image_of_another_size(steady: list[BlindPair], tracker: str) -> None:
    pairs = [*steady[:2], with_left_half(steady[2]), steady[3]]
    found, _ = answers_by_method(pairs, SequenceSettings(("joint",), tracker=tracker))
    assert found["joint"][2].reason == "the images are 320x480 px, the rig's 640x480 px"
    assert [isinstance(estimate, PoseEstimate) for estimate in found["joint"]] == [True, True, False, True]


class TightTracker:
    """Returns boxes at the right place, so tight that they cut the markers off."""

    name = "tight"

    def start(self, images: StereoImages, found: StereoDetection) -> None:
        """Learn nothing."""

    def correct(self, images: StereoImages, found: StereoDetection) -> None:
        """Learn nothing."""

    def follow(self, images: StereoImages, predicted: StereoDetection) -> StereoDetection:
        tight = []
        for eye in EYES:
            x, y, width, height = predicted.of(eye).box_xywh_px
            # The overlap with the whole box is 0.72 squared, above one half.
            tight.append(Detection((x + 0.14 * width, y + 0.14 * height, 0.72 * width, 0.72 * height), 1.0))
        return StereoDetection(*tight)


def test_where_boxes_at_the_right_place_show_no_markers_those_of_the_detector_count(steady: list[BlindPair]) -> None:
    rig, drogue = steady[0].rig, steady[0].drogue
    navigator = PairNavigator(rig, drogue)
    observer = TrackedObserver(navigator, TightTracker(), rig, drogue, 25, FilterSettings())
    for pair in steady[:4]:
        followed, alone = observer.observe(pair.images), navigator.observe(pair.images)
        assert followed.markers == alone.markers == (8, 16)
        assert {region.source for region in followed.regions} == {"detector"}


def test_a_pair_that_the_filter_does_not_believe_has_a_fix_and_no_filtered_pose(steady: list[BlindPair]) -> None:
    (elsewhere,) = fly_past([place(0.8, 0.3, 6.0)], [steady[7].images.time_s])
    pairs = [*steady[:7], replace(elsewhere, frame_index=7), *steady[8:10]]
    found, _ = answers_by_method(pairs, SequenceSettings(("joint-hub",), filtered=True))
    assert all(isinstance(estimate, PoseEstimate) for estimate in found["joint-hub"])
    stay = [isinstance(estimate, PoseEstimate) for estimate in found["joint-hub+filter"]]
    assert stay == 7 * [True] + [False] + 2 * [True]
    assert found["joint-hub+filter"][7].reason.startswith("the filter does not take the fix: ")
    assert found["joint-hub+filter"][7].features == found["joint-hub"][7].features


@pytest.mark.parametrize(("radius_m", "captured"), [(50.0, True), (1e-6, False)])
def test_filtered_and_smoothed_estimates_tell_of_motion_and_docking(
    steady: list[BlindPair], radius_m: float, captured: bool
) -> None:
    settings = SequenceSettings(("joint-hub",), filtered=True, smoothed=True, capture_radius_m=radius_m)
    found, _ = answers_by_method(steady, settings)
    assert all(e.motion is None and e.docking is None for e in found["joint-hub"])
    for suffix in ("+filter", "+smoother"):
        last = found[f"joint-hub{suffix}"][-1]
        # Within four of the deviations that the filter itself states.
        off_m_s = np.array(last.motion.velocity_m_s) - 25 * np.array(STEP_M)
        assert (np.abs(off_m_s) < 4 * np.sqrt(np.diag(last.motion.covariance)[:3])).all()
        assert last.docking.captured is captured


def test_one_fix_tells_neither_motion_nor_closure(steady: list[BlindPair]) -> None:
    settings = SequenceSettings(("joint-hub",), filtered=True, smoothed=True)
    # One pair alone, and two that begin another sequence.
    found, _ = answers_by_method(restamped(steady[:3], [0.0, 10.0, 10.04]), settings)
    for suffix, known in (("+filter", [False, False, True]), ("+smoother", [False, True, True])):
        for estimate, knows in zip(found[f"joint-hub{suffix}"], known, strict=True):
            assert (estimate.motion is not None) is knows
            assert (estimate.docking.closure_m_s is not None) is knows
            assert estimate.docking.mouth_from_tip_m[0] > 0


def test_a_filter_of_a_method_without_covariance_says_so(steady: list[BlindPair]) -> None:
    found, _ = answers_by_method(steady[:2], SequenceSettings(("mean-plane",), filtered=True))
    assert isinstance(found["mean-plane"][0], PoseEstimate)
    assert "no covariance" in found["mean-plane+filter"][0].reason


def restamped(pairs: list[BlindPair], times_s: list[float]) -> list[BlindPair]:
    return [
        replace(pair, images=replace(pair.images, time_s=time_s)) for pair, time_s in zip(pairs, times_s, strict=True)
    ]


def test_sequences_begin_where_time_stamps_jump(steady: list[BlindPair]) -> None:
    pairs = restamped(steady[:8], [0.0, 0.04, 1.04, 2.05, 2.09, 2.09, 1.0, 1.04])
    navigator = open_navigator(SequenceSettings(("constant",)), DETECTOR)
    begins = [navigator.measure(pair).begins for pair in pairs]
    assert begins == [True, False, False, True, False, True, True, False]


def test_a_new_sequence_knows_nothing_of_the_one_before(steady: list[BlindPair]) -> None:
    settings = SequenceSettings(("joint-hub",), tracker="bernoulli", filtered=True, smoothed=True)
    times_s = [*(k / 25 for k in range(6)), *(10 + k / 25 for k in range(6))]
    pairs = restamped([*steady[6:], *steady[:6]], times_s)
    both, _ = answers_by_method(pairs, settings)
    alone, _ = answers_by_method(pairs[6:], settings)
    for name in settings.names:
        for one, other in zip(both[name][6:], alone[name], strict=True):
            # Rounding.
            np.testing.assert_allclose(one.left_from_drogue.as_matrix(), other.left_from_drogue.as_matrix(), atol=1e-9)


def test_another_drogue_begins_another_sequence(steady: list[BlindPair]) -> None:
    smaller = PRESETS["red-8"].model_copy(update={"marker_radius_m": 0.049})
    pairs = [*steady[:2], replace(steady[2], drogue=smaller)]
    navigator = open_navigator(SequenceSettings(("constant",), tracker="bernoulli"), DETECTOR)
    assert [navigator.measure(pair).begins for pair in pairs] == [True, False, True]


class DamagedDataset:
    """Pairs in memory, one of which cannot be read."""

    def __init__(self, pairs: list[BlindPair], damaged: int) -> None:
        self._pairs, self._damaged = pairs, damaged
        self.frame_indices = tuple(range(len(pairs)))

    def pair(self, frame_index: int) -> BlindPair:
        if frame_index == self._damaged:
            raise ValueError("frames/000002/left.png: the PNG is truncated")
        return self._pairs[frame_index]


@pytest.mark.parametrize("stage", ["read", "measure", "estimate"])
@pytest.mark.parametrize("tracker", [None, "flow"])
def test_a_bad_pair_ends_the_sequence(
    steady: list[BlindPair], tracker: str | None, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad, calls = 2, []
    name = "measure" if stage == "measure" else "estimate_measured"
    work = getattr(PairNavigator, name)

    def fails_once(*args: Any) -> Any:
        calls.append(args)
        if len(calls) == bad + 1:
            raise RuntimeError("half of the pair is done")
        return work(*args)

    if stage != "read":
        monkeypatch.setattr(PairNavigator, name, fails_once)
    settings = SequenceSettings(("joint",), tracker=tracker, filtered=True)
    dataset = DamagedDataset(steady[:5], bad if stage == "read" else -1)
    answers = list(process_dataset(dataset, SequenceNavigator(settings, ColorBlobDetector)))
    assert [each.fault is not None for each in answers] == [False, False, True, False, False]
    del answers[bad]
    assert [each.begins for each in answers] == [True, False, True, False]
    assert ["track" in each.stage_s for each in answers] == [False, tracker is not None] * 2
    # One fix tells no motion.
    assert [each.estimates[1].motion is not None for each in answers] == [False, True, False, True]


class BrokenDetector(ColorBlobDetector):
    """Has no run time."""

    def detect(self, images: StereoImages) -> StereoDetection:
        raise RuntimeError("the run time of the network failed")


def test_a_fault_is_the_reason_by_every_method(steady: list[BlindPair]) -> None:
    answers = SequenceNavigator(SequenceSettings(("joint", "joint-rim")), BrokenDetector).process(steady[0])
    assert answers.fault == "internal fault, RuntimeError: the run time of the network failed"
    assert [estimate.reason for estimate in answers.estimates] == 2 * [answers.fault]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tracker": "kcf"}, "tracker: must be one of bernoulli"),
        ({"methods": ("magic",)}, "method: there is no pose method named 'magic'"),
        ({"tracker": "mil", "redetect_every": 0}, "redetect_every: must be at least 1, got 0"),
    ],
)
def test_what_cannot_be_asked_for_is_refused_before_the_first_pair(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        open_navigator(SequenceSettings(**{"methods": ("joint",), **settings}), DETECTOR)
