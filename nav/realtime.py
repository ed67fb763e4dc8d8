"""Navigation in real time: pairs arrive from a source, and each stage of the work has its own thread.

The source is a running camera, or the replay of a dataset at a rate. Its thread takes the pairs as they arrive. Another
thread detects the drogue and estimates poses; the caller's thread writes the answers. Where the detector runs on every
pair it has a thread of its own, since OpenCV and the network's runtime release the interpreter lock. A tracker runs in
Python, as pose estimation does, and the two would only block each other. A free stage takes the newest pair; older
pairs that wait are late: they are not processed, and answered with that reason.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from functools import cache
from queue import Full, Queue
from threading import Condition
from time import monotonic
from typing import Generic, Protocol, TypeVar

import cv2
import numpy as np

from datasets_manifest.storage.blind import BlindPair
from datasets_manifest.storage.pair_faults import unreadable_reason
from drogue_models.marker_layout import MarkerLayout, marker_layout
from drogue_models.presets import PRESETS
from geometry.stereo import paper_rig
from nav.centroids.annuli import fit_annuli
from nav.centroids.blurred_edges import blurred_step
from nav.centroids.disc_fit import fit_discs
from nav.centroids.ellipses import circles
from nav.centroids.marker_signal import MarkerSignal
from nav.matching.marker_channel import Blobs
from nav.matching.ring_matching import match_ring
from nav.pose.features import stack_features
from nav.pose.joint import solve_one
from nav.pose.marker_geometry import project_markers
from nav.sequence_navigator import MeasuredPair, PairEstimates, SequenceNavigator, SkippedPair
from nav.tracking.pose_predict import learn_constellation
from nav.tracking.region import EyeImage

_RADII_PX = 12.0, 8.0
_SIDE_PX, _MIDDLE_PX = 40, 20.0
_LIGHT_DN = 100.0
_DISTANCE_M = 5.0


@cache
def warm_up_jit() -> None:
    """Run the compiled loops once: fit a drawn disc and a drawn annulus in each eye, and find, follow and place a ring.

    The loops take seconds to compile at their first use on a machine, and tenths of a second to load in every later
    process. In real time, pairs that arrive meanwhile would be late.
    """
    _fit_edges()
    rig, layout = paper_rig(), marker_layout(PRESETS["red-8"])
    pixels = project_markers(rig, layout, np.eye(3)[None], np.array([[0.1, 0.1, _DISTANCE_M]]))
    solve_one(stack_features(rig, layout, pixels, np.eye(2)), np.ones(pixels.shape[1:3], dtype=bool))
    radius_px = rig.camera.fx_px * layout.radius_m / _DISTANCE_M
    _find_and_follow(Blobs(pixels[0, 0], np.full(layout.count, np.pi * radius_px**2)), layout)


def _find_and_follow(markers: Blobs, layout: MarkerLayout) -> None:
    match_ring(markers, layout)
    low_px, high_px = markers.centers_px.min(axis=0), markers.centers_px.max(axis=0)
    x_px, y_px = (low_px - markers.radii_px.max()).tolist()
    side_px = float((high_px - low_px).max() + 2 * markers.radii_px.max())
    picture = np.zeros((int(y_px + 2 * side_px), int(x_px + 2 * side_px)), np.uint8)
    for center_px, marker_px in zip(markers.centers_px, markers.radii_px, strict=True):
        cv2.circle(picture, np.rint(center_px).astype(int).tolist(), round(marker_px), (255,), cv2.FILLED)
    image, box = EyeImage(picture, 0.0), (x_px, y_px, side_px, side_px)
    constellation = learn_constellation(image, box)
    if constellation is not None:
        constellation.find(image, box, _MIDDLE_PX)


def _fit_edges() -> None:
    row = np.arange(_SIDE_PX) - _MIDDLE_PX
    distance = np.hypot(row, row[:, None])
    outer, inner = (
        circles(np.arange(2), np.full((2, 2), _MIDDLE_PX), np.full(2, radius_px)) for radius_px in _RADII_PX
    )
    outside, hole = (
        np.clip(sign * (distance - radius) + 0.5, 0, 1) for sign, radius in zip((1, -1), _RADII_PX, strict=True)
    )
    disc, annulus = (
        MarkerSignal(light.astype(np.float32), light < 0, (0.0, 0.0), 1, True)
        for light in (_LIGHT_DN * (1 - outside), _LIGHT_DN * (1 - outside - hole))
    )
    # The background of small markers is drawn by this function directly.
    blurred_step(disc.values)
    fits = fit_discs([disc, disc], outer)
    if fits.noise is not None:
        fit_annuli([annulus, annulus], outer, inner, fits.noise)


Item = TypeVar("Item")
# Capacity of the queue of answers; when it is full the stages block, and pairs become late.
_WAITING_ANSWERS = 32
_POLL_S = 0.1


class LatestItemQueue(Generic[Item]):
    """A queue of one numbered item; a newer item replaces one that still waits, which is then late."""

    def __init__(self) -> None:
        """Create an empty, open queue."""
        self._changed = Condition()
        self._late: list[int] = []
        self._late_after: list[int] = []
        self._waiting: tuple[int, Item] | None = None
        self._is_closed = False

    def put(self, number: int, item: Item) -> None:
        """Put the newest item, in place of one that waits."""
        with self._changed:
            if self._waiting is not None:
                self._late.append(self._waiting[0])
            self._late += self._late_after
            self._late_after = []
            self._waiting = number, item
            self._changed.notify_all()

    def skip(self, number: int) -> None:
        """Report as late an item, newer than all before, that is never put."""
        with self._changed:
            (self._late if self._waiting is None else self._late_after).append(number)

    def take(self) -> tuple[tuple[int, ...], Item] | None:
        """Wait for an item.

        Returns:
            The numbers of late items older than it, ascending and each reported once, and the newest item; None when
            the queue is closed and empty.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._is_closed)
            if self._waiting is None:
                return None
            (_, item), late = self._waiting, tuple(self._late)
            self._waiting, self._late, self._late_after = None, self._late_after, []
            return late, item

    def take_late(self) -> tuple[int, ...]:
        """The numbers of late items that no item followed, once the queue is closed and empty."""
        with self._changed:
            late, self._late, self._late_after = (*self._late, *self._late_after), [], []
            return late

    def close(self) -> None:
        """Accept no more items."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()


class SingleItemQueue(Generic[Item]):
    """A queue of one item; the producer waits until it is empty before the work on the next item begins."""

    def __init__(self) -> None:
        """Create an empty, open queue."""
        self._changed = Condition()
        self._waiting: list[Item] = []
        self._is_closed = False

    def wait_free(self) -> bool:
        """Wait until the queue is empty; False when it is closed."""
        with self._changed:
            self._changed.wait_for(lambda: not self._waiting or self._is_closed)
            return not self._is_closed

    def put(self, item: Item) -> None:
        """Put an item, once the queue is empty."""
        with self._changed:
            self._waiting.append(item)
            self._changed.notify_all()

    def take(self) -> Item | None:
        """Wait for an item; None when the queue is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed)
            item = self._waiting.pop() if self._waiting else None
            self._changed.notify_all()
            return item

    def close(self) -> None:
        """Accept no more items."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()


class Clock(Protocol):
    """A clock that can wait; tests have their own."""

    def now_s(self) -> float:
        """Monotonic time since an arbitrary moment. [s]"""
        ...

    def wait_until(self, time_s: float, stop: threading.Event) -> None:
        """Return at a time, or earlier when `stop` is set."""
        ...


class MonotonicClock:
    """The machine's monotonic clock."""

    def now_s(self) -> float:
        """See `Clock`."""
        return monotonic()

    def wait_until(self, time_s: float, stop: threading.Event) -> None:
        """See `Clock`."""
        stop.wait(max(0.0, time_s - monotonic()))


