"""Work on both eyes side by side."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

from geometry.stereo import Eye

Result = TypeVar("Result")
_NAME = "other-eye"


def map_eyes(work: Callable[[Eye], Result], eyes: Collection[Eye]) -> dict[Eye, Result]:
    """Apply a function to each eye; the second eye runs in a thread of its own, unless this is called from there.

    OpenCV, compiled loops, and numpy on large arrays release the interpreter lock meanwhile.

    Raises:
        Exception: any exception that `work` raises.
    """
    if threading.current_thread().name.startswith(_NAME):  # it would wait for itself
        return {eye: work(eye) for eye in eyes}
    first, *others = eyes
    waiting = {eye: _other_thread().submit(work, eye) for eye in others}
    results = {first: work(first)}
    return results | {eye: result.result() for eye, result in waiting.items()}


@cache
def _other_thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix=_NAME)
