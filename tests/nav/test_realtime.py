"""Replay at a rate: which pairs are processed, which are late, and that threads change no estimate and always end."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest

from datasets_manifest.storage.blind import BlindPair
from datasets_manifest.types.estimates import NoFix, PoseEstimate
from datasets_manifest.types.images import StereoImages
from drogue_models.parameters import DrogueParameters
from drogue_models.presets import PRESETS
from geometry.se3 import RigidTransform, rotation_from_angles
from nav.detector.detector import StereoDetection
from nav.detector.ring_detectors import ColorBlobDetector
from nav.pair_navigator import PairNavigator
from nav.realtime import ArrivedPair, LatestItemQueue, MonotonicClock, SingleItemQueue, process_arrivals, replay
from nav.runner import LATE, add_smoothed, open_navigator
from nav.sequence_navigator import PairEstimates, SequenceNavigator, SequenceSettings, SkippedPair
from tests.support.painted_pairs import fly_past

RATE_HZ = 25.0
PATIENCE_S = 60.0


class DatasetInMemory:
    """Pairs as in a `BlindDataset`; reading one may take time on the test's clock, or fail."""

    def __init__(
        self,
        pairs: list[BlindPair],
        clock: SteppedClock | None = None,
        read_s: dict[int, float] | None = None,
        damaged: Sequence[int] = (),
    ) -> None:
        self._pairs, self._clock, self._read_s, self._damaged = pairs, clock, read_s or {}, damaged
        self.frame_indices = tuple(pair.frame_index for pair in pairs)

    def pair(self, frame_index: int) -> BlindPair:
        if frame_index in self._damaged:
            raise ValueError(f"frames/{frame_index:06d}/left.png: the PNG is truncated")
        if self._clock is not None:
            self._clock.advance(self._read_s.get(frame_index, 0.0))
        return self._pairs[frame_index]


class SteppedClock:
    """A clock that advances only by waiting or by `advance`, never while a pair is processed.

    With `in_turn`, it advances only when all pairs that have arrived are answered.
    """

    def __init__(self, in_turn: bool = True) -> None:
        self._time_s, self._came, self._answered = 1000.0, 0, 0
        self._in_turn = in_turn
        self._changed = threading.Condition()

    def now_s(self) -> float:
        with self._changed:
            return self._time_s

    def advance(self, by_s: float) -> None:
        with self._changed:
            self._changed.wait_for(self._may_go_on, PATIENCE_S)
            self._time_s += by_s

    def _may_go_on(self) -> bool:
        return self._answered == self._came or not self._in_turn

    def answered(self) -> None:
        with self._changed:
            self._answered += 1
            self._changed.notify_all()

    def wait_until(self, time_s: float, stop: Any) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._may_go_on() or stop.is_set(), PATIENCE_S)
            self._came += 1
            self._time_s = max(self._time_s, time_s)


def place(x_m: float, y_m: float, z_m: float) -> RigidTransform:
    return RigidTransform(rotation_from_angles(*np.radians([4, -3, 5])), np.array([x_m, y_m, z_m]))


@pytest.fixture(scope="module")
def pairs() -> list[BlindPair]:
    return fly_past([place(0.02 * k, -0.01 * k, 5.0 - 0.02 * k) for k in range(7)])


@pytest.fixture(autouse=True)
def no_thread_stays() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    # The pool that works on the second eye stays, whoever made it.
    left = [t for t in set(threading.enumerate()) - before if t.is_alive() and not t.name.startswith("other-eye")]
    assert left == []


def stepped(
    pairs: list[BlindPair], settings: SequenceSettings, read_s: dict[int, float] | None = None
) -> list[PairEstimates | SkippedPair]:
    """Estimates of all pairs that arrive by a stepped clock."""
    clock = SteppedClock()
    answers = []
    navigator = open_navigator(settings, "color-blob")
    for each in replay(DatasetInMemory(pairs, clock, read_s), navigator, RATE_HZ, clock):
        answers.append(each)
        if not isinstance(each, SkippedPair):
            clock.answered()
    return answers


@pytest.mark.parametrize("tracker", [None, "bernoulli"])
def test_threads_do_not_change_estimates_of_pairs_in_order(pairs: list[BlindPair], tracker: str | None) -> None:
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