@dataclass(frozen=True, eq=False)
class ArrivedPair:
    """A pair that a source delivered.

    Attributes:
        pair: the pair.
        arrived_s: when it arrived, by the clock of the processing. [s]
        read_s: how long making pixels of it took, before or after its arrival. [s]
    """

    pair: BlindPair
    arrived_s: float
    read_s: float


class PairSource(Protocol):
    """Pairs that arrive whether or not anybody is ready for them."""

    def arrivals(self) -> Iterator[ArrivedPair | SkippedPair]:
        """Wait for pairs, and yield each when it has arrived, and those that were skipped, in their order.

        Raises:
            ValueError: a pair cannot be read; names it.
        """
        ...

    def stop(self) -> None:
        """End `arrivals` soon; from any thread."""
        ...


@dataclass(frozen=True, eq=False)
class _MeasuredPair:
    """A pair between measurement and pose estimation, and the frame indices of late pairs before it."""

    late: tuple[int, ...]
    arrival: ArrivedPair
    pair: MeasuredPair
    started_s: float
    finished_s: float


def process_arrivals(
    source: PairSource, navigator: SequenceNavigator, clock: Clock
) -> Generator[PairEstimates | SkippedPair]:
    """Yield the answers to all pairs that arrive from a source, until it ends.

    Args:
        source: of the pairs; stopped when the generator is closed.
        navigator: before its first pair.
        clock: of the pairs' arrival times.

    Yields:
        Answers in the order of the pairs.

    Raises:
        ValueError: the source cannot read a pair, and does not skip it.
    """
    warm_up_jit()
    return _Stages(source, navigator, clock).answers()


