from __future__ import annotations

import threading

import pytest

from geometry.stereo import EYES, Eye
from nav.numerics.eye_threads import map_eyes


def test_the_eyes_are_worked_on_at_the_same_time() -> None:
    both = threading.Barrier(2, timeout=30)  # breaks unless both eyes come to it

    def work(eye: Eye) -> str:
        both.wait()
        return eye.upper()

    assert map_eyes(work, EYES) == {"left": "LEFT", "right": "RIGHT"}
    assert map_eyes(str.upper, ["right"]) == {"right": "RIGHT"}


def test_work_on_an_eye_may_work_on_both() -> None:
    lengths = {"left": 4, "right": 5}
    assert map_eyes(lambda _: map_eyes(len, EYES), EYES) == {"left": lengths, "right": lengths}


@pytest.mark.parametrize("failing", EYES)
def test_an_error_of_either_eye_is_raised(failing: Eye) -> None:
    def work(eye: Eye) -> None:
        if eye == failing:
            raise ValueError(eye)

    with pytest.raises(ValueError, match=failing):
        map_eyes(work, EYES)
