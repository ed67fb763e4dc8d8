"""Navigation in real time: pairs arrive at a rate, and each stage of the work has its own thread.

The camera thread reads the next pair before its arrival time, because a camera delivers pixels and not files. Another
thread detects the drogue and estimates poses; the caller's thread writes the answers. Where the detector runs on every
pair it has a thread of its own, since OpenCV and the network's runtime release the interpreter lock. A tracker runs in
Python, as pose estimation does, and the two would only block each other. A free stage takes the newest pair; older
pairs that wait are late: they are not processed, and answered with that reason.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from queue import Full, Queue
from threading import Condition
from time import monotonic
from typing import Generic, Protocol, TypeVar

from datasets_manifest.storage.blind import BlindPair
from nav.realtime.warm_up import fit_once
from nav.sequence_navigator import LatePair, PairAnswers, SequenceNavigator, SoughtPair

Item = TypeVar("Item")


class NewestFirst(Generic[Item]):
    """A place for one numbered thing; a newer one takes the place of what waits there, which then is late."""

    def __init__(self) -> None:
        """Empty and open."""
        self._changed = Condition()
        self._late: list[int] = []
        self._late_after: list[int] = []
        self._waiting: tuple[int, Item] | None = None
        self._is_closed = False

    def put(self, number: int, item: Item) -> None:
        """Bring the newest thing."""
        with self._changed:
            if self._waiting is not None:
                self._late.append(self._waiting[0])
            self._late += self._late_after
            self._late_after = []
            self._waiting = number, item
            self._changed.notify_all()

    def skip(self, number: int) -> None:
        """Name one, newer than all before, that is not brought: the next one came too early for it."""
        with self._changed:
            (self._late if self._waiting is None else self._late_after).append(number)

    def take(self) -> tuple[tuple[int, ...], Item] | None:
        """Wait for a thing.

        Returns:
            Numbers of those that are late and older than it, ascending and each told once, and the newest; None when
            there will be no more.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._is_closed)
            if self._waiting is None:
                return None
            (_, item), late = self._waiting, tuple(self._late)
            self._waiting, self._late, self._late_after = None, self._late_after, []
            return late, item

    def close(self) -> None:
        """Nothing more is brought."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()


class Handover(Generic[Item]):
    """A place for one thing; whoever brings the next one waits until it is free."""

    def __init__(self) -> None:
        """Empty and open."""
        self._changed = Condition()
        self._waiting: list[Item] = []
        self._is_closed = False

    def wait_free(self) -> bool:
        """Wait until there is room; False when it is closed."""
        with self._changed:
            self._changed.wait_for(lambda: not self._waiting or self._is_closed)
            return not self._is_closed

    def put(self, item: Item) -> None:
        """Bring a thing, once the place is free."""
        with self._changed:
            self._waiting.append(item)
            self._changed.notify_all()

    def take(self) -> Item | None:
        """Wait for a thing; None when there will be no more."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed)
            item = self._waiting.pop() if self._waiting else None
            self._changed.notify_all()
            return item

    def close(self) -> None:
        """Nothing more is brought."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()


# Answers that wait to be written; more hold up the stages, and pairs become late.
_WAITING_ANSWERS = 32
_LOOK_EVERY_S = 0.1


class Clock(Protocol):
    """Tells the time and waits; a test has its own."""

    def now_s(self) -> float:
        """Seconds from any beginning, never backwards. [s]"""
        ...

    def wait_until(self, time_s: float, stop: threading.Event) -> None:
        """Come back at a time, or earlier where `stop` is set."""
        ...


class MonotonicClock:
    """The machine's clock that nobody sets."""

    def now_s(self) -> float:
        """See `Clock`."""
        return monotonic()

    def wait_until(self, time_s: float, stop: threading.Event) -> None:
        """See `Clock`."""
        stop.wait(max(0.0, time_s - monotonic()))


class PairSource(Protocol):
    """Pairs that can be read one by one, such as a `BlindDataset`."""

    frame_indices: tuple[int, ...]

    def pair(self, frame_index: int) -> BlindPair:
        """One stereo pair.

        Raises:
            ValueError: it cannot be read; names the file.
        """
        ...


@dataclass(frozen=True, eq=False)
class _Arrived:
    """A pair, when it came, and how long it took to read it."""

    pair: BlindPair
    came_s: float
    read_s: float


@dataclass(frozen=True, eq=False)
class _Sought:
    """A pair between the stages, and which ones before it are late."""

    late: tuple[int, ...]
    arrived: _Arrived
    found: SoughtPair
    taken_s: float
    done_s: float