class PairStream(Protocol):
    """Stereo pairs that can be read one by one, such as a `BlindDataset`."""

    frame_indices: tuple[int, ...]

    def pair(self, frame_index: int) -> BlindPair:
        """One stereo pair.

        Raises:
            ValueError: it cannot be read; names the file.
        """
        ...


def replay(
    source: PairStream, navigator: SequenceNavigator, rate_hz: float, clock: Clock
) -> Generator[PairEstimates | SkippedPair]:
    """Replay stereo pairs at a rate, and yield the answers to all of them; a pair that cannot be read is skipped.

    Args:
        source: the pairs, in the order of their indices.
        navigator: before its first pair.
        rate_hz: of the pairs, from the first one on; gaps between sequences are left out. [Hz]
        clock: for arrival times and waiting.

    Yields:
        Answers in the order of the pairs.

    Raises:
        ValueError: a rate that is not positive.
    """
    if not 0 < rate_hz < float("inf"):
        raise ValueError(f"rate_hz: must be positive and finite, got {rate_hz:g}")
    return process_arrivals(_Replay(source, rate_hz, clock), navigator, clock)


class _Replay:
    """Pairs of a dataset, which arrive at a rate.

    Each is read before its arrival time, because a camera delivers pixels and not files.
    """

    def __init__(self, source: PairStream, rate_hz: float, clock: Clock) -> None:
        self._source, self._rate_hz, self._clock = source, rate_hz, clock
        self._stop = threading.Event()

    def stop(self) -> None:
        """See `PairSource`."""
        self._stop.set()

    def arrivals(self) -> Iterator[ArrivedPair | SkippedPair]:
        """See `PairSource`. After a slow read, it skips to the newest pair that is in time.

        A pair that cannot be read is skipped with its fault.
        """
        indices, start_s, index = self._source.frame_indices, None, 0
        while index < len(indices) and not self._stop.is_set():
            read_start_s = self._clock.now_s()
            pair, fault = None, None
            try:
                pair = self._source.pair(indices[index])
            except ValueError as error:
                fault = unreadable_reason(indices[index], error)
            read_s = self._clock.now_s() - read_start_s
            start_s = self._clock.now_s() if start_s is None else start_s
            arrived_s = start_s + index / self._rate_hz
            self._clock.wait_until(arrived_s, self._stop)
            yield SkippedPair(indices[index], fault) if pair is None else ArrivedPair(pair, arrived_s, read_s)
            next_index = max(index + 1, min(self._next_index(start_s, read_s), len(indices) - 1))
            for late in indices[index + 1 : next_index]:
                yield SkippedPair(late)
            index = next_index

    def _next_index(self, start_s: float, read_s: float) -> int:
        """Index of the newest pair that has arrived if it can be read before the next arrival, else of the next one."""
        elapsed_pairs = (self._clock.now_s() - start_s) * self._rate_hz
        newest = int(elapsed_pairs)
        return newest if elapsed_pairs + read_s * self._rate_hz <= newest + 1 else newest + 1


