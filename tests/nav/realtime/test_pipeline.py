"""Pairs that come at a rate: what is worked on, what is late, and that threads change no answer and never stay."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from datasets_manifest.types.estimates import NoFix, PoseEstimate
from drogue_models.presets import PRESETS
from geometry.se3 import RigidTransform, rotation_from_angles
from nav.detector.color_blob import ColorBlobDetector
from nav.realtime.pipeline import LatestItemQueue, MonotonicClock, SingleItemQueue, replay
from nav.runner import LATE, add_smoothed, open_navigator
from nav.sequence_navigator import SequenceNavigator, SequenceSettings, SkippedPair

RATE_HZ = 25.0
PATIENCE_S = 60.0


class DatasetInMemory:
    """Pairs as `BlindDataset` has them; reading one may take time by the test's clock, or fail."""

    def __init__(self, pairs, clock=None, read_s=None, damaged=()):
        self._pairs, self._clock, self._read_s, self._damaged = pairs, clock, read_s or {}, damaged
        self.frame_indices = tuple(pair.frame_index for pair in pairs)

    def pair(self, frame_index):
        if frame_index in self._damaged:
            raise ValueError(f"frames/{frame_index:06d}/left.png: the PNG is truncated")
        if self._clock is not None:
            self._clock.advance(self._read_s.get(frame_index, 0.0))
        return self._pairs[frame_index]


class SteppedClock:
    """Time goes on only when somebody waits for it or `advance` is called, never while a pair is worked on.

    With `in_turn`, it does so when all pairs that have come are answered.
    """

    def __init__(self, in_turn=True):
        self._time_s, self._came, self._answered = 1000.0, 0, 0
        self._in_turn = in_turn
        self._changed = threading.Condition()

    def now_s(self):
        with self._changed:
            return self._time_s

    def advance(self, by_s):
        with self._changed:
            self._changed.wait_for(self._may_go_on, PATIENCE_S)
            self._time_s += by_s

    def _may_go_on(self):
        return self._answered == self._came or not self._in_turn

    def answered(self):
        with self._changed:
            self._answered += 1
            self._changed.notify_all()

    def wait_until(self, time_s, stop):
        with self._changed:
            self._changed.wait_for(lambda: self._may_go_on() or stop.is_set(), PATIENCE_S)
            self._came += 1
            self._time_s = max(self._time_s, time_s)


def place(x_m, y_m, z_m):
    return RigidTransform(rotation_from_angles(*np.radians([4, -3, 5])), np.array([x_m, y_m, z_m]))


@pytest.fixture(scope="module")
def pairs(fly):
    return fly([place(0.02 * k, -0.01 * k, 5.0 - 0.02 * k) for k in range(7)])


@pytest.fixture(autouse=True)
def no_thread_stays():
    before = set(threading.enumerate())
    yield
    # The pool that works on the second eye stays, whoever made it.
    left = [t for t in set(threading.enumerate()) - before if t.is_alive() and not t.name.startswith("other-eye")]
    assert left == []


def stepped(pairs, settings, read_s=None):
    """All answers to pairs that a stepped clock lets come."""
    clock = SteppedClock()
    answers = []
    navigator = open_navigator(settings, "color-blob")
    for each in replay(DatasetInMemory(pairs, clock, read_s), navigator, RATE_HZ, clock):
        answers.append(each)
        if not isinstance(each, SkippedPair):
            clock.answered()
    return answers


@pytest.mark.parametrize("tracker", [None, "bernoulli"])
def test_threads_change_no_estimate_of_pairs_that_are_worked_on_in_order(pairs, tracker):
    settings = SequenceSettings(("joint-hub", "paper"), tracker=tracker, filtered=True)
    navigator = open_navigator(settings, "color-blob")
    alone = [navigator.process(pair) for pair in pairs]
    staged = stepped(pairs, settings)
    assert [answers.frame_index for answers in staged] == list(range(len(pairs)))
    for one, other in zip(alone, staged, strict=True):
        for a, b in zip(one.estimates, other.estimates, strict=True):
            assert (a.method, a.status, a.regions) == (b.method, b.status, b.regions)
            # Rounding.
            if isinstance(a, PoseEstimate):
                np.testing.assert_allclose(a.left_from_drogue.as_matrix(), b.left_from_drogue.as_matrix(), atol=1e-9)
            np.testing.assert_allclose([f.center_px for f in a.features], [f.center_px for f in b.features], atol=1e-9)


def test_of_pairs_that_came_while_one_was_read_the_newest_is_worked_on(pairs):
    # Pair 1 is read when pair 3 has come, which could not be read before pair 4 comes; pair 5 when the last one has.
    answers = stepped(pairs, SequenceSettings(("constant",)), {1: 3.2 / RATE_HZ, 5: 10 / RATE_HZ})
    assert [each.frame_index for each in answers] == list(range(7))
    assert [each.frame_index for each in answers if isinstance(each, SkippedPair)] == [2, 3]


def test_latency_counts_from_the_moment_at_which_a_pair_came(pairs):
    answers = stepped(pairs[:3], SequenceSettings(("constant",), filtered=True), {0: 0.01, 1: 0.06, 2: 0.02})
    # Pair 1 came 0.04 s after pair 0, and was read 0.06 s after it; pair 2 was read before it came.
    assert [each.latency_s for each in answers] == pytest.approx([0.0, 0.02, 0.0])
    assert [each.stage_s["wait"] for each in answers] == pytest.approx([0.0, 0.02, 0.0])
    assert [each.stage_s["read"] for each in answers] == pytest.approx([0.01, 0.06, 0.02])
    for each in answers:
        assert [estimate.latency_s for estimate in each.estimates] == pytest.approx([each.latency_s] * 2)
        assert all(estimate.stage_s["read"] == each.stage_s["read"] for estimate in each.estimates)


