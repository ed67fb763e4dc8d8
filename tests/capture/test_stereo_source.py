"""Partners by time stamp, bounded queues, and what is told when nothing comes."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from droguekit.capture.libav_stream import LibavPlace, LibavStream
from droguekit.capture.stereo_source import CapturedImage, LoadedImage, RunningCamera, StampPairing, VideoPlayback
from nav.realtime import MonotonicClock
from tests.support.live_streams import FFV1, encode, serve

PATIENCE_S = 60.0
SMALL = np.zeros((8, 8), np.uint8)


def image(view: int | None, time_s: float) -> CapturedImage:
    return CapturedImage(view, time_s, time_s, 0.0, lambda: LoadedImage(np.full((8, 8), round(100 * time_s), np.uint8)))


def paired(images: Sequence[CapturedImage], tolerance_s: float) -> tuple[list[tuple[float, float]], Counter[str], str]:
    left_out: Counter[str] = Counter()
    pairing = StampPairing(tolerance_s, left_out)
    found = [pair for each in images if (pair := pairing.add(each)) is not None]
    assert all((left.view, right.view) == (0, 1) for left, right in found)
    return [(left.time_s, right.time_s) for left, right in found], left_out, pairing.advice()


def test_either_view_may_come_first_and_lost_images_leave_no_wrong_pair() -> None:
    images = [image(0, 0.0), image(1, 0.0), image(1, 0.1), image(0, 0.1), image(0, 0.2), image(0, 0.3), image(1, 0.3)]
    pairs, left_out, _ = paired(images, 0.001)
    assert pairs == [(0.0, 0.0), (0.1, 0.1), (0.3, 0.3)]
    assert left_out == {"without a partner": 1}


def test_views_of_cameras_that_are_not_triggered_together_are_no_pairs() -> None:
    # Two cameras at 25 Hz, the right one 13 ms later.
    images = [image(view, 0.04 * index + 0.013 * view) for index in range(40) for view in (0, 1)]
    pairs, left_out, advice = paired(images, 0.001)
    assert pairs == []
    assert left_out["without a partner"] > 0
    assert "differ by 13 ms or more: trigger both cameras together" in advice
    pairs, left_out, _ = paired(images, 0.0131)
    assert len(pairs) == 40
    assert all(right - left == pytest.approx(0.013) for left, right in pairs)


@pytest.mark.parametrize("views", [(0, 1), (1, 0)])
@pytest.mark.parametrize("lost", [(0, 0), (1, 0), (0, 3), (1, 3), (1, 7)])
@pytest.mark.parametrize("offset_s", [0.0, 0.013])
def test_after_a_loss_no_image_takes_a_partner_of_the_next_period(
    views: tuple[int, int], lost: tuple[int, int], offset_s: float
) -> None:
    # At 25 Hz neighbours are within the tolerance too.
    taken = [(view, index) for index in range(10) for view in views if (view, index) != lost]
    pairs, left_out, _ = paired([image(view, 0.04 * index + offset_s * view) for view, index in taken], 0.041)
    assert [left for left, _ in pairs] == pytest.approx([0.04 * index for index in range(10) if index != lost[1]])
    assert all(right - left == pytest.approx(offset_s) for left, right in pairs)
    assert left_out == {"without a partner": 1}


def test_images_midway_between_those_of_the_other_view_are_no_pairs() -> None:
    images = [image(view, (2 * index + view) / 64) for index in range(20) for view in (0, 1)]
    pairs, _, advice = paired(images, 0.02)
    assert pairs == []
    assert advice.endswith("differ by 15.6 ms or more: trigger both cameras together")


def test_after_a_pair_the_advice_is_of_what_came_since() -> None:
    pairs, _, advice = paired([image(0, 0.0), image(1, 0.0005), image(0, 0.04), image(1, 0.047)], 0.001)
    assert len(pairs) == 1
    assert "differ by 7 ms or more" in advice


def test_one_silent_camera_is_named() -> None:
    _, left_out, advice = paired([image(1, 0.04 * index) for index in range(40)], 0.001)
    assert advice == "; only the right camera delivers"
    assert left_out["without a partner"] >= 30


class Listed:
    """A stream of given images, which then waits for its end."""

    def __init__(self, name: str, images: Sequence[CapturedImage]) -> None:
        self.name, self._images = name, images

    def open(self) -> None:
        pass

    def images(self, stop: threading.Event, left_out: Counter[str]) -> Iterator[CapturedImage]:
        yield from self._images
        stop.wait(PATIENCE_S)


def test_pairs_of_two_streams_have_ascending_stamps_in_their_middle() -> None:
    left = Listed("left", [image(0, time_s) for time_s in (0.0, 0.04, 0.04, 0.02, 0.08)])
    right = Listed("right", [image(1, time_s) for time_s in (0.002, 0.042, 0.082)])
    camera = RunningCamera("two", [left, right], MonotonicClock(), PATIENCE_S, 0.003)
    pairs = camera.pairs()
    assert [next(pairs).time_s for _ in range(3)] == pytest.approx([0.001, 0.041, 0.081])
    camera.stop()
    assert list(pairs) == []
    assert camera.left_out["not newer than the one before"] == 2


def test_pairs_that_never_come_are_explained_after_the_time_limit() -> None:
    left, right = Listed("left", [image(0, 0.0)]), Listed("right", [image(1, 0.013)])
    camera = RunningCamera("two", [left, right], MonotonicClock(), 0.3, 0.001)
    with pytest.raises(ValueError, match=r"^two: no pair came for 0.3 s; the time stamps .* differ by 13 ms or more"):
        next(camera.pairs())


class Skipping:
    """A clock on which waiting takes no time."""

    time_s = 0.0

    def now_s(self) -> float:
        return self.time_s

    def wait_until(self, time_s: float, stop: threading.Event) -> None:
        self.time_s = time_s


def test_a_video_ends_where_its_next_time_stamp_is_beyond_the_time_limit() -> None:
    # A day later, as by one bad number in a file.
    images = [image(None, time_s) for time_s in (7.0, 11.9, 12.0, 86412.0, 86412.04)]
    pairs = VideoPlayback(Listed("flight.mkv", images), Skipping(), 5.0).pairs()
    assert [next(pairs).time_s for _ in range(3)] == [7.0, 11.9, 12.0]
    with pytest.raises(ValueError, match=r"^flight.mkv: no pair came for 5 s; the next time stamp is 86400 s later$"):
        next(pairs)


class Unstamped(Listed):
    """A stream that gives its last image again and again, as drivers do that stamp none."""

    def images(self, stop: threading.Event, left_out: Counter[str]) -> Iterator[CapturedImage]:
        yield from self._images
        while not stop.wait(1e-3):
            yield self._images[-1]


def test_images_whose_stamps_stand_still_are_told() -> None:
    camera = RunningCamera("one", [Unstamped("one", [image(None, 0.0)])], MonotonicClock(), 0.3, 0.001)
    pairs = camera.pairs()
    assert next(pairs).time_s == 0.0
    with pytest.raises(ValueError, match=r"^one: no pair came for 0.3 s; \d+ images came whose time stamps do not adv"):
        next(pairs)


def test_a_damaged_image_is_left_out_and_the_first_one_refused() -> None:
    def broken() -> LoadedImage:
        raise ValueError("camera: is truncated")

    good = [image(None, 0.04 * index) for index in range(3)]
    bad = CapturedImage(None, 0.05, 0.05, 0.0, broken)
    camera = RunningCamera("one", [Listed("one", [good[0], good[1], bad, good[2]])], MonotonicClock(), PATIENCE_S, 0)
    pairs = camera.pairs()
    assert [next(pairs).time_s for _ in range(3)] == [0.0, 0.04, 0.08]
    pairs.close()
    assert camera.left_out["damaged"] == 1
    camera = RunningCamera("one", [Listed("one", [bad])], MonotonicClock(), PATIENCE_S, 0)
    with pytest.raises(ValueError, match="camera: is truncated"):
        next(camera.pairs())


def test_images_do_not_wait_in_a_queue_while_nobody_takes_them() -> None:
    count = 60
    images = [np.full((8, 16), index, np.uint8) for index in range(count)]
    with serve(lambda wire: encode(wire, [np.dstack([each] * 3) for each in images], FFV1)) as address:
        stream = LibavStream(LibavPlace(address, address, timeout_s=PATIENCE_S), None, MonotonicClock())
        camera = RunningCamera(address, [stream], MonotonicClock(), PATIENCE_S, 0)
        pairs = camera.pairs()
        values = [int(next(pairs).left.pixels[0, 0, 0])]
        for thread in threading.enumerate():
            if thread.name == f"camera {address}":
                thread.join(PATIENCE_S)  # it reads to the end of the stream, whoever takes its images
        with pytest.raises(ValueError, match="the stream ended"):
            values.extend(int(pair.left.pixels[0, 0, 0]) for pair in pairs)
    # What waited are the newest eight.
    assert values[-8:] == list(range(count - 8, count))
    assert len(values) + camera.left_out["that came faster than they could be taken"] == count
