from __future__ import annotations

import multiprocessing
import threading

import pytest

from geometry.stereo import EYES, Eye
from nav.numerics.eye_threads import map_eyes

LARGE_PX2 = 1e6


def test_the_eyes_are_worked_on_at_the_same_time() -> None:
    both = threading.Barrier(2, timeout=30)  # breaks unless both eyes come to it

    def work(eye: Eye) -> str:
        both.wait()
        return eye.upper()

    assert map_eyes(work, EYES, LARGE_PX2) == {"left": "LEFT", "right": "RIGHT"}
    assert map_eyes(str.upper, ["right"], LARGE_PX2) == {"right": "RIGHT"}


def test_work_on_an_eye_may_work_on_both() -> None:
    lengths = {"left": 4, "right": 5}
    assert map_eyes(lambda _: map_eyes(len, EYES, LARGE_PX2), EYES, LARGE_PX2) == {"left": lengths, "right": lengths}


@pytest.mark.parametrize("failing", EYES)
def test_an_error_of_either_eye_is_raised(failing: Eye) -> None:
    def work(eye: Eye) -> None:
        if eye == failing:
            raise ValueError(eye)

    with pytest.raises(ValueError, match=failing):
        map_eyes(work, EYES, LARGE_PX2)


def test_both_eyes_have_ended_when_one_fails() -> None:
    has_begun, may_end, has_ended = threading.Event(), threading.Event(), threading.Event()

    def work(eye: Eye) -> None:
        if eye == "left":
            assert has_begun.wait(30)
            may_end.set()
            raise ValueError(eye)
        has_begun.set()
        assert may_end.wait(30)
        has_ended.set()

    with pytest.raises(ValueError, match="left"):
        map_eyes(work, EYES, LARGE_PX2)
    assert has_ended.is_set()


def test_a_second_caller_does_not_wait_for_the_first() -> None:
    has_begun, may_end = threading.Event(), threading.Event()

    def slow(eye: Eye) -> None:
        if eye == "right":
            has_begun.set()
        assert may_end.wait(30)

    other = threading.Thread(target=map_eyes, args=(slow, EYES, LARGE_PX2))
    other.start()
    assert has_begun.wait(30)
    assert map_eyes(len, EYES, LARGE_PX2) == {"left": 4, "right": 5}
    assert other.is_alive()
    may_end.set()
    other.join()


def test_small_parts_are_worked_on_in_turn() -> None:
    threads = map_eyes(lambda _: threading.current_thread(), EYES, 1e3)
    assert set(threads.values()) == {threading.current_thread()}


def test_a_forked_process_works_on_both_eyes() -> None:
    map_eyes(len, EYES, LARGE_PX2)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply_async(map_eyes, (len, EYES, LARGE_PX2)).get(60) == {"left": 4, "right": 5}