def test_smoothed_estimates_have_no_latency_for_they_come_when_the_sequence_is_over(pairs):
    settings = SequenceSettings(("joint", "constant"), smoothed=True)
    estimates = list(add_smoothed(stepped(pairs[:3], settings), settings))
    assert sum(isinstance(e, PoseEstimate) for e in estimates if e.method == "joint+smoother") == 3
    for estimate in estimates:
        assert (estimate.latency_s is None) == estimate.method.endswith("+smoother")


class HeldDetector(ColorBlobDetector):
    """Takes as long with its first pair as it takes others to come."""

    def __init__(self, drogue, others_came):
        super().__init__(drogue)
        self._others_came = others_came

    def detect(self, images):
        assert self._others_came.wait(PATIENCE_S)
        return super().detect(images)


def test_a_pair_that_waits_while_a_newer_one_comes_is_late(pairs):
    came = threading.Event()

    class Source(DatasetInMemory):
        def pair(self, frame_index):
            if frame_index == 4:
                came.set()
            return super().pair(frame_index)

    settings = SequenceSettings(("constant",), filtered=True, smoothed=True)
    navigator = SequenceNavigator(settings, lambda drogue: HeldDetector(drogue, came))
    answers = list(replay(Source(pairs[:5]), navigator, RATE_HZ, SteppedClock(in_turn=False)))
    late = [each.frame_index for each in answers if isinstance(each, SkippedPair)]
    assert [each.frame_index for each in answers] == list(range(5))
    # Whichever the detector held: when it was done, all but the newest of the others had waited, or pair 3 was it.
    assert 4 not in late
    assert len(late) >= 2
    estimates = list(add_smoothed(answers, settings))
    for name in settings.names:
        mine = [estimate for estimate in estimates if estimate.method == name]
        assert sorted(estimate.frame_index for estimate in mine) == list(range(5))
        told_late = [e.frame_index for e in mine if isinstance(e, NoFix) and e.reason == LATE]
        assert told_late == late


def test_a_pair_that_cannot_be_read_ends_the_replay_with_its_reason(pairs):
    clock = SteppedClock()
    source = DatasetInMemory(pairs, damaged={2})
    answers = []
    with pytest.raises(ValueError, match=r"frames/000002/left\.png: the PNG is truncated"):
        for each in replay(source, open_navigator(SequenceSettings(("constant",)), "color-blob"), RATE_HZ, clock):
            answers.append(each)
            clock.answered()
    # The pair is read ahead, while the one before may still be worked on.
    assert [each.frame_index for each in answers] in ([0], [0, 1])


class FaultyDetector(ColorBlobDetector):
    """Fails at its second pair."""

    def detect(self, images):
        if images.time_s > 0:
            raise RuntimeError("the run time of the network failed")
        return super().detect(images)


@pytest.mark.parametrize("tracker", [None, "flow"])
def test_a_fault_in_a_stage_ends_the_replay_and_all_threads(pairs, tracker):
    clock = SteppedClock(in_turn=False)
    settings = SequenceSettings(("constant",), tracker=tracker, redetect_every=1)
    navigator = SequenceNavigator(settings, FaultyDetector)
    with pytest.raises(RuntimeError, match="the run time of the network failed"):
        list(replay(DatasetInMemory(pairs), navigator, RATE_HZ, clock))


def test_whoever_stops_listening_stops_the_threads(pairs):
    clock = MonotonicClock()
    # The second pair would come after an hour.
    answers = replay(
        DatasetInMemory(pairs), open_navigator(SequenceSettings(("constant",)), "color-blob"), 1 / 3600, clock
    )
    assert next(answers).frame_index == 0
    answers.close()


def test_no_pairs_have_no_answers():
    navigator = open_navigator(SequenceSettings(("constant",)), "color-blob")
    assert list(replay(DatasetInMemory([]), navigator, RATE_HZ, SteppedClock())) == []


@pytest.mark.parametrize("rate_hz", [0.0, -25.0, float("inf"), float("nan")])
def test_a_rate_that_is_none_is_refused(rate_hz):
    navigator = SequenceNavigator(SequenceSettings(("constant",)), lambda drogue: ColorBlobDetector(PRESETS["red-8"]))
    with pytest.raises(ValueError, match="rate_hz: must be positive and finite"):
        replay(DatasetInMemory([]), navigator, rate_hz, SteppedClock())


def test_the_newest_thing_takes_the_place_of_older_ones():
    place = LatestItemQueue()
    place.put(0, "thing 0")
    place.skip(1)
    assert place.take() == ((), "thing 0")
    place.skip(2)
    place.put(3, "thing 3")
    assert place.take() == ((1, 2), "thing 3")
    place.put(4, "thing 4")
    place.skip(5)
    place.put(6, "thing 6")
    place.put(7, "thing 7")
    place.close()
    assert place.take() == ((4, 5, 6), "thing 7")
    assert place.take() is None


def test_a_handover_gives_what_it_holds_before_it_says_that_there_is_no_more():
    place = SingleItemQueue()
    assert place.wait_free()
    place.put("last")
    place.close()
    assert not place.wait_free()
    assert place.take() == "last"
    assert place.take() is None


def test_whoever_brings_the_next_thing_waits_until_the_place_is_free():
    place, brought = SingleItemQueue(), []

    def bring():
        for number in range(20):
            if place.wait_free():
                brought.append(number)
                place.put(number)

    thread = threading.Thread(target=bring)
    thread.start()
    for number in range(20):
        assert place.take() == number
        assert len(brought) <= number + 2
    thread.join(PATIENCE_S)
    place.close()
    assert place.take() is None
