"""Pairs of images from streams that run: a bounded queue, partners by time stamp, and what happens when nothing comes.

Each stream is read by a thread of its own, because drivers and sockets may block for as long as they like. Its images
go into a short queue, from which the oldest is dropped when it is full, so that no image ages there. Images become
pixels only when they have a partner.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple, Protocol

import numpy as np

from datasets_manifest.types.images import Pixels
from nav.realtime import Clock

DAMAGED = "damaged"
NOT_NEWER = "not newer than the one before"
UNSTAMPED = "without a time stamp"
_ALONE = "without a partner"
_OVERFLOWED = "that came faster than they could be taken"

# Images that may wait to be paired; a few, so that either view may come first.
_WAITING = 8
# Of a view, from which its period is taken: more than half of the steps must be without a loss.
_KNOWN_TIMES = 10
_POLL_S = 0.1
# How long a stream may take to close; ROS aborts a process that ends before.
_CLOSING_S = 1.0


class LoadedImage(NamedTuple):
    """The pixels of an image.

    Attributes:
        pixels: (H, W, 3) red, green, blue, or (H, W) grey; interpolated from a Bayer mosaic.
        mosaic: (H, W) the raw mosaic where its first row begins with red, green, else None.
    """

    pixels: Pixels
    mosaic: Pixels | None = None


@dataclass(frozen=True, eq=False)
class CapturedImage:
    """One image of a stream.

    Attributes:
        view: 0 for left, 1 for right, None for both views side by side.
        time_s: the stream's time stamp. [s]
        arrived_s: when it was there, by the clock of the processing. [s]
        decode_s: how long decoding has taken so far. [s]
        load: makes pixels of it; raises a ValueError of one line where that fails.
    """

    view: int | None
    time_s: float
    arrived_s: float
    decode_s: float
    load: Callable[[], LoadedImage]


@dataclass(frozen=True, eq=False)
class CapturedPair:
    """One stereo pair.

    Attributes:
        names: of the left and the right image, for messages.
        time_s: its time stamp, the middle of both images'. [s]
        left, right: the images.
        arrived_s: when both images were there. [s]
        read_s: how long it took to make pixels of them. [s]
    """

    names: tuple[str, str]
    time_s: float
    left: LoadedImage
    right: LoadedImage
    arrived_s: float
    read_s: float


class ImageStream(Protocol):
    """A stream of images, used by one thread.

    Attributes:
        name: for messages.
    """

    name: str

    def open(self) -> None:
        """Connect.

        Raises:
            ValueError: it cannot be read, or nothing answers in time; names it.
        """
        ...

    def images(self, stop: threading.Event, left_out: Counter[str]) -> Iterator[CapturedImage]:
        """Images as they come, until the stream ends or soon after `stop` is set; then close it.

        Args:
            stop: set by another thread.
            left_out: counts images that cannot be used, by their reason.

        Raises:
            ValueError: the stream broke, or holds something else than images; names it.
        """
        ...


class StereoSource(Protocol):
    """Where pairs come from.

    Attributes:
        name: for messages.
    """

    name: str

    @property
    def left_out(self) -> Counter[str]:
        """Numbers of images that were not used, by their reason."""
        ...

    def pairs(self) -> Iterator[CapturedPair]:
        """Pairs as they arrive, stamps ascending, until the source ends or soon after `stop`.

        Raises:
            ValueError: the source cannot be opened, broke, or delivers nothing for too long; names it.
        """
        ...

    def stop(self) -> None:
        """End `pairs` soon; from any thread."""
        ...


class VideoPlayback:
    """A recorded stream with both views side by side, played by its time stamps as if a camera delivered it now."""

    def __init__(self, stream: ImageStream, clock: Clock, timeout_s: float) -> None:
        """Play a stream by a clock.

        Args:
            stream: the recording.
            clock: for arrival times.
            timeout_s: longest step from one pair's time stamp to the next. [s]
        """
        self.name = stream.name
        self._left_out: Counter[str] = Counter()
        self._stream, self._clock, self._timeout_s = stream, clock, timeout_s
        self._stop = threading.Event()

    @property
    def left_out(self) -> Counter[str]:
        """See `StereoSource`."""
        return self._left_out

    def stop(self) -> None:
        """See `StereoSource`."""
        self._stop.set()

    def pairs(self) -> Iterator[CapturedPair]:
        """See `StereoSource`."""
        self._stream.open()
        loader, offset_s, last_s = _PairLoader(self._left_out), None, None
        images = self._stream.images(self._stop, self._left_out)
        for image in _ascending(images, lambda: self._left_out.update([NOT_NEWER])):
            pair = loader.load((image,), self._clock)
            if pair is None:
                continue
            step_s = 0.0 if last_s is None else image.time_s - last_s
            if step_s > self._timeout_s:
                raise ValueError(
                    f"{self.name}: no pair came for {self._timeout_s:g} s; the next time stamp is {step_s:.6g} s later"
                )
            last_s = image.time_s
            offset_s = self._clock.now_s() - image.time_s if offset_s is None else offset_s
            # A file that is slow to decode is a slow camera.
            arrived_s = max(image.time_s + offset_s, self._clock.now_s())
            self._clock.wait_until(arrived_s, self._stop)
            if self._stop.is_set():
                return
            yield replace(pair, arrived_s=arrived_s)


class RunningCamera:
    """Streams that deliver whether or not anybody is ready: one with both views side by side, or left and right."""

    def __init__(
        self, name: str, streams: Sequence[ImageStream], clock: Clock, timeout_s: float, tolerance_s: float
    ) -> None:
        """Prepare; streams are opened by the first request for a pair.

        Args:
            name: for messages.
            streams: one or two.
            clock: for arrival times.
            timeout_s: longest wait for a pair. [s]
            tolerance_s: largest difference of the stamps of left and right. [s]
        """
        self.name = name
        # Of the streams' threads and of the one that makes pairs.
        self._unread: Counter[str] = Counter()
        self._unpaired: Counter[str] = Counter()
        self._streams, self._clock = streams, clock
        self._timeout_s, self._tolerance_s = timeout_s, tolerance_s
        self._stop = threading.Event()
        self._changed = threading.Condition()
        self._images: deque[CapturedImage] = deque()
        self._opened, self._ended = 0, False
        self._error: Exception | None = None

    @property
    def left_out(self) -> Counter[str]:
        """See `StereoSource`."""
        with self._changed:
            return self._unread + self._unpaired

    def stop(self) -> None:
        """See `StereoSource`."""
        self._stop.set()

    def pairs(self) -> Iterator[CapturedPair]:
        """See `StereoSource`."""
        # A driver may block for ever, and must not keep the process from ending.
        threads = [
            threading.Thread(target=self._read, args=(stream,), name=f"camera {stream.name}", daemon=True)
            for stream in self._streams
        ]
        try:
            for thread in threads:
                thread.start()
            yield from self._paired()
        finally:
            self._stop.set()
            for thread in threads:
                thread.join(_CLOSING_S)

    def _read(self, stream: ImageStream) -> None:
        """The thread of one stream."""
        left_out: Counter[str] = Counter()
        error: Exception | None = None
        try:
            stream.open()
            with self._changed:
                self._opened += 1
            for image in _ascending(stream.images(self._stop, left_out), self._drop):
                self._put(image, left_out)
        except Exception as fault:  # every fault of this thread belongs to the caller's
            error = fault
        with self._changed:
            self._count(left_out)
            self._ended, self._error = True, self._error or error
            self._changed.notify_all()

    def _drop(self) -> None:
        with self._changed:
            self._unread[NOT_NEWER] += 1

    def _put(self, image: CapturedImage, left_out: Counter[str]) -> None:
        with self._changed:
            self._count(left_out)
            if len(self._images) == _WAITING:
                self._images.popleft()
                self._unread[_OVERFLOWED] += 1
            self._images.append(image)
            self._changed.notify_all()

    def _count(self, left_out: Counter[str]) -> None:
        self._unread.update(left_out)
        left_out.clear()

    def _paired(self) -> Iterator[CapturedPair]:
        pairing, loader = StampPairing(self._tolerance_s, self._unpaired), _PairLoader(self._unpaired)
        last_s, seen, dropped = self._clock.now_s(), 0, 0
        while not self._stop.is_set():
            image = self._take()
            if image is None:
                if self._opened < len(self._streams):
                    last_s = self._clock.now_s()  # opening has a time limit of its own
            else:
                seen += 1
                views = (image,) if image.view is None else pairing.add(image)
                pair = None if views is None else loader.load(views, self._clock)
                if pair is not None:
                    yield pair
                    last_s, seen, dropped = self._clock.now_s(), 0, self.left_out[NOT_NEWER]
            if self._clock.now_s() - last_s > self._timeout_s:
                stuck = self.left_out[NOT_NEWER] - dropped
                told = f"; {stuck} images came whose time stamps do not advance" if stuck else pairing.advice()
                raise ValueError(
                    f"{self.name}: no {'pair' if seen or stuck else 'image'} came for {self._timeout_s:g} s{told}"
                )

    def _take(self) -> CapturedImage | None:
        """The oldest image in the queue, or None where none comes for a moment.

        Raises:
            ValueError: the stream broke or ended.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._images or self._ended, _POLL_S)
            if self._images:
                return self._images.popleft()
            if self._error is not None:
                raise self._error
            if self._ended and not self._stop.is_set():
                raise ValueError(f"{self.name}: the stream ended")
            return None


