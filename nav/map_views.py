"""The same work on both images at once."""

from __future__ import annotations

from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

from geometry.stereo import Eye

Result = TypeVar("Result")


def for_each_eye(work: Callable[[Eye], Result], eyes: Collection[Eye]) -> dict[Eye, Result]:
    """What `work` gives for each eye; of two eyes the second is worked on in a thread of its own.

    OpenCV, and numpy on large arrays, let the other thread run meanwhile.

    Raises:
        Exception: whatever `work` raises.
    """
    first, *others = eyes
    waiting = {eye: _other_thread().submit(work, eye) for eye in others}
    results = {first: work(first)}
    return results | {eye: result.result() for eye, result in waiting.items()}


@cache
def _other_thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="other-eye")