class _Stages:
    """Threads of the stages and the queues between them."""

    def __init__(self, source: PairSource, navigator: SequenceNavigator, clock: Clock) -> None:
        self._source, self._navigator, self._clock = source, navigator, clock
        self._stop = threading.Event()
        self._arrived_pairs: LatestItemQueue[ArrivedPair] = LatestItemQueue()
        self._measured_pairs: SingleItemQueue[_MeasuredPair] = SingleItemQueue()
        self._answers: Queue[PairEstimates | SkippedPair | BaseException | None] = Queue(_WAITING_ANSWERS)
        self._unreadable: dict[int, str] = {}

    def answers(self) -> Generator[PairEstimates | SkippedPair]:
        """See `process_arrivals`."""
        workers = (
            (self._measure_stage, self._estimate_stage)
            if self._navigator.detects_every_pair
            else (self._combined_stage,)
        )
        stages = (self._arrival_stage, *workers)
        threads = [threading.Thread(target=self._run_stage, args=(stage,), name=stage.__name__) for stage in stages]
        try:
            for thread in threads:
                thread.start()
            while (answer := self._answers.get()) is not None:
                if isinstance(answer, BaseException):
                    raise answer
                yield answer
        finally:
            self._stop.set()
            self._source.stop()
            self._arrived_pairs.close()
            self._measured_pairs.close()
            for thread in threads:
                if thread.ident is not None:
                    thread.join()

    def _run_stage(self, stage: Callable[[], None]) -> None:
        """Run a stage; its exception is passed to the caller's thread."""
        try:
            stage()
        except BaseException as error:
            self._emit(error)

    def _emit(self, answer: PairEstimates | SkippedPair | BaseException | None) -> None:
        while not self._stop.is_set():
            with contextlib.suppress(Full):
                self._answers.put(answer, timeout=_POLL_S)
                return

    def _arrival_stage(self) -> None:
        for each in self._source.arrivals():
            if isinstance(each, SkippedPair):
                if each.fault is not None:
                    self._unreadable[each.frame_index] = each.fault
                self._arrived_pairs.skip(each.frame_index)
            else:
                self._arrived_pairs.put(each.pair.frame_index, each)
        self._arrived_pairs.close()

    def _measure_stage(self) -> None:
        # A pair is taken only when the next stage is free, so that none ages between the stages.
        while self._measured_pairs.wait_free() and (newest_pair := self._arrived_pairs.take()) is not None:
            self._measured_pairs.put(self._measure(*newest_pair))
        self._measured_pairs.close()

    def _estimate_stage(self) -> None:
        while not self._stop.is_set() and (measured := self._measured_pairs.take()) is not None:
            self._emit_with_late(measured)
        self._emit_end()

    def _combined_stage(self) -> None:
        while not self._stop.is_set() and (newest_pair := self._arrived_pairs.take()) is not None:
            self._emit_with_late(self._measure(*newest_pair))
        self._emit_end()

    def _measure(self, late: tuple[int, ...], arrival: ArrivedPair) -> _MeasuredPair:
        started_s = self._clock.now_s()
        if not self._unreadable.keys().isdisjoint(late):
            self._navigator.restart()
        pair = self._navigator.measure(arrival.pair)
        return _MeasuredPair(late, arrival, pair, started_s, finished_s=self._clock.now_s())

    def _emit_with_late(self, measured: _MeasuredPair) -> None:
        self._emit_skipped(measured.late)
        self._emit(self._estimate(measured))

    def _emit_skipped(self, frame_indices: tuple[int, ...]) -> None:
        for frame_index in frame_indices:
            self._emit(SkippedPair(frame_index, self._unreadable.get(frame_index)))

    def _emit_end(self) -> None:
        self._emit_skipped(self._arrived_pairs.take_late())
        self._emit(None)

    def _estimate(self, measured: _MeasuredPair) -> PairEstimates:
        arrival, taken_s = measured.arrival, self._clock.now_s()
        answers = self._navigator.estimate(measured.pair)
        around_s = {
            "read": arrival.read_s,
            "wait": measured.started_s - arrival.arrived_s,
            "handover": taken_s - measured.finished_s,
        }
        latency_s = self._clock.now_s() - arrival.arrived_s
        estimates = tuple(
            estimate.model_copy(
                update={
                    "latency_s": latency_s,
                    "stage_s": around_s | estimate.stage_s,
                    "time_s": answers.time_s,
                }
            )
            for estimate in answers.estimates
        )
        return replace(answers, estimates=estimates, stage_s=around_s | answers.stage_s, latency_s=latency_s)