class StampPairing:
    """Finds images of left and right that were taken together.

    After a loss, the image before or after may be within the tolerance too. So images are a pair only where they differ
    by less than half the period between images of a view; nothing nearer can come then.
    """

    def __init__(self, tolerance_s: float, left_out: Counter[str]) -> None:
        """Start without images.

        Args:
            tolerance_s: largest difference of time stamps. [s]
            left_out: counts images without a partner.
        """
        self._tolerance_s, self._left_out = tolerance_s, left_out
        self._views: tuple[deque[CapturedImage], deque[CapturedImage]] = (deque(), deque())
        self._times_s: tuple[deque[float], deque[float]] = (deque(maxlen=_KNOWN_TIMES), deque(maxlen=_KNOWN_TIMES))

    def add(self, image: CapturedImage) -> tuple[CapturedImage, CapturedImage] | None:
        """Add the next image of its view.

        Returns:
            The left and the right image of a new pair; older images without a partner are dropped. None where images
            wait for their partners: the first ones also for the period, unless their time stamps are equal.
        """
        assert image.view is not None
        self._times_s[image.view].append(image.time_s)
        own = self._views[image.view]
        own.append(image)
        pair = self._nearest()
        if pair is None or not self._are_together(_difference_s(pair)):
            if len(own) > _WAITING:
                own.popleft()
                self._left_out[_ALONE] += 1
            return None
        for view, partner in zip(self._views, pair, strict=True):
            while view.popleft() is not partner:
                self._left_out[_ALONE] += 1
        return pair

    def _nearest(self) -> tuple[CapturedImage, CapturedImage] | None:
        left, right = self._views
        return min(product(left, right), key=_difference_s, default=None)

    def _are_together(self, difference_s: float) -> bool:
        return difference_s == 0 or (difference_s <= self._tolerance_s and 2 * difference_s < self._period_s())

    def _period_s(self) -> float:
        """Of the faster view, whatever images were lost or late; 0 while it is not known. [s]"""
        steps_s = [np.diff(times_s) for times_s in self._times_s if len(times_s) > 1]
        return min((float(np.median(each)) for each in steps_s), default=0.0)

    def advice(self) -> str:
        """What keeps images from becoming pairs, as the end of a sentence; empty where nothing is known."""
        counts = [len(view) for view in self._views]
        if not any(counts):
            return ""
        if not all(counts):
            return f"; only the {'left' if counts[0] else 'right'} camera delivers"
        nearest = self._nearest()
        assert nearest is not None
        difference_s = _difference_s(nearest)
        if difference_s <= self._tolerance_s and self._period_s() == 0:
            return "; a pair of unequal time stamps waits for the next image, which tells the period"
        remedy = ", or allow the difference by --stamp-tolerance-ms" if difference_s > self._tolerance_s else ""
        return (
            f"; the time stamps of left and right differ by {1e3 * difference_s:.3g} ms or more: trigger both cameras "
            f"together{remedy}"
        )