def play(
    source: PairSource, navigator: SequenceNavigator, rate_hz: float, clock: Clock
) -> Generator[PairAnswers | LatePair]:
    """Answers to all pairs of a source, which come one after the other at a rate.

    Args:
        source: the pairs, in the order of their indices.
        navigator: before its first pair.
        rate_hz: of the pairs, from the first one on; gaps between sequences are left out. [Hz]
        clock: tells when pairs come.

    Yields:
        In the order of the pairs.

    Raises:
        ValueError: a rate that is not positive, or a pair that cannot be read.
    """
    if not 0 < rate_hz < float("inf"):
        raise ValueError(f"rate_hz: must be positive and finite, got {rate_hz:g}")
    fit_once()
    return _Player(source, navigator, rate_hz, clock).answers()


class _Player:
    """The threads of one play."""

    def __init__(self, source: PairSource, navigator: SequenceNavigator, rate_hz: float, clock: Clock) -> None:
        self._source, self._navigator, self._rate_hz, self._clock = source, navigator, rate_hz, clock
        self._stop = threading.Event()
        self._arrived: NewestFirst[_Arrived] = NewestFirst()
        self._sought: Handover[_Sought] = Handover()
        self._done: Queue[PairAnswers | LatePair | BaseException | None] = Queue(_WAITING_ANSWERS)

    def answers(self) -> Generator[PairAnswers | LatePair]:
        """See `play`."""
        apart = (self._seek, self._solve) if self._navigator.seeks_by_detector else (self._seek_and_solve,)
        stages = (self._read, *apart)
        threads = [threading.Thread(target=self._guarded, args=(stage,), name=stage.__name__) for stage in stages]
        try:
            for thread in threads:
                thread.start()
            while (done := self._done.get()) is not None:
                if isinstance(done, BaseException):
                    raise done
                yield done
        finally:
            self._stop.set()
            self._arrived.close()
            self._sought.close()
            for thread in threads:
                if thread.ident is not None:
                    thread.join()

    def _guarded(self, stage: Callable[[], None]) -> None:
        """A stage whose fault goes to whoever waits for answers."""
        try:
            stage()
        except BaseException as error:
            self._tell(error)

    def _tell(self, done: PairAnswers | LatePair | BaseException | None) -> None:
        while not self._stop.is_set():
            with contextlib.suppress(Full):
                self._done.put(done, timeout=_LOOK_EVERY_S)
                return

    def _read(self) -> None:
        """Read each pair before it comes; after one that took too long, go on with the newest that is in time."""
        indices, start_s, place = self._source.frame_indices, None, 0
        while place < len(indices) and not self._stop.is_set():
            began_s = self._clock.now_s()
            pair = self._source.pair(indices[place])
            read_s = self._clock.now_s() - began_s
            start_s = self._clock.now_s() if start_s is None else start_s
            came_s = start_s + place / self._rate_hz
            self._clock.wait_until(came_s, self._stop)
            self._arrived.put(indices[place], _Arrived(pair, came_s, read_s))
            next_place = max(place + 1, min(self._next_place(start_s, read_s), len(indices) - 1))
            for late in indices[place + 1 : next_place]:
                self._arrived.skip(late)
            place = next_place
        self._arrived.close()

    def _next_place(self, start_s: float, read_s: float) -> int:
        """Of the newest pair that has come, if it can be read before another one comes; else of that one."""
        since = (self._clock.now_s() - start_s) * self._rate_hz
        newest = int(since)
        return newest if since + read_s * self._rate_hz <= newest + 1 else newest + 1

    def _seek(self) -> None:
        # A pair is taken when the next stage has room, so that none grows old between the stages.
        while self._sought.wait_free() and (taken := self._arrived.take()) is not None:
            self._sought.put(self._found(*taken))
        self._sought.close()

    def _solve(self) -> None:
        while not self._stop.is_set() and (sought := self._sought.take()) is not None:
            self._report(sought)
        self._tell(None)

    def _seek_and_solve(self) -> None:
        while not self._stop.is_set() and (taken := self._arrived.take()) is not None:
            self._report(self._found(*taken))
        self._tell(None)

    def _found(self, late: tuple[int, ...], arrived: _Arrived) -> _Sought:
        taken_s = self._clock.now_s()
        found = self._navigator.seek(arrived.pair)
        return _Sought(late, arrived, found, taken_s, self._clock.now_s())

    def _report(self, sought: _Sought) -> None:
        for frame_index in sought.late:
            self._tell(LatePair(frame_index))
        self._tell(self._answered(sought))

    def _answered(self, sought: _Sought) -> PairAnswers:
        arrived, solving_s = sought.arrived, self._clock.now_s()
        answers = self._navigator.solve(sought.found)
        around_s = {
            "read": arrived.read_s,
            "wait": sought.taken_s - arrived.came_s,
            "handover": solving_s - sought.done_s,
        }
        latency_s = self._clock.now_s() - arrived.came_s
        estimates = tuple(
            estimate.model_copy(update={"latency_s": latency_s, "stage_s": around_s | estimate.stage_s})
            for estimate in answers.estimates
        )
        return replace(answers, estimates=estimates, stage_s=around_s | answers.stage_s, latency_s=latency_s)