def test_after_a_slow_read_only_the_newest_pair_is_processed(pairs: list[BlindPair]) -> None:
    # Pair 1 is read when pair 3 has come, which could not be read before pair 4 comes; pair 5 when the last one has.
    answers = stepped(pairs, SequenceSettings(("constant",)), {1: 3.2 / RATE_HZ, 5: 10 / RATE_HZ})
    assert [each.frame_index for each in answers] == list(range(7))
    assert [each.frame_index for each in answers if isinstance(each, SkippedPair)] == [2, 3]


def test_latency_starts_at_the_arrival_of_a_pair(pairs: list[BlindPair]) -> None:
    answers = stepped(pairs[:3], SequenceSettings(("constant",), filtered=True), {0: 0.01, 1: 0.06, 2: 0.02})
    # Pair 1 came 0.04 s after pair 0, and was read 0.06 s after it; pair 2 was read before it came.
    assert [each.latency_s for each in answers] == pytest.approx([0.0, 0.02, 0.0])
    assert [each.stage_s["wait"] for each in answers] == pytest.approx([0.0, 0.02, 0.0])
    assert [each.stage_s["read"] for each in answers] == pytest.approx([0.01, 0.06, 0.02])
    for each in answers:
        assert [estimate.latency_s for estimate in each.estimates] == pytest.approx([each.latency_s] * 2)
        assert all(estimate.stage_s["read"] == each.stage_s["read"] for estimate in each.estimates)


def test_smoothed_estimates_have_no_latency(pairs: list[BlindPair]) -> None:
    settings = SequenceSettings(("joint", "constant"), smoothed=True)
    estimates = list(add_smoothed(stepped(pairs[:3], settings), settings))
    assert sum(isinstance(e, PoseEstimate) for e in estimates if e.method == "joint+smoother") == 3
    for estimate in estimates:
        assert (estimate.latency_s is None) == estimate.method.endswith("+smoother")


class HeldDetector(ColorBlobDetector):
    """Takes as long with its first pair as it takes others to come."""

    def __init__(self, drogue: DrogueParameters, others_came: threading.Event) -> None:
        super().__init__(drogue)
        self._others_came = others_came

    def detect(self, images: StereoImages) -> StereoDetection:
        assert self._others_came.wait(PATIENCE_S)
        return super().detect(images)


def test_a_waiting_pair_is_late_when_a_newer_one_arrives(pairs: list[BlindPair]) -> None:
    came = threading.Event()

    class Source(DatasetInMemory):
        def pair(self, frame_index: int) -> BlindPair:
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


@pytest.mark.parametrize("damaged", [0, 2, 6])
def test_an_unreadable_pair_is_told_and_ends_nothing(pairs: list[BlindPair], damaged: int) -> None:
    settings = SequenceSettings(("constant",))
    navigator, clock = open_navigator(settings, "color-blob"), SteppedClock(in_turn=False)
    answers = list(replay(DatasetInMemory(pairs, damaged={damaged}), navigator, RATE_HZ, clock))
    assert [each.frame_index for each in answers] == list(range(len(pairs)))
    message = f"frames/{damaged:06d}/left.png: the PNG is truncated"
    assert [each.frame_index for each in answers if each.fault == message] == [damaged]
    told = [e.frame_index for e in add_smoothed(answers, settings) if isinstance(e, NoFix) and e.reason == message]
    assert told == [damaged]


class InTurn:
    """A source whose next pair arrives when the last one is answered; one pair cannot be read."""

    def __init__(self, pairs: list[BlindPair], damaged: int) -> None:
        self._pairs, self._damaged = pairs, damaged
        self.answered = threading.Semaphore(0)

    def arrivals(self) -> Iterator[ArrivedPair | SkippedPair]:
        for pair in self._pairs:
            if pair.frame_index == self._damaged:
                yield SkippedPair(pair.frame_index, "the PNG is truncated")
            else:
                yield ArrivedPair(pair, arrived_s=0.0, read_s=0.0)
                self.answered.acquire(timeout=PATIENCE_S)

    def stop(self) -> None:
        self.answered.release()