def _difference_s(pair: tuple[CapturedImage, CapturedImage]) -> float:
    return abs(pair[0].time_s - pair[1].time_s)


class _PairLoader:
    """Makes pixels of pairs; after the first pair, images that are damaged are left out."""

    def __init__(self, left_out: Counter[str]) -> None:
        self._left_out = left_out
        self._has_loaded = False

    def load(self, images: Sequence[CapturedImage], clock: Clock) -> CapturedPair | None:
        """The pair of two images, or of one with both views; None where one is damaged.

        Raises:
            ValueError: the first pair cannot be read.
        """
        start_s = clock.now_s()
        try:
            loaded = [image.load() for image in images]
        except ValueError:
            if not self._has_loaded:
                raise
            self._left_out[DAMAGED] += 1
            return None
        self._has_loaded = True
        left, right = loaded if len(loaded) == 2 else _halves(loaded[0])
        return CapturedPair(
            names=("left image", "right image") if len(loaded) == 2 else ("left half", "right half"),
            time_s=float(np.mean([image.time_s for image in images])),
            left=left,
            right=right,
            arrived_s=max(image.arrived_s for image in images),
            read_s=max(image.decode_s for image in images) + clock.now_s() - start_s,
        )


def _halves(both: LoadedImage) -> tuple[LoadedImage, LoadedImage]:
    """The left and the right half of an image; the left one is narrower where the width is odd."""
    middle = both.pixels.shape[1] // 2
    left, right = slice(None, middle), slice(middle, None)
    return _part(both, left), _part(both, right)


def _part(image: LoadedImage, columns: slice) -> LoadedImage:
    mosaic = None if image.mosaic is None else np.ascontiguousarray(image.mosaic[:, columns])
    return LoadedImage(np.ascontiguousarray(image.pixels[:, columns]), mosaic)


def _ascending(images: Iterator[CapturedImage], drop: Callable[[], None]) -> Iterator[CapturedImage]:
    """Images whose stamps are newer than those before of the same view; `drop` is called for each of the others."""
    newest_s: dict[int | None, float] = {}
    for image in images:
        if image.time_s <= newest_s.get(image.view, -np.inf):
            drop()
            continue
        newest_s[image.view] = image.time_s
        yield image
