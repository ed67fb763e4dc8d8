"""Work on both eyes side by side."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import TypeVar

from geometry.stereo import Eye

Result = TypeVar("Result")
_NAME = "other-eye"
# For smaller parts of an image the handover to another thread takes as long as the work itself.
_LEAST_THREADED_AREA_PX2 = 1e5


def map_eyes(work: Callable[[Eye], Result], eyes: Collection[Eye], area_px2: float) -> dict[Eye, Result]:
    """Apply a function to each eye; the second eye runs in a thread of its own where that is quicker.

    OpenCV, compiled loops, and numpy on large arrays release the interpreter lock meanwhile.

    Args:
        work: may run for both eyes at the same time; has ended for both when this returns or raises.
        eyes: one or both.
        area_px2: of the part of an image that is worked on, the larger of both eyes.

    Raises:
        Exception: any exception that `work` raises.
    """
    # In the other thread itself it would wait for itself.
    if area_px2 < _LEAST_THREADED_AREA_PX2 or threading.current_thread().name.startswith(_NAME):
        return {eye: work(eye) for eye in eyes}
    first, *others = eyes
    waiting = {eye: _other_thread().submit(work, eye) for eye in others}
    try:
        results = {first: work(first)}
        for eye, result in waiting.items():
            # What has not begun waits for another caller's work, and is quicker here.
            results[eye] = work(eye) if result.cancel() else result.result()
        return results
    finally:
        wait([result for result in waiting.values() if not result.cancel()])


@cache
def _other_thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix=_NAME)


# A forked process has no threads but takes over what its parent knew of them.
os.register_at_fork(after_in_child=_other_thread.cache_clear)