@pytest.mark.parametrize("tracker", [None, "flow"])
@pytest.mark.parametrize("stage", ["read", "estimate"])
def test_a_bad_pair_ends_the_sequence(
    pairs: list[BlindPair], stage: str, tracker: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = PairNavigator.estimate_measured

    def fails(self: PairNavigator, frame_index: int, *args: Any) -> Any:
        if frame_index == 2:
            raise RuntimeError("half of the pair is done")
        return work(self, frame_index, *args)

    if stage == "estimate":
        monkeypatch.setattr(PairNavigator, "estimate_measured", fails)
    source = InTurn(pairs[:5], 2 if stage == "read" else -1)
    navigator = open_navigator(SequenceSettings(("constant",), tracker=tracker), "color-blob")
    begins = {}
    for each in process_arrivals(source, navigator, MonotonicClock()):
        if isinstance(each, PairEstimates):
            source.answered.release()
            if each.fault is None:
                begins[each.frame_index] = each.begins
    assert begins == {0: True, 1: False, 3: True, 4: False}


class FaultyDetector(ColorBlobDetector):
    """Fails at its second pair."""

    def detect(self, images: StereoImages) -> StereoDetection:
        if images.time_s > 0:
            raise RuntimeError("the run time of the network failed")
        return super().detect(images)


@pytest.mark.parametrize("tracker", [None, "flow"])
def test_a_fault_in_a_pair_does_not_end_the_replay(pairs: list[BlindPair], tracker: str | None) -> None:
    clock = SteppedClock()
    settings = SequenceSettings(("constant",), tracker=tracker, redetect_every=1)
    navigator, answers = SequenceNavigator(settings, FaultyDetector), []
    for each in replay(DatasetInMemory(pairs), navigator, RATE_HZ, clock):
        answers.append(each)
        clock.answered()
    assert [each.frame_index for each in answers] == list(range(len(pairs)))
    assert [each.fault for each in answers[:2]] == [
        None,
        "internal fault, RuntimeError: the run time of the network failed",
    ]


@pytest.mark.parametrize("tracker", [None, "flow"])
def test_a_detector_that_cannot_be_made_ends_the_replay_and_all_threads(
    pairs: list[BlindPair], tracker: str | None
) -> None:
    def no_detector(drogue: DrogueParameters) -> ColorBlobDetector:
        raise ValueError("mine.onnx: is no network")

    navigator = SequenceNavigator(SequenceSettings(("constant",), tracker=tracker), no_detector)
    with pytest.raises(ValueError, match=r"mine\.onnx: is no network"):
        list(replay(DatasetInMemory(pairs), navigator, RATE_HZ, SteppedClock(in_turn=False)))


def test_closing_the_generator_stops_the_threads(pairs: list[BlindPair]) -> None:
    clock = MonotonicClock()
    # The second pair would come after an hour.
    answers = replay(
        DatasetInMemory(pairs), open_navigator(SequenceSettings(("constant",)), "color-blob"), 1 / 3600, clock
    )
    assert next(answers).frame_index == 0
    answers.close()


def test_no_pairs_have_no_answers() -> None:
    navigator = open_navigator(SequenceSettings(("constant",)), "color-blob")
    assert list(replay(DatasetInMemory([]), navigator, RATE_HZ, SteppedClock())) == []


@pytest.mark.parametrize("rate_hz", [0.0, -25.0, float("inf"), float("nan")])
def test_an_invalid_rate_is_an_error(rate_hz: float) -> None:
    navigator = SequenceNavigator(SequenceSettings(("constant",)), lambda drogue: ColorBlobDetector(PRESETS["red-8"]))
    with pytest.raises(ValueError, match="rate_hz: must be positive and finite"):
        replay(DatasetInMemory([]), navigator, rate_hz, SteppedClock())


def test_the_newest_item_replaces_older_ones() -> None:
    queue = LatestItemQueue()
    queue.put(0, "item 0")
    queue.skip(1)
    assert queue.take() == ((), "item 0")
    queue.skip(2)
    queue.put(3, "item 3")
    assert queue.take() == ((1, 2), "item 3")
    queue.put(4, "item 4")
    queue.skip(5)
    queue.put(6, "item 6")
    queue.put(7, "item 7")
    queue.close()
    assert queue.take() == ((4, 5, 6), "item 7")
    assert queue.take() is None


def test_a_closed_queue_returns_its_item_first() -> None:
    queue = SingleItemQueue()
    assert queue.wait_free()
    queue.put("last")
    queue.close()
    assert not queue.wait_free()
    assert queue.take() == "last"
    assert queue.take() is None


def test_the_producer_waits_until_the_queue_is_empty() -> None:
    queue, produced = SingleItemQueue(), []

    def produce() -> None:
        for number in range(20):
            if queue.wait_free():
                produced.append(number)
                queue.put(number)

    thread = threading.Thread(target=produce)
    thread.start()
    for number in range(20):
        assert queue.take() == number
        assert len(produced) <= number + 2
    thread.join(PATIENCE_S)
    queue.close()
    assert queue.take() is None
